"""Residuals of landmarks in images, and their robust minimization.

Signs have residuals along both image axes. Poles have the distance of the projected line from both
observed ends, and the distance of the known ends along it; the position of hidden ends on the line
does not matter. Many landmarks are optimized at once, with the information matrix of each.
"""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.mapping.placement.linear import MIN_ANGLE_RAD, beyond_horizon
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.errors import SemvizError

_KINDS = [0, 0, 1, 2]
"""The column of ``Residuals.squared_px2`` that each row belongs to."""
_RATIOS = [0, 0, 1, 1]
"""The column of ``ObservationArray.sigma_ratio`` of each row of a pole."""
_BEHIND = 1e9


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of k observations, four rows each; rows that do not exist are zero."""

    error_px: FloatArray
    """(k, 4) projection minus observation, over ``sigma_ratio``. Signs: u, v, 0, 0. Poles: across
    the projected line (to its right if it runs downwards) at the observed anchor and end, then
    along the observed line at both."""
    J: FloatArray
    """(k, 4, 6) px/m, by (anchor, end) in the map frame, over ``sigma_ratio``. The row of an end
    that nobody saw has no error, but a derivative, which holds the end on the line."""
    by_u: FloatArray
    """(k, 4) derivative by a shift of the projection to the right, in px/px, over
    ``sigma_ratio``."""
    sigma_ratio: FloatArray
    """(k, 4) sigma of each row, in multiples of the common sigma"""
    counts: BoolArray
    """(k, 4) whether the row is a measurement."""
    ahead: BoolArray
    """(k,) False if the landmark is behind the camera: its rows are zero too."""

    @property
    def pixels_off(self) -> FloatArray:
        """(k, 4) the errors in pixels of the image, whatever their sigma."""
        return np.asarray(self.error_px * self.sigma_ratio)

    def squared_px2(self) -> FloatArray:
        """Return squared lengths (k, 3) of independent errors: of a point or a pole's line, and of
        each of a pole's ends along it."""
        squares = self.error_px**2
        return np.stack([squares[:, 0] + squares[:, 1], squares[:, 2], squares[:, 3]], axis=1)

    def robust(self, sigma_px: float, outlier_sigmas: float) -> tuple[FloatArray, FloatArray]:
        """Return cost (k,) and weights (k, 4) of the rows, in multiples of sigma.

        Cauchy's loss for each of ``squared_px2`` by itself: from about ``outlier_sigmas`` on, an
        error counts less than its square. A landmark behind the camera costs more than any error.
        """
        squares = self.squared_px2() / sigma_px**2
        scaled = squares / outlier_sigmas**2
        cost = squares if np.isinf(outlier_sigmas) else outlier_sigmas**2 * np.log1p(scaled)
        weights = 1.0 / (1.0 + scaled)
        return np.where(self.ahead, cost.sum(axis=1), _BEHIND), weights[:, _KINDS]

    def trust(self, sigma_px: float, outlier_sigmas: float) -> FloatArray:
        """Return the weight (k, 4) of each row's information: 1 unless it is an outlier.

        The weights of ``robust`` would make covariances too large by a tenth (measured).
        """
        _, weights = self.robust(sigma_px, outlier_sigmas)
        return np.where(weights >= 0.5, 1.0, weights)


def residuals(
    views: ViewArray, observations: ObservationArray, anchor_m: FloatArray, end_m: FloatArray
) -> Residuals:
    """Return the residuals of n landmarks at (n, 3) each; the ends of points are ignored."""
    k = len(observations)
    result = Residuals(
        error_px=np.zeros((k, 4)),
        J=np.zeros((k, 4, 6)),
        by_u=np.zeros((k, 4)),
        sigma_ratio=observations.sigma_ratio[:, _RATIOS],
        counts=np.zeros((k, 4), dtype=bool),
        ahead=np.zeros(k, dtype=bool),
    )
    is_line = observations.is_line
    result.sigma_ratio[~is_line, :2] = observations.sigma_ratio[~is_line]
    _fill_points(views, observations, np.flatnonzero(~is_line), anchor_m, result)
    _fill_lines(views, observations, np.flatnonzero(is_line), anchor_m, end_m, result)
    result.J[:] /= result.sigma_ratio[:, :, None]
    for values in (result.error_px, result.by_u):
        values /= result.sigma_ratio
    for values in (result.error_px, result.J, result.by_u):
        values[~result.ahead] = 0.0
    return result


def _fill_points(
    views: ViewArray,
    observations: ObservationArray,
    rows: IntArray,
    anchor_m: FloatArray,
    result: Residuals,
) -> None:
    pixels, J, ahead = projected(
        views, observations.view[rows], anchor_m[observations.landmark[rows]]
    )
    result.error_px[rows, :2] = pixels - observations.anchor_px[rows]
    result.J[rows, :2, :3] = J
    result.by_u[rows, 0] = 1.0
    result.counts[rows, :2] = True
    result.ahead[rows] = ahead


def _fill_lines(
    views: ViewArray,
    observations: ObservationArray,
    rows: IntArray,
    anchor_m: FloatArray,
    end_m: FloatArray,
    result: Residuals,
) -> None:
    landmarks, images = observations.landmark[rows], observations.view[rows]
    anchor, of_anchor, anchor_ahead = projected(views, images, anchor_m[landmarks])
    end, of_end, end_ahead = projected(views, images, end_m[landmarks])
    result.ahead[rows] = anchor_ahead & end_ahead
    length = np.maximum(np.linalg.norm(end - anchor, axis=1), 1e-9)[:, None]
    along = (end - anchor) / length
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    anchor_across, end_across = _dot(across, of_anchor), _dot(across, of_end)
    seen_px = (observations.anchor_px[rows], observations.end_px[rows])
    known = (observations.anchor_known, observations.end_known)
    places, by_place = (anchor, end), (of_anchor, of_end)
    seen_along = seen_px[1] - seen_px[0]  # not along the landmark: a stray line would turn it
    seen_along = unit_vectors(seen_along)
    for which in range(2):
        off = places[which] - seen_px[which]
        share = ((seen_px[which] - anchor) * along).sum(axis=1)[:, None] / length
        result.error_px[rows, which] = (off * across).sum(axis=1)
        result.J[rows, which, :3] = (1.0 - share) * anchor_across
        result.J[rows, which, 3:] = share * end_across
        result.by_u[rows, which] = across[:, 0]
        result.counts[rows, which] = True
        seen_by_any = observations.of(known[which] & result.ahead)[landmarks]
        counts = known[which][rows]
        result.by_u[rows, 2 + which] = np.where(counts, seen_along[:, 0], 0.0)
        result.counts[rows, 2 + which] = counts
        result.error_px[rows, 2 + which] = np.where(counts, (off * seen_along).sum(axis=1), 0.0)
        moves = np.where((counts | ~seen_by_any)[:, None], _dot(seen_along, by_place[which]), 0.0)
        result.J[rows, 2 + which, 3 * which : 3 * which + 3] = moves


def projected(
    views: ViewArray, rows: IntArray, points_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return pixels (k, 2) of points (k, 3), each in the view in its row (k,).

    Also the derivatives (k, 2, 3) by the points, and whether each point is in front of the camera
    (k,); values behind the camera are undefined.
    """
    P = views.projection[rows]
    homogeneous = (P[:, :, :3] @ points_m[:, :, None])[:, :, 0] + P[:, :, 3]
    depth = homogeneous[:, 2]
    ahead = depth > MIN_DEPTH_M
    safe = np.where(ahead, depth, 1.0)[:, None]
    pixels = homogeneous[:, :2] / safe
    J = (P[:, :2, :3] - pixels[:, :, None] * P[:, 2:, :3]) / safe[:, :, None]
    return pixels, J, np.asarray(ahead)


def _dot(direction: FloatArray, J: FloatArray) -> FloatArray:
    """Return the products (k, 3) of directions (k, 2) and derivatives (k, 2, 3)."""
    return np.asarray((direction[:, None] @ J)[:, 0])


_STEPS = 100
_DONE = 1e-8
"""Converged when a step promises less than this, in multiples of sigma squared."""


@dataclass(frozen=True)
class PlaceOptions:
    """Options of triangulation."""

    sigma_px: float = 1.0
    """Standard deviation of an end in each direction."""
    min_angle_rad: float = MIN_ANGLE_RAD
    """Landmarks whose rays or planes have smaller angles have no position."""
    outlier_sigmas: float = 3.0
    """From about here on, an error counts less than its square; infinite: never."""

    def __post_init__(self) -> None:
        for name in ("sigma_px", "outlier_sigmas"):
            if not getattr(self, name) > 0.0:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")
        if not self.min_angle_rad >= 0.0:
            raise SemvizError(f"min_angle_rad must not be negative, but is {self.min_angle_rad}")


@dataclass(frozen=True, eq=False)
class _Normal:
    """The normal equations of n landmarks, in multiples of sigma."""

    cost: FloatArray
    """(n,) robust"""
    gradient: FloatArray
    """(n, 6)"""
    information: FloatArray
    """(n, 6, 6) see ``information``"""

    def chosen(self, landmarks: BoolArray) -> "_Normal":
        return _Normal(self.cost[landmarks], self.gradient[landmarks], self.information[landmarks])

    def put(self, landmarks: BoolArray, others: "_Normal") -> None:
        """Set the landmarks (n,) that are True from ``others`` (n)."""
        self.cost[landmarks] = others.cost[landmarks]
        self.gradient[landmarks] = others.gradient[landmarks]
        self.information[landmarks] = others.information[landmarks]


def refine_positions(
    views: ViewArray,
    observations: ObservationArray,
    X: FloatArray,
    where: BoolArray,
    options: PlaceOptions,
) -> tuple[FloatArray, FloatArray]:
    """Optimize the positions X (n, 6: anchor and end) of landmarks with True in where (n,).

    Return the positions and their robust costs (n,), infinite if there is none. Levenberg-Marquardt
    (Madsen, Nielsen & Tingleff 2004, 3.2), each landmark with its own damping.
    """
    X, cost = np.where(where[:, None], X, 0.0), np.full(len(X), np.inf)
    busy, landmarks = np.flatnonzero(where), observations.only(where)
    observations = landmarks
    damping = np.full(len(busy), 1e-4)
    state = _normal(views, observations, X[busy], options)
    for _ in range(_STEPS):
        if not len(busy):
            break
        damped = state.information * (1.0 + damping[:, None, None] * np.eye(6))
        step = -np.linalg.solve(damped, state.gradient[:, :, None])[:, :, 0]
        promised = -(state.gradient * step).sum(axis=1)
        candidate = _normal(views, observations, X[busy] + step, options)
        better = candidate.cost <= state.cost
        state.put(better, candidate)
        X[busy[better]] += step[better]
        damping = np.clip(damping * np.where(better, 0.1, 10.0), 1e-9, 1e9)
        done = promised < _DONE
        cost[busy[done]] = state.cost[done]
        observations, state = observations.only(~done), state.chosen(~done)
        busy, damping = busy[~done], damping[~done]
    anchor, is_line = X[where, :3], landmarks.of(landmarks.is_line)
    end = np.where(is_line[:, None], X[where, 3:], anchor)
    cost[where] = np.where(beyond_horizon(views, landmarks, anchor, end), np.inf, cost[where])
    return X, cost


def information(
    observations: ObservationArray, at: Residuals, weights: FloatArray, sigma_px: float
) -> FloatArray:
    """Return the information (n, 6, 6) of all rows with weights (k, 4); 1 on the diagonal for the
    ends that points do not have."""
    weighted = weights[:, :, None] * at.J / sigma_px**2
    total = observations.per_landmark(np.add, weighted.transpose(0, 2, 1) @ at.J)
    total[~observations.of(observations.is_line), 3:, 3:] = np.eye(3)
    return total


def _normal(
    views: ViewArray, observations: ObservationArray, X: FloatArray, options: PlaceOptions
) -> _Normal:
    at = residuals(views, observations, X[:, :3], X[:, 3:])
    cost, weights = at.robust(options.sigma_px, options.outlier_sigmas)
    pull = (at.J.transpose(0, 2, 1) @ (weights * at.error_px)[:, :, None])[:, :, 0]
    return _Normal(
        cost=observations.per_landmark(np.add, cost),
        gradient=observations.per_landmark(np.add, pull) / options.sigma_px**2,
        information=information(observations, at, weights, options.sigma_px),
    )
