"""The ground's height, as far as the drive and the bottoms of known poles tell.

A pole whose bottom is marked well above the ground is hidden below, by a car for example.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray

_CAMERA_M, _CAMERA_SIGMA_M = 1.65, 0.3
"""A camera on a car is so high above the road, before any bottom is known."""
_BOTTOM_SIGMA_M = 0.12
"""Kerbs, and what bottoms are marked off by."""
_SLOPE = 0.02
"""What the ground rises or falls by on a metre, if nothing is known of it."""
_LEAST_M = 0.25
_SIGMAS = 2.5


@dataclass(frozen=True, eq=False)
class Ground:
    """Of one stretch of a drive, in a map frame whose z is up."""

    centers_m: FloatArray
    """(k, 3) of cameras, at least one."""
    bottoms_m: FloatArray
    """(n, 3) where poles stand."""

    def height_m(self, point_m: FloatArray) -> tuple[float, float]:
        """z of the ground below a point (3,), and its standard deviation."""
        away = np.linalg.norm(self.centers_m[:, :2] - point_m[:2], axis=1)
        nearest = int(np.argmin(away))
        below = self.centers_m[nearest, 2] - _CAMERA_M
        gaps = np.linalg.norm(self.bottoms_m[:, :2] - point_m[:2], axis=1)
        heights = np.append(self.bottoms_m[:, 2], below)
        sigmas = np.append(
            np.hypot(_BOTTOM_SIGMA_M, _SLOPE * gaps),
            np.hypot(_CAMERA_SIGMA_M, _SLOPE * away[nearest]),
        )
        order = np.argsort(heights, kind="stable")
        weights = 1.0 / sigmas[order] ** 2
        middle = int(np.searchsorted(np.cumsum(weights), weights.sum() / 2.0))
        sigma = max(1.0 / np.sqrt(weights.sum()), _SLOPE * min([*gaps, away[nearest]]))
        return float(heights[order[middle]]), float(sigma)

    def is_below(self, bottom_m: FloatArray, sigma_m: float) -> bool:
        """Whether the ground is clearly below a marked bottom (3,), whose height is known to
        ``sigma_m``: so that is not where the pole stands."""
        height, sigma = self.height_m(bottom_m)
        least = max(_LEAST_M, _SIGMAS * float(np.hypot(sigma, sigma_m)))
        return bool(bottom_m[2] - height > least)
