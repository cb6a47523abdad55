"""What the cameras of a rig see in one frame, when they see it, and how the rig moves meanwhile.

Cameras fire at different times, and a rolling shutter exposes row after row: every end of an
element has a time of its own. With the motion known, each end is compared with the map from where
its camera then was.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Odometry, Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, float_array, unit_vectors
from semviz_core.common.errors import SemvizError
from semviz_core.localization.upright import LEAST_SINE, assumed_upright, level_rotation

MOST_TIME_S = 1.0
"""Further from the time of its frame no element is seen: motions are constant for less."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """The velocity of a body, constant while the images of one frame are taken."""

    velocity_mps: FloatArray
    """(3,) of its origin, in its own axes."""
    turn_radps: FloatArray
    """(3,) about its own axes."""

    def __post_init__(self) -> None:
        for name in ("velocity_mps", "turn_radps"):
            object.__setattr__(
                self, name, float_array(getattr(self, name), (3,), f"motion: {name}")
            )

    @classmethod
    def of_step(cls, odometry: Odometry, duration_s: float) -> "BodyMotion":
        """Return the constant motion of a step that took ``duration_s``."""
        twist = -odometry.T_now_before.log() / duration_s
        return cls(twist[:3], twist[3:])

    def after(self, time_s: float) -> Pose:
        """Return T_then_now: where the body now is, from where it is ``time_s`` later."""
        return Pose.exp(-time_s * np.concatenate([self.velocity_mps, self.turn_radps]))


STANDING = BodyMotion(np.zeros(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class CameraView:
    """The m elements that one camera of a rig sees in one frame."""

    observed: Elements2D
    camera: Camera
    T_body_camera: Pose = field(default_factory=Pose.identity)
    """Where the camera is on the body, whose ``BodyMotion`` is known."""
    time_s: ArrayLike = 0.0
    """When the elements were seen, after the time of the frame: one number for all of them, (m, 1)
    for each, or (m, 2) for the anchor and the end of each. Times are in seconds."""

    def __post_init__(self) -> None:
        time_s, m = np.asarray(self.time_s, dtype=np.float64), len(self.observed)
        if time_s.shape not in ((), (m, 1), (m, 2)):
            raise SemvizError(
                f"time_s has shape {time_s.shape}; give a number, or an array ({m}, 1) or ({m}, 2)"
            )
        if not (np.abs(time_s) <= MOST_TIME_S).all():
            raise SemvizError(
                f"time_s must be within {MOST_TIME_S:g} s of the frame; give seconds after its time"
            )
        object.__setattr__(self, "time_s", np.broadcast_to(time_s, (m, 2)).copy())

    @property
    def mean_time_s(self) -> float:
        """The middle of the times; 0 without elements."""
        times = np.asarray(self.time_s)
        return float(0.5 * (times.min() + times.max())) if len(times) else 0.0


def rolling_shutter(observed: Elements2D, camera: Camera, readout_s: float) -> FloatArray:
    """Return when both ends of each element were exposed (m, 2), after the middle row was.

    ``readout_s`` is the time from the first row to the last, negative from the bottom up. Elements
    are where the sensor saw them: not rectified, or rectified with rows left in place.
    """
    end_px = np.where(observed.is_line[:, None], observed.end_px, observed.anchor_px)
    rows = np.column_stack([observed.anchor_px[:, 1], end_px[:, 1]])
    return readout_s * np.clip((rows + 0.5) / camera.height - 0.5, -0.5, 0.5)


def prior_of_camera(prior: Prior, T_other_camera: Pose) -> Prior:
    """Return the prior of another camera of a rig, from that of one: as far as the heading is not
    known, nor is where the other one is around it."""
    upright = assumed_upright(prior)
    up = upright.up_camera
    assert up is not None
    lever_m = T_other_camera.inverse().translation
    above_m = float(lever_m @ up)
    beside_m = float(np.linalg.norm(lever_m - above_m * up))
    raised = np.array([0.0, 0.0, above_m])
    return replace(
        prior,
        position_m=prior.position_m + raised,
        horizontal_sigma_m=float(np.hypot(prior.horizontal_sigma_m, beside_m)),
        vertical_sigma_m=float(np.hypot(prior.vertical_sigma_m, upright.up_sigma_rad * beside_m)),
        up_camera=None if prior.up_camera is None else unit_vectors(T_other_camera.rotation @ up),
        heading_rad=_other_heading(upright, T_other_camera),
        road_m=None if prior.road_m is None else prior.road_m + raised,
    )


def _other_heading(upright: Prior, T_other_camera: Pose) -> float | None:
    """Return the heading of another camera, None if unknown, or if that one looks up or down."""
    if upright.heading_rad is None or upright.up_camera is None:
        return None
    level = level_rotation(upright.up_camera.copy())
    ahead, left, _ = level @ T_other_camera.rotation.T[:, 2]
    if np.hypot(ahead, left) < LEAST_SINE:
        return None
    return float(np.angle(np.exp(1j * (upright.heading_rad + np.arctan2(left, ahead)))))
