"""One moment of a drive, and what is known about its pose beforehand."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, float_array
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose

SIGMA_RANGE = (1e-6, 1e6)
"""Smaller or larger ones (m or rad) are no sensor's, and their squares lose all digits."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a sequence; its images come from the source."""

    index: int
    """The sequence's own number, as in its file names."""
    time_s: float
    T_map_camera: Pose | None = None
    """Ground truth of the left camera, where there is one."""


@dataclass(frozen=True, eq=False)
class Prior:
    """What a vehicle knows of the camera's pose before it looks.

    Every piece but the rough position can be missing; sigmas are one standard deviation.
    """

    position_m: FloatArray
    """(3,) rough camera centre in the map frame, from GPS and the height of the road."""
    horizontal_sigma_m: float = 5.5
    vertical_sigma_m: float = 0.3
    up_camera: FloatArray | None = None
    """(3,) unit: the map's z axis in camera coordinates, from an IMU; None without one."""
    up_sigma_rad: float = float(np.deg2rad(0.5))
    heading_rad: float | None = None
    """Direction of the optical axis about the map's z, from x towards y; None if unknown."""
    heading_sigma_rad: float = float(np.deg2rad(5.0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", float_array(self.position_m, (3,), "position_m"))
        for name in ("horizontal_sigma_m", "vertical_sigma_m", "up_sigma_rad", "heading_sigma_rad"):
            check_sigma(getattr(self, name), f"prior: {name}")
        if self.heading_rad is not None and not np.isfinite(self.heading_rad):
            raise SemvizError("prior: heading_rad is not a number; leave it None if unknown")
        if self.up_camera is not None:
            up = float_array(self.up_camera, (3,), "up_camera")
            if abs(float(np.linalg.norm(up)) - 1.0) > 1e-6:
                raise SemvizError("prior: up_camera must have length 1")
            object.__setattr__(self, "up_camera", up)


def check_sigma(sigma: float, name: str) -> None:
    """SemvizError where ``sigma`` is no standard deviation of a sensor."""
    low, high = SIGMA_RANGE
    if not low <= sigma <= high:
        raise SemvizError(f"{name} is {sigma:g}; give a number from {low:g} to {high:g}")
