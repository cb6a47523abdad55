"""Compute the residual rows of the prior and the belief, which need no correspondence.

There are up to 12 rows: position 3, gravity 2, heading 1, belief 6. The height of a camera
comes from the road the map carries; roads above one another, as at a bridge, are distinguished.
"""

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.localization.problem import PriorRecord

MOST_ROWS = 12
"""Position 3, up 2, heading 1, belief 6."""
ROAD_BLUR_M = 2.0
"""Standard deviation of the Gaussian weights that average the road's height."""
LEAST_WEIGHT_CHI2 = 25.0
"""Road points that would weigh less than exp(-12.5) of the nearest are left out."""
SAME_PASS_M, STEEPEST = 0.15, 0.15
"""Road points belong to one pass of a road if their heights differ by no more than the first, plus
the second per metre between them. A map's trajectory returns to the same position at another
height: on a bridge, or by the drift of its own poses (0.5 m in KITTI's)."""
HEIGHT_WEIGHT = 10.0
"""A metre of height counts as much as so many metres on the ground."""
OTHER_HEIGHT_M = 0.5
"""Passes whose heights differ by less are searched as one."""
MOST_ROADS, ROAD_WIDTH_M = 3, 15.0
"""Most roads above one another that a position can be on, and the largest distance from them."""
NEAR_ROAD_M = 30.0
"""The road is first looked for within this of a position, then everywhere."""
_FAR_M2 = 1e18


@compiled
def prior_rows(
    prior: PriorRecord, R: FloatArray, t: FloatArray, residual: FloatArray, jacobian: FloatArray
) -> int:
    """Fill whitened residuals (MOST_ROWS,) and their Jacobian (MOST_ROWS, 6) by the left
    perturbation of the pose; return the number of rows."""
    row = 0
    jacobian[:] = 0.0
    if prior.value.has_position:
        row = _position_rows(prior, R, t, residual, jacobian)
    if prior.value.has_up:
        for axis in range(2):
            across = prior.value.across_up[axis]
            off = across[0] * R[0, 2] + across[1] * R[1, 2] + across[2] * R[2, 2]
            residual[row] = off / prior.value.up_sigma_rad
            # d(up) = w x up, so the row a gives a . (w x up) = (up x a) . w
            jacobian[row, 3] = (
                R[1, 2] * across[2] - R[2, 2] * across[1]
            ) / prior.value.up_sigma_rad
            jacobian[row, 4] = (
                R[2, 2] * across[0] - R[0, 2] * across[2]
            ) / prior.value.up_sigma_rad
            jacobian[row, 5] = (
                R[0, 2] * across[1] - R[1, 2] * across[0]
            ) / prior.value.up_sigma_rad
            row += 1
    if prior.value.has_heading:
        _heading_row(prior, R, residual, jacobian, row)
        row += 1
    if prior.value.has_belief:
        row = _belief_rows(prior, R, t, residual, jacobian, row)
    return row


@compiled
def prior_chi2(prior: PriorRecord, R: FloatArray, t: FloatArray) -> float:
    """Return the sum of squares of ``prior_rows``."""
    residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    count = prior_rows(prior, R, t, residual, jacobian)
    return (residual[:count] ** 2).sum()


@compiled_leaf
def road_height(road_m: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the height of a camera on the road at (x, y), and its slopes along x and y.

    ``road_m`` is ordered by x. Of several passes, the one nearest to (x, y, z) counts.
    """
    nearest, first, least = _FAR_M2, 0, 0.0
    for reach_m in (NEAR_ROAD_M, np.inf):
        for k in range(*_rows_between(road_m, x, reach_m)):
            flat = (road_m[k, 0] - x) ** 2 + (road_m[k, 1] - y) ** 2
            distance = flat + (HEIGHT_WEIGHT * (road_m[k, 2] - z)) ** 2
            if distance < nearest:
                nearest, first, least = distance, k, flat
        if nearest < reach_m * reach_m:
            break
    total = height = height_x = height_y = total_x = total_y = 0.0
    blur_m = np.sqrt(least + LEAST_WEIGHT_CHI2 * ROAD_BLUR_M**2)
    for k in range(*_rows_between(road_m, x, blur_m)):
        dx, dy = road_m[k, 0] - x, road_m[k, 1] - y
        further = (dx * dx + dy * dy - least) / ROAD_BLUR_M**2
        if further > LEAST_WEIGHT_CHI2 or not _same_pass(road_m, first, k):
            continue
        weight = np.exp(-0.5 * further)
        total += weight
        height += weight * road_m[k, 2]
        total_x += weight * dx
        total_y += weight * dy
        height_x += weight * dx * road_m[k, 2]
        height_y += weight * dy * road_m[k, 2]
    mean = height / total
    slope_x = (height_x - mean * total_x) / (total * ROAD_BLUR_M**2)
    slope_y = (height_y - mean * total_y) / (total * ROAD_BLUR_M**2)
    return mean, slope_x, slope_y


@compiled
def road_heights(prior: PriorRecord, x: float, y: float) -> FloatArray:
    """Return the heights (l,) that a camera at (x, y) can have: one for each road nearby."""
    road = prior.road_m
    chosen, heights = np.empty(MOST_ROADS, dtype=np.int64), np.empty(MOST_ROADS)
    heights[0] = prior.value.position_m[2]
    count = 0
    while count < MOST_ROADS:
        least, best = ROAD_WIDTH_M**2 if count else _FAR_M2, -1
        for k in range(*_rows_between(road, x, ROAD_WIDTH_M if count else NEAR_ROAD_M)):
            square = (road[k, 0] - x) ** 2 + (road[k, 1] - y) ** 2
            if square < least and _is_new(road, chosen[:count], k):
                least, best = square, k
        if count == 0 and least > NEAR_ROAD_M**2:
            least, best = _nearest(road, x, y)
        if best < 0:
            break
        chosen[count], heights[count] = best, road[best, 2]
        count += 1
    return heights[: max(count, 1)]


@compiled_leaf
def _rows_between(road_m: FloatArray, x: float, reach_m: float) -> tuple[int, int]:
    """Return the first and the last row + 1 of the road points within ``reach_m`` along x."""
    east_m = road_m[:, 0]
    first = np.searchsorted(east_m, x - reach_m)
    return int(first), int(np.searchsorted(east_m, x + reach_m, side="right"))


@compiled_leaf
def _nearest(road_m: FloatArray, x: float, y: float) -> tuple[float, int]:
    """Return the squared distance of the nearest road point, and its row, -1 without a road."""
    least, best = _FAR_M2, -1
    for k in range(len(road_m)):
        square = (road_m[k, 0] - x) ** 2 + (road_m[k, 1] - y) ** 2
        if square < least:
            least, best = square, k
    return least, best


@compiled_leaf
def _same_pass(road_m: FloatArray, row: int, other: int) -> bool:
    east, north = road_m[other, 0] - road_m[row, 0], road_m[other, 1] - road_m[row, 1]
    rise = abs(road_m[other, 2] - road_m[row, 2])
    return rise <= SAME_PASS_M + STEEPEST * np.sqrt(east * east + north * north)


@compiled_leaf
def _is_new(road_m: FloatArray, chosen: IntArray, row: int) -> bool:
    """Return whether a road point is on another pass than those chosen, at another height."""
    new = True
    for other in chosen:
        rise = abs(road_m[other, 2] - road_m[row, 2])
        new = new and rise > OTHER_HEIGHT_M and not _same_pass(road_m, other, row)
    return new


@compiled
def _position_rows(
    prior: PriorRecord, R: FloatArray, t: FloatArray, residual: FloatArray, jacobian: FloatArray
) -> int:
    """Compare the camera centre with the fix, and its height with the road's."""
    center = np.empty(3)
    for k in range(3):
        center[k] = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2])
        residual[k] = (center[k] - prior.value.position_m[k]) / prior.value.position_sigma_m[k]
        for axis in range(3):  # d(center) = -R^T v
            jacobian[k, axis] = -R[axis, k] / prior.value.position_sigma_m[k]
    if len(prior.road_m):
        height, slope_x, slope_y = road_height(prior.road_m, center[0], center[1], center[2])
        sigma = prior.value.position_sigma_m[2]
        residual[2] = (center[2] - height) / sigma
        for axis in range(3):
            jacobian[2, axis] += (slope_x * R[axis, 0] + slope_y * R[axis, 1]) / sigma
    return 3


@compiled_leaf
def _heading_row(
    prior: PriorRecord, R: FloatArray, residual: FloatArray, jacobian: FloatArray, row: int
) -> None:
    x, y = R[2, 0], R[2, 1]
    flat = max(x * x + y * y, 1e-9)
    off = np.arctan2(y, x) - prior.value.heading_rad
    residual[row] = np.arctan2(np.sin(off), np.cos(off)) / prior.value.heading_sigma_rad
    # d(ahead) = R^T (z x w), so the row g gives (R g) . (z x w) = ((R g) x z) . w
    gx, gy = -y / flat, x / flat
    first, second = R[0, 0] * gx + R[0, 1] * gy, R[1, 0] * gx + R[1, 1] * gy
    jacobian[row, 3] = second / prior.value.heading_sigma_rad
    jacobian[row, 4] = -first / prior.value.heading_sigma_rad


@compiled
def _belief_rows(
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    residual: FloatArray,
    jacobian: FloatArray,
    row: int,
) -> int:
    """log(T T_belief^-1), whitened; the Jacobian is that close to the belief."""
    turn = R @ prior.value.belief_rotation.T
    off = np.empty(6)
    off[:3] = t - turn @ prior.value.belief_translation
    cosine = min(max(0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0), -1.0), 1.0)
    angle = np.arccos(cosine)
    scale = 0.5 if angle < 1e-6 else 0.5 * angle / max(np.sin(angle), 1e-9)
    off[3] = scale * (turn[2, 1] - turn[1, 2])
    off[4] = scale * (turn[0, 2] - turn[2, 0])
    off[5] = scale * (turn[1, 0] - turn[0, 1])
    for k in range(6):
        residual[row + k] = 0.0
        for column in range(6):
            residual[row + k] += prior.value.belief_white[k, column] * off[column]
            jacobian[row + k, column] = prior.value.belief_white[k, column]
    return row + 6
