"""One frame of a sequence, its prior, its odometry, and the Dataset protocol.

A Prior is the measurement of GPS, compass and inertial unit, before the image is used. A Belief
is a Gaussian over the whole pose, for example one that odometry predicts. Odometry is the
camera's motion between two frames with its covariance; simulated odometry errors are independent
from step to step. A Dataset supplies frames, (stereo) images and the rig, real or simulated.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.pose import Pose, skew
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray, float_array
from semviz_core.common.errors import SemvizError

SIGMA_RANGE = (1e-6, 1e6)
"""Sigmas (m or rad) that are accepted; squares of smaller or larger ones lose all digits."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a sequence; its images come from the dataset."""

    index: int
    """The frame's number in the sequence, as in its file names."""
    time_s: float
    T_map_camera: Pose | None = None
    """Ground truth pose of the left camera, None if unknown."""
    left_out: bool = False
    """Whether a person took its pose away: its labels do not count until it has one again."""


@dataclass(frozen=True, eq=False)
class Prior:
    """The camera's pose as the vehicle's other sensors measure it.

    All but the position may be missing. Sigmas are one standard deviation.
    """

    position_m: FloatArray
    """(3,) approximate camera centre in the map frame, from GPS and the height of the road."""
    horizontal_sigma_m: float = 5.5
    vertical_sigma_m: float = 0.3
    up_camera: FloatArray | None = None
    """(3,) unit: the map's z axis in camera coordinates, from an IMU; None without an IMU."""
    up_sigma_rad: float = float(np.deg2rad(0.5))
    heading_rad: float | None = None
    """Direction of the optical axis about the map's z, from x towards y; None if unknown."""
    heading_sigma_rad: float = float(np.deg2rad(5.0))
    road_m: FloatArray | None = None
    """(k, 3) camera centres of the mapping drive near ``position_m``. The camera's height is that
    of the nearest of them, within ``vertical_sigma_m``; roads may cross at different heights.
    None: the height is that of ``position_m``."""

    def __post_init__(self) -> None:
        position = float_array(self.position_m, (3,), "prior: position_m")
        object.__setattr__(self, "position_m", position)
        for name in ("horizontal_sigma_m", "vertical_sigma_m", "up_sigma_rad", "heading_sigma_rad"):
            check_sensor_sigma(getattr(self, name), f"prior: {name}")
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
                raise SemvizError(
                    f"prior: up_camera must have length 1, not {length:g}; normalize it"
                )
            object.__setattr__(self, "up_camera", up)


_UNKNOWN_SIGMA_M = 1e4


def vague_prior(position_m: FloatArray) -> Prior:
    """Return a prior that says nothing about a pose near there, for solvers that need one."""
    return Prior(position_m, _UNKNOWN_SIGMA_M, _UNKNOWN_SIGMA_M)


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian over the whole pose, for example the prediction of odometry."""

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


def check_sensor_sigma(sigma: float, name: str) -> None:
    """Raise SemvizError if ``sigma`` is outside ``SIGMA_RANGE``."""
    low, high = SIGMA_RANGE
    value = float(float_array(sigma, (), name))
    if not low <= value <= high:
        raise SemvizError(f"{name} is {value:g}; give a number from {low:g} to {high:g}")


GUESS_M, GUESS_SHARE, GUESS_RAD = 0.05, 0.05, float(np.deg2rad(0.3))
"""Standard deviation that each step adds if odometry is missing and the last motion is assumed to
continue: metres, share of the step, and radians."""


@dataclass(frozen=True, eq=False)
class Odometry:
    """The camera's motion from one frame to the next."""

    T_now_before: Pose
    """From the camera frame one step ago to the camera frame now."""
    covariance: FloatArray
    """(6, 6) of the left perturbation of T_now_before: metres, then radians."""

    def __post_init__(self) -> None:
        covariance = float_array(self.covariance, (6, 6), "odometry covariance")
        if np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] < 0.0:
            raise SemvizError("odometry: covariance is not positive semidefinite")
        object.__setattr__(self, "covariance", covariance)

    def inverse(self) -> "Odometry":
        """Return the same step backwards."""
        back = self.T_now_before.inverse()
        A = adjoint(back)
        return Odometry(back, A @ self.covariance @ A.T)

    def followed_by(self, after: "Odometry") -> "Odometry":
        """Return this motion and the one ``after`` it as one step; their errors are independent."""
        A = adjoint(after.T_now_before)
        covariance = after.covariance + A @ self.covariance @ A.T
        return Odometry(after.T_now_before @ self.T_now_before, covariance)

    def guessed(self, steps: int) -> "Odometry":
        """Return the same motion again, for the ``steps``-th step in a row without odometry."""
        length_m = float(np.linalg.norm(self.T_now_before.translation))
        sigma = np.repeat([GUESS_M + GUESS_SHARE * length_m, GUESS_RAD], 3) * steps
        return Odometry(self.T_now_before, self.covariance + np.diag(sigma**2))


STANDSTILL = Odometry(Pose.identity(), np.zeros((6, 6)))


@dataclass(frozen=True)
class OdometryNoise:
    """Errors of simulated odometry, independent from step to step."""

    translation: float = 0.01
    """Standard deviation along each axis, as a share of the step's length."""
    rotation_rad: float = float(np.deg2rad(0.1))
    """Standard deviation about each axis, per step."""
    rest_m: float = 0.001
    """Standard deviation of the translation along each axis at rest."""

    def __post_init__(self) -> None:
        if min(self.translation, self.rotation_rad, self.rest_m) <= 0.0:
            raise SemvizError("odometry noise: give positive numbers")

    def measure(self, T_now_before: Pose, rng: np.random.Generator) -> Odometry:
        """Return noisy odometry of a true step."""
        error = rng.normal(0.0, self._sigma(T_now_before))
        return self.measured(Pose.exp(error) @ T_now_before, T_now_before)

    def measured(self, T_now_before: Pose, of_step: Pose | None = None) -> Odometry:
        """Return measured odometry with the covariance of a step, by default its own."""
        return Odometry(T_now_before, np.diag(self._sigma(of_step or T_now_before) ** 2))

    def _sigma(self, T_now_before: Pose) -> FloatArray:
        """(6,)"""
        length_m = float(np.linalg.norm(T_now_before.translation))
        return np.repeat([self.rest_m + self.translation * length_m, self.rotation_rad], 3)


def adjoint(T: Pose) -> FloatArray:
    """Return (6, 6) with ``T exp(xi) = exp(adjoint(T) xi) T`` (Barfoot 2017, eq. 7.45)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T.rotation
    A[:3, 3:] = skew(T.translation) @ T.rotation
    return A


Side = Literal["left", "right"]


class Dataset(Protocol):
    """A sequence of (stereo) images with poses, real or simulated.

    Opening a dataset reads no image. ``image`` raises SemvizError if the image is missing or wrong.
    """

    @property
    def map_frame(self) -> MapFrame:
        """The frame of the poses."""
        ...

    @property
    def rig(self) -> Rig: ...

    @property
    def frames(self) -> tuple[Frame, ...]:
        """In order of time."""
        ...

    def image(self, index: int, side: Side) -> ByteImage:
        """Return (height, width, 3) sRGB of the frame with this ``Frame.index``."""
        ...


@runtime_checkable
class FileDataset(Dataset, Protocol):
    """A ``Dataset`` whose images are files.

    Both paths raise SemvizError for a frame or side that is not there.
    """

    def with_frames(self, frames: tuple[Frame, ...]) -> "FileDataset":
        """Return the same images with other poses; ``frames`` have the same numbers."""
        ...

    def image_path(self, index: int, side: Side) -> Path:
        """Return the file with the pixels of ``image``; it is made if it is missing."""
        ...

    def original_path(self, index: int, side: Side) -> Path:
        """Return the recorded file; another one than ``image_path`` if that is rectified."""
        ...
