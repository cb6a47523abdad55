"""Match an image's detections with its true elements.

Detections are matched in order of score, each to the nearest free element of its class within the
tolerance. So a detection gets at most one element and does not depend on lower scores: the matches
above any threshold are those of that threshold. An optimal assignment would not have this
property, and could let an outlier move a good detection to a neighbouring element.

Tolerance: the centre of a sign is within ``tolerance_px`` of the true centre. The visible part of a
pole and the true one share ``LEAST_SHARED`` of their union, measured along the true axis; there,
the line stays within ``tolerance_px`` of the axis; and the angle is at most ``ANGLE_DEG``, or that
of ``ANGLE_PX`` over the shared length.

Detections within the tolerance of an ignored element are neither right nor wrong, whatever their
class and number. All other detections are false positives. A detection of a wrong class is a false
positive and its element a missed detection; ``match_confused_classes`` pairs them.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

HELD_OUT_SEED = 30_000
"""Simulated streets with seeds from here on are for evaluation, not for training or tuning."""
NEAREST_M, REACH_M = RANGE_M
"""Closer or farther elements do not count by default."""
TOLERANCE_PX, TOLERANCE_SHARE = 4.0, 0.25
"""Tolerance of a sign's centre or a pole's line: px, or this share of its size if larger."""
LEAST_SHARED = 0.3
ANGLE_DEG, ANGLE_PX = 5.0, 2.0
SHORTEST_PX = 8.0
"""Poles with a shorter visible part do not count."""
FALSE_POSITIVE, IGNORED = -1, -2
"""Stand for the row of an element."""


@dataclass(frozen=True, eq=False)
class ImageGroundTruth:
    """The true elements of an image."""

    elements: Elements2D
    """(n,)"""
    counts: BoolArray
    """(n,) False for ignored elements."""
    distance_m: FloatArray
    """(n,) horizontal distance from the camera; NaN if unknown."""
    size_px: FloatArray
    """(n,) shorter side of a sign, width of a pole; NaN if unknown."""

    @classmethod
    def of(
        cls,
        elements: Elements2D,
        distance_m: FloatArray | None = None,
        size_px: FloatArray | None = None,
        ignored: BoolArray | None = None,
        reach_m: float = REACH_M,
    ) -> "ImageGroundTruth":
        """Return ground truth in which all elements count but these: ``ignored`` ones, those not
        ``NEAREST_M`` to ``reach_m`` away, and poles shorter than ``SHORTEST_PX``."""
        unknown = np.full(len(elements), np.nan)
        distance = unknown if distance_m is None else distance_m
        length = np.linalg.norm(elements.end_px - elements.anchor_px, axis=1)
        counts = ~((distance < NEAREST_M) | (distance > reach_m) | (length < SHORTEST_PX))
        if ignored is not None:
            counts &= ~ignored
        return cls(elements, counts, distance, unknown if size_px is None else size_px)

    @property
    def tolerance_px(self) -> FloatArray:
        """(n,) tolerance of each element."""
        return np.fmax(TOLERANCE_PX, TOLERANCE_SHARE * self.size_px)


def match_detections(detections: Elements2D, truth: ImageGroundTruth) -> IntArray:
    """Return (m,) the row of each detection's element, ``FALSE_POSITIVE`` or ``IGNORED``."""
    distance = _distances(detections, truth)
    own = detections.class_id[:, None] == truth.elements.class_id
    rows = _match_greedily(np.where(own & truth.counts, distance, np.inf), detections.score)
    beside = np.isfinite(distance[:, ~truth.counts]).any(axis=1)
    return np.where((rows == FALSE_POSITIVE) & beside, IGNORED, rows)


def match_confused_classes(
    detections: Elements2D, truth: ImageGroundTruth, matches: IntArray
) -> IntArray:
    """Return (m,) the row of the missed element of another class, or ``FALSE_POSITIVE``.

    The rule of ``match_detections`` is applied to the false positives and missed elements it left.
    """
    missed = truth.counts & ~np.isin(np.arange(len(truth.counts)), matches)
    candidates = (matches == FALSE_POSITIVE)[:, None] & missed
    return _match_greedily(
        np.where(candidates, _distances(detections, truth), np.inf), detections.score
    )


def _match_greedily(distance: FloatArray, score: FloatArray) -> IntArray:
    """Return (m,) the nearest free row of each, best score first, or ``FALSE_POSITIVE``.

    Infinite distances do not match.
    """
    distance = distance.copy()
    rows = np.full(len(score), FALSE_POSITIVE)
    if not distance.shape[1]:
        return rows
    for row in np.argsort(-score, kind="stable"):
        element = int(distance[row].argmin())
        if np.isfinite(distance[row, element]):
            rows[row] = element
            distance[:, element] = np.inf
    return rows


def _distances(detections: Elements2D, truth: ImageGroundTruth) -> FloatArray:
    """Return (m, n) the distance over its tolerance, for any class; infinity above 1."""
    distance = np.full((len(detections), len(truth.elements)), np.inf)
    for is_line, rule in ((True, _pole_distances), (False, _sign_distances)):
        rows = np.flatnonzero(detections.is_line == is_line)
        columns = np.flatnonzero(truth.elements.is_line == is_line)
        if len(rows) and len(columns):
            tolerance = truth.tolerance_px[columns]
            ratio = rule(detections[rows], truth.elements[columns], tolerance)
            distance[np.ix_(rows, columns)] = np.where(ratio <= 1.0, ratio, np.inf)
    return distance


def _sign_distances(
    detections: Elements2D, true: Elements2D, tolerance_px: FloatArray
) -> FloatArray:
    """Return (m, n) the distance over its tolerance."""
    offset = detections.anchor_px[:, None] - true.anchor_px
    return np.asarray(np.linalg.norm(offset, axis=2) / tolerance_px)


def _pole_distances(
    detections: Elements2D, true: Elements2D, tolerance_px: FloatArray
) -> FloatArray:
    """Return (m, n) the larger ratio of distance and angle to their limits.

    NaN if the shared length is too short.
    """
    axis = true.end_px - true.anchor_px
    length = np.linalg.norm(axis, axis=1)
    along = axis / length[:, None]
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    ends = (
        np.stack([detections.anchor_px, detections.end_px], axis=1)[:, None]
        - true.anchor_px[:, None]
    )
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
        off = [
            np.abs(t[..., 0] + slope * (end_s - s[..., 0])) for end_s in (shared_low, shared_high)
        ]
        ratio = np.maximum(np.maximum(*off) / tolerance_px, angle / limit)
    return np.where(enough, ratio, np.nan)
