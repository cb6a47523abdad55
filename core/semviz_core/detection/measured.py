"""One region's element as it was measured; the same one found twice counts once."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.elements import Elements2D

_BESIDE_PX = 1.5
"""Poles nearer than this and half a width are one."""
_SHARED = 0.5
"""Of the shorter one's length, that two of one pole have in common."""
_INSIDE = 0.5
"""Of the smaller half size: signs with middles nearer than this are one."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A pole or a sign."""

    class_id: int
    score: float
    points_px: FloatArray
    """(2, 2) a pole's ends, or (1, 2) a sign's middle."""
    sigma_px: tuple[float, float]
    """Across and along a pole; both alike for signs."""
    known: tuple[bool, bool]
    size_px: float
    """Width of a pole, half the shorter side of a sign."""


def elements(found: Iterable[Measured]) -> Elements2D:
    """As arrays, in this order."""
    rows = list(found)
    nothing = np.full((1, 2), np.nan)
    ends = np.array([np.concatenate([one.points_px, nothing])[:2] for one in rows])
    ends = ends.reshape(-1, 2, 2)
    return Elements2D(
        anchor_px=ends[:, 0],
        end_px=ends[:, 1],
        class_id=np.array([one.class_id for one in rows], np.int64),
        score=np.array([one.score for one in rows], np.float64),
        sigma_px=np.array([one.sigma_px for one in rows], np.float64).reshape(-1, 2),
        anchor_known=np.array([one.known[0] for one in rows], bool),
        end_known=np.array([one.known[1] for one in rows], bool),
    )


def without_repeats(found: Iterable[Measured]) -> list[Measured]:
    """Each element once: what comes first of it stays."""
    kept: list[Measured] = []
    for one in found:
        if not any(_same(one, other) for other in kept):
            kept.append(one)
    return kept


def _same(one: Measured, other: Measured) -> bool:
    if len(one.points_px) != len(other.points_px):
        return False
    size = min(one.size_px, other.size_px)
    if len(one.points_px) == 1:
        apart = np.linalg.norm(one.points_px - other.points_px)
        return bool(apart < _INSIDE * size)
    return _one_pole(one.points_px, other.points_px, _BESIDE_PX + size / 2.0)


def _one_pole(one: FloatArray, other: FloatArray, beside_px: float) -> bool:
    """Whether two lines (2, 2) lie on each other for much of the shorter one."""
    step = one[1] - one[0]
    length = float(np.linalg.norm(step))
    along = step / length
    places = np.sort((other - one[0]) @ along)
    shared = min(places[1], length) - max(places[0], 0.0)
    if shared < _SHARED * min(length, float(np.linalg.norm(other[1] - other[0]))):
        return False
    offsets = (other - one[0]) @ np.array([along[1], -along[0]])
    return bool(abs(offsets.mean()) < beside_px and np.abs(offsets).max() < 3.0 * beside_px)
