"""The upright view: what a camera with known gravity sees, as azimuths and slopes.

In the level frame z is up and x is the optical axis laid flat, so the one unknown angle left is the
heading, and an observed element is an azimuth and, where an end is known, a slope (tangent of elevation).
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.frame import Prior
from semviz_core.solving.residuals import Scene

ASSUMED_UP = np.array([0.0, -1.0, 0.0])
"""Cameras on vehicles look about level: where to start without an IMU."""
ASSUMED_UP_SIGMA_RAD = float(np.deg2rad(4.0))
POLE_LEAN_RAD = float(np.deg2rad(1.0))
"""How far poles lean, one standard deviation: limits gravity taken from them."""


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


def gravity(scene: Scene, prior: Prior) -> tuple[FloatArray, float]:
    """Unit (3,) up in camera coordinates and its sigma (rad).

    Without an IMU: the vertical vanishing point of the observed poles, each of whose planes holds it,
    least squares from an upright camera.
    """
    if prior.up_camera is not None:
        return prior.up_camera, prior.up_sigma_rad
    line = scene.is_line
    normal = np.cross(_rays(scene, scene.anchor_px[line]), _rays(scene, scene.end_px[line]))
    length = np.linalg.norm(normal, axis=1)
    seen = length > 1e-3
    normal = normal[seen] / length[seen, None]
    lean = np.sqrt(scene.variance_px2[line][seen, 0]) / scene.K[0, 0] / length[seen]
    weight = 1.0 / (lean**2 + POLE_LEAN_RAD**2)
    across = np.eye(3)[[0, 2]]  # perpendicular to the assumed up
    J = normal @ across.T
    offset = normal @ ASSUMED_UP
    for _ in range(3):  # reweighted: a false pole may lean anyhow
        information = J.T @ (weight[:, None] * J) + np.eye(2) / ASSUMED_UP_SIGMA_RAD**2
        tilt = -np.linalg.solve(information, J.T @ (weight * offset))
        error2 = (offset + J @ tilt) ** 2 / (lean**2 + POLE_LEAN_RAD**2)
        weight = 1.0 / (lean**2 + POLE_LEAN_RAD**2) / (1.0 + error2 / 4.0)
    up = ASSUMED_UP + tilt @ across
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
