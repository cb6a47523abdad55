"""Match an image's detections with its true elements, and measure their errors by class.

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

Errors follow the criteria of the paper's tables. Signs: RMSE is over the distances; lateral and
longitudinal are the image axes u and v. Poles: the angle between the detected and the true line,
and the distance of the detected line from the true ends. Errors are detected minus true. SDE is the
standard deviation around the mean error (ME), with divisor n, so for signs RMSE^2 is the sum of all
four squared.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

CRITERIA = {
    "RMSE (px)": "rmse_px",
    "lateral ME (px)": "lateral_me_px",
    "lateral SDE (px)": "lateral_sde_px",
    "lateral RMSE (px)": "lateral_rmse_px",
    "longitudinal ME (px)": "longitudinal_me_px",
    "longitudinal SDE (px)": "longitudinal_sde_px",
    "angular ME (deg)": "angular_me_deg",
    "angular SDE (deg)": "angular_sde_deg",
    "angular RMSE (deg)": "angular_rmse_deg",
}
"""Names in tables of the fields of ``ClassAccuracy``."""


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """Errors of one pole or sign in an image."""

    lateral_px: FloatArray
    """(1,) of a sign, (2,) of a pole: one for each true end."""
    longitudinal_px: FloatArray
    """(1,) of a sign, (0,) of a pole."""
    angular_deg: FloatArray
    """(0,) of a sign, (1,) of a pole."""

    @classmethod
    def between(cls, found_px: FloatArray, true_px: FloatArray) -> "ImageErrors":
        """Return the errors of an anchor and end (2, 2); a sign's end is NaN."""
        if np.isnan(true_px[1, 0]):
            du, dv = found_px[0] - true_px[0]
            return cls(np.array([du]), np.array([dv]), np.zeros(0))
        true, estimate = true_px[1] - true_px[0], found_px[1] - found_px[0]
        sine = true[0] * estimate[1] - true[1] * estimate[0]
        angle = np.rad2deg(np.arctan2(sine, true @ estimate))
        return cls(across_px(found_px, true_px), np.zeros(0), np.array([angle]))


@dataclass(frozen=True)
class ClassAccuracy:
    """Errors of one class; None if not defined for the class, or without observations."""

    rmse_px: float | None
    """Signs only, as in the paper."""
    lateral_me_px: float | None
    """Poles: across the true line; positive to the right of a line that runs downwards."""
    lateral_sde_px: float | None
    lateral_rmse_px: float | None
    longitudinal_me_px: float | None
    longitudinal_sde_px: float | None
    angular_me_deg: float | None
    """Poles only: from the true to the detected direction, from u towards v."""
    angular_sde_deg: float | None
    angular_rmse_deg: float | None
    observations: int

    @classmethod
    def of(cls, errors: Sequence[ImageErrors]) -> "ClassAccuracy":
        lateral, longitudinal, angular = (
            np.concatenate([getattr(error, name) for error in errors] or [np.zeros(0)])
            for name in ("lateral_px", "longitudinal_px", "angular_deg")
        )
        return cls(
            rmse_px=rms(np.hypot(lateral, longitudinal)) if longitudinal.size else None,
            lateral_me_px=_mean(lateral),
            lateral_sde_px=_deviation(lateral),
            lateral_rmse_px=rms(lateral),
            longitudinal_me_px=_mean(longitudinal),
            longitudinal_sde_px=_deviation(longitudinal),
            angular_me_deg=_mean(angular),
            angular_sde_deg=_deviation(angular),
            angular_rmse_deg=rms(angular),
            observations=len(errors),
        )


def across_px(line_px: FloatArray, points_px: FloatArray) -> FloatArray:
    """Return (n,) signed distances of a line (2, 2: anchor, end) from points (n, 2).

    Positive if the line is to the right of the point, for a line that runs downwards.
    """
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return np.asarray((line_px[0] - points_px) @ across)


def rms(values: FloatArray) -> float | None:
    """Return the root mean square; None without values."""
    return float(np.sqrt(np.square(values).mean())) if values.size else None


def _mean(values: FloatArray) -> float | None:
    return float(values.mean()) if values.size else None


def _deviation(values: FloatArray) -> float | None:
    return float(values.std()) if values.size else None


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
