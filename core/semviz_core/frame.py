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
    road_m: FloatArray | None = None
    """(k, 3) places where cameras were when the map was made, near ``position_m``: the camera's
    height is that of the nearest one, within ``vertical_sigma_m``. Roads may cross at different
    heights. None: the height is that of ``position_m``."""

    def __post_init__(self) -> None:
        position = float_array(self.position_m, (3,), "prior: position_m")
        object.__setattr__(self, "position_m", position)
        for name in ("horizontal_sigma_m", "vertical_sigma_m", "up_sigma_rad", "heading_sigma_rad"):
            check_sigma(getattr(self, name), f"prior: {name}")
        if self.heading_rad is not None:
            heading = float(float_array(self.heading_rad, (), "prior: heading_rad"))
            if abs(heading) > 2.0 * np.pi:
                raise SemvizError(f"prior: heading_rad is {heading:g}; give radians, not degrees")
            object.__setattr__(self, "heading_rad", heading)
        if self.road_m is not None:
            road = float_array(self.road_m, (None, 3), "prior: road_m")
            object.__setattr__(self, "road_m", road if len(road) else None)
        if self.up_camera is not None:
            up = float_array(self.up_camera, (3,), "prior: up_camera")
            length = float(np.linalg.norm(up))
            if abs(length - 1.0) > 1e-6:
                raise SemvizError(f"prior: up_camera must have length 1, not {length:g}; divide it")
            object.__setattr__(self, "up_camera", up)


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian over the whole pose, such as odometry predicts it."""

    T_camera_map: Pose
    covariance: FloatArray
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians."""

    def __post_init__(self) -> None:
        if not isinstance(self.T_camera_map, Pose):
            kind = type(self.T_camera_map).__name__
            raise SemvizError(f"belief: T_camera_map is of type {kind}; give a Pose")
        covariance = float_array(self.covariance, (6, 6), "belief: covariance")
        if np.abs(covariance - covariance.T).max() > 1e-9 * np.abs(covariance).max():
            raise SemvizError("belief: covariance is not symmetric")
        if np.linalg.eigvalsh(covariance)[0] <= 0.0:
            raise SemvizError("belief: covariance is not positive definite")
        object.__setattr__(self, "covariance", covariance)


def check_sigma(sigma: float, name: str) -> None:
    """SemvizError where ``sigma`` is no standard deviation of a sensor."""
    low, high = SIGMA_RANGE
    value = float(float_array(sigma, (), name))
    if not low <= value <= high:
        raise SemvizError(f"{name} is {value:g}; give a number from {low:g} to {high:g}")
