"""Diagnose the frames of a run, and the run as a whole, and phrase the result.

`semviz_core.diagnosis` gets the run's ids, detector and ground truth. A label whose element is
not in the map may be of any element.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from semviz.runs.metrics import Errors, difference, errors_of
from semviz.runs.run import KNOWN_DIAGNOSES, TRACK, FrameRecord, Run, assumed_detector
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Odometry
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.diagnosis import reference
from semviz_core.diagnosis.confidence import what_tells_apart
from semviz_core.diagnosis.element_statistics import (
    DiagnosedFrame,
    ElementRecord,
    element_records,
)
from semviz_core.diagnosis.fault import (
    FALSE_POSITIVE,
    UNKNOWN_ID,
    Fault,
    FrameDiagnosis,
    GroundTruth,
)
from semviz_core.diagnosis.frame import diagnose_frame
from semviz_core.diagnosis.run import RunDiagnosis, diagnose_run
from semviz_core.localization.residuals import pair_residuals

STARTING_OR_LOST = "starting or lost"
"""Name of a tracked frame without a pose."""


def diagnosis_name(run: Run, record: FrameRecord) -> str:
    """Return the name of a frame's diagnosis; in lists, frames with the same name are one row."""
    truth = truth_of(run, record)
    if record.localization.method == TRACK and record.localization.status == "cannot":
        return STARTING_OR_LOST
    if reference.is_healthy(record.localization, None if truth is None else truth.T_camera_map):
        return "healthy"
    return frame_diagnosis(run, record).kind


def frame_diagnosis(run: Run, record: FrameRecord) -> FrameDiagnosis:
    """Return the diagnosis of a frame, with the ground truth that the run holds."""
    if record not in KNOWN_DIAGNOSES:
        KNOWN_DIAGNOSES[record] = diagnose_frame(
            record.localization, run.semantic_map, truth_of(run, record), detector_of(run)
        )
    return KNOWN_DIAGNOSES[record]


def implicated_elements(run: Run, record: FrameRecord) -> tuple[int, ...]:
    """Return ids of the map elements that a frame's diagnosis is about; none if it is healthy."""
    diagnosis = frame_diagnosis(run, record)
    if diagnosis_name(run, record) != diagnosis.kind:
        return ()
    elements = diagnosis.fault.elements  # a missing element is not in the map
    return tuple(element for element in elements if element in run.semantic_map)


class DetectionErrors(NamedTuple):
    """Missed detections and false positives of a frame."""

    missed_detections: tuple[int, ...]
    """Ids of map elements in view that were not detected; some may be occluded."""
    false_positives: tuple[int, ...]
    """Rows of observed."""


def detection_errors(run: Run, record: FrameRecord) -> DetectionErrors:
    """Return the errors of a detector, real or simulated; none for labels.

    Missed detections are known only with a true pose or status ``ok``.
    """
    if run.info.observations in ("", "labels"):
        return DetectionErrors((), ())
    truth, result = truth_of(run, record), record.localization
    false_positives = tuple(np.flatnonzero(record.element_id == FALSE_POSITIVE).tolist())
    if truth is None and result.status != "ok":
        return DetectionErrors((), false_positives)
    frame = reference.FrameReference.of(result, run.semantic_map, truth, detector_of(run))
    return DetectionErrors(tuple(frame.nearby.id[frame.missed].tolist()), false_positives)


def detector_of(run: Run) -> DetectorModel:
    """Return the assumed rates of the run's detector."""
    return assumed_detector(run.info)


def truth_of(run: Run, record: FrameRecord) -> GroundTruth | None:
    """Return the ground truth of a frame; None without a true pose."""
    pose, ids = record.frame.T_map_camera, record.element_id
    if pose is None:
        return None
    if run.info.observations == "labels":
        ids = np.where(ids < 0, UNKNOWN_ID, ids)
    return GroundTruth(pose.inverse(), ids if (ids >= 0).any() else None)


def run_diagnosis(
    run: Run,
    watch: reference.ProgressCallback = reference.no_progress,
    positions: Sequence[int] | None = None,
) -> RunDiagnosis:
    """Return the faults of camera and map that recur over the frames, or over some of them.

    The results of these are held in memory, all at once.
    """
    rows = range(len(run.frames)) if positions is None else positions
    localized, odometry = [], list[Odometry | None]()
    for row, position in enumerate(rows):
        frame = run.frames[position]  # not kept, because of its images
        localized.append((frame.localization, truth_of(run, frame)))
        is_next = row > 0 and rows[row - 1] == position - 1
        odometry.append(frame.odometry if is_next else None)
    found = diagnose_run(localized, run.semantic_map, detector_of(run), watch, odometry)
    return found if positions is None else found.at(positions)


def run_elements(
    run: Run, watch: reference.ProgressCallback = reference.no_progress
) -> tuple[ElementRecord, ...]:
    """Return every map element in view of some frame; outliers in most frames first."""
    return element_records(_DiagnosedFrames(run), run.semantic_map, detector_of(run), watch)


class _DiagnosedFrames(Sequence[DiagnosedFrame]):
    """The frames of a run with their ground truth and faults, each made when it is needed."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def __len__(self) -> int:
        return len(self._run.frames)

    def __getitem__(self, position: Any) -> Any:
        frame = self._run.frames[position]
        found = frame_diagnosis(self._run, frame)
        faults = (*found.secondary_faults, found.fault)
        return DiagnosedFrame(frame.localization, truth_of(self._run, frame), faults)


LISTED = 2
"""Maximum number of items in a row of the card, which must not scroll."""


@dataclass(frozen=True)
class OtherPose:
    """An alternative pose: its distance from the estimate, and its log-likelihood below it."""

    name: str
    distance_m: float
    angle_deg: float
    gap_nats: float | None


@dataclass(frozen=True)
class DiagnosisCard:
    """The diagnosis of a frame as people read it."""

    title: str
    sentence: str
    confidence: float | None
    """Confidence of the diagnosis; None if the solver's status explains the frame."""
    tells_apart: str
    """What would tell the diagnosis from its rivals; empty if it is sure."""
    implicated: tuple[str, ...]
    """Names of the map elements that the diagnosis blames."""
    rows: tuple[tuple[str, str], ...]
    """Labels and values."""
    alternatives: tuple[OtherPose, ...]
    more_alternatives: int
    times_ms: tuple[tuple[str, float], ...]
    """Runtime by stage."""
    poses_tried: int | None


def diagnosis_sentence(run: Run, record: FrameRecord) -> str:
    """Return the cause, if the diagnosis adds one, and the solver's reason."""
    reason = record.localization.reason
    if not _adds_to_status(run, record):
        return reason
    return f"{frame_diagnosis(run, record).sentence} {reason}"


def diagnosis_card(run: Run, record: FrameRecord, detection: DetectionErrors) -> DiagnosisCard:
    """Return the card of a frame whose detection errors are ``detection``."""
    result, diagnosis = record.localization, frame_diagnosis(run, record)
    estimate, errors = result.T_camera_map, errors_of(record)
    rows = [
        ("Also found", noticed_faults(run, record)),
        *_detection_rows(run, detection),
        *_rows(run, record, errors),
    ]
    listed = 1 if _adds_to_status(run, record) else LISTED  # the diagnosis needs the space
    confidence = diagnosis.confidence if _finds_fault(run, record) else None
    return DiagnosisCard(
        title=diagnosis_name(run, record).capitalize(),
        sentence=diagnosis_sentence(run, record),
        confidence=confidence,
        tells_apart="" if confidence is None else what_tells_apart(diagnosis.kind, confidence),
        implicated=tuple(run.semantic_map.name_of(id) for id in implicated_elements(run, record)),
        rows=tuple(row for row in rows if row[1]),
        alternatives=_alternatives(result)[:listed],
        more_alternatives=0 if estimate is None else max(0, len(result.alternatives) - listed),
        times_ms=tuple(result.time_ms.items()),
        poses_tried=None if result.search is None else result.search.hypotheses,
    )


def _finds_fault(run: Run, record: FrameRecord) -> bool:
    """Whether a frame is named by its diagnosis, and the diagnosis finds a fault."""
    return diagnosis_name(run, record) == frame_diagnosis(run, record).kind != "healthy"


def _adds_to_status(run: Run, record: FrameRecord) -> bool:
    """Whether the diagnosis says more than the solver, whose reason explains ambiguity itself."""
    return _finds_fault(run, record) and frame_diagnosis(run, record).kind != "ambiguous geometry"


def noticed_faults(run: Run, record: FrameRecord) -> str:
    """Return the faults that did no harm to a healthy frame, as far as its diagnosis is known.

    A list may be cut at its end: what concerns the whole frame comes first, then what is furthest
    off.
    """
    diagnosis = KNOWN_DIAGNOSES.get(record)
    if diagnosis is None or diagnosis.kind != "healthy":
        return ""
    of_kind: dict[str, dict[str, str]] = {}
    for fault in sorted(diagnosis.secondary_faults, key=_importance):
        subject, off = _noticed(run.semantic_map, fault)
        of_kind.setdefault(fault.kind, {}).setdefault(subject, f"{subject} {off}".strip())
    return "; ".join(
        f"{kind}: {named}" if (named := ", ".join(filter(None, subjects.values()))) else kind
        for kind, subjects in of_kind.items()
    )


def _noticed(semantic_map: SemanticMap, fault: Fault) -> tuple[str, str]:
    """Return a fault's element or detection, and by how much it is off, if that is in pixels."""
    known = (element for element in fault.elements if element in semantic_map)
    named = [semantic_map.name_of(element) for element in known]
    subject = " and ".join(named or [f"#{row}" for row in fault.rows])
    off_px = _off_px(fault)
    return subject, "" if off_px is None else f"({off_px:.0f} px)"


def _importance(fault: Fault) -> tuple[bool, float]:
    return bool(fault.elements or fault.rows), -(_off_px(fault) or 0.0)


def _off_px(fault: Fault) -> float | None:
    return next((item.value for item in fault.evidence if item.unit == "px"), None)


def _detection_rows(run: Run, detection: DetectionErrors) -> list[tuple[str, str]]:
    missed = [run.semantic_map.name_of(element) for element in detection.missed_detections]
    return [
        ("Missed or occluded", _shortened(missed)),
        ("False positives", _shortened([f"#{row}" for row in detection.false_positives])),
    ]


def _shortened(names: Sequence[str]) -> str:
    """Return the first names, and the number of the others."""
    others = [f"{len(names) - LISTED} more"] if len(names) > LISTED else []
    return ", ".join([*names[:LISTED], *others])


def _rows(run: Run, record: FrameRecord, errors: Errors | None) -> list[tuple[str, str]]:
    result = record.localization
    error = "" if errors is None else f"{errors.distance_m:.2f} m · {errors.angle_deg:.2f}°"
    return [
        ("Error (ground truth)", error),
        ("Seen / pairs / inliers", _counts(result)),
        ("Uncertainty, 1σ", _sigma(result)),
        ("Error of the prior", _prior(record)),
        _outliers(run, record),
    ]


def _outliers(run: Run, record: FrameRecord) -> tuple[str, str]:
    """Return a label and the outliers, worst first: at the true pose or, if it is unknown, among
    the estimated pairs."""
    result, truth = record.localization, record.frame.T_map_camera
    if truth is not None:
        label = "Outliers, true pose"
        pairs = true_pairs(record)
        seen, submap, detector = result.observed, result.submap, detector_of(run)
        fit = pair_residuals(truth.inverse(), result.camera, seen, submap, pairs, detector)
        size_px, inlier = np.sqrt(np.nansum(fit.residual_px**2, axis=1)), fit.inlier
    elif result.refinement is not None:
        label, pairs = "Outliers", result.refinement.pairs
        size_px = np.sqrt(np.nansum(result.refinement.residual_px**2, axis=1))
        inlier = result.refinement.inlier
    else:
        return "", ""
    submap, outliers = result.submap, []
    for row in (row for row in np.argsort(-size_px) if not inlier[row]):
        column = int(pairs[row, 1])
        class_id, id = int(submap.class_id[column]), int(submap.id[column])
        name = run.semantic_map.classes.element_name(class_id, id)
        outliers.append(f"{name} {size_px[row]:.0f} px")
    return label, _shortened(outliers)


def true_pairs(record: FrameRecord) -> IntArray:
    """Return rows (k, 2) of observed and submap that are the same element, by the true ids."""
    rows = {int(id): row for row, id in enumerate(record.localization.submap.id)}
    pairs = [(i, rows[int(id)]) for i, id in enumerate(record.element_id) if int(id) in rows]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _counts(localization: Localization) -> str:
    """Return the numbers of detections, pairs and inliers, and chi2 of the inliers."""
    refinement, detections = localization.refinement, len(localization.observed)
    if refinement is None:
        return f"{detections} / none / none"
    inlier = refinement.inlier
    counts = f"{detections} / {len(refinement.pairs)} / {int(inlier.sum())}"
    return f"{counts} · χ² {np.nansum(refinement.chi2[inlier]):.1f}" if inlier.any() else counts


def _sigma(localization: Localization) -> str:
    if localization.covariance is None:
        return ""
    variance = np.diag(localization.covariance)
    if not np.isfinite(variance).all():
        return ""
    position_m = float(np.sqrt(max(variance[:3].sum(), 0.0)))
    angle_deg = float(np.rad2deg(np.sqrt(max(variance[3:].sum(), 0.0))))
    return f"{position_m:.2f} m · {angle_deg:.2f}°"


def _prior(record: FrameRecord) -> str:
    """Return the prior's distance from the true pose or, if it is unknown, from the estimate."""
    result = record.localization
    center = record.frame.T_map_camera
    if center is None and result.T_camera_map is not None:
        center = result.T_camera_map.inverse()
    if center is None or result.prior is None:
        return ""
    error_m = np.linalg.norm((result.prior.position_m - center.translation)[:2])
    return f"{error_m:.1f} m (σ {result.prior.horizontal_sigma_m:.1f} m)"


def _alternatives(localization: Localization) -> tuple[OtherPose, ...]:
    """Return the first alternative poses; none without an estimate."""
    estimate = localization.T_camera_map
    if estimate is None:
        return ()
    best = None if localization.search is None else localization.search.score
    values = []
    for name, other in zip("BCDEFGH"[:LISTED], localization.alternatives, strict=False):
        apart = difference(estimate.inverse(), other.T_camera_map.inverse())
        known = best is not None and len(best) and np.isfinite(best[0] - other.score)
        gap_nats = float(best[0] - other.score) if best is not None and known else None
        values.append(OtherPose(name, apart.distance_m, apart.angle_deg, gap_nats))
    return tuple(values)
