"""The drive down a street: where the camera is at each frame."""

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.pose import Pose, so3_exp
from semviz_core.sources.street.layout import StreetOptions
from semviz_core.sources.street.road import LANE_M, Road

CAMERA_HEIGHT_M = 1.65
LATERAL_SIGMA_M = 0.3
HEIGHT_SIGMA_M = 0.03
YAW_SIGMA_RAD = float(np.deg2rad(3.0))
ATTITUDE_SIGMA_RAD = float(np.deg2rad(0.5))
_MEMORY_M = 7.0
"""Over this length a driver's deviations stay alike."""


def drive(road: Road, options: StreetOptions, seed: int) -> list[Pose]:
    """True ``T_map_camera`` of each frame: in the right lane, with the benchmark's deviations."""
    rng = np.random.default_rng([seed, 1])
    s: FloatArray = np.arange(options.frames, dtype=np.float64) * options.spacing_m
    sigmas = (LATERAL_SIGMA_M, HEIGHT_SIGMA_M, ATTITUDE_SIGMA_RAD, YAW_SIGMA_RAD)
    lateral, height, pitch, yaw = (sigma * _wander(rng, options) for sigma in sigmas)
    roll = ATTITUDE_SIGMA_RAD * _wander(rng, options)
    centers = road.at(s, lateral - LANE_M / 2, CAMERA_HEIGHT_M + height)
    headings = road.heading(s)
    grade = np.cos(headings) * road.slope[0] + np.sin(headings) * road.slope[1]
    turns = np.stack([np.arctan(grade) + pitch, yaw, roll], axis=1)
    return [
        Pose(camera_axes(float(heading)) @ so3_exp(turn), center)
        for heading, turn, center in zip(headings, turns, centers, strict=True)
    ]


def camera_axes(heading_rad: float) -> FloatArray:
    """(3, 3) rotation of ``T_map_camera`` for a level camera that looks along a heading."""
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    return np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])


def _wander(rng: np.random.Generator, options: StreetOptions) -> FloatArray:
    """(frames,) smooth noise of standard deviation 1."""
    memory = _MEMORY_M / options.spacing_m
    reach = int(np.ceil(3.0 * memory))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / memory) ** 2)
    kernel /= np.linalg.norm(kernel)
    white = rng.standard_normal(options.frames + 2 * reach)
    return np.convolve(white, kernel, mode="valid")
