"""How far things are from where they were seen: the one definition of fit of a map.

Signs: both image axes. Poles: how far the projected line passes beside both observed ends, and how
far along it the known ends are. So a line is a line: where on it a hidden end is means nothing.
"""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M

_KINDS = [0, 0, 1, 2]
"""Which of ``Residuals.squared_px2`` each row belongs to."""
_BEHIND = 1e9


@dataclass(frozen=True, eq=False)
class Residuals:
    """Of k sightings, four rows each; a row that does not exist is zero throughout."""

    error_px: FloatArray
    """(k, 4) thing minus sighting. Signs: u, v, nothing, nothing. Poles: across the projected line
    (to its right where it runs downwards) at the observed anchor and end; along the observed line
    at both."""
    J: FloatArray
    """(k, 4, 6) px/m, by (anchor, end) in the map frame. An end that nobody saw is held where it is
    along the line: its rows along have no error, but a derivative."""
    by_u: FloatArray
    """(k, 4) derivative by a shift of what is projected to the right, in px/px."""
    counts: BoolArray
    """(k, 4) whether the row is a measurement."""
    ahead: BoolArray
    """(k,) False where the thing is behind the camera: its rows are zero too."""

    def squared_px2(self) -> FloatArray:
        """(k, 3) squared lengths of what can be wrong by itself: a click, or a pole's line; and
        each of a pole's ends along it."""
        squares = self.error_px**2
        return np.stack([squares[:, 0] + squares[:, 1], squares[:, 2], squares[:, 3]], axis=1)

    def robust(self, sigma_px: float, outlier_sigmas: float) -> tuple[FloatArray, FloatArray]:
        """(k,) cost and (k, 4) weights of the rows, in multiples of sigma.

        Cauchy's loss, for each of ``squared_px2`` by itself: from about ``outlier_sigmas`` on an
        error counts less than its square. A thing behind the camera costs more than any error.
        """
        squares = self.squared_px2() / sigma_px**2
        scaled = squares / outlier_sigmas**2
        cost = squares if np.isinf(outlier_sigmas) else outlier_sigmas**2 * np.log1p(scaled)
        weights = 1.0 / (1.0 + scaled)
        return np.where(self.ahead, cost.sum(axis=1), _BEHIND), weights[:, _KINDS]

    def trust(self, sigma_px: float, outlier_sigmas: float) -> FloatArray:
        """(k, 4) how much of each row's information counts: all of it where it is no outlier.

        The weights of ``robust`` would make covariances too large by a tenth (measured).
        """
        _, weights = self.robust(sigma_px, outlier_sigmas)
        return np.where(weights >= 0.5, 1.0, weights)


def residuals(
    views: Views, sightings: Sightings, anchor_m: FloatArray, end_m: FloatArray
) -> Residuals:
    """Of the n things of ``sightings`` at (n, 3) each; ends of points are not looked at."""
    k = len(sightings)
    result = Residuals(
        error_px=np.zeros((k, 4)),
        J=np.zeros((k, 4, 6)),
        by_u=np.zeros((k, 4)),
        counts=np.zeros((k, 4), dtype=bool),
        ahead=np.zeros(k, dtype=bool),
    )
    is_line = sightings.is_line
    _fill_points(views, sightings, np.flatnonzero(~is_line), anchor_m, result)
    _fill_lines(views, sightings, np.flatnonzero(is_line), anchor_m, end_m, result)
    for values in (result.error_px, result.J, result.by_u):
        values[~result.ahead] = 0.0
    return result


def _fill_points(
    views: Views, sightings: Sightings, rows: IntArray, anchor_m: FloatArray, result: Residuals
) -> None:
    pixels, J, ahead = projected(views, sightings.view[rows], anchor_m[sightings.thing[rows]])
    result.error_px[rows, :2] = pixels - sightings.anchor_px[rows]
    result.J[rows, :2, :3] = J
    result.by_u[rows, 0] = 1.0
    result.counts[rows, :2] = True
    result.ahead[rows] = ahead


def _fill_lines(
    views: Views,
    sightings: Sightings,
    rows: IntArray,
    anchor_m: FloatArray,
    end_m: FloatArray,
    result: Residuals,
) -> None:
    things, images = sightings.thing[rows], sightings.view[rows]
    anchor, of_anchor, anchor_ahead = projected(views, images, anchor_m[things])
    end, of_end, end_ahead = projected(views, images, end_m[things])
    result.ahead[rows] = anchor_ahead & end_ahead
    length = np.maximum(np.linalg.norm(end - anchor, axis=1), 1e-9)[:, None]
    along = (end - anchor) / length
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    anchor_across, end_across = _dot(across, of_anchor), _dot(across, of_end)
    seen_px = (sightings.anchor_px[rows], sightings.end_px[rows])
    known = (sightings.anchor_known, sightings.end_known)
    places, by_place = (anchor, end), (of_anchor, of_end)
    seen_along = seen_px[1] - seen_px[0]  # not along the thing: a stray line would turn it
    seen_along /= np.maximum(np.linalg.norm(seen_along, axis=1, keepdims=True), 1e-9)
    for which in range(2):
        off = places[which] - seen_px[which]
        share = ((seen_px[which] - anchor) * along).sum(axis=1)[:, None] / length
        result.error_px[rows, which] = (off * across).sum(axis=1)
        result.J[rows, which, :3] = (1.0 - share) * anchor_across
        result.J[rows, which, 3:] = share * end_across
        result.by_u[rows, which] = across[:, 0]
        result.counts[rows, which] = True
        seen_by_any = sightings.of(known[which] & result.ahead)[things]
        counts = known[which][rows]
        result.by_u[rows, 2 + which] = np.where(counts, seen_along[:, 0], 0.0)
        result.counts[rows, 2 + which] = counts
        result.error_px[rows, 2 + which] = np.where(counts, (off * seen_along).sum(axis=1), 0.0)
        moves = np.where((counts | ~seen_by_any)[:, None], _dot(seen_along, by_place[which]), 0.0)
        result.J[rows, 2 + which, 3 * which : 3 * which + 3] = moves


def projected(
    views: Views, rows: IntArray, points_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels (k, 2) of points (k, 3), each in the view in its row (k,); how they move with the
    points (k, 2, 3); and whether the point is ahead (k,). Numbers behind the camera mean nothing.
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
    """(k, 3) of directions (k, 2) and derivatives (k, 2, 3)."""
    return np.asarray((direction[:, None] @ J)[:, 0])
