"""Where the paper's chain loses the pose: pairs, coarse pose, refined pose.

    python bench/paper_stages.py --kitti-poses ... --pole-maps ...

Of the surest pairs, which P3P-RANSAC gets: how many are true. Of all frames: in how many RANSAC
finds a pose, in how many that is within 1 m of the truth, and what weighted PnPL makes of it.
"""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import Difficulty, Problem, valid_problems
from semviz_core.learning.drills import KittiFiles
from semviz_core.localize import Localizer
from semviz_core.pose import Pose

METHODS = ("bpnpnet", "paper-no-semantics", "bpnpnet-semantic", "paper")
NOISES: tuple[Literal["paper", "low"], ...] = ("paper", "low")
MANY = 6


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    sequences: tuple[str, ...] = ("09", "10")
    frames: int = 300
    """With four detections or more."""
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
    roads = [files.road(one) for one in options.sequences]
    heads = ("true pairs", "coarse", "< 1 m", "refined", "< 1 m")
    print(f"{'':<28}{'frames':>7}" + "".join(f"{one:>11}" for one in heads))
    for noise in NOISES:
        coming = valid_problems(roads, Difficulty(noise=noise), options.first_seed)
        problems = list(islice(coming, options.frames))
        for method in METHODS:
            localizer = Localizer(method)
            told = [stages(localizer, one) for one in problems]
            show(f"{noise}, {method}", told)
            show(f"  of these >= {MANY} true", [one for one in told if one.many])


def stages(localizer: Localizer, problem: Problem) -> Stages:
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


def _below_1m(pose: Pose | None, problem: Problem) -> bool:
    return pose is not None and pose_error(pose, problem.T_camera_map)[0] < 1.0


def show(name: str, told: list[Stages]) -> None:
    names = ("true_pairs", "coarse", "coarse_below_1m", "refined", "refined_below_1m")
    shares = [float(np.mean([getattr(one, name) for one in told])) for name in names]
    print(f"{name:<28}{len(told):>7}" + "".join(f"{one:>11.1%}" for one in shares), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
