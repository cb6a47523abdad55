"""The upright view: what a camera with known gravity sees, as azimuths and slopes.

In the level frame z is up and x is the optical axis laid flat, so the one unknown angle left is the
heading, and an observed element is an azimuth and, where an end is known, a slope (tangent of
elevation).
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.frame import Prior
from semviz_core.solving.residuals import Scene, perpendicular

ASSUMED_UP = np.array([0.0, -1.0, 0.0])
"""Cameras on vehicles look about level: what is known without an IMU."""
ASSUMED_UP_SIGMA_RAD = float(np.deg2rad(4.0))
POLE_LEAN_RAD = float(np.deg2rad(1.0))
"""How far poles lean, one standard deviation: limits gravity taken from them."""
CAUCHY_SIGMAS = 2.0
"""Poles that lean by more count less (Cauchy weights)."""


@dataclass(frozen=True, eq=False)
class UprightView:
    """m observed elements in the level frame."""

    R_level_camera: FloatArray
    """(3, 3)"""
    up_sigma_rad: float
    azimuth_rad: FloatArray
    """(m,) anticlockwise from the optical axis; of a pole, at the middle of what is seen."""
    slope: FloatArray
    """(m, 2) of anchor and end; only where known."""
    slope_known: BoolArray
    """(m, 2)"""
    sigma_rad: FloatArray
    """(m, 2) of the detection: azimuth, slope."""


def upright_view(scene: Scene, prior: Prior) -> UprightView:
    """The view with gravity from the prior, or from the poles where it has none."""
    up, sigma = gravity(scene, prior)
    R = level_rotation(up)
    first, last = _rays(scene, scene.anchor_px) @ R.T, _rays(scene, scene.end_px) @ R.T
    middle = first + last
    flat = np.stack([np.hypot(ray[:, 0], ray[:, 1]) for ray in (first, last)], axis=1)
    height = np.stack([first[:, 2], last[:, 2]], axis=1)
    known = scene.seen_known & np.stack([np.ones_like(scene.is_line), scene.is_line], axis=1)
    return UprightView(
        R_level_camera=R,
        up_sigma_rad=sigma,
        azimuth_rad=np.arctan2(middle[:, 1], middle[:, 0]),
        slope=height / np.maximum(flat, 1e-9),
        slope_known=known,
        sigma_rad=np.sqrt(scene.variance_px2) / scene.K[0, 0],
    )


def assumed_upright(prior: Prior) -> Prior:
    """The prior, with cameras taken to look about level where no IMU says more."""
    if prior.up_camera is not None:
        return prior
    return replace(prior, up_camera=ASSUMED_UP, up_sigma_rad=ASSUMED_UP_SIGMA_RAD)


def gravity(scene: Scene, prior: Prior) -> tuple[FloatArray, float]:
    """Unit (3,) up in camera coordinates and its sigma (rad).

    The vertical vanishing point of the observed poles, each of whose planes holds it, with the
    prior's up: least squares, reweighted since a false pole may lean anyhow.
    """
    start = assumed_upright(prior)
    assert start.up_camera is not None
    line = scene.is_line
    normal = np.cross(_rays(scene, scene.anchor_px[line]), _rays(scene, scene.end_px[line]))
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-4)
    normal = normal / length[:, None]
    variance = scene.variance_px2[line, 0] / (scene.K[0, 0] * length) ** 2 + POLE_LEAN_RAD**2
    across = perpendicular(start.up_camera)
    J, offset, tilt = normal @ across.T, normal @ start.up_camera, np.zeros(2)
    for _ in range(3):
        weight = 1.0 / (variance + (offset + J @ tilt) ** 2 / CAUCHY_SIGMAS**2)
        information = J.T @ (weight[:, None] * J) + np.eye(2) / start.up_sigma_rad**2
        tilt = -np.linalg.solve(information, J.T @ (weight * offset))
    up = start.up_camera + tilt @ across
    sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information))[-1]))
    return up / np.linalg.norm(up), sigma


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


def _rays(scene: Scene, pixels_px: FloatArray) -> FloatArray:
    ones = np.ones((len(pixels_px), 1))
    ray = np.concatenate([pixels_px, ones], axis=1) @ np.linalg.inv(scene.K).T
    unit: FloatArray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return unit
