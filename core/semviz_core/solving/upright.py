"""The upright view: what a camera with known gravity sees, as azimuths and slopes.

In the level frame z is up and x is the optical axis laid flat, so the one unknown angle left is the
heading, and an observed element is an azimuth and, where an end is known, a slope (tangent of
elevation).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.frame import Prior
from semviz_core.solving.scene import RecordArray, Scene, perpendicular

ASSUMED_UP = np.array([0.0, -1.0, 0.0])
"""Cameras on vehicles look about level: what is known without an IMU."""
ASSUMED_UP_SIGMA_RAD = float(np.deg2rad(4.0))
POLE_LEAN_RAD = float(np.deg2rad(1.0))
"""How far poles lean, one standard deviation: limits gravity taken from them."""
CAUCHY_SIGMAS = 2.0
"""Poles that lean by more count less (Cauchy weights)."""
DOUBTFUL_UP_RAD = float(np.deg2rad(1.5))
"""A camera whose up is less certain about an axis is tried at three angles about it."""
TRIED_SIGMAS = 1.2
"""How far the outer two of the three angles are off."""


SIGHT = np.dtype(
    [
        # cosine and sine of the angle anticlockwise from the optical axis; of a pole, at the middle
        # of what is seen
        ("azimuth", float, (2,)),
        ("azimuth_rad", float),
        ("slope", float, (2,)),  # of anchor and end; only where known
        ("slope_sigma", float),  # of the detection
        ("known", np.uint8, (2,)),
    ],
    align=True,
)
"""An observed element in the level frame."""


class UprightView(NamedTuple):
    """m observed elements in the level frame."""

    R_level_camera: FloatArray
    """(3, 3)"""
    up_sigma_rad: float
    seen: RecordArray
    """(m,) SIGHT"""


def upright_views(scene: Scene, prior: Prior) -> list[UprightView]:
    """The view with gravity from the prior and the poles, best guess first; several where
    gravity stays doubtful."""
    up, covariance = gravity(scene, prior)
    sigma, axes = np.linalg.eigh(covariance)
    sigma, axes = np.sqrt(sigma), axes.T @ perpendicular(up)
    ups = [up]
    for k in np.flatnonzero(sigma > DOUBTFUL_UP_RAD):
        lean = TRIED_SIGMAS * sigma[k] * axes[k]
        ups += [one + way * lean for one in ups for way in (-1.0, 1.0)]
    left = min(float(sigma[-1]), DOUBTFUL_UP_RAD)
    return [_view(scene, one / np.linalg.norm(one), left) for one in ups]


def assumed_upright(prior: Prior) -> Prior:
    """The prior, with cameras taken to look about level where no IMU says more."""
    if prior.up_camera is not None:
        return prior
    return replace(prior, up_camera=ASSUMED_UP, up_sigma_rad=ASSUMED_UP_SIGMA_RAD)


def gravity(scene: Scene, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Unit (3,) up in camera coordinates, and its covariance (2, 2) in rad^2 along the axes that
    ``perpendicular`` gives.

    The vertical vanishing point of the observed poles, each of whose planes holds it, with the
    prior's up: least squares, reweighted since a false pole may lean anyhow.
    """
    start = assumed_upright(prior)
    assert start.up_camera is not None
    poles = scene.seen[scene.seen["is_line"]]
    normal = poles["plane"]
    length = np.linalg.norm(poles["end_ray"] - poles["anchor_ray"], axis=1)
    focal = scene.setting["K"][0, 0]
    variance = poles["variance_px2"][:, 0] / (focal * np.maximum(length, 1e-4)) ** 2
    variance = variance + POLE_LEAN_RAD**2
    across = perpendicular(start.up_camera)
    J, offset, tilt = normal @ across.T, normal @ start.up_camera, np.zeros(2)
    for _ in range(3):
        weight = 1.0 / (variance + (offset + J @ tilt) ** 2 / CAUCHY_SIGMAS**2)
        information = J.T @ (weight[:, None] * J) + np.eye(2) / start.up_sigma_rad**2
        covariance = np.linalg.inv(information)
        tilt = -covariance @ (J.T @ (weight * offset))
    up = start.up_camera + tilt @ across
    return up / np.linalg.norm(up), covariance


def level_rotation(up_camera: FloatArray) -> FloatArray:
    """(3, 3) R_level_camera: z up, x the optical axis laid flat."""
    ahead = np.array([0.0, 0.0, 1.0])
    x = ahead - up_camera * up_camera[2]
    length = float(np.linalg.norm(x))
    if length < 0.05:  # looks straight up or down: any heading will do
        x = np.cross(up_camera, np.array([1.0, 0.0, 0.0]))
        length = float(np.linalg.norm(x))
    x = x / length
    return np.stack([x, np.cross(up_camera, x), up_camera])


def _view(scene: Scene, up: FloatArray, up_sigma_rad: float) -> UprightView:
    R = level_rotation(up)
    first, last = scene.seen["anchor_ray"] @ R.T, scene.seen["end_ray"] @ R.T
    middle = (first + last)[:, :2]
    seen = np.zeros(len(scene.seen), SIGHT)
    seen["azimuth"] = middle / np.maximum(np.hypot(middle[:, :1], middle[:, 1:]), 1e-9)
    seen["azimuth_rad"] = np.arctan2(middle[:, 1], middle[:, 0])
    for end, ray in enumerate((first, last)):
        seen["slope"][:, end] = ray[:, 2] / np.maximum(np.hypot(ray[:, 0], ray[:, 1]), 1e-9)
    seen["known"] = scene.seen["known"]
    seen["known"][:, 1] &= scene.seen["is_line"]
    seen["slope_sigma"] = np.sqrt(scene.seen["variance_px2"][:, 1]) / scene.setting["K"][0, 0]
    return UprightView(R, up_sigma_rad, seen)
