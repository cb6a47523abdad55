"""Accuracy of each stage of the paper's method: pairs, coarse pose, refined pose.

    python bench/paper_stages.py --kitti-poses ... --pole-maps ... [--suite paper-20m]

Of the most likely pairs, the input of P3P-RANSAC: the share that is true. Of all frames: in how
many RANSAC finds a pose, in how many it is within 1 m of the truth, and the result of weighted
PnPL.
"""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from semviz.research.benchmark.suites import SUITES, make_method
from semviz_core.base.pose import Pose
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import LocalizationProblem, valid_problems
from semviz_core.research.training.simulated_samples import KittiFiles

METHODS = ("bpnpnet", "paper-no-semantics", "bpnpnet-semantic", "paper")
NOISES: tuple[Literal["paper", "low"], ...] = ("paper", "low")
MANY = 6


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    sequences: tuple[str, ...] = ("09", "10")
    suite: Literal["paper", "paper-20m"] = "paper"
    frames: int = 300
    """With four detections or more."""
    hidden_bottoms: float = 0.5
    """Share of poles whose bottom is hidden, unknown to the detector."""
    first_seed: int = 1000


@dataclass(frozen=True)
class Stages:
    """Of one frame."""

    many: bool
    true_pairs: float
    """Share among the surest."""
    coarse: bool
    coarse_below_1m: bool
    refined: bool
    refined_below_1m: bool


def main(options: Options) -> None:
    files = KittiFiles(options.kitti_poses, options.pole_maps)
    roads = [files.road(sequence) for sequence in options.sequences]
    heads = ("true pairs", "coarse", "< 1 m", "refined", "< 1 m")
    print(f"{'':<28}{'frames':>7}" + "".join(f"{head:>11}" for head in heads))
    for noise in NOISES:
        level = replace(
            SUITES[options.suite].difficulty, noise=noise, hidden_bottoms=options.hidden_bottoms
        )
        coming = valid_problems(roads, level, options.first_seed)
        problems = list(islice(coming, options.frames))
        for method in METHODS:
            localizer = make_method(SUITES[options.suite], method).localizer
            told = [stages(localizer, problem) for problem in problems]
            show(f"{noise}, {method}", told)
            show(f"  of these >= {MANY} true", [outcome for outcome in told if outcome.many])


def stages(localizer: Localizer, problem: LocalizationProblem) -> Stages:
    found = localizer.localize(problem.observed, problem.submap, problem.camera, problem.prior)
    surest = [] if found.match is None else found.match.order.tolist()
    true = problem.pairs.tolist()
    coarse = None
    if found.search is not None and found.search.T_camera_map:
        coarse = found.search.T_camera_map[0]
    return Stages(
        len(true) >= MANY,
        float(np.mean([pair in true for pair in surest])) if surest else 0.0,
        coarse is not None,
        _below_1m(coarse, problem),
        found.T_camera_map is not None,
        _below_1m(found.T_camera_map, problem),
    )


def _below_1m(pose: Pose | None, problem: LocalizationProblem) -> bool:
    return pose is not None and pose_error(pose, problem.T_camera_map)[0] < 1.0


def show(name: str, told: list[Stages]) -> None:
    names = ("true_pairs", "coarse", "coarse_below_1m", "refined", "refined_below_1m")
    shares = [float(np.mean([getattr(outcome, name) for outcome in told])) for name in names]
    print(f"{name:<28}{len(told):>7}" + "".join(f"{share:>11.1%}" for share in shares), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
