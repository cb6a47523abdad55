"""What is wrong with detections and map, seen from a pose: row by row, then in the map itself.

Where the ids are known, each row has its element, and what disagrees is the fault. Where they are
not, rows that fit no element are compared with the elements in view that no row fits.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.elements import Elements, Elements3D
from semviz_core.explaining.case import Case
from semviz_core.explaining.told import FALSE, UNKNOWN, Evidence, Fault
from semviz_core.solving.residuals import INLIER_CHI2, scene_residuals
from semviz_core.solving.scene import Scene

SURELY_OFF = 2.0
"""Times the inlier's limit: a true pair beyond is no matter of noise."""
MOVED_M = 3.0
"""Without ids, what is seen further from an unseen element is another thing."""
FLAT_SLOPE = 0.03
"""Ends seen at less, up or down, tell no distance."""
TWICE_M, TWICE_HEIGHT_M = 1.0, 0.15
"""Two mapped elements of a class nearer than both, of which one is seen, are one thing."""


def noticed(case: Case) -> tuple[Fault, ...]:
    """All faults of detections and map, in the order of rows; then those of the map."""
    if case.reference is None:
        return ()
    return (*_row_faults(case), *_twice(case))


def sound_pairs(case: Case) -> IntArray:
    """(k, 2) pairs of ``case`` of one class that fit the reference."""
    same = case.same_class
    return same[_fits(case, same)] if len(same) else same


def _fits(case: Case, pairs: IntArray) -> BoolArray:
    found = case.residuals(pairs)
    return np.asarray(found.chi2 <= SURELY_OFF * INLIER_CHI2[found.rows])


def _row_faults(case: Case) -> list[Fault]:
    """What is wrong with each row that is not soundly paired."""
    m = len(case.localization.observed)
    sound = sound_pairs(case) if case.ids is not None else case.pairs
    ids = np.full(m, UNKNOWN) if case.ids is None else case.ids
    mapped = {int(i): int(j) for i, j in case.pairs}
    wrong = np.setdiff1d(np.arange(m), sound[:, 0]).tolist()
    strangers = _Strangers.of(case) if (ids[wrong] == UNKNOWN).any() else None
    return [
        strangers.explained(i)
        if strangers is not None and ids[i] == UNKNOWN
        else _known(case, i, int(ids[i]), mapped.get(i))
        for i in wrong
    ]


def _known(case: Case, i: int, element: int, j: int | None) -> Fault:
    """What is wrong with a row whose element is known."""
    if element == FALSE:
        return Fault("false detection", f"Detection {i} is nothing real.", rows=(i,))
    if j is None:
        return Fault(
            "missing in the map", f"Detection {i} is element {element}, which is not in the map.",
            elements=(element,), rows=(i,),
        )  # fmt: skip
    if not case.scene.compatible[i, j]:
        return _wrong_class(case, i, j)
    return _moved(case, i, j)


def _wrong_class(case: Case, i: int, j: int) -> Fault:
    classes = case.semantic_map.classes
    seen = classes[int(case.localization.observed.class_id[i])].name
    return Fault(
        "wrong class", f"Detection {i} is {case.name(j)}, but was called {seen}.",
        elements=(int(case.nearby.id[j]),), rows=(i,),
    )  # fmt: skip


def _moved(case: Case, i: int, j: int) -> Fault:
    off_px = float(np.sqrt(np.nansum(case.residuals(np.array([[i, j]])).residual_px ** 2)))
    off_m = distance_m(case, i, j)
    return Fault(
        "moved in the map",
        f"{case.name(j)} is mapped {off_m:.1f} m ({off_px:.0f} px) off.",
        (Evidence("off", off_px, "px"), Evidence("off", off_m, "m")),
        (int(case.nearby.id[j]),), (i,),
    )  # fmt: skip


def distance_m(case: Case, i: int, j: int) -> float:
    """How far the place of element j is from where it would look like row i, horizontally.

    The ray to the anchor is cut with the anchor's height; where it is too flat, or the anchor is
    not known, only the distance aside is left.
    """
    assert case.reference is not None
    back, anchor_m = case.reference.inverse(), case.nearby.anchor_m[j]
    ray = back.rotation @ case.scene.seen[i]["anchor_ray"]
    offset_m = anchor_m - back.translation
    level = float(np.hypot(ray[0], ray[1]))
    known = case.scene.seen[i]["known"][0] or not case.scene.seen[i]["is_line"]
    if known and abs(ray[2]) > FLAT_SLOPE * level and offset_m[2] * ray[2] > 0.0:
        there = ray[:2] * offset_m[2] / ray[2]
        return float(np.linalg.norm(there - offset_m[:2]))
    ahead = float(offset_m[:2] @ ray[:2]) / level
    aside = float(offset_m[0] * ray[1] - offset_m[1] * ray[0]) / level
    return abs(aside) if ahead > 0.0 else float(np.linalg.norm(offset_m[:2]))


@dataclass(frozen=True, eq=False)
class _Strangers:
    """Rows that fit nothing at the reference, and the elements in view that nothing fits."""

    case: Case
    free: IntArray
    """Rows of ``nearby``."""
    fits_but_class: BoolArray
    """(m, n) would fit if classes did not count."""

    @classmethod
    def of(cls, case: Case) -> "_Strangers":
        free = np.setdiff1d(np.flatnonzero(case.in_view), case.pairs[:, 1])
        return cls(case, free, _fits_but_class(case, free))

    def explained(self, i: int) -> Fault:
        case = self.case
        other = [j for j in self.free if self.fits_but_class[i, j]]
        if other:
            return _wrong_class(case, i, int(other[0]))
        alike = [int(j) for j in self.free if case.scene.compatible[i, j]]
        off_m = [distance_m(case, i, j) for j in alike]
        if off_m and min(off_m) < MOVED_M:
            return _moved(case, i, alike[int(np.argmin(off_m))])
        return Fault(
            "false or not mapped", f"Detection {i} is nothing that is mapped here.", rows=(i,)
        )


def _fits_but_class(case: Case, free: IntArray) -> BoolArray:
    one = case.localization
    seen, mapped = _of_one_class(one.observed), _of_one_class(case.nearby)
    scene = Scene.of(one.camera, seen, mapped, case.detector)
    found = np.zeros(scene.compatible.shape, dtype=bool)
    pairs = np.argwhere(scene.compatible & ~case.scene.compatible)
    pairs = pairs[np.isin(pairs[:, 1], free)]
    if len(pairs):
        assert case.reference is not None
        found[tuple(pairs.T)] = scene_residuals(scene, case.reference, pairs).inlier
    return found


def _of_one_class(elements: Elements) -> Elements:
    """Poles and signs of class 0 alike; they still are lines and points."""
    return replace(elements, class_id=np.zeros(len(elements), dtype=np.int64))


def _twice(case: Case) -> list[Fault]:
    """Mapped elements that stand where a seen one of their class does, themselves unseen."""
    seen = case.pairs[:, 1]
    found = []
    for i, j in case.pairs:
        for copy in np.flatnonzero(_alike(case.nearby, int(j))):
            if copy not in seen:
                found.append(_copied(case, int(i), int(j), int(copy)))
    return found


def _alike(elements: Elements3D, j: int) -> BoolArray:
    """(n,) the others of its class that stand in the same place."""
    offset_m: FloatArray = elements.anchor_m - elements.anchor_m[j]
    near = np.hypot(offset_m[:, 0], offset_m[:, 1]) < TWICE_M
    near &= np.abs(offset_m[:, 2]) < TWICE_HEIGHT_M
    return np.asarray(
        near & (elements.class_id == elements.class_id[j]) & (elements.id != elements.id[j])
    )


def _copied(case: Case, i: int, j: int, copy: int) -> Fault:
    offset_m = case.nearby.anchor_m[copy] - case.nearby.anchor_m[j]
    away_m = float(np.linalg.norm(offset_m))
    return Fault(
        "twice in the map",
        f"{case.name(j)} and {case.name(copy)} are mapped {away_m:.2f} m apart; one is seen.",
        (Evidence("apart", away_m, "m"),),
        (int(case.nearby.id[j]), int(case.nearby.id[copy])), (i,),
    )  # fmt: skip
