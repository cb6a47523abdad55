"""Robust triangulation of landmarks from all their views, with covariance.

An outlier loses weight with its distance (Cauchy's loss). If several observations are wrong, the
position that most observations agree with is found from pairs of observations. That resembles
RANSAC (Fischler and Bolles 1981), but the pairs are not random. A single element is triangulated
fast enough to follow a dragged mark; that result equals the linear one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.labels.labels import Observation
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.landmarks import Landmarks, measure_landmarks, rms_px
from semviz_annotation.mapping.placement.linear import (
    MIN_ANGLE_RAD,
    along_lines,
    end_rays,
    linear_start,
    outermost,
)
from semviz_annotation.mapping.placement.observations import (
    ObservationArray,
    ViewArray,
    as_views,
    undistorted,
)
from semviz_annotation.mapping.placement.reprojection import (
    PlaceOptions,
    refine_positions,
    residuals,
)
from semviz_core.base.camera import Rig
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnCount, unwatched

__all__ = [
    "Landmarks",
    "PlaceOptions",
    "triangulate_landmarks",
    "triangulate_linearly",
]

_PAIRS = 24
"""Pairs per landmark. With two wrong observations in five, all 24 pairs contain a wrong one once in
40,000 landmarks."""
_GOLDEN = (5.0**0.5 - 1.0) / 2.0


def best_of_pairs(
    views: ViewArray, observations: ObservationArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """Return the positions (n, 6: anchor and end) from pairs with the least robust cost over all
    observations, and that cost (n,), infinite if no pair intersects.

    Each landmark has two observations or more.
    """
    best, least = np.zeros((observations.count, 6)), np.full(observations.count, np.inf)
    for number in range(_PAIRS):
        rows = _pairs(observations, number)
        pairs = observations.taken(rows.ravel(), np.repeat(np.arange(len(rows)), 2), len(rows))
        start = linear_start(views, pairs, min_angle_rad=0.0)
        X = np.where(start.ok[:, None], start.places_m(), 0.0)
        at = residuals(views, observations, X[:, :3], X[:, 3:])
        cost, _ = at.robust(options.sigma_px, options.outlier_sigmas)
        total = np.where(start.ok, observations.per_landmark(np.add, cost), np.inf)
        better = total < least
        best[better], least[better] = X[better], total[better]
    return best, least


def _pairs(observations: ObservationArray, number: int) -> IntArray:
    """Return the rows (n, 2) of two observations per landmark, near or far ones by ``number``."""
    seen, first = observations.seen, observations.first
    start = number * seen // _PAIRS
    apart = 1 + (number * _GOLDEN % 1.0 * (seen - 1)).astype(np.int64)
    return np.stack([first + start, first + (start + apart) % seen], axis=1)


_OUTLIER_SIGMAS = 5.0
"""An observation with a larger error, RMS in multiples of sigma, is an outlier."""
_REFUSED = 0.5
"""Landmarks with a larger share of outliers have no position."""
_DOUBTFUL = 0.1
"""With a larger share of outliers, the position may be between two landmarks."""
_AT_ONCE = 20_000
"""Number of observations handled at once, which bounds the memory."""


def triangulate_landmarks(
    views: ViewArray,
    observations: ObservationArray,
    options: PlaceOptions = PlaceOptions(),
    on_progress: OnCount = unwatched,
) -> Landmarks:
    """Triangulate the landmarks of ``observations`` from all their views; ``on_progress`` counts
    them."""
    parts, done = [], 0
    for part in _parts(observations):
        parts.append(_place(views, part, options))
        done += part.count
        on_progress(done, observations.count)
    return Landmarks.joined(parts)


def triangulate_linearly(
    views: ViewArray, observations: ObservationArray, options: PlaceOptions = PlaceOptions()
) -> Landmarks:
    """Triangulate from rays and planes alone, as in the paper; otherwise like
    ``triangulate_landmarks``."""
    start = linear_start(views, observations, options.min_angle_rad)
    return measure_landmarks(
        views,
        observations,
        start.places_m(),
        start.failure,
        start.too_narrow,
        start.angle_rad,
        replace(options, outlier_sigmas=np.inf),
    )


def _parts(observations: ObservationArray) -> Iterator[ObservationArray]:
    """Yield parts with about ``_AT_ONCE`` rows and whole landmarks."""
    if not observations.count:
        yield observations
    part = np.cumsum(observations.seen) // _AT_ONCE
    for number in np.unique(part):
        yield observations.only(part == number)


def _place(views: ViewArray, observations: ObservationArray, options: PlaceOptions) -> Landmarks:
    start = linear_start(views, observations, options.min_angle_rad)
    X, cost = refine_positions(views, observations, start.places_m(), start.ok, options)
    outliers, _ = _outliers(views, observations, X, options)
    doubtful = (
        (np.isinf(cost) | (outliers >= _DOUBTFUL)) & ~start.too_narrow & (observations.seen > 2)
    )
    _put_better(views, observations, doubtful, X, cost, options)
    placed = np.isfinite(cost)
    start.failure[placed] = ""
    start.fail(~placed, "the views do not agree on a place: are these different landmarks?")
    outliers, rms = _outliers(views, observations, X, options)
    for landmark in np.flatnonzero(placed & (outliers >= _REFUSED)):
        words = f"the views disagree by {rms[landmark]:.1f} px: are these different landmarks?"
        start.failure[landmark] = words
    X = _stretched(views, observations, X, options)
    return measure_landmarks(
        views, observations, X, start.failure, start.too_narrow, start.angle_rad, options
    )


def _put_better(
    views: ViewArray,
    observations: ObservationArray,
    landmarks: BoolArray,
    X: FloatArray,
    cost: FloatArray,
    options: PlaceOptions,
) -> None:
    """Replace positions X (n, 6) and costs (n,) of landmarks (n,) by better ones from pairs."""
    if not landmarks.any():
        return
    observations = observations.only(landmarks)
    near, agreed = best_of_pairs(views, observations, options)
    new_X, new_cost = refine_positions(views, observations, near, np.isfinite(agreed), options)
    better = new_cost < cost[landmarks]
    rows = np.flatnonzero(landmarks)[better]
    X[rows], cost[rows] = new_X[better], new_cost[better]


def _outliers(
    views: ViewArray, observations: ObservationArray, X: FloatArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """Return the share of outliers (n,) of landmarks at X (n, 6), and the RMS error (n,) px."""
    at = residuals(views, observations, X[:, :3], X[:, 3:])
    off = (at.error_px**2).sum(axis=1) / np.maximum(at.counts.sum(axis=1), 1)
    outlier = ~at.ahead | (off > (_OUTLIER_SIGMAS * options.sigma_px) ** 2)
    share = observations.per_landmark(np.add, outlier.astype(float)) / np.maximum(
        observations.seen, 1
    )
    return share, rms_px(observations, at)


def _stretched(
    views: ViewArray, observations: ObservationArray, X: FloatArray, options: PlaceOptions
) -> FloatArray:
    """Return X (n, 6) with unknown ends at the farthest point of the line that anybody saw.

    Observations that lie beside the line do not count for its length, unless all do.
    """
    observations = observations.where(observations.is_line)
    unseen = [
        ~observations.of(known) for known in (observations.anchor_known, observations.end_known)
    ]
    anchor, end = X[:, :3], X[:, 3:]
    at = residuals(views, observations, anchor, end)
    on_line = at.squared_px2()[:, 0] <= (options.outlier_sigmas * options.sigma_px) ** 2
    usable = observations.where(on_line | ~observations.of(on_line)[observations.landmark])
    length = np.maximum(np.linalg.norm(end - anchor, axis=1, keepdims=True), 1e-9)
    direction = (end - anchor) / length
    along = along_lines(views, usable, end_rays(views, usable), anchor, direction)
    is_line = observations.seen > 0
    result = X.copy()
    for which, place in enumerate(outermost(usable, along)):
        moved = is_line & unseen[which]
        result[moved, 3 * which : 3 * which + 3] = (anchor + place[:, None] * direction)[moved]
    return result


_NO_END = (np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class Triangulated:
    """One triangulated element in the map frame."""

    anchor_m: FloatArray
    """(3,) peak of a pole, centre of a sign."""
    end_m: FloatArray
    """(3,) bottom of a pole, NaN for signs."""
    covariance_m2: FloatArray
    """(6, 6) of (anchor, end), to first order; zero in the rows of a sign's end."""
    anchor_known: bool
    end_known: bool
    angle_rad: float
    """Largest angle between two of the rays (signs) or planes (poles)."""
    rms_px: float
    """Reprojection error: of the point, or of a pole's ends across its line."""

    @property
    def is_line(self) -> bool:
        return bool(np.isfinite(self.end_m).all())


@dataclass(frozen=True)
class TriangulationFailure:
    """Why an element cannot be triangulated."""

    reason: str
    too_narrow: bool = False
    """The rays are sound but nearly parallel: views from elsewhere can help."""


def triangulate_pair(
    rig: Rig, left: Observation, right: Observation, sigma_px: float = 1.0
) -> Triangulated | TriangulationFailure:
    """Triangulate an element from both images of one frame, in the frame of the left camera."""
    return triangulate([rig_view(rig, "left"), rig_view(rig, "right")], [left, right], sigma_px)


def triangulate(
    views: Sequence[PosedView],
    observations: Sequence[Observation],
    sigma_px: float = 1.0,
    min_angle_rad: float = MIN_ANGLE_RAD,
) -> Triangulated | TriangulationFailure:
    """Triangulate an element from k >= 2 observations, one in each of ``views``, in their map
    frame.

    ``sigma_px`` is the standard deviation of an end in each direction. Return
    ``TriangulationFailure`` if the geometry gives no position. Raise SemvizError for fewer than two
    views, or poles among signs.
    """
    if len(views) < 2 or len(views) != len(observations):
        raise SemvizError("triangulation needs two or more observations, and a view for each")
    images = [(observation.frame_index, observation.side) for observation in observations]
    options = PlaceOptions(sigma_px, min_angle_rad)
    placed = triangulate_linearly(
        as_views(images, views), _observation_array(views, observations), options
    )
    if not placed.ok[0]:
        return TriangulationFailure(placed.failure[0], bool(placed.too_narrow[0]))
    return Triangulated(
        anchor_m=placed.anchor_m[0],
        end_m=placed.end_m[0],
        covariance_m2=placed.covariance_m2[0],
        anchor_known=bool(placed.anchor_known[0]),
        end_known=bool(placed.end_known[0]),
        angle_rad=float(placed.angle_rad[0]),
        rms_px=float(placed.rms_px[0]),
    )


def _observation_array(
    views: Sequence[PosedView], observations: Sequence[Observation]
) -> ObservationArray:
    """Return observations of one landmark, each in a view of its own."""
    k = len(observations)
    ends_px = np.array(
        [(observation.anchor_px, observation.end_px or _NO_END) for observation in observations]
    )
    for pair, view in zip(ends_px, views, strict=True):
        pair[:] = undistorted(view.camera, pair)
    return ObservationArray(
        landmark=np.zeros(k, dtype=np.int64),
        view=np.arange(k),
        anchor_px=ends_px[:, 0],
        end_px=ends_px[:, 1],
        anchor_known=np.array([observation.anchor_known for observation in observations]),
        end_known=np.array([observation.end_known for observation in observations]),
        sigma_ratio=np.ones((k, 2)),
        label_row=np.arange(k),
        count=1,
    )
