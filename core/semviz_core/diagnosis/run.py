"""Diagnose a run: find faults of map and camera that recur over frames.

Frames without ground truth count if their status is ok. An unmapped landmark is found where rays
of unmatched detections of one class meet, from more frames than false detections explain.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Odometry
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis import run_causes
from semviz_core.diagnosis.carried_poses import with_carried_poses
from semviz_core.diagnosis.cause_fits import common_cause
from semviz_core.diagnosis.checks import find_faults
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind, GroundTruth, RunFault
from semviz_core.diagnosis.frame_causes import with_sigma_scaled
from semviz_core.diagnosis.odometry import odometry_fault
from semviz_core.diagnosis.prior_offsets import (
    PriorOffset,
    prior_offsets,
    solved_without_fixes,
    without_offset,
)
from semviz_core.diagnosis.ray_meetings import RayMeeting, RayMeetings, UnmatchedRays, Views
from semviz_core.diagnosis.reference import FrameReference, ProgressCallback, no_progress

NEEDED_FRAMES = 3
MAP_KINDS: tuple[FaultKind, ...] = ("moved in the map", "missing in the map", "twice in the map")
UNMATCHED_KINDS: tuple[FaultKind, ...] = ("moved in the map", "false or not mapped")
"""Faults of unmatched detections in single frames without known ids."""
MOVED_M = 10.0
"""A landmark further than this from an undetected element is another one."""
OF_CALIBRATION: tuple[FaultKind, ...] = ("wrong detection sigma", "wrong gravity prior")
"""What a wrong calibration looks like in single frames."""
MOSTLY_OK = 0.5
"""Share of frames that are ok beyond which priors are not off by more than they state."""
STRAY_SHARE = 0.2
"""Share of the frames with an element in view below which other things are detected there."""
LEAST_SHARE = 0.5
"""Share of the frames that detect an element in which a fault must recur."""

ONE_NATS = 3.0
"""Against the chance that one of two real elements is missed in all frames that detect the other:
then they are one, mapped twice. Chance exceeds it once in twenty such pairs."""


@dataclass(frozen=True)
class RunDiagnosis:
    """Faults of all elements together, of the camera, and of single elements."""

    calibration: RunFault | None
    elements: tuple[RunFault, ...]
    """By falling number of frames. Empty if the calibration is wrong: then no element fits."""
    frames: int
    """Number of frames with a pose to compare with."""
    causes: tuple[RunFault, ...] = ()
    """Wrong priors, sigmas and odometry, and what shifts all elements together."""

    def at(self, positions: Sequence[int]) -> "RunDiagnosis":
        """Return the diagnosis of the frames at ``positions`` of a run, with its positions."""
        calibration = self.calibration
        return replace(
            self,
            calibration=None if calibration is None else _at(calibration, positions),
            elements=tuple(_at(fault, positions) for fault in self.elements),
            causes=tuple(_at(fault, positions) for fault in self.causes),
        )


def diagnose_run(
    frames: Sequence[tuple[Localization, GroundTruth | None]],
    semantic_map: SemanticMap,
    detector: DetectorModel | None = None,
    watch: ProgressCallback = no_progress,
    odometry: Sequence[Odometry | None] | None = None,
) -> RunDiagnosis:
    """Return the recurring faults of a run.

    Frames without ground truth count if their status is ok. ``odometry`` is the measured motion of
    each frame from the one before.
    """
    cases = [
        FrameReference.of(localization, semantic_map, truth, detector)
        for localization, truth in frames
    ]
    measured = [None] * len(cases) if odometry is None else odometry
    is_blind = all(case.truth is None for case in cases)
    found = (_common_without_truth if is_blind else _common)(cases, measured, watch)
    positions = _with_pose(found.cases)
    compared = [found.cases[position] for position in positions]
    for cause in found.causes:
        if cause.kind == "wrong detection sigma":
            scale = next(item.value for item in cause.evidence if "sigma" in item.name)
            compared = [with_sigma_scaled(case, scale) for case in compared]
    recurring = () if found.calibration else _element_faults(compared, watch)
    elements = tuple(_at(fault, positions) for fault in recurring)
    return RunDiagnosis(found.calibration, elements, len(compared), tuple(found.causes))


class _Common(NamedTuple):
    """What all frames have in common, and the frames as single elements are judged in them."""

    cases: Sequence[FrameReference]
    calibration: RunFault | None
    causes: Sequence[RunFault]


def _common(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None], watch: ProgressCallback
) -> _Common:
    """Return what frames have in common against their true poses."""
    positions = [position for position, case in enumerate(cases) if case.truth is not None]
    compared = [cases[position] for position in positions]
    calibration: RunFault | None = None
    causes: list[RunFault] = []
    found = common_cause(compared, watch)
    if found is not None:
        fault = _at(run_causes.cause_fault(*found, watch), positions)
        if found[0].fit.cause in CALIBRATIONS:
            calibration = fault
        else:
            causes.append(fault)
            corrected = [found[0].fit.corrected(row) for row in range(len(compared))]
            cases = _replaced(cases, positions, corrected)
    causes += run_causes.assumption_run_faults(cases, watch)
    moved = odometry_fault(cases, odometry)
    causes += [] if moved is None else [moved]
    if calibration is not None:  # it explains large residuals, and a camera that is rolled
        causes = [cause for cause in causes if cause.kind not in OF_CALIBRATION]
    return _Common(cases, calibration, causes)


def _common_without_truth(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None], watch: ProgressCallback
) -> _Common:
    """Return what frames without true poses have in common, by one fit of all that they measured.

    Assumptions are tested frame by frame where no pose is known to start the fit from.
    """
    if offsets := _prior_offsets(cases, watch):
        cases = without_offset(cases, offsets[0])
        return _Common(cases, None, [run_causes.prior_offset_fault(offsets, cases, watch)])
    carried = with_carried_poses(cases, odometry, watch)
    joint = run_causes.joint_fault(carried, odometry)
    if joint is None:
        return _Common(carried, None, run_causes.assumption_run_faults(cases, watch))
    if joint.kind == "wrong calibration":
        return _Common(carried, joint, [])
    is_odometry = joint.kind == "wrong odometry"  # it carries poses to wrong places
    return _Common(cases if is_odometry else carried, None, [joint])


def _with_pose(cases: Sequence[FrameReference]) -> list[int]:
    """Return the positions of frames with a pose to compare with the map."""
    return [
        position
        for position, case in enumerate(cases)
        if case.truth is not None or case.localization.status == "ok"
    ]


def _prior_offsets(
    cases: Sequence[FrameReference], watch: ProgressCallback
) -> tuple[PriorOffset, ...]:
    """Return what all priors of a run without ground truth have in common."""
    ok = sum(case.localization.status == "ok" for case in cases)
    if (found := prior_offsets(cases)) or ok > MOSTLY_OK * len(cases):
        return found
    return prior_offsets(solved_without_fixes(cases, watch))


def _at(fault: RunFault, positions: Sequence[int]) -> RunFault:
    """Return a fault whose frames are rows of ``positions``, with positions in the run."""
    return replace(fault, frames=tuple(positions[row] for row in fault.frames))


def _replaced(
    cases: Sequence[FrameReference], positions: Sequence[int], others: Sequence[FrameReference]
) -> list[FrameReference]:
    by_position = dict(zip(positions, others, strict=True))
    return [by_position.get(position, case) for position, case in enumerate(cases)]


def _element_faults(
    cases: Sequence[FrameReference], watch: ProgressCallback
) -> tuple[RunFault, ...]:
    """Return recurring faults; their ``frames`` are rows of ``cases``."""
    faults = [find_faults(case) for case in watch(cases, "collecting faults", len(cases))]
    recurring = [*_recurring_faults(cases, faults), *_unmatched_landmarks(cases, faults)]
    return tuple(sorted(recurring, key=lambda fault: (-fault.evidence[0].value, fault.elements)))


def _recurring_faults(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> list[RunFault]:
    """Return faults of an element that recur in most of the frames that detect it."""
    reports: dict[tuple[FaultKind, tuple[int, ...]], list[tuple[int, Fault]]] = defaultdict(list)
    for row, (case, frame_faults) in enumerate(zip(cases, faults, strict=True)):
        kinds = MAP_KINDS if case.ids is not None else MAP_KINDS[2:]
        for fault in frame_faults:
            if fault.kind not in kinds:
                continue
            reported = reports[fault.kind, tuple(sorted(fault.elements))]
            if not reported or reported[-1][0] != row:  # several detections may report it
                reported.append((row, fault))
    detected = _detection_counts(cases)
    return [
        _recurring_fault(kind, elements, reported)
        for (kind, elements), reported in reports.items()
        if len(reported)
        >= max(NEEDED_FRAMES, LEAST_SHARE * max(detected.get(element, 0) for element in elements))
        and (len(elements) == 1 or _are_one(cases, elements, reported))
    ]


def _recurring_fault(
    kind: FaultKind, elements: tuple[int, ...], reports: Sequence[tuple[int, Fault]]
) -> RunFault:
    """Return the fault of ``elements`` in several frames, with the median frame's evidence."""
    ordered = sorted((fault for _, fault in reports), key=lambda fault: fault.evidence[-1:])
    middle = ordered[len(ordered) // 2]
    sentence = f"In {len(reports)} frames: {middle.sentence}"
    if kind == "missing in the map":  # it has no name, and its row differs between frames
        sentence = f"{len(reports)} frames show element {elements[0]}, which is not in the map."
    return RunFault(
        kind,
        sentence,
        (EvidenceItem("frames", len(reports)), *middle.evidence),
        elements,
        rows=tuple(fault.rows[0] for _, fault in reports),
        frames=tuple(row for row, _ in reports),
    )


def _are_one(
    cases: Sequence[FrameReference],
    elements: tuple[int, ...],
    reported: Sequence[tuple[int, Fault]],
) -> bool:
    """Whether two elements are one landmark: no frame detects both, and chance hardly ever misses
    one of two in all frames with both in view."""
    for case in cases:
        if set(elements) <= set(case.nearby.id[case.pairs[:, 1]].tolist()):
            return False
    nats = 0.0
    for case, copy in ((cases[row], fault.elements[1]) for row, fault in reported):
        assert case.reference is not None
        place_m = case.nearby.anchor_m[case.nearby.id == copy]
        away_m = np.linalg.norm(case.reference.apply(place_m), axis=1)
        nats -= float(np.log1p(-case.detector.recall_at(away_m)).sum())
    return nats > ONE_NATS


def _detection_counts(cases: Sequence[FrameReference]) -> dict[int, int]:
    """Return the number of frames with a detection of each element id."""
    seen: dict[int, int] = defaultdict(int)
    for case in cases:
        for id in set(case.nearby.id[case.pairs[:, 1]].tolist()):
            seen[id] += 1
    return dict(seen)


def _unmatched_landmarks(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> list[RunFault]:
    """Return landmarks that several frames detect where no element is mapped."""
    rays, detected = _unmatched_rays(cases, faults), _detection_counts(cases)
    if not len(rays.row):
        return []
    meetings = RayMeetings(rays, Views.of(cases)).found()
    return [_unmatched_landmark(cases, detected, rays, point) for point in meetings]


def _unmatched_rays(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> UnmatchedRays:
    return UnmatchedRays.of(
        cases,
        [
            (frame, fault.rows[0])
            for frame, (case, frame_faults) in enumerate(zip(cases, faults, strict=True))
            for fault in frame_faults
            if case.ids is None and fault.kind in UNMATCHED_KINDS
        ],
    )


def _unmatched_landmark(
    cases: Sequence[FrameReference],
    detected: dict[int, int],
    rays: UnmatchedRays,
    point: RayMeeting,
) -> RunFault:
    """Return the fault of a landmark where rays meet.

    A near element that is seldom detected is the same landmark, moved; else it is missing.
    """
    frames, first = np.unique(rays.frame[point.rays], return_index=True)
    rows = rays.row[point.rays[first]]
    of_frames = {"rows": tuple(rows.tolist()), "frames": tuple(frames.tolist())}
    class_id = int(rays.class_id[point.rays[0]])
    nearby_m: dict[int, float] = {}
    for case in (cases[frame] for frame in frames):
        away_m = np.linalg.norm(case.nearby.anchor_m[:, :2] - point.at_m, axis=1)
        for j in np.flatnonzero((away_m < MOVED_M) & (case.nearby.class_id == class_id)):
            nearby_m[int(case.nearby.id[j])] = float(away_m[j])
    expected = {
        id: away for id, away in nearby_m.items() if _is_absent(cases, id, detected.get(id, 0))
    }
    evidence = EvidenceItem("frames", len(frames))
    where = f"at {point.at_m[0]:.1f}, {point.at_m[1]:.1f}"
    if not expected:
        return RunFault(
            "missing in the map",
            f"{len(frames)} frames show an element {where} that is not in the map.",
            (
                evidence, EvidenceItem("x", point.at_m[0], "m"),
                EvidenceItem("y", point.at_m[1], "m"),
            ),
            **of_frames,
        )  # fmt: skip
    id = min(expected, key=lambda id: expected[id])
    name = cases[0].semantic_map.classes.element_name(class_id, id)
    often = "seldom" if id in detected else "never"
    return RunFault(
        "moved in the map",
        f"{name} is {often} detected at its mapped position; {len(frames)} frames show it {where}.",
        (evidence, EvidenceItem("moved", expected[id], "m")), (id,), **of_frames,
    )  # fmt: skip


def _is_absent(cases: Sequence[FrameReference], id: int, detected: int) -> bool:
    """Whether an element is in view of several frames, and detected by hardly any."""
    times = sum(bool((case.in_view & (case.nearby.id == id)).any()) for case in cases)
    return times >= NEEDED_FRAMES and detected < max(1.0, STRAY_SHARE * times)
