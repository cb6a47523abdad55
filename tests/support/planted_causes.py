"""Frames whose prior, stated sigma or map is wrong as a whole, to see whether that is named.

Each frame is healthy until the fault is planted. The priors and the sigma claim to be as accurate
as ever; the map is shifted as a whole, against the true poses.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from semviz_core.base.pose import heading_rad, so3_exp
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.research.evaluation.problems import Difficulty, make_problem, mapped_elements
from semviz_core.research.evaluation.roads import BenchmarkRoad
from support.planted_faults import WHOLE, Given, Planted, aside, localized_with, shifted_map

HEADING_SIGMA_RAD = float(np.deg2rad(3.0))
SIGMA_FACTOR = 4.0
SHOWS_SIGMA = 7
"""Elements that show how large the errors are; fewer may be off by chance."""
LEVELS: dict[FaultKind, Difficulty] = {
    "wrong heading prior": replace(WHOLE, heading_sigma_rad=HEADING_SIGMA_RAD),
    "wrong detection sigma": replace(WHOLE, sigma_px=SIGMA_FACTOR, map_view_sigma_m=0.05),
}
"""The problems in which a fault is planted, if they are not ``WHOLE``."""


def plant_cause(fault: FaultKind, seed: int, road: BenchmarkRoad) -> Planted | None:
    """A frame with the fault; None if it is not healthy without it."""
    level = LEVELS.get(fault, WHOLE)
    level = replace(level, false_detections=0.0)
    problem = make_problem(seed, level, road)
    given = Given.of(problem, mapped_elements(road, seed, level))
    if fault == "wrong detection sigma" and len(given.true_rows) < SHOWS_SIGMA:
        return None
    if not problem.is_valid or not localized_with("healthy", given).is_healthy:
        return None
    changed = CAUSES[fault](given, np.random.default_rng([seed, 10]))
    return localized_with(fault, changed)


def _heading(given: Given, rng: np.random.Generator) -> Given:
    """A compass 15 to 30 deg off that states 3."""
    return with_heading(given, _signed(rng, np.deg2rad(15.0), np.deg2rad(30.0)))


def with_heading(given: Given, off_rad: float) -> Given:
    """With a heading prior that is off."""
    heading = heading_rad(given.T_camera_map.inverse()) + off_rad
    wrapped = float(np.arctan2(np.sin(heading), np.cos(heading)))
    prior = replace(given.prior, heading_rad=wrapped, heading_sigma_rad=HEADING_SIGMA_RAD)
    return replace(given, prior=prior)


def with_noise(given: Given, factor: float, rng: np.random.Generator) -> Given:
    """With detections whose error is larger than they state, by ``factor`` in all."""
    observed = given.observed
    more = np.sqrt(factor**2 - 1.0) * observed.sigma_px[:, :1]
    anchor_px = observed.anchor_px + more * rng.standard_normal(observed.anchor_px.shape)
    end_px = observed.end_px + more * rng.standard_normal(observed.end_px.shape)
    return replace(given, observed=replace(observed, anchor_px=anchor_px, end_px=end_px))


def _gravity(given: Given, rng: np.random.Generator) -> Given:
    """An inertial unit rolled by 3 to 6 deg that states half a degree."""
    roll = np.array([0.0, 0.0, _signed(rng, np.deg2rad(3.0), np.deg2rad(6.0))])
    up = so3_exp(roll) @ given.T_camera_map.rotation[:, 2]
    return replace(given, prior=replace(given.prior, up_camera=up))


def _height(given: Given, rng: np.random.Generator) -> Given:
    """A road 1 to 3 m above or below the true one."""
    up_m = np.array([0.0, 0.0, _signed(rng, 1.0, 3.0)])
    prior = given.prior
    road_m = None if prior.road_m is None else prior.road_m + up_m
    return replace(given, prior=replace(prior, position_m=prior.position_m + up_m, road_m=road_m))


def _position(given: Given, rng: np.random.Generator) -> Given:
    """A fix 30 to 90 m off that states 5.5."""
    position_m = given.T_camera_map.inverse().translation + aside(rng, 30.0, 90.0)
    return replace(given, prior=replace(given.prior, position_m=position_m))


def _sigma(given: Given, rng: np.random.Generator) -> Given:
    """Detections with an error of 4 px that state 1 px."""
    sigma_px = given.observed.sigma_px / SIGMA_FACTOR
    return replace(given, observed=replace(given.observed, sigma_px=sigma_px))


def _shift(given: Given, rng: np.random.Generator) -> Given:
    """A map 1 to 3 m further along the road than the true poses."""
    ahead = given.T_camera_map.rotation[2] * [1.0, 1.0, 0.0]
    by_m = _signed(rng, 1.0, 3.0) * ahead / np.linalg.norm(ahead)
    return replace(given, elements=shifted_map(given.elements, by_m))


CAUSES: dict[FaultKind, Callable[[Given, np.random.Generator], Given]] = {
    "wrong heading prior": _heading,
    "wrong gravity prior": _gravity,
    "wrong height prior": _height,
    "wrong position prior": _position,
    "wrong detection sigma": _sigma,
    "misaligned map": _shift,
}


def _distorted(given: Given, rng: np.random.Generator) -> Given:
    """A lens whose distortion nobody removed: 10 to 25 % at 45 deg beside the axis."""
    share = _signed(rng, 0.1, 0.25)
    return _with_pixels(given, lambda x: x * (1.0 + share * (x**2).sum(axis=1, keepdims=True)))


def _rolling(given: Given, rng: np.random.Generator) -> Given:
    """A rolling shutter in a curve: lower rows are later."""
    shear = np.array([[1.0, _signed(rng, 0.1, 0.3)], [0.0, 1.0]])
    return _with_pixels(given, lambda x: x @ shear.T)


def _mirrored(given: Given, rng: np.random.Generator) -> Given:
    return _with_pixels(given, lambda x: x * [-1.0, 1.0])


def _resized(given: Given, rng: np.random.Generator) -> Given:
    """An image that is smaller or larger than the calibration states."""
    factor = 1.0 + _signed(rng, 0.1, 0.25)
    return _with_pixels(given, lambda x: factor * x)


def _with_pixels(given: Given, moved: Callable[[np.ndarray], np.ndarray]) -> Given:
    """With points moved in the image plane at unit distance (n, 2)."""
    K, observed = given.camera.K, given.observed
    anchor_px, end_px = (
        moved((points - K[:2, 2]) / K[0, 0]) * K[0, 0] + K[:2, 2]
        for points in (observed.anchor_px, observed.end_px)
    )
    return replace(given, observed=replace(observed, anchor_px=anchor_px, end_px=end_px))


UNKNOWN: dict[str, Callable[[Given, np.random.Generator], Given]] = {
    "lens distortion": _distorted,
    "rolling shutter": _rolling,
    "mirrored image": _mirrored,
    "resized image": _resized,
}
"""Faults for which the diagnosis has no kind: "unexplained" is right if the frame fails."""


def plant_unknown(name: str, seed: int, road: BenchmarkRoad) -> Planted | None:
    """A frame that fails by a fault of no kind; None if it is not healthy without, or is with."""
    level = replace(WHOLE, false_detections=0.0)
    problem = make_problem(seed, level, road)
    given = Given.of(problem, mapped_elements(road, seed, level))
    if not problem.is_valid or not localized_with("healthy", given).is_healthy:
        return None
    changed = UNKNOWN[name](given, np.random.default_rng([seed, 11]))
    planted = localized_with("unexplained", changed)
    return None if planted.is_healthy else planted


def _signed(rng: np.random.Generator, least: float, most: float) -> float:
    return float(rng.uniform(least, most) * rng.choice([-1.0, 1.0]))
