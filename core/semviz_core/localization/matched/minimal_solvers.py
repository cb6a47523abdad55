"""Camera poses from minimal samples of two or three matches.

Samples are of five kinds. What poles without a point need is PoseLib's; the rest is compiled.

| sample | solver | constraints |
|---|---|---|
| two points, gravity known | `solve_upright` | 4 of 4 |
| two poles with a point each | p3ll: both lines and the line that joins the points | 6 |
| three points | `solve_p3p` | 6 |
| two points and a line | p2p1ll | 6 |
| a point and two lines | p1p2ll | 6 |

A point is a peak, a sign's centre or, where the peak is unknown, a bottom. Bottoms that may be
hidden are points only in samples of two, since three matches have enough in their lines. In
PoseLib 2.0.5, p2p1ll and p1p2ll fail where a line passes through one of the points, and p3ll
where lines are parallel. So lines are taken only from poles that give no point.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.localization.matched.matches import Matches
from semviz_core.localization.matched.p3p import MOST_POSES, solve_p3p
from semviz_core.localization.problem import perpendicular

FARTHEST_M = 1e4
"""Sampled points further away give no pose."""


@dataclass(frozen=True, eq=False)
class Constraints:
    """The constraints of k matches on the pose, in the forms that minimal solvers take."""

    has_point: BoolArray  # (k,)
    reliable_point: BoolArray  # (k,) not a bottom that may be hidden
    ray: FloatArray  # (k, 3) unit, through the observed point
    point_m: FloatArray  # (k, 3)
    is_line: BoolArray  # (k,)
    normal: FloatArray  # (k, 3) unit normal of the plane through the camera and the observed line
    direction: FloatArray  # (k, 3) unit, of the mapped line

    @classmethod
    def of(cls, matches: Matches) -> "Constraints":
        known = matches.known()
        by_peak = known[:, :1]
        hidden = matches.detector is not None and matches.detector.hidden_bottoms > 0.0
        (first, last), (anchor, end) = matches.rays(), matches.points_m()
        return cls(
            has_point=known[:, 0] | known[:, 1],
            reliable_point=known[:, 0] | (known[:, 1] & (not hidden)),
            ray=np.where(by_peak, first, last),
            point_m=np.where(by_peak, anchor, end),
            is_line=matches.is_line,
            normal=unit_vectors(np.cross(first, last)),
            direction=unit_vectors(end - anchor),
        )

    def two_suffice(self, upright: bool) -> BoolArray:
        """Return (k,) which matches fix a pose together with one other such match."""
        return self.has_point & (self.is_line | upright)


def sample_poses(
    constraints: Constraints, samples: IntArray, up_camera: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (b, 3, 3) and translations (b, 3) of T_camera_map that fit ``samples``.

    ``samples`` are rows of ``constraints``: (s, 2) that ``two_suffice``, or (s, 3) of any kind. A
    sample gives up to four poses. Two kinds are dropped: those that are not finite, which
    degenerate samples give, and those with a point behind the camera or beyond FARTHEST_M.
    """
    if samples.shape[1] == 3:
        by_points = constraints.reliable_point[samples].all(axis=1)
        of_points = _point_poses(constraints.ray, constraints.point_m, samples[by_points])
        solutions = [of_points, _with_lines(constraints, samples[~by_points])]
    elif up_camera is None:
        solutions = [_two_poles(constraints, samples)]
    else:
        R_level_camera = np.vstack([perpendicular(up_camera), up_camera])
        solutions = [_upright_poses(constraints.ray, constraints.point_m, samples, R_level_camera)]
    sample, rotation, translation = (
        np.concatenate(arrays) for arrays in zip(*solutions, strict=True)
    )
    good = _are_in_view(constraints.point_m[sample], rotation, translation)
    return rotation[good], translation[good]


def _are_in_view(point_m: FloatArray, rotation: FloatArray, translation: FloatArray) -> BoolArray:
    """Return (b,) which poses are finite and have their points (b, k, 3) ahead and in reach."""
    depth = np.einsum("bj,bkj->bk", rotation[:, 2], point_m) + translation[:, 2:]
    in_reach = ((depth > MIN_DEPTH_M) & (depth < FARTHEST_M)).all(axis=1)  # False for NaN
    return np.asarray(np.isfinite(rotation).all(axis=(1, 2)) & in_reach)


Solutions: TypeAlias = tuple[IntArray, FloatArray, FloatArray]
"""The samples (b, k) of poses, and their rotations (b, 3, 3) and translations (b, 3)."""


def _with_lines(constraints: Constraints, samples: IntArray) -> Solutions:
    """Solve p2p1ll or p1p2ll, by how many of a sample's matches have a reliable point."""
    import poselib

    reliable = constraints.reliable_point[samples]
    ordered = np.take_along_axis(samples, np.argsort(~reliable, axis=1), axis=1)
    ray, point = constraints.ray[ordered], constraints.point_m[ordered]
    line = constraints.normal[ordered], point, constraints.direction[ordered]
    solutions: list[list[Any]] = []
    for row, points in enumerate(reliable.sum(axis=1)):
        solve = (None, poselib.p1p2ll, poselib.p2p1ll)[points]
        seen, mapped = ray[row, :points], point[row, :points]
        lines = [array[row, points:] for array in line]
        # three lines alone are nearly parallel
        solutions.append([] if solve is None else solve(seen, mapped, *lines))
    return _from_poselib(samples, solutions)


def _two_poles(constraints: Constraints, samples: IntArray) -> Solutions:
    import poselib

    ray, point = constraints.ray[samples], constraints.point_m[samples]
    joined = unit_vectors(np.cross(ray[:, 0], ray[:, 1])), unit_vectors(point[:, 1] - point[:, 0])
    normal = np.concatenate([constraints.normal[samples], joined[0][:, None]], axis=1)
    direction = np.concatenate([constraints.direction[samples], joined[1][:, None]], axis=1)
    on_line = np.concatenate([point, point[:, :1]], axis=1)
    lines = zip(normal, on_line, direction, strict=True)
    return _from_poselib(samples, [poselib.p3ll(*three) for three in lines])


def _from_poselib(samples: IntArray, solutions: list[list[Any]]) -> Solutions:
    sample = np.repeat(samples, [len(poses) for poses in solutions], axis=0)
    rotation = np.array([pose.R for poses in solutions for pose in poses]).reshape(-1, 3, 3)
    translation = np.array([pose.t for poses in solutions for pose in poses]).reshape(-1, 3)
    return sample, rotation, translation


@compiled
def _point_poses(ray: FloatArray, point_m: FloatArray, samples: IntArray) -> Solutions:
    """Solve P3P for samples (s, 3) of points."""
    most = MOST_POSES * len(samples)
    sample = np.empty((most, 3), dtype=np.int64)
    rotation, translation = np.empty((most, 3, 3)), np.empty((most, 3))
    count = 0
    for rows in samples:
        new = solve_p3p(ray[rows], point_m[rows], rotation[count:], translation[count:])
        sample[count : count + new] = rows
        count += new
    return sample[:count], rotation[:count], translation[:count]


@compiled
def _upright_poses(
    ray: FloatArray, point_m: FloatArray, samples: IntArray, R_level_camera: FloatArray
) -> Solutions:
    """Solve samples (s, 2) of points for a camera whose third level axis is up."""
    most = 2 * len(samples)
    sample = np.empty((most, 2), dtype=np.int64)
    rotation, translation = np.empty((most, 3, 3)), np.empty((most, 3))
    level = ray @ R_level_camera.T
    count = 0
    for a, b in samples:
        for c, s, offset in solve_upright(level[a], level[b], point_m[a], point_m[b]):
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            rotation[count] = R_level_camera.T @ turn
            translation[count] = R_level_camera.T @ offset
            sample[count, 0], sample[count, 1] = a, b
            count += 1
    return sample[:count], rotation[:count], translation[:count]


@compiled
def solve_upright(
    first: FloatArray, second: FloatArray, first_m: FloatArray, second_m: FloatArray
) -> list[tuple[float, float, FloatArray]]:
    """Return cosine and sine of the heading, and the translation (3,), of level cameras that see
    two points along rays (3,) of level axes; z is up.

    With depths l of the rays, l2 second - l1 first is the vector between the points, turned: its
    height gives l2, and its length on the ground a quadratic equation for l1.
    """
    solutions = [(1.0, 0.0, first_m) for _ in range(0)]
    if abs(second[2]) < abs(first[2]):
        first, second, first_m, second_m = second, first, second_m, first_m
    dx, dy, dz = second_m[0] - first_m[0], second_m[1] - first_m[1], second_m[2] - first_m[2]
    ax, ay = second[0] * dz / second[2], second[1] * dz / second[2]
    bx = second[0] * first[2] / second[2] - first[0]
    by = second[1] * first[2] / second[2] - first[1]
    square = dx * dx + dy * dy
    p, half, rest = bx * bx + by * by, ax * bx + ay * by, ax * ax + ay * ay - square
    inside = half * half - p * rest
    if not inside >= 0.0:
        return solutions
    for root in (np.sqrt(inside), -np.sqrt(inside)):
        depth = (root - half) / p
        x, y = ax + depth * bx, ay + depth * by
        c, s = (x * dx + y * dy) / square, (y * dx - x * dy) / square
        offset = depth * first
        offset[0] -= c * first_m[0] - s * first_m[1]
        offset[1] -= s * first_m[0] + c * first_m[1]
        offset[2] -= first_m[2]
        solutions.append((c, s, offset))
    return solutions
