"""What a detector got right in an image: its detections against what is truly there.

The rule: detections come one after the other, the best score first, and each takes the nearest
element of its own class that is near enough and still free. So one detection answers for one
element at most, and what a detection takes never depends on worse ones: the matches above any
threshold are those of the threshold that says so. An optimal assignment has neither property, and
would let a wild detection push a good one to its neighbour.

Near enough: a sign within ``tolerance_px`` of the true middle; a pole whose visible part and the
true one share ``LEAST_SHARED`` of what both cover together, measured along the true axis, whose
line stays within ``tolerance_px`` of the axis where they share it, and whose direction is within
``ANGLE_DEG``, or within what 2 px make of the shared length.

Truth that does not count makes a detection that is near enough neither right nor false, whatever
its class, and however many there are of them. All other detections are false. One of a wrong class
is false, and what it shows is missed; ``confused`` says which.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.elements import Elements2D
from semviz_core.sources.street.detector import RANGE_M

HELD_OUT_SEED = 30_000
"""Simulated streets from this seed on are for figures: nothing is trained or tuned on them."""
NEAREST_M, REACH_M = RANGE_M
"""Elements nearer or farther do not count, unless another reach is asked for."""
TOLERANCE_PX, TOLERANCE_SHARE = 4.0, 0.25
"""Of a sign's middle or a pole's line: the larger of that, and of that share of its size."""
LEAST_SHARED = 0.3
ANGLE_DEG, ANGLE_PX = 5.0, 2.0
SHORTEST_PX = 8.0
"""Poles of which less is visible do not count."""
FALSE, IGNORED = -1, -2
"""In place of the row of an element."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What an image truly shows."""

    elements: Elements2D
    """(n,)"""
    counts: BoolArray
    """(n,) False for what may be found or not."""
    distance_m: FloatArray
    """(n,) from the camera, horizontally; NaN where nobody knows."""
    size_px: FloatArray
    """(n,) shorter side of a sign, width of a pole; NaN where nobody knows."""

    @classmethod
    def of(
        cls,
        elements: Elements2D,
        distance_m: FloatArray | None = None,
        size_px: FloatArray | None = None,
        ignored: BoolArray | None = None,
        reach_m: float = REACH_M,
    ) -> "Truth":
        """What counts: all that is not ``ignored``, is ``NEAREST_M`` to ``reach_m`` away as far as
        is known, and of poles what shows ``SHORTEST_PX``."""
        unknown = np.full(len(elements), np.nan)
        distance = unknown if distance_m is None else distance_m
        length = np.linalg.norm(elements.end_px - elements.anchor_px, axis=1)
        counts = ~((distance < NEAREST_M) | (distance > reach_m) | (length < SHORTEST_PX))
        if ignored is not None:
            counts &= ~ignored
        return cls(elements, counts, distance, unknown if size_px is None else size_px)

    @property
    def tolerance_px(self) -> FloatArray:
        """(n,)"""
        return np.fmax(TOLERANCE_PX, TOLERANCE_SHARE * self.size_px)


def matched(found: Elements2D, truth: Truth) -> IntArray:
    """(m,) row of the element that each detection is, ``FALSE`` or ``IGNORED``."""
    apart = _apart(found, truth)
    own = found.class_id[:, None] == truth.elements.class_id
    rows = _taken(np.where(own & truth.counts, apart, np.inf), found.score)
    beside = np.isfinite(apart[:, ~truth.counts]).any(axis=1)
    return np.where((rows == FALSE) & beside, IGNORED, rows)


def confused(found: Elements2D, truth: Truth, matches: IntArray) -> IntArray:
    """(m,) row of the missed element that a false detection shows by another class, or ``FALSE``.

    By the same rule, over what ``matched`` left.
    """
    missed = truth.counts & ~np.isin(np.arange(len(truth.counts)), matches)
    left = (matches == FALSE)[:, None] & missed
    return _taken(np.where(left, _apart(found, truth), np.inf), found.score)


def _taken(apart: FloatArray, score: FloatArray) -> IntArray:
    """(m,) row that each takes, the best score first, or ``FALSE``; infinity is too far."""
    apart = apart.copy()
    rows = np.full(len(score), FALSE)
    if not apart.shape[1]:
        return rows
    for one in np.argsort(-score, kind="stable"):
        nearest = int(apart[one].argmin())
        if np.isfinite(apart[one, nearest]):
            rows[one] = nearest
            apart[:, nearest] = np.inf
    return rows


def _apart(found: Elements2D, truth: Truth) -> FloatArray:
    """(m, n) how far detections are from elements, of any class: 1 is the largest that matches,
    infinity what does not."""
    apart = np.full((len(found), len(truth.elements)), np.inf)
    for is_line, rule in ((True, _poles_apart), (False, _signs_apart)):
        rows = np.flatnonzero(found.is_line == is_line)
        columns = np.flatnonzero(truth.elements.is_line == is_line)
        if len(rows) and len(columns):
            tolerance = truth.tolerance_px[columns]
            ratio = rule(found[rows], truth.elements[columns], tolerance)
            apart[np.ix_(rows, columns)] = np.where(ratio <= 1.0, ratio, np.inf)
    return apart


def _signs_apart(found: Elements2D, true: Elements2D, tolerance_px: FloatArray) -> FloatArray:
    """(m, n) ratios of distance to tolerance."""
    offset = found.anchor_px[:, None] - true.anchor_px
    return np.asarray(np.linalg.norm(offset, axis=2) / tolerance_px)


def _poles_apart(found: Elements2D, true: Elements2D, tolerance_px: FloatArray) -> FloatArray:
    """(m, n) the largest ratio of distance and angle to their limits; NaN where too little of
    their length is shared."""
    axis = true.end_px - true.anchor_px
    length = np.linalg.norm(axis, axis=1)
    along = axis / length[:, None]
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    ends = np.stack([found.anchor_px, found.end_px], axis=1)[:, None] - true.anchor_px[:, None]
    s = np.einsum("mnek,nk->mne", ends, along)
    t = np.einsum("mnek,nk->mne", ends, across)
    low, high = s.min(axis=2), s.max(axis=2)
    shared_low, shared_high = np.maximum(low, 0.0), np.minimum(high, length)
    shared = shared_high - shared_low
    with np.errstate(divide="ignore", invalid="ignore"):
        enough = shared / (np.maximum(high, length) - np.minimum(low, 0.0)) >= LEAST_SHARED
        slope = (t[..., 1] - t[..., 0]) / (s[..., 1] - s[..., 0])
        angle = np.abs(np.arctan2(t[..., 1] - t[..., 0], s[..., 1] - s[..., 0]))
        limit = np.maximum(np.deg2rad(ANGLE_DEG), np.arctan(ANGLE_PX / shared))
        off = [np.abs(t[..., 0] + slope * (at - s[..., 0])) for at in (shared_low, shared_high)]
        ratio = np.maximum(np.maximum(*off) / tolerance_px, angle / limit)
    return np.where(enough, ratio, np.nan)
