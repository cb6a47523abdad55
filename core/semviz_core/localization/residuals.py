"""Define residual, chi2 and inlier of correspondences under a pose, once for all stages.

A point gives two rows, u and v. A pole gives two to four: the distance of each observed end
from the projected line, and the distance along it of peak and bottom, where known on both
sides. The OBSERVED ends are measured against the PROJECTED infinite line, not the other way
round. Observed ends lie in the image with a known noise. Mapped ends can be behind the camera
or far beyond what was observed, where the observed line extrapolates badly. So a pole
contributes with or without its bottom.

Every row has the covariance of the detection plus the map's, projected into the image. The
bottom's row comes last: whitening by the Cholesky factor then leaves the other rows unchanged,
so a bottom that may be hidden can be weighted separately. Pixels are undistorted.
"""

from dataclasses import dataclass
from math import erfc
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.special import chdtri  # the chi-square quantile; scipy.stats is slow to import

from semviz_core.base.camera import MIN_DEPTH_M, Camera
from semviz_core.base.detector_model import LABELS, DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.common.linalg import cholesky
from semviz_core.localization.problem import PoseProblem, Record

INLIER_PROBABILITY = 0.999
"""Share of true pairs that pass the inlier test when sigmas are stated truly."""
INLIER_CHI2: FloatArray = np.concatenate([[0.0], chdtri(np.arange(1, 5), 1.0 - INLIER_PROBABILITY)])
"""(5,) largest chi2 of an inlier by its number of rows."""
_TINY = 1e-9
Vector: TypeAlias = tuple[float, float, float]
"""In compiled code a tuple stays in registers, where an array would be allocated."""


@dataclass(frozen=True, eq=False)
class PairResiduals:
    """k pairs under one pose."""

    residual_px: FloatArray
    """(k, 2) detection minus projection: u, v of points; across (the larger of both ends) and
    along poles (peak, else bottom). NaN where not known, or behind the camera."""
    chi2: FloatArray
    """(k,) squared residual of all rows over their covariance; inf behind the camera."""
    rows: IntArray
    """(k,) degrees of freedom of chi2: 2 for points, 2 to 4 for poles. A bottom that is more
    likely hidden than seen is not counted."""
    inlier: BoolArray
    """(k,) chi2 below INLIER_CHI2 for its number of rows."""


EXACT_POSE: FloatArray = np.zeros((6, 6))
"""Covariance of a pose without error."""


class Rows(NamedTuple):
    """The rows of one pair, filled by ``fill_rows`` and ``whiten``.

    Arrays, not a record: in compiled code a record only points into its array, and does not keep
    the memory that it points to (``np.zeros(1, dtype)[0]`` is freed at once).
    """

    residual: FloatArray  # (4,) pixels, then whitened
    jacobian: FloatArray  # (4, 6) by the left perturbation of the pose
    by_map: FloatArray  # (4, 6) by the mapped anchor and end, map axes
    by_camera: FloatArray  # (4, 6) by anchor and end in camera axes
    factor: FloatArray  # (4, 4) Cholesky factor of the covariance, lower triangle
    length_px: FloatArray  # (1,) of the projected pole


@compiled
def new_rows() -> Rows:
    """Return new rows; each thread needs its own."""
    return Rows(
        np.zeros(4), np.zeros((4, 6)), np.zeros((4, 6)), np.zeros((4, 6)), np.zeros((4, 4)),
        np.zeros(1),
    )  # fmt: skip


def pair_residuals(
    T_camera_map: Pose,
    camera: Camera,
    observed: Elements2D,
    elements: Elements3D,
    pairs: IntArray,
    detector: DetectorModel = LABELS,
) -> PairResiduals:
    """Return the residuals of ``pairs`` (k, 2): rows of ``observed`` and of ``elements``."""
    problem = PoseProblem.of(camera, observed, elements, detector)
    return problem_residuals(problem, T_camera_map, pairs)


def problem_residuals(problem: PoseProblem, T_camera_map: Pose, pairs: IntArray) -> PairResiduals:
    """Return ``pair_residuals`` of a problem."""
    R, t = T_camera_map.writable()
    residual, chi2, count = _pair_residuals(problem, R, t, np.asarray(pairs, dtype=np.int64))
    return PairResiduals(residual, chi2, count, chi2 <= INLIER_CHI2[count])


@compiled
def _pair_residuals(
    problem: PoseProblem, R: FloatArray, t: FloatArray, pairs: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    k = len(pairs)
    shown = np.full((k, 2), np.nan)
    chi2 = np.full(k, np.inf)
    used = np.full(k, 2)
    rows = new_rows()
    for pair in range(k):
        i, j = pairs[pair, 0], pairs[pair, 1]
        count = fill_rows(problem, R, t, i, j, rows)
        if count == 0:
            continue
        raw = rows.residual.copy()
        shown[pair, 0], shown[pair, 1] = raw[0], raw[1]
        if problem.seen[i].is_line:
            if abs(raw[1]) > abs(raw[0]):
                shown[pair, 0] = raw[1]
            shown[pair, 1] = raw[2] if count > 2 else np.nan
        whiten(problem, i, j, count, EXACT_POSE, rows)
        used[pair] = rows_that_count(problem, i, j, count, rows)
        chi2[pair] = (rows.residual[: used[pair]] ** 2).sum()
    return shown, chi2, used


@compiled_leaf
def fill_rows(
    problem: PoseProblem, R: FloatArray, t: FloatArray, i: int, j: int, rows: Rows
) -> int:
    """Fill the residuals (pixels) of observed i and mapped j, and their derivatives.

    Return the number of rows, 0 if the element is behind the camera.
    """
    seen = problem.seen[i]
    a = transform_point(R, t, problem.mapped[j].anchor_m)
    e = transform_point(R, t, problem.mapped[j].end_m)
    a_first, e_first = as_seen(seen, 0, a), as_seen(seen, 0, e)
    rows.by_camera[:] = 0.0
    count = 2
    if not seen.is_line:
        if a_first[2] <= MIN_DEPTH_M:
            return 0
        for axis in range(2):
            slope = rows.by_camera[axis, :3]
            rows.residual[axis] = _offset(problem.setting.K, seen.anchor_px, a_first, axis, slope)
            _chain(seen, 0, rows, axis, a, e, R)
        return count
    a_last, e_last = as_seen(seen, 1, a), as_seen(seen, 1, e)
    if a_first[2] <= MIN_DEPTH_M and e_last[2] <= MIN_DEPTH_M:
        return 0
    _fill_distance(problem, seen.anchor_px, a_first, e_first, rows, 0)
    _fill_distance(problem, seen.end_px, a_last, e_last, rows, 1)
    _chain(seen, 0, rows, 0, a, e, R)
    _chain(seen, 1, rows, 1, a, e, R)
    if seen.known[0] and problem.mapped[j].known[0] and a_first[2] > MIN_DEPTH_M:
        slope = rows.by_camera[count, :3]
        rows.residual[count] = _distance_along(problem, i, seen.anchor_px, a_first, slope)
        _chain(seen, 0, rows, count, a, e, R)
        count += 1
    if seen.known[1] and problem.mapped[j].known[1] and e_last[2] > MIN_DEPTH_M:
        slope = rows.by_camera[count, 3:]
        rows.residual[count] = _distance_along(problem, i, seen.end_px, e_last, slope)
        _chain(seen, 1, rows, count, a, e, R)
        count += 1
    rows.length_px[0] = _length_px(problem, a_first, e_last)
    return count


@compiled_leaf
def as_seen(seen: Record, end: int, point: Vector) -> Vector:
    """Return a point, given in the axes of the pose that is sought, in those of the camera that saw
    an end of the element (0: anchor), when it saw it."""
    if not seen.is_moved:
        return point
    x, y, z = point
    turn, shift = seen.turn[end], seen.shift_m[end]
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0],
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1],
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2],
    )


@compiled_leaf
def largest_shift_m2(problem: PoseProblem) -> float:
    """Return the square of how far, at most, a camera was from the pose when it saw an element."""
    largest = 0.0
    for i in range(len(problem.seen)):
        if problem.seen[i].is_moved:
            for end in range(2):
                shift = problem.seen[i].shift_m[end]
                largest = max(largest, shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2)
    return largest


@compiled_leaf
def whiten(
    problem: PoseProblem, i: int, j: int, count: int, pose_covariance: FloatArray, rows: Rows
) -> None:
    """Divide residuals and Jacobian by the Cholesky factor of the rows' covariance.

    ``pose_covariance`` (6, 6) is that of the pose, EXACT_POSE for none.
    """
    size = 6 if problem.seen[i].is_line else 3  # a point's end is its anchor and counts once
    for row in range(count):
        for k in range(size):
            spread = 0.0
            for other in range(size):
                spread += rows.by_map[row, other] * problem.mapped[j].covariance_m2[other, k]
            rows.by_camera[row, k] = spread  # no longer needed
        for column in range(row + 1):
            total = 0.0
            for k in range(size):
                total += rows.by_camera[row, k] * rows.by_map[column, k]
            rows.factor[row, column] = total
        across = row == 0 or (row == 1 and problem.seen[i].is_line)
        rows.factor[row, row] += problem.seen[i].variance_px2[0 if across else 1]
    if pose_covariance[0, 0] > 0.0:
        _add_pose_covariance(count, pose_covariance, rows)
    whiten_by_factor(count, rows, cholesky(rows.factor, count))


@compiled_leaf
def _add_pose_covariance(count: int, pose_covariance: FloatArray, rows: Rows) -> None:
    for row in range(count):
        for k in range(6):
            spread = 0.0
            for other in range(6):
                spread += rows.jacobian[row, other] * pose_covariance[other, k]
            for column in range(row + 1):
                rows.factor[row, column] += spread * rows.jacobian[column, k]


@compiled_leaf
def whiten_by_factor(count: int, rows: Rows, sound: bool) -> None:
    """Whiten by ``rows.factor``; make the residual infinite if the factor is not ``sound``."""
    for row in range(count):
        inverse = 1.0 / rows.factor[row, row]
        for k in range(row):
            weight = rows.factor[row, k]
            rows.residual[row] -= weight * rows.residual[k]
            for column in range(6):
                rows.jacobian[row, column] -= weight * rows.jacobian[k, column]
        rows.residual[row] *= inverse
        for column in range(6):
            rows.jacobian[row, column] *= inverse
    if not sound:
        rows.residual[0] = np.inf


@compiled_leaf
def hidden_odds(problem: PoseProblem, count: int, rows: Rows) -> float:
    """Return c in the likelihood ``(1 - h) exp(-e^2 / 2) + c`` of a bottom's whitened residual e.

    h is the probability that the bottom is hidden; it then lies anywhere between peak and bottom,
    apart from noise. With s the row's sigma, c = h sqrt(2 pi) s / length times the chance that
    noise alone puts it as far down. Call after ``whiten``.
    """
    h, length = problem.setting.hidden_bottoms, max(rows.length_px[0], 1.0)
    if h == 0.0:
        return 0.0
    above = 0.5 * erfc(rows.residual[count - 1] / np.sqrt(2.0))
    return above * h * np.sqrt(2.0 * np.pi) * rows.factor[count - 1, count - 1] / length


@compiled_leaf
def bottom_is_given(problem: PoseProblem, i: int, j: int, count: int) -> bool:
    """Return whether the last of ``count`` rows is that of a bottom."""
    return (
        problem.seen[i].is_line
        and problem.seen[i].known[1]
        and problem.mapped[j].known[1]
        and count > 2
    )


@compiled_leaf
def rows_that_count(problem: PoseProblem, i: int, j: int, count: int, rows: Rows) -> int:
    """Return ``count`` without the bottom's row if the bottom is more likely hidden than seen."""
    if bottom_is_given(problem, i, j, count):
        e = rows.residual[count - 1]
        if (1.0 - problem.setting.hidden_bottoms) * np.exp(-0.5 * e * e) < hidden_odds(
            problem, count, rows
        ):
            return count - 1
    return count


@compiled_leaf
def transform_point(R: FloatArray, t: FloatArray, point: FloatArray | Vector) -> Vector:
    """Return ``point`` (3,), given in map coordinates, in camera coordinates."""
    x, y, z = point[0], point[1], point[2]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0],
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1],
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2],
    )


@compiled_leaf
def _offset(K: FloatArray, pixel: FloatArray, point: Vector, axis: int, slope: FloatArray) -> float:
    """Return detection minus projection along an image axis; fill its derivative by the point."""
    inverse = 1.0 / point[2]
    projection = (K[axis, 0] * point[0] + K[axis, 1] * point[1] + K[axis, 2] * point[2]) * inverse
    for k in range(3):
        slope[k] = -K[axis, k] * inverse
    slope[2] += projection * inverse
    return float(pixel[axis] - projection)


@compiled_leaf
def _distance_along(
    problem: PoseProblem, i: int, pixel: FloatArray, point: Vector, slope: FloatArray
) -> float:
    """Return detection minus projection along the observed pole, downwards positive."""
    du, dv = problem.seen[i].direction[0], problem.seen[i].direction[1]
    K, inverse = problem.setting.K, 1.0 / point[2]
    u = (K[0, 0] * point[0] + K[0, 1] * point[1]) * inverse + K[0, 2]
    v = K[1, 1] * point[1] * inverse + K[1, 2]
    slope[0] = -du * K[0, 0] * inverse
    slope[1] = -(du * K[0, 1] + dv * K[1, 1]) * inverse
    slope[2] = (du * (u - K[0, 2]) + dv * (v - K[1, 2])) * inverse
    return float(du * (pixel[0] - u) + dv * (pixel[1] - v))


@compiled_leaf
def _fill_distance(
    problem: PoseProblem, pixel: FloatArray, a: Vector, e: Vector, rows: Rows, row: int
) -> None:
    """Fill the distance of an observed end from the projected line, and its derivatives.

    The line through the projections is l = K^-T (end x anchor); positive is to the right of a
    pole that stands upright in the image.
    """
    inverse = problem.setting.K_inverse
    normal = _cross(e, a)
    line0 = normal[0] * inverse[0, 0]  # K is upper triangular, and so is its inverse
    line1 = normal[0] * inverse[0, 1] + normal[1] * inverse[1, 1]
    line2 = normal[0] * inverse[0, 2] + normal[1] * inverse[1, 2] + normal[2]
    norm = max(np.sqrt(line0 * line0 + line1 * line1), _TINY)
    distance = (line0 * pixel[0] + line1 * pixel[1] + line2) / norm
    rows.residual[row] = distance
    first = (pixel[0] - distance * line0 / norm) / norm
    second = (pixel[1] - distance * line1 / norm) / norm
    third = 1.0 / norm
    ray = (
        inverse[0, 0] * first + inverse[0, 1] * second + inverse[0, 2] * third,
        inverse[1, 1] * second + inverse[1, 2] * third,
        third,
    )
    anchor_slope, end_slope = _cross(ray, e), _cross(a, ray)
    for k in range(3):
        rows.by_camera[row, k] = anchor_slope[k]
        rows.by_camera[row, 3 + k] = end_slope[k]


@compiled_leaf
def _length_px(problem: PoseProblem, a: Vector, e: Vector) -> float:
    """Return the length of the projected pole; the image's height if an end is not ahead."""
    if a[2] <= MIN_DEPTH_M or e[2] <= MIN_DEPTH_M:
        return problem.setting.size_px[1]
    du = problem.setting.K[0, 0] * (a[0] / a[2] - e[0] / e[2])
    dv = problem.setting.K[1, 1] * (a[1] / a[2] - e[1] / e[2])
    return np.sqrt(du * du + dv * dv)


@compiled_leaf
def _chain(
    seen: Record, end: int, rows: Rows, row: int, a: Vector, e: Vector, R: FloatArray
) -> None:
    """Turn derivatives by camera coordinates of an end's time into those by pose and by map
    coordinates."""
    by = rows.by_camera[row]
    by_a, by_e = (by[0], by[1], by[2]), (by[3], by[4], by[5])
    if seen.is_moved:
        by_a, by_e = _turned_back(seen.turn[end], by_a), _turned_back(seen.turn[end], by_e)
    turn_a, turn_e = _cross(a, by_a), _cross(e, by_e)
    for k in range(3):
        rows.jacobian[row, k] = by_a[k] + by_e[k]
        rows.jacobian[row, 3 + k] = turn_a[k] + turn_e[k]
        rows.by_map[row, k] = by_a[0] * R[0, k] + by_a[1] * R[1, k] + by_a[2] * R[2, k]
        rows.by_map[row, 3 + k] = by_e[0] * R[0, k] + by_e[1] * R[1, k] + by_e[2] * R[2, k]


@compiled_leaf
def _turned_back(turn: FloatArray, vector: Vector) -> Vector:
    x, y, z = vector
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@compiled_leaf
def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )
