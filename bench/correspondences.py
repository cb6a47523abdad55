"""Learned correspondences that localize: `correspondences` beside `search`, on the same frames.

    OMP_NUM_THREADS=1 python bench/correspondences.py --kitti-poses DIR --pole-maps DIR
        [--report] [--frames 1000] [--sets low,paper]

Methods: `search`; `learned`; `correspondences`; the same with P of the true pairs; `search` with
the poses of the couples among its candidates; the same with as many more candidates of its own.
--ways takes some of them. Frames are KITTI's 00, 02, 05, 06, 08 with seeds from 200 on (for
tuning), or with --report 09 and 10 from seed 1000 on. The set `paper-20m` is the suite of that
name. Times are processor time of whole frames.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time

import numpy as np
import tyro

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Match
from semviz_core.base.pose import Pose
from semviz_core.common.jit import Stopwatch
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.correspondences.matcher import (
    CoupleHypotheses,
    load_pair_matcher,
)
from semviz_core.localization.heading_votes import DEFAULT_EFFORT, Effort
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import Modes, Propose, ProposedCandidates, most_voted, search
from semviz_core.localization.upright import UprightView
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    HARD_SETS,
    PAPER_20M,
    Difficulty,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.evaluation.roads import BenchmarkRoad, kitti_road

SETS = {
    "low": Difficulty(),
    "paper": Difficulty(noise="paper"),
    "GPS 30 m": replace(HARD_SETS["GPS 30 m"], noise="paper"),
    "clutter 100 %": replace(HARD_SETS["clutter 100 %"], noise="paper"),
    "paper-20m": PAPER_20M,
}
TUNING, REPORTING = ("00", "02", "05", "06", "08"), ("09", "10")
TUNING_SEED, REPORTING_SEED = 200, 1000
MORE = 50
"""Poses of couples among the candidates of `search`."""
WITH_MORE = DEFAULT_EFFORT._replace(polished=DEFAULT_EFFORT.polished + MORE, started=24)


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    report: bool = False
    frames: int = 200
    sets: str = ",".join(SETS)
    ways: str | None = None


def main(options: Options) -> None:
    names = REPORTING if options.report else TUNING
    roads = [_road(options, name) for name in names]
    ways = {way: WAYS[way] for way in (options.ways or ",".join(WAYS)).split(",")}
    seed = REPORTING_SEED if options.report else TUNING_SEED
    for name in options.sets.split(","):
        measured: dict[str, list[tuple[str, float, float]]] = {way: [] for way in ways}
        frames = problems(name, roads, seed)
        for number in range(1, options.frames + 1):
            problem = next(frames)
            for way, localize in ways.items():
                measured[way].append(_measured(localize, problem))
            if number % 250 == 0 or number == options.frames:
                for way, outcomes in measured.items():
                    print(f"{name:14} {way:26}", _row(outcomes), flush=True)


def _road(options: Options, name: str) -> BenchmarkRoad:
    return kitti_road(
        options.kitti_poses / f"{name}.txt", options.pole_maps / f"kitti_{name}.npz", name
    )


def problems(name: str, roads: list[BenchmarkRoad], seed: int) -> Iterator[LocalizationProblem]:
    while True:
        problem = make_problem(seed, SETS[name], roads[seed % len(roads)])
        if problem.is_valid and len(problem.submap):
            yield problem
        seed += 1


class TrueP(Localizer):
    """`correspondences` with the P of true pairs: what a perfect matcher reaches."""

    def answered(self, problem: LocalizationProblem) -> Localization:
        object.__setattr__(self, "pairs", problem.pairs)
        return self.localize(*asked(problem))

    def _correspondences(
        self, work: Localization, problem: PoseProblem, pairing: PairConstraints, watch: Stopwatch
    ) -> Match:
        learned = super()._correspondences(work, problem, pairing, watch)
        P = np.zeros_like(learned.probability)
        P[tuple(self.pairs.T)] = 1.0
        P[:-1] /= np.maximum(P[:-1].sum(axis=1, keepdims=True), 1.0)  # mapped twice
        P[:-1, -1] = 1.0 - P[:-1, :-1].sum(axis=1)
        return Match(learned.cost, P, self.pairs)


@dataclass(frozen=True)
class Both:
    """Candidates of `search`, and after them the best couples."""

    couples: CoupleHypotheses

    def __call__(
        self, problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
    ) -> ProposedCandidates:
        voted = most_voted(problem, view, prior, effort._replace(polished=effort.polished - MORE))
        more = self.couples(problem, view, prior, effort._replace(polished=MORE))
        pose = np.concatenate([voted.pose, more.pose])
        return ProposedCandidates(pose, voted.evaluated + more.evaluated, voted.rated + more.rated)


@dataclass(frozen=True)
class WithCouples(Localizer):
    """`search` with the poses of couples among its candidates, or with more of its own."""

    couples: bool = field(default=True)

    def _modes(
        self,
        work: Localization,
        problem: PoseProblem,
        prior: Prior,
        start: Pose | None,
        propose: Propose,
        watch: Stopwatch,
    ) -> tuple[Modes, None]:
        if self.couples:
            frame = work.observed, work.submap, work.camera, work.prior
            learned = load_pair_matcher(None, DEFAULT_CLASSES).match(*frame)
            propose = Both(CoupleHypotheses(learned))
        return search(problem, prior, WITH_MORE, propose), None


def asked(problem: LocalizationProblem) -> tuple:
    return problem.observed, problem.submap, problem.camera, problem.prior


_LOCALIZERS = {
    "search": Localizer("search", detector=DETECTOR),
    "learned": Localizer("learned", detector=DETECTOR),
    "correspondences": Localizer("correspondences", detector=DETECTOR),
    "search + couples": WithCouples("search", detector=DETECTOR),
    "search + as many more": WithCouples("search", detector=DETECTOR, couples=False),
}
_TRUE_P = TrueP("correspondences", detector=DETECTOR)
WAYS = {
    name: (lambda problem, localizer=localizer: localizer.localize(*asked(problem)))
    for name, localizer in _LOCALIZERS.items()
} | {"true P": _TRUE_P.answered}


def _measured(localize, problem: LocalizationProblem) -> tuple[str, float, float]:
    """Status, error (m) and time (ms)."""
    start = process_time()
    found = localize(problem)
    time_ms = (process_time() - start) * 1e3
    pose = found.T_camera_map
    off_m = np.inf if pose is None else pose_error(pose, problem.T_camera_map)[0]
    return found.status, off_m, time_ms


def _row(outcomes: list[tuple[str, float, float]]) -> str:
    status, off_m, time_ms = (np.array(column) for column in zip(*outcomes, strict=True))
    below, ok = (off_m < 1.0).mean(), status == "ok"
    error = np.sqrt(below * (1.0 - below) / len(off_m))
    median, p95 = np.percentile(time_ms, [50, 95])
    return (
        f"n {len(off_m)}  <1 m {below:.1%} +- {error:.1%}  median {np.median(off_m):.2f} m  "
        f"ok {ok.mean():.1%}, of these {int((ok & (off_m > 1.0)).sum())} wrong  "
        f"cannot {(status == 'cannot').mean():.1%}  {median:.1f} ms, p95 {p95:.1f}"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
