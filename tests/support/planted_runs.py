"""Short drives with one fault planted in the map or in the camera, to see whether it is named.

Frames a few metres apart share a world and its map. The element that is moved, missing or mapped
twice is the one most frames see, four or more.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Odometry, OdometryNoise
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, angle_between
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis.fault import FaultKind, GroundTruth
from semviz_core.research.evaluation.problems import make_problem, mapped_elements
from semviz_core.research.evaluation.roads import BenchmarkRoad
from support.planted_causes import SIGMA_FACTOR, with_heading, with_noise
from support.planted_faults import WHOLE, Given, aside, copied, shifted, shifted_map

FRAMES = 10
STEP = 3
"""Poses of the road from frame to frame: metres."""
LEAST_SEEN = 4
ODOMETRY_FAULTS = ((0, 0.03, 0.1), (1, float(np.deg2rad(0.3)), float(np.deg2rad(1.0))))
"""Length 3 to 10 % off, or yaw 0.3 to 1 deg at each step."""
OF_POSES: tuple[FaultKind, ...] = ("misaligned map", "wrong extrinsic", "time offset")


@dataclass(frozen=True, eq=False)
class PlantedRun:
    """One run, and what is wrong with it."""

    fault: FaultKind
    frames: tuple[tuple[Localization, GroundTruth], ...]
    semantic_map: SemanticMap
    elements: tuple[int, ...] = ()
    """Ids of which one must be named with the fault; empty where it has none."""
    odometry: tuple[Odometry | None, ...] = ()
    """The motion of each frame from the one before."""


def plant_in_run(
    fault: FaultKind,
    seed: int,
    road: BenchmarkRoad,
    count: int = FRAMES,
    fix_sigma_m: float | None = None,
) -> PlantedRun | None:
    """A run of ``count`` frames with the fault; None where no element is seen often enough.

    With ``fix_sigma_m``, position priors are the stated poses with that error, as an inertial
    system has them: what is wrong with the poses is wrong with the priors.
    """
    rng = np.random.default_rng([seed, 9])
    first = _start(road, count, rng, turning=fault in OF_POSES)
    elements = mapped_elements(road, seed, WHOLE)
    frames = [
        Given.of(make_problem(seed, WHOLE, road, first + k * STEP, driving=True), elements)
        for k in range(count)
    ]
    ids, times = np.unique(np.concatenate([frame.ids for frame in frames]), return_counts=True)
    if not len(ids) or times.max() < LEAST_SEEN:
        return None
    element = int(ids[np.argmax(times)])
    named: tuple[int, ...] = ()
    odometry = odometry_of(frames, seed, ODOMETRY_FAULTS if fault == "wrong odometry" else ())
    if fault in _WHOLE:
        frames = _WHOLE[fault](frames, rng)
    elif fault in _FAULTS:
        changed, *named_ids = _FAULTS[fault](elements, element, rng)
        frames, named = [replace(frame, elements=changed) for frame in frames], tuple(named_ids)
    if fix_sigma_m is not None:
        frames = [_with_fix(frame, fix_sigma_m, rng) for frame in frames]
    return replace(_localized(fault, frames, named), odometry=tuple(odometry))


def _with_fix(given: Given, sigma_m: float, rng: np.random.Generator) -> Given:
    off_m = np.append(sigma_m * rng.standard_normal(2), 0.0)
    position_m = given.T_camera_map.inverse().translation + off_m
    prior = replace(given.prior, position_m=position_m, horizontal_sigma_m=sigma_m)
    return replace(given, prior=prior)


def odometry_of(
    frames: list[Given], seed: int, faults: Sequence[tuple[int, float, float]]
) -> list[Odometry | None]:
    """Odometry with 1 % and 0.1 deg noise, as it states, and one of ``faults``."""
    rng, noise, off = np.random.default_rng([seed, 12]), OdometryNoise(), np.zeros(2)
    if faults:
        kind, least, most = faults[int(rng.integers(len(faults)))]
        off[kind] = rng.uniform(least, most) * rng.choice([-1.0, 1.0])
    steps: list[Odometry | None] = [None]
    for before, now in pairwise(frame.T_camera_map for frame in frames):
        step = noise.measure(now @ before.inverse(), rng)
        moved = step.T_now_before
        turn = Pose.from_rotvec(np.array([0.0, off[1], 0.0]), np.zeros(3))
        longer = Pose(moved.rotation, (1.0 + off[0]) * moved.translation)
        steps.append(Odometry(turn @ longer, step.covariance))
    return steps


def _start(road: BenchmarkRoad, count: int, rng: np.random.Generator, turning: bool) -> int:
    """A place on the road; of twenty, that with the largest turn, since straight ahead at one speed
    a late pose, a shifted map and a camera mounted further back are the same."""
    last = len(road) - count * STEP
    if not turning:
        return int(rng.integers(last))
    poses, starts = road.T_map_camera, rng.integers(last, size=20)
    turns = [
        angle_between(poses[s].rotation, poses[s + (count - 1) * STEP].rotation) for s in starts
    ]
    return int(starts[int(np.argmax(turns))])


def _localized(fault: FaultKind, frames: list[Given], elements: tuple[int, ...] = ()) -> PlantedRun:
    found = tuple(
        (frame.localized(), GroundTruth(frame.T_camera_map, frame.ids)) for frame in frames
    )
    return PlantedRun(fault, found, frames[0].semantic_map, elements)


def _moved(elements: Elements3D, element: int, rng: np.random.Generator) -> tuple[Elements3D, int]:
    return shifted(elements, element, aside(rng, 1.0, 8.0)), element


def _missing(
    elements: Elements3D, element: int, rng: np.random.Generator
) -> tuple[Elements3D, int]:
    return elements[elements.id != element], element


def _twice(elements: Elements3D, element: int, rng: np.random.Generator) -> tuple[Elements3D, int]:
    return copied(elements, element, aside(rng, 0.2, 0.8))


_FAULTS: dict[
    FaultKind, Callable[[Elements3D, int, np.random.Generator], tuple[Elements3D, int]]
] = {
    "moved in the map": _moved,
    "missing in the map": _missing,
    "twice in the map": _twice,
}


def _other_camera(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    """A focal length 2 to 5 % off, a principal point 6 to 20 px, or a mounting rolled by 1 to 3
    deg, the same in all frames."""
    pattern, sign = int(rng.integers(3)), float(rng.choice([-1.0, 1.0]))
    if pattern == 2:
        roll = np.array([0.0, 0.0, sign * np.deg2rad(rng.uniform(1.0, 3.0))])
        return [_rolled(frame, Pose.from_rotvec(roll, np.zeros(3))) for frame in frames]
    K = frames[0].camera.K.copy()
    if pattern == 0:
        K[[0, 1], [0, 1]] *= 1.0 + sign * rng.uniform(0.02, 0.05)
    else:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        K[:2, 2] += rng.uniform(6.0, 20.0) * np.array([np.cos(angle), np.sin(angle)])
    return [replace(frame, camera=replace(frame.camera, K=K)) for frame in frames]


def _rolled(given: Given, T_stated_camera: Pose) -> Given:
    """As a camera that is said to be mounted otherwise: pose and gravity are told for that one."""
    up = given.prior.up_camera
    prior = replace(given.prior, up_camera=None if up is None else T_stated_camera.rotation @ up)
    return replace(given, T_camera_map=T_stated_camera @ given.T_camera_map, prior=prior)


def _shifted(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    """A map 0.5 to 2 m beside its poses, in any direction."""
    by_m = aside(rng, 0.5, 2.0)
    return [replace(frame, elements=shifted_map(frame.elements, by_m)) for frame in frames]


def _mounted_elsewhere(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    """A camera 0.4 to 1 m to the side of where its extrinsic says, which the truth follows."""
    off_m = float(rng.uniform(0.4, 1.0) * rng.choice([-1.0, 1.0]))
    mount = Pose(np.eye(3), np.array([off_m, 0.0, 0.0]))
    return [replace(frame, T_camera_map=mount @ frame.T_camera_map) for frame in frames]


def _late(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    """Poses one frame late."""
    poses = [frame.T_camera_map for frame in frames]
    late = [poses[0], *poses[:-1]]
    return [replace(frame, T_camera_map=pose) for frame, pose in zip(frames, late, strict=True)]


def _turned_compass(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    """A compass 15 to 30 deg off that states 3."""
    off = float(rng.uniform(np.deg2rad(15.0), np.deg2rad(30.0)) * rng.choice([-1.0, 1.0]))
    return [with_heading(frame, off) for frame in frames]


def _too_sure(frames: list[Given], rng: np.random.Generator) -> list[Given]:
    return [with_noise(frame, SIGMA_FACTOR, rng) for frame in frames]


_WHOLE: dict[FaultKind, Callable[[list[Given], np.random.Generator], list[Given]]] = {
    "wrong calibration": _other_camera,
    "misaligned map": _shifted,
    "wrong extrinsic": _mounted_elsewhere,
    "time offset": _late,
    "wrong heading prior": _turned_compass,
    "wrong detection sigma": _too_sure,
}
