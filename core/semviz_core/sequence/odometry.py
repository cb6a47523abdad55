"""How far the camera moved between two frames, and how well that is known."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, float_array
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose, skew

GUESS_M, GUESS_SHARE, GUESS_RAD = 0.05, 0.05, float(np.deg2rad(0.3))
"""Without odometry the last motion is taken to go on; each step guessed in a row adds this much to
how far it may be off: metres, share of the step, and radians."""


@dataclass(frozen=True, eq=False)
class Odometry:
    """One step of the camera."""

    T_now_before: Pose
    """From the camera's axes one frame ago to its axes now."""
    covariance: FloatArray
    """(6, 6) of the left perturbation of T_now_before: metres, then radians."""

    def __post_init__(self) -> None:
        covariance = float_array(self.covariance, (6, 6), "odometry covariance")
        if np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] < 0.0:
            raise SemvizError("odometry: covariance is not positive semidefinite")
        object.__setattr__(self, "covariance", covariance)

    def inverse(self) -> "Odometry":
        """The same step backwards."""
        back = self.T_now_before.inverse()
        A = adjoint(back)
        return Odometry(back, A @ self.covariance @ A.T)

    def guessed(self, steps: int) -> "Odometry":
        """The same motion once more, for the ``steps``-th time in a row without odometry."""
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
    """Standard deviation about each axis, each step."""
    rest_m: float = 0.001
    """The same in translation at rest."""

    def __post_init__(self) -> None:
        if min(self.translation, self.rotation_rad, self.rest_m) <= 0.0:
            raise SemvizError("odometry noise: give positive numbers")

    def measure(self, T_now_before: Pose, rng: np.random.Generator) -> Odometry:
        """Odometry of a true step."""
        length_m = float(np.linalg.norm(T_now_before.translation))
        sigma = np.repeat([self.rest_m + self.translation * length_m, self.rotation_rad], 3)
        return Odometry(Pose.exp(rng.normal(0.0, sigma)) @ T_now_before, np.diag(sigma**2))


def adjoint(T: Pose) -> FloatArray:
    """(6, 6) with ``T exp(xi) = exp(adjoint(T) xi) T`` (Barfoot 2017, eq. 7.45)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T.rotation
    A[:3, 3:] = skew(T.translation) @ T.rotation
    return A
