"""Camera poses from minimal samples of two or three matches, by PoseLib's closed-form solvers.

| sample | solver | constraints |
|---|---|---|
| two points, gravity known | up2p | 4 of 4 |
| two poles with a point each | p3ll: both lines and the line that joins the points | 6 |
| three points | p3p | 6 |
| two points and a line | p2p1ll | 6 |
| a point and two lines | p1p2ll | 6 |

A point is a peak, a sign's middle or, where the peak is unknown, a bottom; but bottoms that may be
hidden are points in samples of two only, since three matches have enough in their lines.
PoseLib 2.0.5's p2p1ll and p1p2ll give nothing or nonsense where a line passes through one of the
points, and p3ll where lines are parallel, so lines are only taken from poles that give no point.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M
from semviz_core.solving.matched.matches import Matches
from semviz_core.solving.scene import perpendicular

FARTHEST_M = 1e4
"""Nothing that is seen is further away."""
_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""(3, 3) from z up to y down, the axes of PoseLib's upright solvers."""


@dataclass(frozen=True, eq=False)
class Constraints:
    """What each of k matches says of the pose, in the forms that minimal solvers take."""

    has_point: BoolArray  # (k,)
    sure_point: BoolArray  # (k,) that is no bottom which may be hidden
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
            sure_point=known[:, 0] | (known[:, 1] & (not hidden)),
            ray=np.where(by_peak, first, last),
            point_m=np.where(by_peak, anchor, end),
            is_line=matches.is_line,
            normal=_unit(np.cross(first, last)),
            direction=_unit(end - anchor),
        )

    def two_suffice(self, upright: bool) -> BoolArray:
        """(k,) which matches fix a pose together with one other such match."""
        return self.has_point & (self.is_line | upright)


def sample_poses(
    of: Constraints, samples: IntArray, up_camera: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Rotations (b, 3, 3) and translations (b, 3) T_camera_map that fit ``samples``.

    These are rows of ``of``: (s, 2) that ``two_suffice``, or (s, 3) of any kind. A sample gives up
    to four poses. Those that are not finite, which PoseLib gives for degenerate samples, and those
    with a sampled point behind the camera or beyond FARTHEST_M, are left out.
    """
    if samples.shape[1] == 3:
        found = _three(of, samples)
    elif up_camera is None:
        found = _two_poles(of, samples)
    else:
        found = _upright(of, samples, up_camera)
    rotation = np.array([one.R for poses in found for one in poses]).reshape(-1, 3, 3)
    translation = np.array([one.t for poses in found for one in poses]).reshape(-1, 3)
    if up_camera is not None and samples.shape[1] == 2:
        R_camera_solver = _level(up_camera).T
        rotation, translation = (
            R_camera_solver @ rotation @ _Y_DOWN,
            translation @ R_camera_solver.T,
        )
    sample = np.repeat(samples, [len(poses) for poses in found], axis=0)
    depth = np.einsum("bj,bkj->bk", rotation[:, 2], of.point_m[sample]) + translation[:, 2:]
    in_reach = ((depth > MIN_DEPTH_M) & (depth < FARTHEST_M)).all(axis=1)  # NaN is not
    good = np.isfinite(rotation).all(axis=(1, 2)) & in_reach
    return rotation[good], translation[good]


def _three(of: Constraints, samples: IntArray) -> list[list[Any]]:
    """p3p, p2p1ll or p1p2ll, by how many of a sample's matches have a point."""
    import poselib

    ordered = np.take_along_axis(samples, np.argsort(~of.sure_point[samples], axis=1), axis=1)
    ray, point = of.ray[ordered], of.point_m[ordered]
    line = of.normal[ordered], point, of.direction[ordered]
    found: list[list[Any]] = []
    for row, points in enumerate(of.sure_point[samples].sum(axis=1)):
        seen, mapped = ray[row, :points], point[row, :points]
        lines = [one[row, points:] for one in line]
        if points == 3:
            found.append(poselib.p3p(seen, mapped))
        elif points == 2:
            found.append(poselib.p2p1ll(seen, mapped, *lines))
        else:  # three lines alone are nearly parallel
            found.append(poselib.p1p2ll(seen, mapped, *lines) if points else [])
    return found


def _two_poles(of: Constraints, samples: IntArray) -> list[list[Any]]:
    import poselib

    ray, point = of.ray[samples], of.point_m[samples]
    joined = _unit(np.cross(ray[:, 0], ray[:, 1])), _unit(point[:, 1] - point[:, 0])
    normal = np.concatenate([of.normal[samples], joined[0][:, None]], axis=1)
    direction = np.concatenate([of.direction[samples], joined[1][:, None]], axis=1)
    on_line = np.concatenate([point, point[:, :1]], axis=1)
    return [poselib.p3ll(*one) for one in zip(normal, on_line, direction, strict=True)]


def _upright(of: Constraints, samples: IntArray, up_camera: FloatArray) -> list[list[Any]]:
    """Poses from the map with y down to the levelled camera, as PoseLib's solver has them."""
    import poselib

    ray, point = of.ray[samples] @ _level(up_camera).T, of.point_m[samples] @ _Y_DOWN.T
    return [poselib.up2p(*one) for one in zip(ray, point, strict=True)]


def _level(up_camera: FloatArray) -> FloatArray:
    """(3, 3) from the camera's axes to ones whose y axis is down, at any heading."""
    return _Y_DOWN @ np.vstack([perpendicular(up_camera), up_camera])


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))
