"""The solvers of DeepI2P: the pose of a cloud whose points are known to be inside a picture, or in
which of its cells.

The inverse camera projection seeks the pose that projects all points called inside into the
picture, and no others. As published: residuals, robust cost, starts, four unknowns (heading and
position). Different here: gravity is known, horizontal bounds are 12 m in place of 5 and 10, since
the origin is a fix that may be 5 m off, and depths are at least 0.1 m.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.jit import compiled
from semviz_core.localization.upright import ASSUMED_UP
from semviz_core.research.evaluation.street_frames import CELL_PX, PICTURE_CAMERA
from semviz_core.research.point_matching.epnp import epnp_ransac

STARTS, ITERATIONS = 60, 60
START_SIGMA_RAD, START_M = float(np.deg2rad(10.0)), 10.0
BEHIND_M = 10.0
BOUND_M, HEIGHT_BOUND_M = 12.0, 0.1
NEAREST_M = 0.1
BEHIND_PX_PER_M = 100.0
LEAST_INSIDE = 4
CELL_TRIALS, CELL_THRESHOLD = 500, 0.6
_SAME_COST = 1e-6
_LEAST_GAIN = 1e-7


class _Problem(NamedTuple):
    """What the cost depends on besides the pose."""

    points_m: FloatArray
    """(n, 3) local"""
    inside: BoolArray
    """(n,)"""
    axes: FloatArray
    """(3, 3) rotation from the level frame (x ahead, z up) to the camera."""
    camera: FloatArray
    """fx, fy, cx, cy, width - 1, height - 1"""


def inverse_projection(
    points_m: FloatArray, inside: BoolArray, camera: Camera, up_camera: FloatArray | None
) -> Pose | str:
    """Return T_camera_local of points (n, 3), or the reason for none.

    Starts whose cost is equally low are answered by their median, since whole regions of poses
    agree with few points.
    """
    if inside.sum() < LEAST_INSIDE:
        return f"{inside.sum()} points are called inside, {LEAST_INSIDE} needed."
    mean = points_m[inside].mean(axis=0)
    heading = float(np.arctan2(mean[1], mean[0]))
    forward = points_m[:, :2] @ [np.cos(heading), np.sin(heading)]
    near = forward > forward[inside].min() - BEHIND_M
    (fx, _, cx), (_, fy, cy), _ = camera.K
    intrinsics = np.array([fx, fy, cx, cy, camera.width - 1.0, camera.height - 1.0])
    axes = level_axes(ASSUMED_UP if up_camera is None else up_camera)
    problem = _Problem(np.ascontiguousarray(points_m[near]), inside[near], axes, intrinsics)
    rng = np.random.default_rng(0)
    start = np.zeros((STARTS, 4))
    start[:, 0] = heading + START_SIGMA_RAD * rng.standard_normal(STARTS)
    ahead = rng.uniform(-START_M, START_M, STARTS)
    start[:, 1] = ahead * np.cos(start[:, 0])
    start[:, 2] = ahead * np.sin(start[:, 0])
    cost = np.array([_descend(problem, one) for one in start])
    turn, *position = np.median(start[cost <= cost.min() + _SAME_COST], axis=0)
    c, s = np.cos(turn), np.sin(turn)
    rotation = axes @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Pose(rotation, -rotation @ np.array(position))


def cell_matches(points_m: FloatArray, inside: BoolArray, center_px: FloatArray) -> Pose | str:
    """Return T_camera_local by points (n, 3) and the centres (n, 2) of their cells; published code
    has the corners, half a cell off."""
    limits = CELL_TRIALS, CELL_THRESHOLD * CELL_PX
    return epnp_ransac(center_px[inside], points_m[inside], PICTURE_CAMERA, *limits)


def level_axes(up_camera: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation from the level frame (x ahead, y left, z up) to the camera."""
    ahead = np.array([0.0, 0.0, 1.0]) - up_camera[2] * up_camera
    ahead /= np.linalg.norm(ahead)
    return np.column_stack([ahead, np.cross(up_camera, ahead), up_camera])


@compiled
def _descend(problem: _Problem, state: FloatArray) -> float:
    """Move ``state`` (4,), heading and position, downhill by Levenberg and Marquardt's method
    within the bounds; return its cost."""
    bounds = np.array([np.inf, BOUND_M, BOUND_M, HEIGHT_BOUND_M])
    cost, gradient, hessian = _normal_equations(problem, state)
    damping = 1e-3
    for _ in range(ITERATIONS):
        damped = hessian + damping * np.diag(np.diag(hessian) + 1e-9)
        moved = state - np.linalg.solve(damped, gradient)
        moved = np.minimum(np.maximum(moved, -bounds), bounds)
        new_cost, new_gradient, new_hessian = _normal_equations(problem, moved)
        if new_cost >= cost:
            damping *= 4.0
            if damping > 1e8:
                break
            continue
        gain = (cost - new_cost) / max(cost, 1e-12)
        state[:] = moved
        cost, gradient, hessian = new_cost, new_gradient, new_hessian
        damping = max(0.3 * damping, 1e-9)
        if gain < _LEAST_GAIN:
            break
    return cost


@compiled
def _normal_equations(problem: _Problem, state: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return 1/2 sum ln(1 + |r|^2), and gradient (4,) and Hessian (4, 4) by Gauss and Newton."""
    fx, fy, cx, cy, right, low = problem.camera
    c, s = np.cos(state[0]), np.sin(state[0])
    axes = problem.axes
    cost, gradient, hessian = 0.0, np.zeros(4), np.zeros((4, 4))
    place, slope, jacobian = np.zeros(3), np.zeros((3, 4)), np.zeros((3, 4))
    for row in range(len(problem.points_m)):
        dx, dy, dz = problem.points_m[row] - state[1:]
        ahead, left = c * dx + s * dy, c * dy - s * dx
        for i in range(3):
            place[i] = axes[i, 0] * ahead + axes[i, 1] * left + axes[i, 2] * dz
        is_inside = problem.inside[row]
        z = max(place[2], NEAREST_M)
        u, v = fx * place[0] / z + cx, fy * place[1] / z + cy
        is_seen = place[2] > NEAREST_M and 0.0 <= u <= right and 0.0 <= v <= low
        if is_inside == is_seen:
            continue
        for i in range(3):
            slope[i, 0] = axes[i, 0] * left - axes[i, 1] * ahead
            slope[i, 1] = -axes[i, 0] * c + axes[i, 1] * s
            slope[i, 2] = -axes[i, 0] * s - axes[i, 1] * c
            slope[i, 3] = -axes[i, 2]
        clamped = 0.0 if place[2] < NEAREST_M else 1.0
        for k in range(4):
            depth = clamped * slope[2, k] / z
            jacobian[0, k] = fx * (slope[0, k] / z - place[0] / z * depth)
            jacobian[1, k] = fy * (slope[1, k] / z - place[1] / z * depth)
            jacobian[2, k] = slope[2, k]
        if is_inside:
            r = (
                max(-u, 0.0) + max(u - right, 0.0),
                max(-v, 0.0) + max(v - low, 0.0),
                BEHIND_PX_PER_M * max(-place[2], 0.0),
            )
            signs = (
                (-1.0 if u < 0.0 else 1.0) if r[0] > 0.0 else 0.0,
                (-1.0 if v < 0.0 else 1.0) if r[1] > 0.0 else 0.0,
                -BEHIND_PX_PER_M if r[2] > 0.0 else 0.0,
            )
            for k in range(4):
                for i in range(3):
                    jacobian[i, k] *= signs[i]
        else:
            r = (right / 2 - abs(u - right / 2) + low / 2 - abs(v - low / 2), 0.0, 0.0)
            for k in range(4):
                horizontal = -jacobian[0, k] if u > right / 2 else jacobian[0, k]
                vertical = -jacobian[1, k] if v > low / 2 else jacobian[1, k]
                jacobian[0, k] = horizontal + vertical
                jacobian[1, k] = jacobian[2, k] = 0.0
        square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        cost += 0.5 * np.log1p(square)
        weight = 1.0 / (1.0 + square)
        for k in range(4):
            for i in range(3):
                gradient[k] += weight * jacobian[i, k] * r[i]
                for m in range(4):
                    hessian[k, m] += weight * jacobian[i, k] * jacobian[i, m]
    return cost, gradient, hessian
