"""What each map element does over a run: how often it is seen, fits, and makes answers worse."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from semviz_core.arrays import IntArray
from semviz_core.detector_model import DetectorModel
from semviz_core.explaining.case import Case, Watch, apart, unwatched
from semviz_core.explaining.told import Truth
from semviz_core.localization import Localization
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.least_squares import fit_known
from semviz_core.solving.refine import NEEDED_PAIRS
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.upright import assumed_upright


@dataclass(frozen=True)
class ElementRecord:
    """One map element over a run. Frames are positions in the run, in order."""

    id: int
    in_view: list[int] = field(default_factory=list)
    """Frames in whose image it should be, where it is mapped."""
    seen: list[int] = field(default_factory=list)
    """Frames with a detection of it: by the known ids, else what fits it or was taken for it."""
    used: list[int] = field(default_factory=list)
    """Frames whose answer rests on it."""
    outlier: list[int] = field(default_factory=list)
    """Frames of ``seen`` whose detection does not fit it: at the true pose where it is known, else
    under the answer."""
    residual_px: list[float] = field(default_factory=list)
    """Of each of ``seen``, at the same pose."""
    cost_m: list[float] = field(default_factory=list)
    """By how much the error is larger with it than without, in each of ``used`` with a true pose:
    the answer is fitted again to the other pairs, which stay as they are (nothing is searched
    again). Nothing of frames that need it, and of tracks, whose answers rest on frames before."""

    @property
    def outlier_share(self) -> float:
        """Of the frames that see it; nan where none does."""
        return len(self.outlier) / len(self.seen) if self.seen else np.nan

    @property
    def median_px(self) -> float:
        """The residual in the middle; nan where it is never seen."""
        return float(np.median(self.residual_px)) if self.residual_px else np.nan

    @property
    def mean_cost_m(self) -> float:
        """Below 0 where it helps; nan where that is not known."""
        return float(np.mean(self.cost_m)) if self.cost_m else np.nan


def element_records(
    frames: Sequence[tuple[Localization, Truth | None]],
    semantic_map: SemanticMap,
    detector: DetectorModel | None = None,
    watch: Watch = unwatched,
) -> tuple[ElementRecord, ...]:
    """Of all elements that are in view or seen in some frame; outliers in most frames first."""
    records: dict[int, ElementRecord] = {}
    cases = [Case.of(one, semantic_map, truth, detector) for one, truth in frames]
    for position, case in enumerate(watch(cases, "looking at elements", len(cases))):
        if case.reference is not None:
            _add_case(records, position, case)
    return tuple(sorted(records.values(), key=lambda one: (-len(one.outlier), one.id)))


def _add_case(records: dict[int, ElementRecord], position: int, case: Case) -> None:
    def of(id: int) -> ElementRecord:
        return records.setdefault(id, ElementRecord(id))

    for id in case.nearby.id[case.in_view].tolist():
        of(id).in_view.append(position)
    for id, (size_px, fits) in _residuals(case).items():
        one = of(id)
        one.seen.append(position)
        one.residual_px.append(size_px)
        if not fits:
            one.outlier.append(position)
    for id in _used(case.localization):
        of(id).used.append(position)
    for id, cost_m in _costs(case):
        of(id).cost_m.append(cost_m)


def _residuals(case: Case) -> dict[int, tuple[float, bool]]:
    """Of each element that is seen: how far off (px), and whether it fits. What no pose can tell
    of, such as a pole of which no end and no slope is seen, counts as fitting."""
    pairs = _seen_pairs(case)
    if not len(pairs):
        return {}
    found = case.residuals(pairs)
    size_px = np.sqrt(np.nansum(found.residual_px**2, axis=1))
    ids = case.nearby.id[pairs[:, 1]].tolist()
    values = zip(size_px.tolist(), found.inlier.tolist(), strict=True)
    return dict(zip(ids, values, strict=True))


def _seen_pairs(case: Case) -> IntArray:
    """(k, 2) rows (observed, nearby): by the ids, else what fits, and what the solver took."""
    fine = case.localization.refinement
    if case.ids is not None or fine is None:
        return case.same_class
    rows = {id: row for row, id in enumerate(case.nearby.id.tolist())}
    ids = case.localization.submap.id[fine.pairs[:, 1]].tolist()
    taken = [(int(i), rows[id]) for i, id in zip(fine.pairs[:, 0], ids, strict=True) if id in rows]
    fitting = [(int(i), int(j)) for i, j in case.same_class]
    by_element = {j: (i, j) for i, j in [*fitting, *taken]}
    return np.array(sorted(by_element.values()), dtype=np.int64).reshape(-1, 2)


def _used(localization: Localization) -> list[int]:
    """Ids of the elements that the answer rests on."""
    fine = localization.refinement
    if fine is None or localization.T_camera_map is None:
        return []
    return [int(id) for id in localization.submap.id[fine.pairs[fine.inlier, 1]]]


def _costs(case: Case) -> Iterator[tuple[int, float]]:
    """Element and metres, of each that the answer rests on and could do without."""
    one = case.localization
    pose, fine = one.T_camera_map, one.refinement
    if case.truth is None or pose is None or fine is None or len(fine.cost_trace) < 2:
        return
    if len(fine.pairs) <= NEEDED_PAIRS:
        return
    scene = Scene.of(one.camera, one.observed, one.submap, case.detector)
    known = Known.of(assumed_upright(one.prior))
    error_m, _ = apart(pose, case.truth)
    for row in np.flatnonzero(fine.inlier):
        without = fit_known(scene, known, pose, np.delete(fine.pairs, row, axis=0))
        without_m, _ = apart(without.T_camera_map, case.truth)
        yield int(one.submap.id[fine.pairs[row, 1]]), error_m - without_m
