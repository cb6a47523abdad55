"""Where a pixel of one image can lie in another: of the other camera, or of another frame."""

from itertools import pairwise

import numpy as np

from semviz_annotation.view import View
from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera

PLAUSIBLE_DEPTH_M = (2.0, 80.0)
"""Nearer things are cut off by the image; further ones cannot be triangulated (BENCHMARK: 3-40)."""
_SAMPLES = 33
"""Points along the curve that distortion makes of the line."""


def epipolar_segment(
    here: View,
    there: View,
    pixel_px: tuple[float, float],
    depth_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> FloatArray:
    """(k, 2) px: the epipolar line of a pixel of ``here`` in ``there``, near end first.

    ``depth_m`` bounds the depth in ``here``; its upper bound can be infinite. k is 2, more where
    the other camera has distortion, and 0 where no such point is in the other image.
    Hartley & Zisserman, 9.1; rectification is not assumed.
    """
    target = there.camera
    T_target_camera = there.T_camera_map @ here.T_camera_map.inverse()
    ray = np.append(here.camera.normalize(np.array([pixel_px]))[0], 1.0)
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
