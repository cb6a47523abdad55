"""Find the faults of detections and map elements at the reference pose.

If the ids are known, each detection has its element, and a disagreement is a fault. If they are
unknown, unmatched detections are compared with unmatched elements in view. Faults of the map
itself follow.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.elements import Elements, Elements3D
from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.diagnosis.fault import FALSE_POSITIVE, UNKNOWN_ID, EvidenceItem, Fault
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import INLIER_CHI2, problem_residuals

SURELY_OFF = 2.0
"""Factor on the inlier limit: a true pair beyond is not explained by noise."""
MOVED_M = 3.0
"""Without ids, a detection further than this from an unmatched element is another element."""
FLAT_SLOPE = 0.03
"""Rays with a smaller slope, up or down, give no distance."""
DUPLICATE_M, DUPLICATE_HEIGHT_M = 1.0, 0.15
"""Two mapped elements of a class, closer than both and only one of them detected, are
duplicates."""


def find_faults(case: FrameReference) -> tuple[Fault, ...]:
    """Return the faults of all observed rows, in their order, then duplicates in the map."""
    if case.reference is None:
        return ()
    return (*_row_faults(case), *_duplicate_faults(case))


def sound_pairs(case: FrameReference) -> IntArray:
    """Return the (k, 2) pairs of ``case`` of equal class that fit the reference."""
    same = case.same_class
    return same[_fits(case, same)] if len(same) else same


def _fits(case: FrameReference, pairs: IntArray) -> BoolArray:
    residuals = case.residuals(pairs)
    return np.asarray(residuals.chi2 <= SURELY_OFF * INLIER_CHI2[residuals.rows])


def _row_faults(case: FrameReference) -> list[Fault]:
    """Return one fault for each row without a sound pair."""
    m = len(case.localization.observed)
    sound = sound_pairs(case) if case.ids is not None else case.pairs
    ids = np.full(m, UNKNOWN_ID) if case.ids is None else case.ids
    mapped = {int(i): int(j) for i, j in case.pairs}
    wrong = np.setdiff1d(np.arange(m), sound[:, 0]).tolist()
    unmatched = _UnmatchedDetections.of(case) if (ids[wrong] == UNKNOWN_ID).any() else None
    found = [
        unmatched.fault(i)
        if unmatched is not None and ids[i] == UNKNOWN_ID
        else _known_row_fault(case, i, int(ids[i]), mapped.get(i))
        for i in wrong
    ]
    return [fault for fault in found if fault is not None]


def _known_row_fault(case: FrameReference, i: int, element: int, j: int | None) -> Fault:
    """Return the fault of a row whose element is known."""
    if element == FALSE_POSITIVE:
        return Fault("false detection", f"Detection {i} is a false positive.", rows=(i,))
    if j is None:
        return Fault(
            "missing in the map", f"Detection {i} is element {element}, which is not in the map.",
            elements=(element,), rows=(i,),
        )  # fmt: skip
    if not case.problem.compatible[i, j]:
        return _wrong_class_fault(case, i, j)
    return _moved_fault(case, i, j)


def _wrong_class_fault(case: FrameReference, i: int, j: int) -> Fault:
    classes = case.semantic_map.classes
    reported = classes[int(case.localization.observed.class_id[i])].name
    return Fault(
        "wrong class", f"Detection {i} is {case.name(j)}, but was classified as {reported}.",
        elements=(int(case.nearby.id[j]),), rows=(i,),
    )  # fmt: skip


def _moved_fault(case: FrameReference, i: int, j: int) -> Fault:
    off_px = float(np.sqrt(np.nansum(case.residuals(np.array([[i, j]])).residual_px ** 2)))
    off_m = distance_m(case, i, j)
    return Fault(
        "moved in the map",
        f"{case.name(j)} is mapped {off_m:.1f} m ({off_px:.0f} px) off.",
        (EvidenceItem("off", off_px, "px"), EvidenceItem("off", off_m, "m")),
        (int(case.nearby.id[j]),), (i,),
    )  # fmt: skip


def distance_m(case: FrameReference, i: int, j: int) -> float:
    """Return the horizontal distance of element j from the position that explains row i.

    The ray to the anchor is intersected with the anchor's height. If the ray is too flat or the
    anchor unknown, only the distance across the ray counts.
    """
    assert case.reference is not None
    back, anchor_m = case.reference.inverse(), case.nearby.anchor_m[j]
    ray = back.rotation @ case.problem.seen[i]["anchor_ray"]
    offset_m = anchor_m - back.translation
    level = float(np.hypot(ray[0], ray[1]))
    known = case.problem.seen[i]["known"][0] or not case.problem.seen[i]["is_line"]
    if known and abs(ray[2]) > FLAT_SLOPE * level and offset_m[2] * ray[2] > 0.0:
        crossing = ray[:2] * offset_m[2] / ray[2]
        return float(np.linalg.norm(crossing - offset_m[:2]))
    ahead = float(offset_m[:2] @ ray[:2]) / level
    aside = float(offset_m[0] * ray[1] - offset_m[1] * ray[0]) / level
    return abs(aside) if ahead > 0.0 else float(np.linalg.norm(offset_m[:2]))


@dataclass(frozen=True, eq=False)
class _UnmatchedDetections:
    """Detections that fit no element at the reference, and elements in view without one."""

    case: FrameReference
    free: IntArray
    """Rows of ``nearby``."""
    fits_but_class: BoolArray
    """(m, n) fits except for the class."""

    @classmethod
    def of(cls, case: FrameReference) -> "_UnmatchedDetections":
        free = np.setdiff1d(np.flatnonzero(case.in_view), case.pairs[:, 1])
        return cls(case, free, _fits_but_class(case, free))

    def fault(self, i: int) -> Fault | None:
        """Return the likeliest fault of an observed row; None if noise may explain it."""
        case = self.case
        candidates = [int(j) for j in self.free if case.problem.compatible[i, j]]
        if candidates and _fits(case, np.array([(i, j) for j in candidates])).any():
            return None
        misclassified = [j for j in self.free if self.fits_but_class[i, j]]
        if misclassified:
            return _wrong_class_fault(case, i, int(misclassified[0]))
        off_m = [distance_m(case, i, j) for j in candidates]
        if off_m and min(off_m) < MOVED_M:
            return _moved_fault(case, i, candidates[int(np.argmin(off_m))])
        return Fault(
            "false or not mapped", f"Detection {i} matches no element of the map.", rows=(i,)
        )


def _fits_but_class(case: FrameReference, free: IntArray) -> BoolArray:
    localization = case.localization
    seen, mapped = _of_one_class(localization.observed), _of_one_class(case.nearby)
    problem = PoseProblem.of(localization.camera, seen, mapped, case.detector)
    fits = np.zeros(problem.compatible.shape, dtype=bool)
    pairs = np.argwhere(problem.compatible & ~case.problem.compatible)
    pairs = pairs[np.isin(pairs[:, 1], free)]
    if len(pairs):
        assert case.reference is not None
        fits[tuple(pairs.T)] = problem_residuals(problem, case.reference, pairs).inlier
    return fits


def _of_one_class(elements: Elements) -> Elements:
    """Return the elements with class 0; poles stay lines, signs points."""
    return replace(elements, class_id=np.zeros(len(elements), dtype=np.int64))


def _duplicate_faults(case: FrameReference) -> list[Fault]:
    """Return one fault for each unmatched element in view at the position of a matched one."""
    copies = same_positions(case.nearby)
    return [
        _duplicate_fault(case, int(i), int(j), copy)
        for i, j in case.pairs
        for copy in copies.get(int(j), ())
        if case.missed[copy]
    ]


def same_positions(elements: Elements3D) -> dict[int, list[int]]:
    """Return, by row, the rows of the other elements of its class at its position, where there are
    any."""
    from scipy.spatial import cKDTree

    copies: dict[int, list[int]] = {}
    near = cKDTree(elements.anchor_m[:, :2]).query_pairs(DUPLICATE_M, output_type="ndarray")
    i, j = near[np.lexsort(near.T[::-1])].T
    same = elements.class_id[i] == elements.class_id[j]
    same &= np.abs(elements.anchor_m[i, 2] - elements.anchor_m[j, 2]) < DUPLICATE_HEIGHT_M
    for a, b in np.stack([i, j], axis=1)[same].tolist():
        copies.setdefault(a, []).append(b)
        copies.setdefault(b, []).append(a)
    return copies


def _duplicate_fault(case: FrameReference, i: int, j: int, copy: int) -> Fault:
    offset_m = case.nearby.anchor_m[copy] - case.nearby.anchor_m[j]
    away_m = float(np.linalg.norm(offset_m))
    return Fault(
        "twice in the map",
        f"{case.name(j)} and {case.name(copy)} are mapped {away_m:.2f} m apart, but only one is "
        "detected.",
        (EvidenceItem("apart", away_m, "m"),),
        (int(case.nearby.id[j]), int(case.nearby.id[copy])), (i,),
    )  # fmt: skip
