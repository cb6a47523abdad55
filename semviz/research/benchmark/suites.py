"""The suites of problems, their roads, and the methods that can run here.

Roads are KITTI's if its folders are given, else simulated. A method that cannot run is listed
with its reason.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from semviz_core.base.weights import shipped_weights
from semviz_core.common.errors import SemvizError
from semviz_core.localization.localizer import EFFORTS
from semviz_core.research.evaluation import baselines, methods, problems, sequences
from semviz_core.research.evaluation.methods import MatchedProblem, make_matched_problem
from semviz_core.research.evaluation.roads import BenchmarkRoad, kitti_road, simulated_road
from semviz_core.research.evaluation.street_frames import street_problem
from semviz_core.research.paper import true_costs
from semviz_core.research.paper.matcher import MODELS
from semviz_core.research.point_matching import methods as point_methods
from semviz_core.research.point_matching import pixel_methods
from semviz_core.research.point_matching.methods import POINT_MODELS, load_point_method

Kind = Literal["single", "matched", "sequence"]
"""Kinds of problems: single frames, single frames whose matches are given, and sequences."""
_SINGLE = {
    **methods.METHODS,
    **point_methods.METHODS,
    **baselines.METHODS,
    **true_costs.METHODS,
    **pixel_methods.METHODS,
}
_FIRST = [name for name in (*EFFORTS, *MODELS, *POINT_MODELS) if name in _SINGLE]
KNOWN: dict[Kind, Mapping[str, Callable[[], Any]]] = {
    "single": {name: _SINGLE[name] for name in dict.fromkeys((*_FIRST, *_SINGLE))},
    "matched": {**methods.MATCHED_METHODS, **baselines.MATCHED_METHODS},
    "sequence": sequences.SEQUENCE_METHODS,
}
"""In the order of tables: our own methods, the paper's, references, other libraries'."""


@dataclass(frozen=True)
class Chosen:
    """Methods by kind of problem, and the reasons of those left out."""

    by_kind: dict[Kind, tuple[str, ...]]
    left_out: dict[str, str]

    def notes(self) -> list[str]:
        return [f"{name} is left out: {reason}" for name, reason in self.left_out.items()]


def choose_methods(text: str | None, suites: Sequence["Suite"]) -> Chosen:
    """Return the methods of ``--methods a,b`` (None: all) for problems of ``suites``."""
    known = {kind: named for kind, named in KNOWN.items() if any(kind == s.kind for s in suites)}
    names = dict.fromkeys(name for named in known.values() for name in named)
    wanted = list(names) if text is None else [name.strip() for name in text.split(",")]
    if unknown := [name for name in wanted if name not in names]:
        raise SemvizError(
            f"--methods: no method {', '.join(unknown)} for these suites; known: {', '.join(names)}"
        )
    left_out: dict[str, str] = {}
    by_kind: dict[Kind, tuple[str, ...]] = {}
    for kind, named in known.items():
        selected = [name for name in dict.fromkeys(wanted) if name in named]
        of_kind = [suite for suite in suites if suite.kind == kind]
        left_out |= {name: reason for name in selected if (reason := _obstacle(of_kind, name))}
        by_kind[kind] = tuple(name for name in selected if name not in left_out)
    chosen = Chosen(by_kind, left_out)
    if not any(by_kind.values()):
        raise SemvizError(f"--methods: nothing can run here; {'; '.join(chosen.notes())}")
    return chosen


def make_method(suite: "Suite", name: str) -> Any:
    """Return the method for a suite: a Method, MatchedMethod or SequenceMethod.

    Each is made once per process. Networks of the paper's table are those trained for the suite,
    if any.
    """
    if name in pixel_methods.METHODS and not suite.has_pictures:
        raise SemvizError("it needs pictures and scans, which only suite street-paper has")
    of_suite = suite.networks if name in MODELS or name in POINT_MODELS else ""
    return _made(suite.kind, name, of_suite)


@cache
def _made(kind: Kind, name: str, networks: str) -> Any:
    weights = shipped_weights(f"{name}-{networks}")
    if name in POINT_MODELS:
        if not networks:
            raise SemvizError("its network is trained for submaps within 20 m only")
        return load_point_method(name, weights)
    if networks:
        return methods.LocalizerMethod(name, weights=weights)
    return KNOWN[kind][name]()


def _obstacle(suites: Sequence["Suite"], name: str) -> str:
    """Return why a method cannot run here; empty if it can."""
    try:
        for suite in suites:
            make_method(suite, name)
    except SemvizError as error:
        return str(error)
    return ""


SEQUENCE_FRAMES = 200
BLACKOUT = sequences.Blackout(start_s=10.0, length_s=3.0)
"""Halfway through each sequence."""
FRAMES_A_ROAD = 100
"""Frames on one simulated road; so tuning and reporting seeds share no road."""


NoiseLevel = Literal["paper", "low"]


@dataclass(frozen=True)
class Roads:
    """The roads of the frames: KITTI's if its folders are given, otherwise simulated ones."""

    poses: Path | None = None
    pole_maps: Path | None = None
    sequences: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.poses is None) != (self.pole_maps is None):
            raise SemvizError("--kitti-poses and --pole-maps: give both, or neither")

    def of_frame(self, seed: int) -> BenchmarkRoad:
        if self.poses is None:
            return _simulated(seed // FRAMES_A_ROAD)
        return _kitti(*self._files(self.sequences[seed % len(self.sequences)]))

    def digest(self) -> str:
        """Return an identifier of the roads; KITTI's includes a digest of the files."""
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
    difficulty: problems.Difficulty = problems.Difficulty()  # noqa: RUF009  frozen
    networks: str = ""
    """Ending of the files with the paper's networks for it; empty: those of normal frames."""
    has_pictures: bool = False
    """Whether frames are of simulated streets, with a picture and a cloud."""

    def sequence(self, seeds: range, noise: NoiseLevel, roads: Roads) -> sequences.SequenceProblem:
        """Return as many consecutive frames as ``seeds``, starting where the first seed draws."""
        road = roads.of_frame(seeds[0])
        most = max(len(road) - SEQUENCE_FRAMES, 0)
        start = int(np.random.default_rng(seeds[0]).integers(most + 1))
        difficulty = replace(self.difficulty, noise=noise)
        frames = [
            problems.make_problem(seeds[0], difficulty, road, index, driving=True)
            for index in range(start, start + len(seeds))
        ]
        return sequences.make_sequence(frames, seeds[0], blackout=BLACKOUT)

    def problem(
        self, seed: int, noise: NoiseLevel, roads: Roads
    ) -> problems.LocalizationProblem | MatchedProblem:
        """Return the single-frame problem of ``seed``; its type depends on ``kind``."""
        if self.has_pictures:
            return street_problem(seed, noise)
        difficulty = replace(self.difficulty, noise=noise)
        make = problems.make_problem if self.kind == "single" else make_matched_problem
        return make(seed, difficulty=difficulty, road=roads.of_frame(seed))

    @property
    def has_bound(self) -> bool:
        """Whether noise is as stated; otherwise the Cramer-Rao bound is meaningless."""
        stated = self.difficulty.stated_sigma_px, self.difficulty.stated_gps_sigma_m
        return self.kind != "sequence" and stated == (None, None)


SUITES: dict[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite("frames", "single"),
        Suite("paper", "single"),
        Suite("paper-20m", "single", problems.PAPER_20M, networks="20m"),
        Suite("street-paper", "single", problems.PAPER_20M, networks="20m", has_pictures=True),
        *(Suite(name, "single", difficulty) for name, difficulty in problems.HARD_SETS.items()),
        Suite("matched", "matched"),
        Suite("sequence", "sequence"),
    )
}
GROUPS = {
    "hard": tuple(problems.HARD_SETS),
    "all": tuple(name for name in SUITES if name not in ("paper", "street-paper")),
}
"""``paper`` has the same problems as ``frames``; those of ``street-paper`` take long to make."""


def choose_suites(text: str) -> tuple[Suite, ...]:
    """Return the suites of ``--suite a,b``, in the order of SUITES."""
    wanted = [name.strip() for name in text.split(",")]
    if unknown := [name for name in wanted if name not in SUITES and name not in GROUPS]:
        known = ", ".join([*SUITES, *GROUPS])
        raise SemvizError(f"--suite: no suite {', '.join(unknown)}; known: {known}")
    names = {part for name in wanted for part in GROUPS.get(name, (name,))}
    return tuple(suite for name, suite in SUITES.items() if name in names)


@lru_cache(maxsize=2)
def _simulated(seed: int) -> BenchmarkRoad:
    return simulated_road(seed)


@lru_cache(maxsize=16)
def _kitti(poses: Path, pole_map: Path) -> BenchmarkRoad:
    return kitti_road(poses, pole_map, poses.stem)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SemvizError(f"{path}: {error.strerror}; is it KITTI's folder?") from None
