"""The prior's and the belief's rows: what is known of a pose before anything is paired."""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.scene import Known

MOST_ROWS = 12
"""Place 3, up 2, heading 1, belief 6."""
ROAD_BLUR_M = 2.0
"""The road's height is averaged over places about this far from one another."""
LEAST_WEIGHT_CHI2 = 25.0
"""Places that would weigh less than exp(-12.5) of the nearest are left out."""
SAME_PASS_M, STEEPEST = 0.15, 0.15
"""Places belong to one pass of a road if their heights differ by no more than this, and this much
per metre between them. A map's trajectory comes by the same place again at another height: on a
bridge, or by the drift of its own poses (0.5 m in KITTI's)."""
HEIGHT_COUNTS = 10.0
"""A metre up is as far from a pass as so many aside."""
OTHER_HEIGHT_M = 0.5
"""Passes whose heights differ by less are not tried apart."""
MOST_ROADS, ROAD_WIDTH_M = 3, 15.0
"""Roads above one another that a place can be on, if no further from them than that."""
_FAR_M2 = 1e18


@compiled
def known_rows(
    known: Known, R: FloatArray, t: FloatArray, residual: FloatArray, jacobian: FloatArray
) -> int:
    """Fill whitened residuals (MOST_ROWS,) and their Jacobian by the left perturbation of the pose
    (MOST_ROWS, 6); how many rows."""
    row = 0
    jacobian[:] = 0.0
    if known.value.has_place:
        row = _place_rows(known, R, t, residual, jacobian)
    if known.value.has_up:
        for axis in range(2):
            across = known.value.across_up[axis]
            off = across[0] * R[0, 2] + across[1] * R[1, 2] + across[2] * R[2, 2]
            residual[row] = off / known.value.up_sigma_rad
            # d(up) = w x up, so the row a gives a . (w x up) = (up x a) . w
            jacobian[row, 3] = (
                R[1, 2] * across[2] - R[2, 2] * across[1]
            ) / known.value.up_sigma_rad
            jacobian[row, 4] = (
                R[2, 2] * across[0] - R[0, 2] * across[2]
            ) / known.value.up_sigma_rad
            jacobian[row, 5] = (
                R[0, 2] * across[1] - R[1, 2] * across[0]
            ) / known.value.up_sigma_rad
            row += 1
    if known.value.has_heading:
        _heading_row(known, R, residual, jacobian, row)
        row += 1
    if known.value.has_belief:
        row = _belief_rows(known, R, t, residual, jacobian, row)
    return row


@compiled
def known_chi2(known: Known, R: FloatArray, t: FloatArray) -> float:
    """Sum of squares of ``known_rows``."""
    residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    count = known_rows(known, R, t, residual, jacobian)
    return (residual[:count] ** 2).sum()


@compiled
def road_height(road_m: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Height of a camera on the road at (x, y), and its slopes along x and y.

    Of several passes, that of the one nearest to (x, y, z).
    """
    nearest, first, least = _FAR_M2, 0, 0.0
    for k in range(len(road_m)):
        flat = (road_m[k, 0] - x) ** 2 + (road_m[k, 1] - y) ** 2
        apart = flat + (HEIGHT_COUNTS * (road_m[k, 2] - z)) ** 2
        if apart < nearest:
            nearest, first, least = apart, k, flat
    total = height = height_x = height_y = total_x = total_y = 0.0
    for k in range(len(road_m)):
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
def road_heights(known: Known, x: float, y: float) -> FloatArray:
    """(l,) heights that a camera at (x, y) can have: one for each road near by."""
    road = known.road_m
    chosen, heights = np.empty(MOST_ROADS, dtype=np.int64), np.empty(MOST_ROADS)
    heights[0] = known.value.place_m[2]
    count = 0
    while count < MOST_ROADS:
        least, best = _FAR_M2, -1
        for k in range(len(road)):
            square = (road[k, 0] - x) ** 2 + (road[k, 1] - y) ** 2
            if square < least and _is_new(road, chosen[:count], k):
                least, best = square, k
        if best < 0 or (count and least > ROAD_WIDTH_M**2):
            break
        chosen[count], heights[count] = best, road[best, 2]
        count += 1
    return heights[: max(count, 1)]


@compiled
def _same_pass(road_m: FloatArray, one: int, other: int) -> bool:
    east, north = road_m[other, 0] - road_m[one, 0], road_m[other, 1] - road_m[one, 1]
    rise = abs(road_m[other, 2] - road_m[one, 2])
    return rise <= SAME_PASS_M + STEEPEST * np.sqrt(east * east + north * north)


@compiled
def _is_new(road_m: FloatArray, chosen: IntArray, row: int) -> bool:
    """Whether a place is on another pass than those chosen, and at another height."""
    new = True
    for one in chosen:
        apart = abs(road_m[one, 2] - road_m[row, 2])
        new = new and apart > OTHER_HEIGHT_M and not _same_pass(road_m, one, row)
    return new


@compiled
def _place_rows(
    known: Known, R: FloatArray, t: FloatArray, residual: FloatArray, jacobian: FloatArray
) -> int:
    """Camera centre against the fix, its height against the road's."""
    center = np.empty(3)
    for k in range(3):
        center[k] = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2])
        residual[k] = (center[k] - known.value.place_m[k]) / known.value.place_sigma_m[k]
        for axis in range(3):  # d(center) = -R^T v
            jacobian[k, axis] = -R[axis, k] / known.value.place_sigma_m[k]
    if len(known.road_m):
        height, slope_x, slope_y = road_height(known.road_m, center[0], center[1], center[2])
        sigma = known.value.place_sigma_m[2]
        residual[2] = (center[2] - height) / sigma
        for axis in range(3):
            jacobian[2, axis] += (slope_x * R[axis, 0] + slope_y * R[axis, 1]) / sigma
    return 3


@compiled
def _heading_row(
    known: Known, R: FloatArray, residual: FloatArray, jacobian: FloatArray, row: int
) -> None:
    x, y = R[2, 0], R[2, 1]
    flat = max(x * x + y * y, 1e-9)
    off = np.arctan2(y, x) - known.value.heading_rad
    residual[row] = np.arctan2(np.sin(off), np.cos(off)) / known.value.heading_sigma_rad
    # d(ahead) = R^T (z x w), so the row g gives (R g) . (z x w) = ((R g) x z) . w
    gx, gy = -y / flat, x / flat
    first, second = R[0, 0] * gx + R[0, 1] * gy, R[1, 0] * gx + R[1, 1] * gy
    jacobian[row, 3] = second / known.value.heading_sigma_rad
    jacobian[row, 4] = -first / known.value.heading_sigma_rad


@compiled
def _belief_rows(
    known: Known,
    R: FloatArray,
    t: FloatArray,
    residual: FloatArray,
    jacobian: FloatArray,
    row: int,
) -> int:
    """log(T T_belief^-1), whitened; the Jacobian is that close to the belief."""
    turn = R @ known.value.belief_rotation.T
    off = np.empty(6)
    off[:3] = t - turn @ known.value.belief_translation
    cosine = min(max(0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0), -1.0), 1.0)
    angle = np.arccos(cosine)
    scale = 0.5 if angle < 1e-6 else 0.5 * angle / max(np.sin(angle), 1e-9)
    off[3] = scale * (turn[2, 1] - turn[1, 2])
    off[4] = scale * (turn[0, 2] - turn[2, 0])
    off[5] = scale * (turn[1, 0] - turn[0, 1])
    for k in range(6):
        residual[row + k] = 0.0
        for column in range(6):
            residual[row + k] += known.value.belief_white[k, column] * off[column]
            jacobian[row + k, column] = known.value.belief_white[k, column]
    return row + 6
