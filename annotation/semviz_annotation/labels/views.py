"""The camera of an image with its pose, and epipolar segments between two images.

The poses of all views refer to one coordinate frame for triangulation, called map. The two images
may differ in camera, in frame, or in both.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True, eq=False)
class PosedView:
    """A camera with its pose in the map frame."""

    camera: Camera
    T_camera_map: Pose

    @cached_property
    def center_m(self) -> FloatArray:
        """(3,) camera centre in the map frame."""
        return -self.T_camera_map.rotation.T @ self.T_camera_map.translation

    def rays(self, pixels_px: FloatArray) -> FloatArray:
        """Return the unit rays (n, 3) of pixels (n, 2), in the map frame."""
        return self.camera.bearing(pixels_px) @ self.T_camera_map.rotation

    def depth_m(self, points_m: FloatArray) -> FloatArray:
        """Return the depths (n,) of points (n, 3) of the map frame."""
        R, t = self.T_camera_map.rotation, self.T_camera_map.translation
        return np.asarray(points_m @ R[2] + t[2])

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (n, 2) of points (n, 3) of the map frame; NaN behind the camera."""
        return self.camera.project(self.T_camera_map.apply(points_m))

    def jacobian(self, point_m: FloatArray) -> FloatArray:
        """Return d(pixel)/d(point) (2, 3) px/m of a map point (3,); distortion is ignored."""
        x, y, z = self.T_camera_map.apply(point_m)
        plane = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
        return np.asarray(self.camera.K[:2, :2] @ plane @ self.T_camera_map.rotation)


def other_side(side: Side) -> Side:
    """Return the opposite side."""
    return "right" if side == "left" else "left"


def camera_of(rig: Rig, side: Side) -> tuple[Camera, Pose]:
    """Return the camera of a side and ``T_camera_left``. Raise SemvizError if there is none."""
    if side == "left":
        return rig.left, Pose.identity()
    if rig.right is None or rig.T_right_left is None:
        raise SemvizError("this sequence has no right camera")
    return rig.right, rig.T_right_left


def rig_view(rig: Rig, side: Side, T_left_map: Pose | None = None) -> PosedView:
    """Return the view of one camera of a rig at ``T_left_map``; None: the left camera's frame."""
    camera, T_camera_left = camera_of(rig, side)
    return PosedView(camera, T_camera_left if T_left_map is None else T_camera_left @ T_left_map)


PLAUSIBLE_DEPTH_M = (2.0, 80.0)
"""Nearer elements are cut off by the image border, farther ones cannot be triangulated."""
_SAMPLES = 33
"""Points along the epipolar curve if the target camera has distortion."""


def epipolar_segment(
    source: PosedView,
    target: PosedView,
    pixel_px: tuple[float, float],
    depth_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> FloatArray:
    """Return the epipolar line (k, 2) px in ``target`` of a pixel of ``source``, near end first.

    ``depth_m`` bounds the depth in ``source``; the upper bound may be infinite. k is 2, more if the
    target camera has distortion, and 0 if the line misses the target image.
    Hartley & Zisserman, 9.1; images need not be rectified.
    """
    camera = target.camera
    T_target_camera = target.T_camera_map @ source.T_camera_map.inverse()
    ray = np.append(source.camera.normalize(np.array([pixel_px]))[0], 1.0)
    towards, offset = T_target_camera.rotation @ ray, T_target_camera.translation
    inverse_depths = _in_front(1.0 / depth_m[1], 1.0 / depth_m[0], towards[2], offset[2])
    if inverse_depths is None:
        return np.zeros((0, 2))
    count = _SAMPLES if camera.distortion.size else 2
    points = towards + np.linspace(*inverse_depths, count)[::-1, None] * offset
    return _clip_to_image(camera.project(points / points[:, 2:]), camera)


def _in_front(far: float, near: float, z: float, slope: float) -> tuple[float, float] | None:
    """Return the part of inverse depths [far, near] with ``z + inverse * slope`` > 0, or None."""
    margin = 1e-3  # relative to the depth in the source camera; avoids a division by zero
    if slope != 0.0:
        bound = (margin - z) / slope
        far, near = (max(far, bound), near) if slope > 0 else (far, min(near, bound))
    elif z <= margin:
        return None
    return (far, near) if far < near else None


def _clip_to_image(line_px: FloatArray, camera: Camera) -> FloatArray:
    """Return the part of a polyline inside the image (Liang & Barsky 1984, per segment)."""
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
