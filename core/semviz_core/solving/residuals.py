"""The one definition of residual, chi2 and inlier of pairs under a pose.

A point gives two rows, u and v. A pole gives two to four: how far each observed end lies beside the
projected line, and how far the peak and the bottom lie along it, where known on both sides. The
OBSERVED ends are measured against the PROJECTED infinite line, not the other way round: they
lie in the image with noise that is stated, while mapped ends can be behind the camera or far beyond
what was seen, where the observed line extrapolates badly. So a pole counts whatever its bottom
does.

Every row has the covariance of the detection plus the map's, projected into the image. The bottom's
row comes last: whitening by the Cholesky factor then leaves the rows before it as they are without
it, so that a bottom that may be hidden can be weighed by itself. Pixels are undistorted ones.
"""

from dataclasses import dataclass
from math import erfc
from typing import TypeAlias

import numpy as np
from scipy.special import chdtri  # the chi-square quantile; scipy.stats is slow to import

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M, Camera
from semviz_core.compiled import compiled
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.pose import Pose
from semviz_core.solving.linear import cholesky
from semviz_core.solving.scene import Record, Scene

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
    along poles (peak, else bottom). NaN where not known, and where nothing projects."""
    chi2: FloatArray
    """(k,) squared residual of all rows over their covariance; inf where nothing projects."""
    rows: IntArray
    """(k,) number of rows behind chi2: 2 for points, 2 to 4 for poles. A bottom that is more
    likely hidden than seen is not counted."""
    inlier: BoolArray
    """(k,) chi2 below INLIER_CHI2 for its number of rows."""


SURE: FloatArray = np.zeros((6, 6))
"""No doubt about a pose: the covariance of its left perturbation is 0."""


ROWS = np.dtype(
    [
        ("residual", float, (4,)),  # pixels, then whitened
        ("jacobian", float, (4, 6)),  # by the left perturbation of the pose
        ("by_map", float, (4, 6)),  # by the mapped anchor and end, map axes
        ("by_camera", float, (4, 6)),  # by anchor and end in camera axes
        ("factor", float, (4, 4)),  # Cholesky factor of the covariance, lower triangle
        ("length_px", float),  # of the projected pole
    ]
)
"""The rows of one pair, filled by ``fill_rows`` and ``whiten``."""


@compiled
def new_rows() -> Record:
    """Fresh ROWS; one for each thread."""
    return np.zeros(1, ROWS)[0]


def pair_residuals(
    T_camera_map: Pose, camera: Camera, observed: Elements2D, elements: Elements3D, pairs: IntArray
) -> PairResiduals:
    """Residuals of ``pairs`` (k, 2) of rows of ``observed`` and of ``elements``."""
    return scene_residuals(Scene.of(camera, observed, elements), T_camera_map, pairs)


def scene_residuals(scene: Scene, T_camera_map: Pose, pairs: IntArray) -> PairResiduals:
    """As ``pair_residuals``, for a scene already made."""
    residual, chi2, count = _pair_residuals(
        scene, T_camera_map.rotation, T_camera_map.translation, np.asarray(pairs, dtype=np.int64)
    )
    return PairResiduals(residual, chi2, count, chi2 <= INLIER_CHI2[count])


@compiled
def _pair_residuals(
    scene: Scene, R: FloatArray, t: FloatArray, pairs: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    k = len(pairs)
    shown = np.full((k, 2), np.nan)
    chi2 = np.full(k, np.inf)
    used = np.full(k, 2)
    rows = new_rows()
    for pair in range(k):
        i, j = pairs[pair, 0], pairs[pair, 1]
        count = fill_rows(scene, R, t, i, j, rows)
        if count == 0:
            continue
        raw = rows.residual.copy()
        shown[pair, 0], shown[pair, 1] = raw[0], raw[1]
        if scene.seen[i].is_line:
            if abs(raw[1]) > abs(raw[0]):
                shown[pair, 0] = raw[1]
            shown[pair, 1] = raw[2] if count > 2 else np.nan
        whiten(scene, i, j, count, SURE, rows)
        used[pair] = rows_that_count(scene, i, j, count, rows)
        chi2[pair] = (rows.residual[: used[pair]] ** 2).sum()
    return shown, chi2, used


@compiled
def fill_rows(scene: Scene, R: FloatArray, t: FloatArray, i: int, j: int, rows: Record) -> int:
    """Residuals (pixels) of observed i and mapped j, and their derivatives; how many rows.

    0 where nothing projects.
    """
    a, e = moved(R, t, scene.mapped[j].anchor_m), moved(R, t, scene.mapped[j].end_m)
    rows.by_camera[:] = 0.0
    count = 2
    if not scene.seen[i].is_line:
        if a[2] <= MIN_DEPTH_M:
            return 0
        for axis in range(2):
            slope = rows.by_camera[axis, :3]
            rows.residual[axis] = _offset(scene.setting.K, scene.seen[i].anchor_px, a, axis, slope)
    else:
        if a[2] <= MIN_DEPTH_M and e[2] <= MIN_DEPTH_M:
            return 0
        _beside(scene, i, a, e, rows)
        if scene.seen[i].known[0] and scene.mapped[j].known[0] and a[2] > MIN_DEPTH_M:
            slope = rows.by_camera[count, :3]
            rows.residual[count] = _along(scene, i, scene.seen[i].anchor_px, a, slope)
            count += 1
        if scene.seen[i].known[1] and scene.mapped[j].known[1] and e[2] > MIN_DEPTH_M:
            slope = rows.by_camera[count, 3:]
            rows.residual[count] = _along(scene, i, scene.seen[i].end_px, e, slope)
            count += 1
        rows.length_px = _length_px(scene, a, e)
    for row in range(count):
        _chain(rows, row, a, e, R)
    return count


@compiled
def whiten(scene: Scene, i: int, j: int, count: int, doubt: FloatArray, rows: Record) -> None:
    """Divide residuals and Jacobian by the Cholesky factor of the rows' covariance.

    ``doubt`` (6, 6) is the covariance of the pose itself, or SURE.
    """
    size = 6 if scene.seen[i].is_line else 3  # a point's end is its anchor and counts once
    for row in range(count):
        for k in range(size):
            spread = 0.0
            for other in range(size):
                spread += rows.by_map[row, other] * scene.mapped[j].covariance_m2[other, k]
            rows.by_camera[row, k] = spread  # no longer needed
        for column in range(row + 1):
            total = 0.0
            for k in range(size):
                total += rows.by_camera[row, k] * rows.by_map[column, k]
            rows.factor[row, column] = total
        across = row == 0 or (row == 1 and scene.seen[i].is_line)
        rows.factor[row, row] += scene.seen[i].variance_px2[0 if across else 1]
    if doubt[0, 0] > 0.0:
        _add_doubt(count, doubt, rows)
    whiten_by_factor(count, rows, cholesky(rows.factor, count))


@compiled
def _add_doubt(count: int, doubt: FloatArray, rows: Record) -> None:
    for row in range(count):
        for k in range(6):
            spread = 0.0
            for other in range(6):
                spread += rows.jacobian[row, other] * doubt[other, k]
            for column in range(row + 1):
                rows.factor[row, column] += spread * rows.jacobian[column, k]


@compiled
def whiten_by_factor(count: int, rows: Record, sound: bool) -> None:
    """As ``whiten`` with ``rows.factor`` given; without a sound one the residual is infinite."""
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


@compiled
def hidden_odds(scene: Scene, count: int, rows: Record) -> float:
    """c in the likelihood ``(1 - h) exp(-e^2 / 2) + c`` of a bottom's whitened residual e.

    A hidden bottom is anywhere between peak and bottom, but for noise: with h its probability and
    s the row's sigma, c = h sqrt(2 pi) s / length times the chance that noise alone puts it as far
    down. Call after ``whiten``.
    """
    h, length = scene.setting.hidden_bottoms, max(rows.length_px, 1.0)
    if h == 0.0:
        return 0.0
    above = 0.5 * erfc(rows.residual[count - 1] / np.sqrt(2.0))
    return above * h * np.sqrt(2.0 * np.pi) * rows.factor[count - 1, count - 1] / length


@compiled
def bottom_is_given(scene: Scene, i: int, j: int, count: int) -> bool:
    """Whether the last of ``count`` rows is a bottom's."""
    return (
        scene.seen[i].is_line and scene.seen[i].known[1] and scene.mapped[j].known[1] and count > 2
    )


@compiled
def rows_that_count(scene: Scene, i: int, j: int, count: int, rows: Record) -> int:
    """``count`` without the bottom's row where that is more likely hidden than seen."""
    if bottom_is_given(scene, i, j, count):
        e = rows.residual[count - 1]
        if (1.0 - scene.setting.hidden_bottoms) * np.exp(-0.5 * e * e) < hidden_odds(
            scene, count, rows
        ):
            return count - 1
    return count


@compiled
def moved(R: FloatArray, t: FloatArray, point: FloatArray) -> Vector:
    """``point`` (3,) in the camera's coordinates."""
    x, y, z = point[0], point[1], point[2]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0],
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1],
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2],
    )


@compiled
def _offset(K: FloatArray, pixel: FloatArray, point: Vector, axis: int, slope: FloatArray) -> float:
    """Detection minus projection along one image axis; fills its derivative by the point."""
    inverse = 1.0 / point[2]
    projection = (K[axis, 0] * point[0] + K[axis, 1] * point[1] + K[axis, 2] * point[2]) * inverse
    for k in range(3):
        slope[k] = -K[axis, k] * inverse
    slope[2] += projection * inverse
    return float(pixel[axis] - projection)


@compiled
def _along(scene: Scene, i: int, pixel: FloatArray, point: Vector, slope: FloatArray) -> float:
    """Detection minus projection along the observed pole, downwards positive."""
    du, dv = scene.seen[i].direction[0], scene.seen[i].direction[1]
    K, inverse = scene.setting.K, 1.0 / point[2]
    u = (K[0, 0] * point[0] + K[0, 1] * point[1]) * inverse + K[0, 2]
    v = K[1, 1] * point[1] * inverse + K[1, 2]
    slope[0] = -du * K[0, 0] * inverse
    slope[1] = -(du * K[0, 1] + dv * K[1, 1]) * inverse
    slope[2] = (du * (u - K[0, 2]) + dv * (v - K[1, 2])) * inverse
    return float(du * (pixel[0] - u) + dv * (pixel[1] - v))


@compiled
def _beside(scene: Scene, i: int, a: Vector, e: Vector, rows: Record) -> None:
    """How far both observed ends lie beside the projected line, and the derivatives.

    The line through the projections is l = K^-T (end x anchor); positive is to the right of a
    pole that stands upright in the image.
    """
    inverse = scene.setting.K_inverse
    normal = _cross(e, a)
    line0 = normal[0] * inverse[0, 0]  # K is upper triangular, and so is its inverse
    line1 = normal[0] * inverse[0, 1] + normal[1] * inverse[1, 1]
    line2 = normal[0] * inverse[0, 2] + normal[1] * inverse[1, 2] + normal[2]
    norm = max(np.sqrt(line0 * line0 + line1 * line1), _TINY)
    for row in range(2):
        pixel = scene.seen[i].anchor_px if row == 0 else scene.seen[i].end_px
        beside = (line0 * pixel[0] + line1 * pixel[1] + line2) / norm
        rows.residual[row] = beside
        first = (pixel[0] - beside * line0 / norm) / norm
        second = (pixel[1] - beside * line1 / norm) / norm
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


@compiled
def _length_px(scene: Scene, a: Vector, e: Vector) -> float:
    """Length of the projected pole; of what is in the image's height where an end is not ahead."""
    if a[2] <= MIN_DEPTH_M or e[2] <= MIN_DEPTH_M:
        return scene.setting.size_px[1]
    du = scene.setting.K[0, 0] * (a[0] / a[2] - e[0] / e[2])
    dv = scene.setting.K[1, 1] * (a[1] / a[2] - e[1] / e[2])
    return np.sqrt(du * du + dv * dv)


@compiled
def _chain(rows: Record, row: int, a: Vector, e: Vector, R: FloatArray) -> None:
    """Derivatives by camera coordinates, to those by pose and by map coordinates."""
    by = rows.by_camera[row]
    by_a, by_e = (by[0], by[1], by[2]), (by[3], by[4], by[5])
    turn_a, turn_e = _cross(a, by_a), _cross(e, by_e)
    for k in range(3):
        rows.jacobian[row, k] = by_a[k] + by_e[k]
        rows.jacobian[row, 3 + k] = turn_a[k] + turn_e[k]
        rows.by_map[row, k] = by_a[0] * R[0, k] + by_a[1] * R[1, k] + by_a[2] * R[2, k]
        rows.by_map[row, 3 + k] = by_e[0] * R[0, k] + by_e[1] * R[1, k] + by_e[2] * R[2, k]


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )
