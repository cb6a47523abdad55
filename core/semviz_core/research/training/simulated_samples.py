"""Simulated training samples, generated on the fly from their numbers.

A number gives the same sample in every process. Samples are rotated about the vertical by any
angle and shifted on the ground, the paper's augmentation.
"""

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.common.errors import SemvizError
from semviz_core.localization.correspondences.candidate_pairs import Sample, SampleTarget
from semviz_core.research.evaluation import problems
from semviz_core.research.evaluation.roads import BenchmarkRoad, kitti_road, simulated_road

HELD_OUT = 1_000_000_000
"""Numbers from here on are never trained on."""
FRAMES_A_WORLD = 20
"""Consecutive numbers that share a road's elements and map, which take long to draw."""
ROADS_AT_A_TIME = 8
"""Number of roads that worlds alternate between, so that training mixes roads."""
FRAMES_A_SET_OF_ROADS = 20_000
FIRST_ROAD = 10_000
"""Smaller numbers of simulated roads are for tests and benchmarks."""
FIRST_SEED = 10_000_000
"""Smaller seeds are for tuning and benchmarks, on KITTI's roads too."""
TRAINING_SEQUENCES = ("00", "01", "02", "03", "04", "05", "06")
HELD_OUT_SEQUENCES = ("08",)
"""Of KITTI; 09 and 10 are for reporting only."""
PAPER_SHIFT_M = 5.0
PAPER_20M_FRAMES = 30_000
"""Ten times as many as the paper has, kept in memory: to make one takes as long as ten to turn."""
_MOST_TRIES = 1000
WeightedDifficulty = tuple[float, problems.Difficulty]
"""Relative frequency, and the difficulty."""


@dataclass(frozen=True)
class KittiFiles:
    """Folders of KITTI's poses and of pole maps."""

    poses: Path
    pole_maps: Path

    def road(self, sequence: str) -> BenchmarkRoad:
        poses, pole_map = f"{sequence}.txt", f"kitti_{sequence}.npz"
        return kitti_road(self.poses / poses, self.pole_maps / pole_map, sequence)


@dataclass(frozen=True)
class SimulatedSamples:
    """Problems and samples by number: a number gives the same one in every process."""

    levels: tuple[WeightedDifficulty, ...]
    shift_m: float = 0.0
    """Largest shift of the local origin from the fix, as in the paper; 0 for networks whose input
    includes the sigma of the fix."""
    kitti: KittiFiles | None = None
    """KITTI's roads (default: simulated ones)."""
    frames: int | None = None
    """Number of distinct frames; further samples turn and shift these anew (None: no limit)."""

    def problem(self, number: int) -> problems.LocalizationProblem:
        """Return a frame with at least four detections, at least one of them in the map.

        ``number`` is below HELD_OUT for training. Raise SemvizError if the road has no such frame.
        """
        rng = np.random.default_rng([number, 0])
        weight = np.array([weight for weight, _ in self.levels])
        _, level = self.levels[rng.choice(len(weight), p=weight / weight.sum())]
        name, seed = self.place(number)
        road = _road(self.kitti, name)
        for _ in range(_MOST_TRIES):
            index = int(rng.integers(len(road)))
            if not problems.may_be_valid(road, seed, index, level):
                continue
            problem = problems.make_problem(seed, level, road, index, variant=number)
            if problem.is_valid and len(problem.pairs):
                return problem
        raise SemvizError(
            f"road {road.name}: no frame shows four elements; are poses and poles of one drive?"
        )

    def sample(self, number: int) -> Sample:
        """Return ``problem(number)`` as a sample, turned and shifted at random."""
        rng = np.random.default_rng([number, 1])
        if self.frames is None or number >= HELD_OUT:
            return make_sample(self.problem(number), self.shift_m, rng)
        return augmented(_kept_sample(self, number % self.frames), self.shift_m, rng)

    def held_out(self, number: int) -> Sample:
        """Return validation sample ``number``, on other roads and seeds."""
        return self.sample(HELD_OUT + number)

    def place(self, number: int) -> tuple[str, int]:
        """Return the name of the road, and the seed of its elements and map."""
        world = number // FRAMES_A_WORLD
        if self.kitti is None:
            first = FIRST_ROAD + number // FRAMES_A_SET_OF_ROADS * ROADS_AT_A_TIME
            return str(first + world % ROADS_AT_A_TIME), FIRST_SEED + world
        names = TRAINING_SEQUENCES if number < HELD_OUT else HELD_OUT_SEQUENCES
        return names[world % len(names)], FIRST_SEED + world

    def describe(self) -> dict[str, Any]:
        """Return the settings of the samples as JSON."""
        roads = "simulated" if self.kitti is None else "KITTI " + ",".join(TRAINING_SEQUENCES)
        levels = [{"weight": weight, **_off_default(level)} for weight, level in self.levels]
        limit = {} if self.frames is None else {"frames": self.frames}
        return {"roads": roads, "shift_m": self.shift_m, "levels": levels, **limit}


@lru_cache(maxsize=PAPER_20M_FRAMES)
def _kept_sample(samples: SimulatedSamples, number: int) -> Sample:
    return sample_of(samples.problem(number))


def make_sample(
    problem: problems.LocalizationProblem, shift_m: float, rng: np.random.Generator
) -> Sample:
    """Return ``problem`` as an ``augmented`` sample with ground truth."""
    return augmented(sample_of(problem), shift_m, rng)


def sample_of(problem: problems.LocalizationProblem) -> Sample:
    """Return ``problem`` as a sample with ground truth, as it is."""
    sample = Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)
    return sample.with_truth(problem.T_camera_map, problem.pairs)


def augmented(sample: Sample, shift_m: float, rng: np.random.Generator) -> Sample:
    """Return a sample augmented as in the paper ("Evaluation of Localization Accuracy"): turned
    about the vertical by any angle, and shifted on the ground by up to ``shift_m``."""
    turn = rng.uniform(-np.pi, np.pi)
    length, bearing = shift_m * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    return transform_sample(sample, turn, [length * np.cos(bearing), length * np.sin(bearing)])


def transform_sample(sample: Sample, turn_rad: float, shift_m: ArrayLike) -> Sample:
    """Transform map, road, heading and truth by x' = Rz(``turn_rad``) x + ``shift_m`` (2,).

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
        truth = SampleTarget(rotation, truth.translation - rotation @ shift, truth.pairs)
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
def _road(kitti: KittiFiles | None, name: str) -> BenchmarkRoad:
    return simulated_road(int(name)) if kitti is None else kitti.road(name)


def _off_default(level: problems.Difficulty) -> dict[str, Any]:
    return {
        field.name: value
        for field in fields(problems.Difficulty)
        if (value := getattr(level, field.name)) != field.default
    }


def _add_low_noise(levels: tuple[WeightedDifficulty, ...]) -> tuple[WeightedDifficulty, ...]:
    low = tuple((weight, replace(level, noise="low")) for weight, level in levels)
    paper = tuple((weight, replace(level, noise="paper")) for weight, level in levels)
    return paper + low


def _add_heading(levels: tuple[WeightedDifficulty, ...]) -> tuple[WeightedDifficulty, ...]:
    """Give a quarter of the samples a heading within 15 deg (7.5 deg is one sigma)."""
    sigma_rad = float(np.deg2rad(7.5))
    known = tuple((weight, replace(level, heading_sigma_rad=sigma_rad)) for weight, level in levels)
    return tuple((3.0 * weight, level) for weight, level in levels) + known


_FAR_OFF = problems.Difficulty(gps_distance_m=(5.0, 50.0), crop_m=90.0)
PAPER_DISTRIBUTION = SimulatedSamples(
    _add_low_noise(((1.0, problems.Difficulty()),)), PAPER_SHIFT_M
)
"""The benchmark's normal frames, half of them with each noise."""
PAPER_20M_DISTRIBUTION = SimulatedSamples(
    _add_low_noise(((1.0, problems.PAPER_20M),)), frames=PAPER_20M_FRAMES
)
"""Frames of the paper's own protocol, whose fix is as far off as the paper shifts its maps."""
LEARNED_DISTRIBUTION = SimulatedSamples(
    _add_heading(
        _add_low_noise(
            (
                (4.0, problems.Difficulty()),
                (2.0, _FAR_OFF),
                *((1.0, level) for level in problems.HARD_SETS.values()),
            )
        )
    )
)
"""A quarter normal frames, the rest of all hard kinds."""
_FAR_IN_CLUTTER = replace(problems.HARD_SETS["GPS 30 m"], clutter_share=1.0)
_ALL_UNLEVEL = replace(problems.HARD_SETS["all together"], with_gravity=False)
HARD_DISTRIBUTION = SimulatedSamples(
    _add_heading(
        _add_low_noise(
            (
                (1.0, problems.Difficulty()),
                (1.0, _FAR_OFF),
                (1.0, _FAR_IN_CLUTTER),
                (1.0, problems.HARD_SETS["4 elements"]),
                (1.0, problems.HARD_SETS["map 20 % wrong"]),
                (2.0, problems.HARD_SETS["clutter 100 %"]),
                (3.0, problems.HARD_SETS["GPS 30 m"]),
                (2.0, problems.HARD_SETS["GPS 50 m"]),
                (3.0, problems.HARD_SETS["all together"]),
                (2.0, problems.HARD_SETS["no attitude"]),
                (1.0, _ALL_UNLEVEL),
            )
        )
    )
)
"""For the verifier: mostly frames in which several poses explain much of the image."""
