"""The suites: kinds of problems under their names, and the roads that they are set on."""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from semviz.benchmark import paper_table
from semviz.benchmark.methods import Kind
from semviz_core.errors import SemvizError
from semviz_core.evaluation.drives import Blackout, Drive, make_drive
from semviz_core.evaluation.matched_problems import MatchedProblem, make_matched_problem
from semviz_core.evaluation.problems import HARD_SETS, Difficulty, Problem, make_problem
from semviz_core.evaluation.roads import Road, kitti_road, simulated_road

DRIVE_FRAMES = 200
BLACKOUT = Blackout(start_s=10.0, length_s=3.0)
"""In each drive, halfway."""
FRAMES_A_ROAD = 100
"""Frames on one simulated road; so tuning and reporting seeds share no road."""


Noise = Literal["paper", "low"]


@dataclass(frozen=True)
class Roads:
    """Where frames are: KITTI's roads if its folders are given, else simulated ones."""

    poses: Path | None = None
    pole_maps: Path | None = None
    sequences: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.poses is None) != (self.pole_maps is None):
            raise SemvizError("--kitti-poses and --pole-maps: give both, or neither")

    def of_frame(self, seed: int) -> Road:
        if self.poses is None:
            return _simulated(seed // FRAMES_A_ROAD)
        return _kitti(*self._files(self.sequences[seed % len(self.sequences)]))

    def digest(self) -> str:
        """Tells roads apart: by name, and KITTI's by what the files hold."""
        if self.poses is None:
            return "simulated"
        content = hashlib.sha256()
        for sequence in self.sequences:
            for path in self._files(sequence):
                content.update(_content(path))
        return f"kitti {','.join(self.sequences)} {content.hexdigest()[:12]}"

    def _files(self, sequence: str) -> tuple[Path, Path]:
        assert self.poses is not None
        assert self.pole_maps is not None
        return self.poses / f"{sequence}.txt", self.pole_maps / f"kitti_{sequence}.npz"


@dataclass(frozen=True)
class Suite:
    """A kind of problem."""

    name: str
    kind: Kind
    difficulty: Difficulty = Difficulty()  # noqa: RUF009  frozen

    def drive(self, seeds: range, noise: Noise, roads: Roads) -> Drive:
        """As many consecutive frames as ``seeds``, from a place that the first seed draws."""
        road = roads.of_frame(seeds[0])
        most = max(len(road) - DRIVE_FRAMES, 0)
        start = int(np.random.default_rng(seeds[0]).integers(most + 1))
        difficulty = replace(self.difficulty, noise=noise)
        problems = [
            make_problem(seeds[0], difficulty, road, index, driving=True)
            for index in range(start, start + len(seeds))
        ]
        return make_drive(problems, seeds[0], blackout=BLACKOUT)

    def problem(self, seed: int, noise: Noise, roads: Roads) -> Problem | MatchedProblem:
        """The problem of ``seed``, of a single frame; its type is as ``kind`` says."""
        difficulty = replace(self.difficulty, noise=noise)
        make = make_problem if self.kind == "single" else make_matched_problem
        return make(seed, difficulty=difficulty, road=roads.of_frame(seed))

    @property
    def has_bound(self) -> bool:
        """Whether noise is as stated; what is stated wrongly bounds nothing."""
        stated = self.difficulty.stated_sigma_px, self.difficulty.stated_gps_sigma_m
        return self.kind != "sequence" and stated == (None, None)


SUITES: dict[str, Suite] = {
    one.name: one
    for one in (
        Suite("frames", "single"),
        Suite(paper_table.SUITE, "single"),
        *(Suite(name, "single", difficulty) for name, difficulty in HARD_SETS.items()),
        Suite("matched", "matched"),
        Suite("sequence", "sequence"),
    )
}
GROUPS = {
    "hard": tuple(HARD_SETS),
    "all": tuple(name for name in SUITES if name != paper_table.SUITE),
}
"""``paper`` has the same problems as ``frames``."""


def choose_suites(text: str) -> tuple[Suite, ...]:
    """The suites of ``--suite a,b``, in the order of SUITES."""
    wanted = [name.strip() for name in text.split(",")]
    if unknown := [name for name in wanted if name not in SUITES and name not in GROUPS]:
        known = ", ".join([*SUITES, *GROUPS])
        raise SemvizError(f"--suite: no suite {', '.join(unknown)}; known: {known}")
    names = {part for name in wanted for part in GROUPS.get(name, (name,))}
    return tuple(suite for name, suite in SUITES.items() if name in names)


@lru_cache(maxsize=2)
def _simulated(seed: int) -> Road:
    return simulated_road(seed)


@lru_cache(maxsize=16)
def _kitti(poses: Path, pole_map: Path) -> Road:
    return kitti_road(poses, pole_map, poses.stem)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SemvizError(f"{path}: {error.strerror}; is it KITTI's folder?") from None
