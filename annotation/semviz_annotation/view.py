"""One image's camera and where it stood, and the cameras of a rig by their side."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera, Rig
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose
from semviz_core.sources.source import Side


@dataclass(frozen=True, eq=False)
class View:
    """A camera in the frame in which to triangulate, called map here."""

    camera: Camera
    T_camera_map: Pose

    @cached_property
    def center_m(self) -> FloatArray:
        """(3,) camera centre in the map frame."""
        return -self.T_camera_map.rotation.T @ self.T_camera_map.translation

    def rays(self, pixels_px: FloatArray) -> FloatArray:
        """(n, 3) of pixels (n, 2): unit, in the map frame."""
        return self.camera.bearing(pixels_px) @ self.T_camera_map.rotation

    def depth_m(self, points_m: FloatArray) -> FloatArray:
        """(n,) of points (n, 3)."""
        R, t = self.T_camera_map.rotation, self.T_camera_map.translation
        return np.asarray(points_m @ R[2] + t[2])

    def project(self, points_m: FloatArray) -> FloatArray:
        """(n, 2) px of points (n, 3) of the map frame; NaN behind the camera."""
        return self.camera.project(self.T_camera_map.apply(points_m))

    def jacobian(self, point_m: FloatArray) -> FloatArray:
        """(2, 3) px/m: how the projection of a map point moves with it; distortion left out."""
        x, y, z = self.T_camera_map.apply(point_m)
        plane = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
        return np.asarray(self.camera.K[:2, :2] @ plane @ self.T_camera_map.rotation)


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


def rig_view(rig: Rig, side: Side, T_left_map: Pose | None = None) -> View:
    """One camera of a rig whose left camera is at ``T_left_map`` (None: the map frame is its)."""
    camera, T_camera_left = camera_of(rig, side)
    return View(camera, T_camera_left if T_left_map is None else T_camera_left @ T_left_map)
