"""Statistics of each map element over a run: in view, detected, inlier, blamed, effect on the
error."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import vague_prior
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.diagnosis import reference
from semviz_core.diagnosis.fault import Fault, FaultKind, GroundTruth
from semviz_core.localization.least_squares import fit_record
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.refinement import NEEDED_PAIRS
from semviz_core.localization.upright import assumed_upright


class DiagnosedFrame(NamedTuple):
    """A frame, and what its diagnosis found."""

    localization: Localization
    truth: GroundTruth | None
    faults: tuple[Fault, ...] = ()
    """That which made it fail last."""


@dataclass(frozen=True)
class ElementRecord:
    """One map element over a run. Frames are positions in the run, in order."""

    id: int
    in_view: list[int] = field(default_factory=list)
    """Frames whose image contains its mapped position."""
    seen: list[int] = field(default_factory=list)
    """Frames with a detection of it: by the known ids, else one that fits or is paired with it."""
    used: list[int] = field(default_factory=list)
    """Frames with it among the inliers."""
    outlier: list[int] = field(default_factory=list)
    """Frames of ``seen`` whose detection does not fit it: at the true pose if known, else at the
    estimate."""
    residual_px: list[float] = field(default_factory=list)
    """Of each of ``seen``, at the same pose."""
    cost_m: list[float] = field(default_factory=list)
    """How much larger the error is with it than without, in each of ``used`` with a true pose. The
    pose is refined again with the other pairs; the search is not repeated. Frames that need the
    element have no value, nor have tracks, whose poses rest on earlier frames."""
    blamed: dict[int, FaultKind] = field(default_factory=dict)
    """Frames whose diagnosis blames it, and as what."""

    @property
    def outlier_share(self) -> float:
        """Share of the frames that detect it; nan without any."""
        return len(self.outlier) / len(self.seen) if self.seen else np.nan

    @property
    def median_px(self) -> float:
        """Median residual; nan if it is never detected."""
        return float(np.median(self.residual_px)) if self.residual_px else np.nan

    @property
    def mean_cost_m(self) -> float:
        """Below 0 if the element reduces the error; nan if unknown."""
        return float(np.mean(self.cost_m)) if self.cost_m else np.nan


def element_records(
    frames: Sequence[DiagnosedFrame],
    semantic_map: SemanticMap,
    detector: DetectorModel | None = None,
    watch: reference.ProgressCallback = reference.no_progress,
) -> tuple[ElementRecord, ...]:
    """Return records of all elements in view or detected, sorted by falling outlier count.

    Frames are taken one by one, so they may come from a file.
    """
    records: dict[int, ElementRecord] = {}

    def cases() -> Iterator[reference.FrameReference]:
        for position, frame in enumerate(frames):
            _add_blame(records, position, frame.faults, semantic_map)
            yield reference.FrameReference.of(
                frame.localization, semantic_map, frame.truth, detector
            )

    for position, case in enumerate(watch(cases(), "checking elements", len(frames))):
        if case.reference is not None:
            _add_case(records, position, case)
    return tuple(sorted(records.values(), key=lambda record: (-len(record.outlier), record.id)))


def _add_blame(
    records: dict[int, ElementRecord],
    position: int,
    faults: Sequence[Fault],
    semantic_map: SemanticMap,
) -> None:
    for fault in faults:
        for id in fault.elements:
            if id in semantic_map:  # a missing element is not
                records.setdefault(id, ElementRecord(id)).blamed[position] = fault.kind


def _add_case(
    records: dict[int, ElementRecord], position: int, case: reference.FrameReference
) -> None:
    def of(id: int) -> ElementRecord:
        return records.setdefault(id, ElementRecord(id))

    for id in case.nearby.id[case.in_view].tolist():
        of(id).in_view.append(position)
    for id, (size_px, fits) in _residuals(case).items():
        record = of(id)
        record.seen.append(position)
        record.residual_px.append(size_px)
        if not fits:
            record.outlier.append(position)
    for id in _used(case.localization):
        of(id).used.append(position)
    for id, cost_m in _costs(case):
        of(id).cost_m.append(cost_m)


def _residuals(case: reference.FrameReference) -> dict[int, tuple[float, bool]]:
    """Return residual (px) and fit of each detected element, by id.

    A pair without residual rows, for example a pole without a visible end or slope, counts as
    fitting.
    """
    pairs = _seen_pairs(case)
    if not len(pairs):
        return {}
    residuals = case.residuals(pairs)
    size_px = np.sqrt(np.nansum(residuals.residual_px**2, axis=1))
    ids = case.nearby.id[pairs[:, 1]].tolist()
    values = zip(size_px.tolist(), residuals.inlier.tolist(), strict=True)
    return dict(zip(ids, values, strict=True))


def _seen_pairs(case: reference.FrameReference) -> IntArray:
    """Return (k, 2) rows (observed, nearby): by the ids, else fitting and solver's pairs."""
    refinement = case.localization.refinement
    if case.ids is not None or refinement is None:
        return case.same_class
    rows = {id: row for row, id in enumerate(case.nearby.id.tolist())}
    ids = case.localization.submap.id[refinement.pairs[:, 1]].tolist()
    used = [
        (int(i), rows[id]) for i, id in zip(refinement.pairs[:, 0], ids, strict=True) if id in rows
    ]
    fitting = [(int(i), int(j)) for i, j in case.same_class]
    by_element = {j: (i, j) for i, j in [*fitting, *used]}
    return np.array(sorted(by_element.values()), dtype=np.int64).reshape(-1, 2)


def _used(localization: Localization) -> list[int]:
    """Return the ids of the inliers' elements."""
    refinement = localization.refinement
    if refinement is None or localization.T_camera_map is None:
        return []
    return [int(id) for id in localization.submap.id[refinement.pairs[refinement.inlier, 1]]]


def _costs(case: reference.FrameReference) -> Iterator[tuple[int, float]]:
    """Yield id and ``cost_m`` of each inlier that the pose does not need."""
    result = case.localization
    pose, refinement = result.T_camera_map, result.refinement
    if case.truth is None or pose is None or refinement is None or len(refinement.cost_trace) < 2:
        return
    if len(refinement.pairs) <= NEEDED_PAIRS:
        return
    problem = PoseProblem.of(result.camera, result.observed, result.submap, case.detector)
    prior = result.prior or vague_prior(result.around_m)
    prior_record = PriorRecord.of(assumed_upright(prior))
    error_m, _ = reference.pose_distance(pose, case.truth)
    for row in np.flatnonzero(refinement.inlier):
        refit = fit_record(problem, prior_record, pose, np.delete(refinement.pairs, row, axis=0))
        refit_m, _ = reference.pose_distance(refit.T_camera_map, case.truth)
        yield int(result.submap.id[refinement.pairs[row, 1]]), error_m - refit_m
