"""Simulate the prior of a vehicle from its true pose.

Options are the sigmas of GPS, compass and inertial unit; None means that the sensor is missing.
The same seed gives the same prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semviz_core.base.frame import Prior, check_sensor_sigma
from semviz_core.base.pose import Pose, heading_rad, so3_exp
from semviz_core.common.errors import SemvizError

_LEAST_SIGMA_M = 0.01  # of a GPS without errors
_FARTHEST_M = 1e5  # largest error of a fix


@dataclass(frozen=True)
class PriorOptions:
    """Accuracy of GPS, compass and inertial unit; a sigma of None means that one is missing."""

    distance_m: tuple[float, float] = (5.0, 10.0)
    """Range of the fix's horizontal distance from the truth, in any direction."""
    heading_sigma_rad: float | None = None
    imu_sigma_rad: float | None = float(np.deg2rad(0.5))
    """Of the vertical, about each of two horizontal axes."""
    vertical_sigma_m: float = 0.3

    def __post_init__(self) -> None:
        near, far = self.distance_m
        if not 0.0 <= near <= far <= _FARTHEST_M:
            raise SemvizError(
                f"prior: {near:g} to {far:g} m is not a range of distances; "
                f"give two numbers in order, up to {_FARTHEST_M:g} m"
            )
        for name in ("heading_sigma_rad", "imu_sigma_rad", "vertical_sigma_m"):
            if (sigma := getattr(self, name)) is not None:
                check_sensor_sigma(sigma, f"prior: {name}")

    @property
    def horizontal_sigma_m(self) -> float:
        """Standard deviation of the fix along each of two axes."""
        near, far = self.distance_m
        return max(float(np.sqrt((near**2 + near * far + far**2) / 6.0)), _LEAST_SIGMA_M)


def simulate_prior(T_map_camera: Pose, options: PriorOptions, seed: int | Sequence[int]) -> Prior:
    """Return a prior for the camera at this true pose; the same for the same seed.

    All errors are drawn, used or not, so leaving one sensor out does not change the others.
    """
    rng = np.random.default_rng(seed)
    distance, bearing = rng.uniform(*options.distance_m), rng.uniform(-np.pi, np.pi)
    height, turn, tilt = rng.standard_normal(), rng.standard_normal(), rng.standard_normal(2)
    offset = [
        distance * np.cos(bearing),
        distance * np.sin(bearing),
        height * options.vertical_sigma_m,
    ]
    known: dict[str, Any] = {}
    if options.imu_sigma_rad is not None:
        tilted = so3_exp(T_map_camera.rotation.T @ np.append(tilt * options.imu_sigma_rad, 0.0))
        known["up_camera"] = tilted @ T_map_camera.rotation[2]
        known["up_sigma_rad"] = options.imu_sigma_rad
    if options.heading_sigma_rad is not None:
        error_rad = turn * options.heading_sigma_rad
        known["heading_rad"] = _wrapped(heading_rad(T_map_camera) + error_rad)
        known["heading_sigma_rad"] = options.heading_sigma_rad
    return Prior(
        position_m=T_map_camera.translation + offset,
        horizontal_sigma_m=options.horizontal_sigma_m,
        vertical_sigma_m=options.vertical_sigma_m,
        **known,
    )


def _wrapped(angle_rad: float) -> float:
    """Return the same angle in [-pi, pi)."""
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
