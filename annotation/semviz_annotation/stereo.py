"""Where a pixel of one image can lie in the other, for any two calibrated cameras of a rig."""

from itertools import pairwise

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera, Rig
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose
from semviz_core.sources.source import Side

PLAUSIBLE_DEPTH_M = (2.0, 80.0)
"""Nearer things are cut off by the image; further ones cannot be triangulated (BENCHMARK: 3-40)."""
_SAMPLES = 33
"""Points along the curve that distortion makes of the line."""


def other(side: Side) -> Side:
    """The side that is not ``side``."""
    return "right" if side == "left" else "left"


def camera_of(rig: Rig, side: Side) -> tuple[Camera, Pose]:
    """The camera on one side with its pose ``T_camera_left``; SemvizError where there is none."""
    if side == "left":
        return rig.left, Pose.identity()
    if rig.right is None or rig.T_right_left is None:
        raise SemvizError("this sequence has no right camera")
    return rig.right, rig.T_right_left


def epipolar_segment(
    rig: Rig,
    side: Side,
    pixel_px: tuple[float, float],
    depth_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> FloatArray:
    """(k, 2) px: the epipolar line of a pixel on ``side``, in the other image, near end first.

    ``depth_m`` bounds the depth in the camera of ``side``; its upper bound can be infinite. k is 2,
    more where the other camera has distortion, and 0 where no such point is in the other image.
    Hartley & Zisserman, 9.1; rectification is not assumed.
    """
    camera, T_camera_left = camera_of(rig, side)
    target, T_target_left = camera_of(rig, other(side))
    T_target_camera = T_target_left @ T_camera_left.inverse()
    ray = np.append(camera.normalize(np.array([pixel_px]))[0], 1.0)
    towards, offset = T_target_camera.rotation @ ray, T_target_camera.translation
    inverse_depths = _ahead(1.0 / depth_m[1], 1.0 / depth_m[0], towards[2], offset[2])
    if inverse_depths is None:
        return np.zeros((0, 2))
    count = _SAMPLES if target.distortion.size else 2
    points = towards + np.linspace(*inverse_depths, count)[::-1, None] * offset
    return _clipped(target.project(points / points[:, 2:]), target)


def _ahead(far: float, near: float, z: float, slope: float) -> tuple[float, float] | None:
    """The part of inverse depths [far, near] for which ``z + inverse * slope`` is ahead."""
    margin = 1e-3  # of the depth in the first camera: keeps the division sane
    if slope != 0.0:
        bound = (margin - z) / slope
        far, near = (max(far, bound), near) if slope > 0 else (far, min(near, bound))
    elif z <= margin:
        return None
    return (far, near) if far < near else None


def _clipped(line_px: FloatArray, camera: Camera) -> FloatArray:
    """The part of a polyline inside the image (Liang & Barsky 1984, segment by segment)."""
    low = np.array([-0.5, -0.5])
    high = np.array([camera.width - 0.5, camera.height - 0.5])
    kept: list[FloatArray] = []
    for start, end in pairwise(line_px):
        step = end - start
        with np.errstate(divide="ignore", invalid="ignore"):
            bounds = np.stack([(low - start) / step, (high - start) / step])
        parallel = step == 0.0
        if ((start < low) | (start > high))[parallel].any():
            continue
        enter = max(0.0, *bounds.min(axis=0)[~parallel])
        leave = min(1.0, *bounds.max(axis=0)[~parallel])
        if enter <= leave:
            kept += [start + enter * step, start + leave * step]
    if not kept:
        return np.zeros((0, 2))
    points = np.array(kept)
    new = np.r_[True, (np.diff(points, axis=0) != 0.0).any(axis=1)]
    return np.asarray(points[new])
