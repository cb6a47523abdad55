"""The upright view: what a camera with known gravity sees, as azimuths and slopes.

In the level frame z is up and x is the optical axis laid flat, so the one unknown angle left is the
heading, and an observed element is an azimuth and, where an end is known, a slope (tangent of
elevation).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.compiled import compiled
from semviz_core.frame import Prior
from semviz_core.solving.scene import Known, RecordArray, Scene

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
STEEP = 0.05
"""A camera whose axis is closer to the vertical than this (sine) has no heading of its own."""

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


def assumed_upright(prior: Prior) -> Prior:
    """The prior, with cameras taken to look about level where no IMU says more."""
    if prior.up_camera is not None:
        return prior
    return replace(prior, up_camera=ASSUMED_UP, up_sigma_rad=ASSUMED_UP_SIGMA_RAD)


@compiled
def likely_ups(scene: Scene, known: Known) -> tuple[FloatArray, float]:
    """(k, 3) directions of up in camera coordinates worth trying, best guess first, several where
    gravity stays doubtful; and how far each may be off (rad)."""
    up, covariance = gravity(scene, known)
    mean = 0.5 * (covariance[0, 0] + covariance[1, 1])
    differ = 0.5 * (covariance[0, 0] - covariance[1, 1])
    radius = np.hypot(differ, covariance[0, 1])
    sigma = np.sqrt(np.array([max(mean - radius, 0.0), mean + radius]))  # of the principal axes
    turn = 0.5 * np.arctan2(covariance[0, 1], differ)
    across = known.value.across_up
    major = np.cos(turn) * across[0] + np.sin(turn) * across[1]
    minor = np.cos(turn) * across[1] - np.sin(turn) * across[0]
    ups = np.empty((9, 3))
    ups[0] = up
    count = 1
    for k in range(2):
        if sigma[k] > DOUBTFUL_UP_RAD:
            lean = TRIED_SIGMAS * sigma[k] * (minor if k == 0 else major)
            for row in range(count):
                ups[count + 2 * row] = ups[row] - lean
                ups[count + 2 * row + 1] = ups[row] + lean
            count *= 3
    for row in range(count):
        ups[row] /= np.sqrt((ups[row] ** 2).sum())
    return ups[:count], min(sigma[1], DOUBTFUL_UP_RAD)


@compiled
def gravity(scene: Scene, known: Known) -> tuple[FloatArray, FloatArray]:
    """Unit (3,) up in camera coordinates, and its covariance (2, 2) in rad^2 along ``across_up``.

    The vertical vanishing point of the observed poles, each of whose planes holds it, with the
    prior's up: least squares, reweighted since a false pole may lean anyhow.
    """
    start, across = known.value.up_camera, known.value.across_up
    focal, information = scene.setting.K[0, 0], 1.0 / known.value.up_sigma_rad**2
    tilt, covariance = np.zeros(2), np.zeros((2, 2))
    for _ in range(3):
        a = d = information
        b = gradient0 = gradient1 = 0.0
        for i in range(len(scene.seen)):
            seen = scene.seen[i]
            if not seen.is_line:
                continue
            length = max(np.sqrt(((seen.end_ray - seen.anchor_ray) ** 2).sum()), 1e-4)
            offset = (seen.plane * start).sum()
            j0, j1 = (seen.plane * across[0]).sum(), (seen.plane * across[1]).sum()
            left = offset + j0 * tilt[0] + j1 * tilt[1]
            variance = seen.variance_px2[0] / (focal * length) ** 2 + POLE_LEAN_RAD**2
            weight = 1.0 / (variance + left * left / CAUCHY_SIGMAS**2)
            a, b, d = a + weight * j0 * j0, b + weight * j0 * j1, d + weight * j1 * j1
            gradient0 += weight * j0 * offset
            gradient1 += weight * j1 * offset
        determinant = a * d - b * b
        covariance[0, 0], covariance[1, 1] = d / determinant, a / determinant
        covariance[0, 1] = covariance[1, 0] = -b / determinant
        tilt[0] = -(covariance[0, 0] * gradient0 + covariance[0, 1] * gradient1)
        tilt[1] = -(covariance[1, 0] * gradient0 + covariance[1, 1] * gradient1)
    up = start + tilt[0] * across[0] + tilt[1] * across[1]
    return up / np.sqrt((up**2).sum()), covariance


@compiled
def upright_view(scene: Scene, up: FloatArray, up_sigma_rad: float) -> UprightView:
    """What is seen, by azimuth and slope, where ``up`` (3,) in camera coordinates is up."""
    R = level_rotation(up)
    seen = np.zeros(len(scene.seen), SIGHT)
    for i in range(len(seen)):
        here = scene.seen[i]
        first, last = R @ here.anchor_ray, R @ here.end_ray
        x, y = first[0] + last[0], first[1] + last[1]
        length = max(np.hypot(x, y), 1e-9)
        seen[i].azimuth[0], seen[i].azimuth[1] = x / length, y / length
        seen[i].azimuth_rad = np.arctan2(y, x)
        seen[i].slope[0] = first[2] / max(np.hypot(first[0], first[1]), 1e-9)
        seen[i].slope[1] = last[2] / max(np.hypot(last[0], last[1]), 1e-9)
        seen[i].known[0] = here.known[0]
        seen[i].known[1] = here.known[1] and here.is_line
        seen[i].slope_sigma = np.sqrt(here.variance_px2[1]) / scene.setting.K[0, 0]
    return UprightView(R, up_sigma_rad, seen)


@compiled
def level_rotation(up_camera: FloatArray) -> FloatArray:
    """(3, 3) R_level_camera: z up, x the optical axis laid flat."""
    x = np.array([0.0, 0.0, 1.0]) - up_camera * up_camera[2]
    length = np.sqrt((x**2).sum())
    if length < STEEP:
        x = np.cross(up_camera, np.array([1.0, 0.0, 0.0]))
        length = np.sqrt((x**2).sum())
    R = np.empty((3, 3))
    R[0] = x / length
    R[1] = np.cross(up_camera, R[0])
    R[2] = up_camera
    return R
