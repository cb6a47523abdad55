"""Where things stand that several frames see and no map holds: where their rays meet."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray

NEEDED_FRAMES = 3
"""So many rays of different frames must meet; two always do."""
MEET_RAD = float(np.deg2rad(0.7))
"""A ray passes through a place that it misses by less, seen from its camera."""
LEAST_PARALLAX_RAD = float(np.deg2rad(3.0))
NEAREST_M, FURTHEST_M = 2.0, 60.0
"""From a camera to what it sees."""


@dataclass(frozen=True, eq=False)
class Sights:
    """k detections that fit nothing, as rays in the ground plane."""

    frame: IntArray
    """(k,) position in the run."""
    row: IntArray
    """(k,) observed row there."""
    class_id: IntArray
    center_m: FloatArray
    """(k, 2) of the camera."""
    toward: FloatArray
    """(k, 2) unit."""


@dataclass(frozen=True, eq=False)
class Place:
    """Where rays meet."""

    at_m: FloatArray
    """(2,)"""
    sights: IntArray
    """Rows of ``Sights`` that pass through, of three or more frames."""


def meeting_places(sights: Sights) -> list[Place]:
    """Places through which rays of one class and of several frames pass, best first.

    Each ray belongs to one place at most.
    """
    free = np.ones(len(sights.row), dtype=bool)
    found = []
    while (best := _best(sights, free)) is not None:
        free[best.sights] = False
        found.append(best)
    return found


def _best(sights: Sights, free: BoolArray) -> Place | None:
    places = [_through(sights, int(one), free) for one in np.flatnonzero(free)]
    known = [one for one in places if one is not None]
    return max(known, key=lambda one: len(one.sights), default=None)


def _through(sights: Sights, one: int, free: BoolArray) -> Place | None:
    """The place on one ray that most frames see."""
    away_m = np.linalg.norm(sights.center_m - sights.center_m[one], axis=1)
    others = free & (sights.class_id == sights.class_id[one]) & (away_m < FURTHEST_M)
    rows = np.flatnonzero(others)
    at_m = _crossings(sights, one, rows[sights.frame[rows] != sights.frame[one]])
    if not len(at_m):
        return None
    passes = _passes(sights, rows, at_m)
    frames = [len(np.unique(sights.frame[rows[chosen]])) for chosen in passes]
    best = int(np.argmax(frames))
    if frames[best] < NEEDED_FRAMES:
        return None
    return Place(at_m[best], rows[passes[best]])


def _crossings(sights: Sights, one: int, rows: IntArray) -> FloatArray:
    """(c, 2) where ray ``one`` crosses others, ahead of both cameras."""
    a, b = sights.toward[one], sights.toward[rows]
    cross = a[0] * b[:, 1] - a[1] * b[:, 0]
    wide = np.abs(cross) > np.sin(LEAST_PARALLAX_RAD)
    offset = sights.center_m[rows[wide]] - sights.center_m[one]
    b, cross = b[wide], cross[wide]
    along_a = (offset[:, 0] * b[:, 1] - offset[:, 1] * b[:, 0]) / cross
    along_b = (offset[:, 0] * a[1] - offset[:, 1] * a[0]) / cross
    ahead = (np.minimum(along_a, along_b) > NEAREST_M) & (along_a < FURTHEST_M)
    return np.asarray(sights.center_m[one] + along_a[ahead, None] * a)


def _passes(sights: Sights, rows: IntArray, at_m: FloatArray) -> BoolArray:
    """(c, len(rows)) whether rays pass through places (c, 2)."""
    offset = at_m[:, None] - sights.center_m[rows]
    toward = sights.toward[rows]
    aside = offset[..., 0] * toward[:, 1] - offset[..., 1] * toward[:, 0]
    ahead = (offset * toward).sum(axis=-1)
    near = np.abs(aside) < np.tan(MEET_RAD) * ahead
    return np.asarray(near & (ahead > NEAREST_M) & (ahead < FURTHEST_M))
