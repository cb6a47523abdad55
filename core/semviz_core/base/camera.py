"""Pinhole cameras and stereo rigs.

Camera axes are those of OpenCV: x right, y down, z forward. Pixel (0, 0) is the centre of the
top-left pixel. The pose of a frame is that of its left camera.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, float_array, int_array, unit_vectors
from semviz_core.common.errors import SemvizError

MIN_DEPTH_M = 0.1
"""Nearer points are treated as behind the camera."""
LEAST_FOCAL_PX = 1e-6
DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera. Pixel (0, 0) is the centre of the top-left pixel (OpenCV, KITTI)."""

    width: int
    height: int
    K: FloatArray
    """(3, 3) intrinsics, px."""
    distortion: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(k,) OpenCV's k1, k2, p1, p2, k3, ...; empty where images are rectified."""

    def __post_init__(self) -> None:
        K = float_array(self.K, (3, 3), "K")
        for name in ("width", "height"):
            size = int_array(getattr(self, name), (), name)
            if size <= 0:
                raise SemvizError(f"image {name} {size} is not positive")
            object.__setattr__(self, name, int(size))
        if (
            min(K[0, 0], K[1, 1]) < LEAST_FOCAL_PX
            or K[1, 0]
            or not np.array_equal(K[2], [0.0, 0.0, 1.0])
        ):
            raise SemvizError("K is not an intrinsic matrix: [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
        object.__setattr__(self, "K", K)
        distortion = float_array(self.distortion, (None,), "distortion")
        if len(distortion) not in DISTORTION_LENGTHS:
            counts = ", ".join(str(count) for count in DISTORTION_LENGTHS)
            raise SemvizError(f"distortion has {len(distortion)} numbers; OpenCV's has {counts}")
        object.__setattr__(self, "distortion", distortion)

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of points (n, 3) in camera coordinates; NaN behind the camera."""
        points = np.atleast_2d(points_camera)
        pixels = np.full((len(points), 2), np.nan)
        ahead = points[:, 2] > MIN_DEPTH_M
        if self.distortion.size and ahead.any():
            import cv2

            projected, _ = cv2.projectPoints(
                points[ahead], np.zeros(3), np.zeros(3), self.K, self.distortion
            )
            pixels[ahead] = projected.reshape(-1, 2)
        else:
            homogeneous = points[ahead] @ self.K.T
            pixels[ahead] = homogeneous[:, :2] / homogeneous[:, 2:]
        return pixels

    def normalize(self, pixels_px: FloatArray) -> FloatArray:
        """Return undistorted image-plane coordinates (n, 2) at depth 1 of pixels (n, 2)."""
        pixels = np.atleast_2d(pixels_px)
        if self.distortion.size and len(pixels):
            import cv2

            undistorted = cv2.undistortPoints(
                np.ascontiguousarray(pixels)[:, None, :], self.K, self.distortion
            )
            return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        rays: FloatArray = np.linalg.solve(self.K, homogeneous.T).T
        return rays[:, :2]

    def bearing(self, pixels_px: FloatArray) -> FloatArray:
        """Return unit rays (n, 3) in camera coordinates: the paper's f = unit(K^-1 [u, v, 1])."""
        plane = self.normalize(pixels_px)
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        return unit_vectors(rays)

    def contains(self, pixels_px: FloatArray) -> BoolArray:
        """Return (n,) whether pixels (n, 2) lie in the image; False for NaN."""
        u, v = np.atleast_2d(pixels_px).T
        inside: BoolArray = (
            (u >= -0.5) & (v >= -0.5) & (u <= self.width - 0.5) & (v <= self.height - 0.5)
        )
        return inside


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of a vehicle. Poses of frames are those of the left camera.

    ``right`` and ``T_right_left`` are both None for a single camera.
    """

    left: Camera
    right: Camera | None = None
    T_right_left: Pose | None = None

    def __post_init__(self) -> None:
        if (self.right is None) != (self.T_right_left is None):
            raise SemvizError("give both the right camera and its pose T_right_left, or neither")
        if self.T_right_left is not None and self.T_right_left.translation[0] >= 0:
            raise SemvizError(
                f"left and right are swapped: baseline is {self.baseline_m:.2f} m; swap the cameras"
            )

    @property
    def sides(self) -> tuple[Literal["left", "right"], ...]:
        """Which cameras there are."""
        return ("left",) if self.right is None else ("left", "right")

    @property
    def baseline_m(self) -> float:
        """Distance along x from the left to the right camera; 0 for a single camera."""
        if self.T_right_left is None:
            return 0.0
        return float(self.T_right_left.inverse().translation[0])
