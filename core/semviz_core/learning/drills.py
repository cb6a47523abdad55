"""What matchers train on: simulated frames with their answers, made on the fly from numbers."""

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.errors import SemvizError
from semviz_core.evaluation.problems import HARD_SETS, Difficulty, Problem, make_problem
from semviz_core.evaluation.roads import Road, kitti_road, simulated_road
from semviz_core.learning.sample import Sample, Truth

HELD_OUT = 1_000_000_000
"""Numbers from here on are never trained on."""
FRAMES_A_WORLD = 20
"""Consecutive numbers share what stands beside a road, and its map: both take long to draw."""
ROADS_AT_A_TIME = 8
"""Worlds take turns on so many roads, so that nothing is learned of one road for long."""
FRAMES_A_SET_OF_ROADS = 20_000
FIRST_ROAD = 10_000
"""Simulated roads below are for tests and benchmarks."""
FIRST_SEED = 10_000_000
"""Seeds below are for tuning and for benchmarks, on KITTI's roads too."""
TRAINING_SEQUENCES = ("00", "01", "02", "03", "04", "05", "06")
HELD_OUT_SEQUENCES = ("08",)
"""Of KITTI; 09 and 10 are for reporting only."""
PAPER_SHIFT_M = 5.0
_MOST_TRIES = 1000
Level = tuple[float, Difficulty]
"""How often, relative to the other levels, and how hard."""


@dataclass(frozen=True)
class KittiFiles:
    """Folders with KITTI's poses and with pole maps."""

    poses: Path
    pole_maps: Path

    def road(self, sequence: str) -> Road:
        poses, pole_map = f"{sequence}.txt", f"kitti_{sequence}.npz"
        return kitti_road(self.poses / poses, self.pole_maps / pole_map, sequence)


@dataclass(frozen=True)
class Drills:
    """Problems and samples by number: the same number is the same one in every process."""

    levels: tuple[Level, ...]
    shift_m: float = 0.0
    """Samples' coordinates begin up to so far beside the fix, as in the paper; 0 for networks that
    are told how far off the fix may be."""
    kitti: KittiFiles | None = None
    """On KITTI's roads; on simulated ones if not given."""

    def problem(self, number: int) -> Problem:
        """A frame with four detections or more, at least one of which is truly in the map.

        ``number`` is below HELD_OUT for training. Raises SemvizError where the road shows no such
        frame.
        """
        rng = np.random.default_rng([number, 0])
        weight = np.array([weight for weight, _ in self.levels])
        _, level = self.levels[rng.choice(len(weight), p=weight / weight.sum())]
        name, seed = self.place(number)
        road = _road(self.kitti, name)
        for _ in range(_MOST_TRIES):
            index = int(rng.integers(len(road)))
            problem = make_problem(seed, level, road, index, look=number)
            if problem.is_valid and len(problem.pairs):
                return problem
        raise SemvizError(
            f"road {road.name}: no frame shows four elements; are poses and poles of one drive?"
        )

    def sample(self, number: int) -> Sample:
        """``problem(number)`` as a matcher sees it, turned and shifted at random."""
        return drilled(self.problem(number), self.shift_m, np.random.default_rng([number, 1]))

    def held_out(self, number: int) -> Sample:
        """Sample ``number`` of those that are never trained on: other roads, other seeds."""
        return self.sample(HELD_OUT + number)

    def place(self, number: int) -> tuple[str, int]:
        """Name of the road, and the seed of what stands beside it and of its map."""
        world = number // FRAMES_A_WORLD
        if self.kitti is None:
            first = FIRST_ROAD + number // FRAMES_A_SET_OF_ROADS * ROADS_AT_A_TIME
            return str(first + world % ROADS_AT_A_TIME), FIRST_SEED + world
        names = TRAINING_SEQUENCES if number < HELD_OUT else HELD_OUT_SEQUENCES
        return names[world % len(names)], FIRST_SEED + world

    def describe(self) -> dict[str, Any]:
        """What the samples are made with, as JSON."""
        roads = "simulated" if self.kitti is None else "KITTI " + ",".join(TRAINING_SEQUENCES)
        levels = [{"weight": weight, **_off_default(level)} for weight, level in self.levels]
        return {"roads": roads, "shift_m": self.shift_m, "levels": levels}


def drilled(problem: Problem, shift_m: float, rng: np.random.Generator) -> Sample:
    """The problem as a matcher sees it, with its answer, in coordinates turned about the vertical
    by any angle and shifted on the ground by up to ``shift_m``: the paper's augmentation
    ("Evaluation of Localization Accuracy")."""
    sample = Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)
    sample = sample.with_truth(problem.T_camera_map, problem.pairs)
    turn = rng.uniform(-np.pi, np.pi)
    length, bearing = shift_m * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    return moved(sample, turn, [length * np.cos(bearing), length * np.sin(bearing)])


def moved(sample: Sample, turn_rad: float, shift_m: ArrayLike) -> Sample:
    """In coordinates x' = Rz(``turn_rad``) x + ``shift_m`` (2,): map, road, heading and truth.

    Nothing changes in the camera's coordinates. The axes are no longer the map's.
    """
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    shift = np.append(np.asarray(shift_m, dtype=np.float64), 0.0)
    prior, slope = sample.prior.copy(), turn[:2, :2] @ sample.road[1:]
    prior[5:7] = turn[:2, :2] @ prior[5:7]
    truth = sample.truth
    if truth is not None:
        rotation = truth.rotation @ turn.T
        truth = Truth(rotation, truth.translation - rotation @ shift, truth.pairs)
    return replace(
        sample,
        point_m=sample.point_m @ turn.T + shift,
        bottom_m=sample.bottom_m @ turn.T + shift,
        road=np.append(sample.road[0] - slope @ shift[:2], slope),
        prior=prior,
        origin_m=sample.origin_m - turn.T @ shift,
        truth=truth,
    )


@lru_cache(maxsize=2 * ROADS_AT_A_TIME)
def _road(kitti: KittiFiles | None, name: str) -> Road:
    return simulated_road(int(name)) if kitti is None else kitti.road(name)


def _off_default(level: Difficulty) -> dict[str, Any]:
    return {
        one.name: value
        for one in fields(Difficulty)
        if (value := getattr(level, one.name)) != one.default
    }


def _with_low_noise_too(levels: tuple[Level, ...]) -> tuple[Level, ...]:
    low = tuple((weight, replace(level, noise="low")) for weight, level in levels)
    paper = tuple((weight, replace(level, noise="paper")) for weight, level in levels)
    return paper + low


def _with_heading_too(levels: tuple[Level, ...]) -> tuple[Level, ...]:
    """A quarter of them with a heading known within 15 deg (7.5 deg is one sigma)."""
    sigma_rad = float(np.deg2rad(7.5))
    known = tuple((weight, replace(one, heading_sigma_rad=sigma_rad)) for weight, one in levels)
    return tuple((3.0 * weight, one) for weight, one in levels) + known


_FAR_OFF = Difficulty(gps_distance_m=(5.0, 50.0), crop_m=90.0)
PAPER_DRILLS = Drills(_with_low_noise_too(((1.0, Difficulty()),)), PAPER_SHIFT_M)
"""The benchmark's normal frames with both noises, half of them each."""
LEARNED_DRILLS = Drills(
    _with_heading_too(
        _with_low_noise_too(
            ((4.0, Difficulty()), (2.0, _FAR_OFF), *((1.0, one) for one in HARD_SETS.values()))
        )
    )
)
"""A quarter of the normal frames, the rest of all kinds that are hard."""
_FAR_IN_CLUTTER = replace(HARD_SETS["GPS 30 m"], clutter_share=1.0)
_ALL_UNLEVEL = replace(HARD_SETS["all together"], with_gravity=False)
PUZZLES = Drills(
    _with_heading_too(
        _with_low_noise_too(
            (
                (1.0, Difficulty()),
                (1.0, _FAR_OFF),
                (1.0, _FAR_IN_CLUTTER),
                (1.0, HARD_SETS["4 elements"]),
                (1.0, HARD_SETS["map 20 % wrong"]),
                (2.0, HARD_SETS["clutter 100 %"]),
                (3.0, HARD_SETS["GPS 30 m"]),
                (2.0, HARD_SETS["GPS 50 m"]),
                (3.0, HARD_SETS["all together"]),
                (2.0, HARD_SETS["no attitude"]),
                (1.0, _ALL_UNLEVEL),
            )
        )
    )
)
"""For the verifier: mostly frames in which several poses explain much of what is seen."""
