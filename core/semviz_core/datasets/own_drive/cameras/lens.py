"""Cameras as recorded, with the distortion of their lens.

Pixel (0, 0) is the centre of the top-left pixel, as everywhere in semviz; readers of formats that
count from the corner subtract 0.5. Camera axes: x right, y down, z forward.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError

LensModel: TypeAlias = Literal["pinhole", "brown-conrady", "fisheye"]
COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {
    "pinhole": (0,),
    "brown-conrady": (4, 5, 8),
    "fisheye": (4,),
}
"""How many a model has: Brown-Conrady's are OpenCV's k1, k2, p1, p2, k3, k4, k5, k6; those of the
fisheye (Kannala-Brandt) k1 to k4."""
WIDEST_RAD = float(np.deg2rad(85.0))
"""Rays farther from the optical axis are on no rectified image."""
_ITERATIONS = 30
_CONVERGED = 1e-9
_RADII = np.linspace(0.0, np.tan(WIDEST_RAD), 20_000)


@dataclass(frozen=True, eq=False)
class OriginalCamera:
    """A camera as it recorded its images."""

    model: LensModel
    width: int
    height: int
    K: FloatArray
    """(3, 3) intrinsics, px."""
    distortion: FloatArray
    """(k,) of ``COEFFICIENTS``; without dimension."""

    def __post_init__(self) -> None:
        pinhole = Camera(self.width, self.height, self.K)  # checks size and K
        object.__setattr__(self, "K", pinhole.K)
        distortion = float_array(self.distortion, (None,), "distortion")
        if len(distortion) not in COEFFICIENTS[self.model]:
            counts = " or ".join(map(str, COEFFICIENTS[self.model]))
            raise SemvizError(
                f"{self.model} distortion has {len(distortion)} numbers; give {counts}"
            )
        object.__setattr__(self, "distortion", distortion)

    @property
    def is_pinhole(self) -> bool:
        """Whether its images need no undistortion."""
        return self.model == "pinhole" or (
            self.model == "brown-conrady" and not self.distortion.any()
        )

    @property
    def focal_px(self) -> float:
        """Geometric mean of both focal lengths."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def project(self, points: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of points (n, 3) in camera coordinates.

        NaN behind the camera, and where the model folds back and no lens would show the point.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = points[:, :2] / points[:, 2:]
        radius = np.hypot(plane[:, 0], plane[:, 1])
        valid = (points[:, 2] > 0.0) & (radius <= self._largest_radius)
        pixels = np.full((len(points), 2), np.nan)
        pixels[valid] = self._distorted(plane[valid]) @ self.K[:2, :2].T + self.K[:2, 2]
        return pixels

    def rays(self, pixels_px: FloatArray) -> FloatArray:
        """Return image-plane coordinates (n, 2) at depth 1 of pixels (n, 2); inverts ``project``.

        NaN where no ray leads to the pixel.
        """
        centered = pixels_px - self.K[:2, 2]
        distorted = np.asarray(np.linalg.solve(self.K[:2, :2], centered.T).T, dtype=np.float64)
        if self.is_pinhole:
            return distorted
        plane: FloatArray = self._start(distorted)
        for _ in range(_ITERATIONS):
            error = self._distorted(plane) - distorted
            if not (np.abs(error) > _CONVERGED).any():
                break
            plane = np.asarray(
                plane - np.einsum("nij,nj->ni", self._inverse_jacobian(plane), error)
            )
        error = np.abs(self._distorted(plane) - distorted).max(axis=1)
        radius = np.hypot(plane[:, 0], plane[:, 1])
        wrong = ~(error < 1e-6) | (radius > self._largest_radius)
        plane[wrong] = np.nan
        return plane

    def _start(self, distorted: FloatArray) -> FloatArray:
        """Return the inverse (n, 2) of the radial part alone, from a table."""
        table = self._distorted(np.column_stack([self._valid_radii, 0.0 * self._valid_radii]))
        radius = np.hypot(distorted[:, 0], distorted[:, 1])
        undistorted = np.interp(radius, np.maximum.accumulate(table[:, 0]), self._valid_radii)
        scale = undistorted / np.maximum(radius, 1e-12)
        return np.asarray(distorted * np.where(radius > 1e-12, scale, 1.0)[:, None])

    def _inverse_jacobian(self, plane: FloatArray) -> FloatArray:
        step = 1e-6
        columns = [
            (self._distorted(plane + offset) - self._distorted(plane - offset)) / (2.0 * step)
            for offset in np.eye(2) * step
        ]
        (a, c), (b, d) = (column.T for column in columns)
        determinant = a * d - b * c
        determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
        inverse = np.array([[d, -b], [-c, a]]) / determinant
        return np.asarray(np.moveaxis(inverse, 2, 0))

    def _distorted(self, plane: FloatArray) -> FloatArray:
        """Return (n, 2) image-plane coordinates as the lens bends them."""
        if self.model == "pinhole":
            return plane
        return self._brown_conrady(plane) if self.model == "brown-conrady" else self._bent(plane)

    def _brown_conrady(self, plane: FloatArray) -> FloatArray:
        """Apply OpenCV's rational model: calib3d, "Detailed Description"."""
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(self.distortion, (0, 8 - len(self.distortion)))
        x, y = plane.T
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        )

    def _bent(self, plane: FloatArray) -> FloatArray:
        """Apply Kannala and Brandt 2006 with OpenCV's terms: the angle becomes a radius."""
        k1, k2, k3, k4 = self.distortion
        r = np.hypot(plane[:, 0], plane[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
        return np.asarray(plane * scale[:, None])

    @cached_property
    def _valid_radii(self) -> FloatArray:
        """The radii, from 0, up to which a larger one is also larger in the image."""
        on_axis = self._distorted(np.column_stack([_RADII, 0.0 * _RADII]))
        across = self._distorted(np.column_stack([0.0 * _RADII, _RADII]))
        grows = (np.diff(on_axis[:, 0]) > 0.0) & (np.diff(across[:, 1]) > 0.0)
        return _RADII[: len(_RADII) if grows.all() else int(np.argmin(grows)) + 1]

    @cached_property
    def _largest_radius(self) -> float:
        return float(self._valid_radii[-1])


@dataclass(frozen=True, eq=False)
class OriginalRig:
    """One or two cameras as recorded."""

    left: OriginalCamera
    right: OriginalCamera | None = None
    T_right_left: Pose | None = None
    """None with one camera."""

    def __post_init__(self) -> None:
        if (self.right is None) != (self.T_right_left is None):
            raise SemvizError("give both the right camera and its pose T_right_left, or neither")
