"""Effect of more effort and of learning on hard problems: search, wide and learned.

    python bench/search_methods.py --kitti-poses ... --pole-maps ...
    python bench/search_methods.py --kitti-poses ... --pole-maps ... --sequences 00 02 05 06 08 \
        --first-seed 0        (tuning)

``wide`` searches with the same effort as ``learned`` and has learned nothing. Times are of a
processor, not of the clock, of whole frames on one core. ``gain``: points of ``< 1 m`` more than
the first method has on the same frames, with its standard error. ``s+w``, sure and wrong: the
answer is ok, and further than 1 m or 1 deg from the truth.
"""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from time import thread_time
from typing import Literal

import numpy as np
import tyro

from semviz_core.common.arrays import FloatArray
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.methods import LocalizerMethod
from semviz_core.research.evaluation.problems import (
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    valid_problems,
)
from semviz_core.research.training.simulated_samples import KittiFiles

METHODS = ("search", "learned")
SUITES = {"normal": Difficulty(), **HARD_SETS}


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    sequences: tuple[str, ...] = ("09", "10")
    suites: tuple[str, ...] = (
        "normal", "GPS 30 m", "GPS 50 m", "no attitude", "clutter 100 %", "4 elements",
        "map 20 % wrong", "all together",
    )  # fmt: skip
    noise: tuple[Literal["low", "paper"], ...] = ("low", "paper")
    frames: int = 300
    """Of each suite and noise, with four detections or more."""
    first_seed: int = 1000


@dataclass(frozen=True)
class Told:
    """One answer."""

    below_1m: bool
    ok: bool
    sure_and_wrong: bool
    ms: float


def main(options: Options) -> None:
    files = KittiFiles(options.kitti_poses, options.pole_maps)
    roads = [files.road(sequence) for sequence in options.sequences]
    methods = [LocalizerMethod(method) for method in METHODS]
    everything: dict[str, list[Told]] = {name: [] for name in METHODS}
    titles = "".join(f"{value:>8}" for value in ("ok", "s+w", "ms Q2", "p95"))
    print(f"{'':<34}{'frames':>7}{'< 1 m':>8}{'gain':>13}{titles}")
    for suite in options.suites:
        for noise in options.noise:
            level = replace(SUITES[suite], noise=noise)
            told: dict[str, list[Told]] = {name: [] for name in METHODS}
            coming = valid_problems(roads, level, options.first_seed)
            for problem in islice(coming, options.frames):
                for method in methods:
                    told[method.name].append(asked(method, problem))
            show(f"{suite}, {noise}", told)
            for name, answers in told.items():
                everything[name] += answers
    show("all of these", everything)


def asked(method: LocalizerMethod, problem: LocalizationProblem) -> Told:
    start = thread_time()
    answer = method.solve(problem)
    ms = (thread_time() - start) * 1e3
    if answer.T_camera_map is None:
        return Told(below_1m=False, ok=False, sure_and_wrong=False, ms=ms)
    off_m, off_deg = pose_error(answer.T_camera_map, problem.T_camera_map)
    ok = answer.status == "ok"
    return Told(off_m < 1.0, ok, ok and (off_m > 1.0 or off_deg > 1.0), ms)


def show(suite: str, told: dict[str, list[Told]]) -> None:
    """One line for each method; all were asked about the same frames."""
    first = shares(told[METHODS[0]], "below_1m")
    for method, answers in told.items():
        below, ok, wrong = (shares(answers, x) for x in ("below_1m", "ok", "sure_and_wrong"))
        more = below - first
        gain = f"{1e2 * more.mean():+.1f} +- {1e2 * more.std() / np.sqrt(len(more)):.1f}"
        median, p95 = np.percentile([answer.ms for answer in answers], [50, 95])
        print(
            f"{suite:<24}{method:<10}{len(answers):>7}{below.mean():>8.1%}{gain:>13}"
            f"{ok.mean():>8.1%}{wrong.mean():>8.2%}{median:>8.1f}{p95:>8.1f}",
            flush=True,
        )


def shares(answers: list[Told], name: str) -> FloatArray:
    return np.array([getattr(answer, name) for answer in answers], dtype=np.float64)


if __name__ == "__main__":
    main(tyro.cli(Options))
