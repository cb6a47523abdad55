"""Effect of the pair matcher's poses on a search: share of frames whose best pose is within 1 m.

    python bench/proposed_poses.py [WEIGHTS] [--kitti-poses DIR --pole-maps DIR]
        [--problems N] [--report]

Options as of bench/pair_matcher.py. For the usual and the wide search, each alone, with the
matcher's poses, and with these and the verifier: the share whose first mode is right, and in
brackets that with a right one among the modes. Paper's noise.
"""

from dataclasses import replace
from time import process_time

import numpy as np
import torch
from pair_matcher import REPORTING_SEED, SETS, TUNING_SEED, asked, chosen_roads, parsed

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.localization.heading_votes import DEFAULT_EFFORT, WIDE
from semviz_core.localization.mode_verifier import ModeVerifier, load_verifier
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import Modes, search
from semviz_core.localization.upright import assumed_upright
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem, make_problem
from semviz_core.research.pair_matcher.inference import (
    PairMatcher,
    load_pair_matcher,
    with_proposed,
)

SHOWN = ("normal", "GPS 30 m", "GPS 50 m", "clutter 100 %", "all together", "no attitude")
WAYS = ("search", "+ matcher", "+ verifier")
RIGHT_M = 1.0


def main() -> None:
    torch.set_num_threads(1)
    options = parsed()
    matcher = load_pair_matcher(options.weights, DEFAULT_CLASSES)
    verifier = load_verifier(None, DEFAULT_CLASSES)
    roads = list(chosen_roads(options))
    first = REPORTING_SEED if options.report else TUNING_SEED
    print(f"{'':14}{'':>7}", *(f"{way:>15}" for _ in range(2) for way in WAYS), "  matcher ms")
    for name in SHOWN:
        level = replace(SETS[name], noise="paper")
        seeds = range(first, first + options.problems)
        problems = (make_problem(seed, level, roads[seed % len(roads)]) for seed in seeds)
        told = np.array(
            [compared(problem, matcher, verifier) for problem in problems if problem.is_valid]
        )
        share, time_ms = 100.0 * told[:, :-1].mean(axis=0), np.median(told[:, -1])
        cells = (f"{value:7.1f} ({some:5.1f})" for value, some in share.reshape(-1, 2))
        print(f"{name:14}{len(told):7}", *cells, f"{time_ms:12.1f}", flush=True)


def compared(
    problem: LocalizationProblem, matcher: PairMatcher, verifier: ModeVerifier
) -> list[float]:
    """For each search, and each of WAYS: first mode right, any right; and the matcher's time."""
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    prior = assumed_upright(problem.prior)
    start = process_time()
    pose = matcher.match(*asked(problem)).pose
    time_ms = (process_time() - start) * 1e3
    found: list[float] = []
    for effort in (DEFAULT_EFFORT, WIDE):
        modes = search(scene, prior, effort)
        more = with_proposed(modes, scene, prior, pose)
        sure, _ = verifier.verified(problem.observed, problem.submap, problem.camera, prior, more)
        for value in (modes, more, sure):
            right = are_right(value, problem)
            found += [float(any(right[:1])), float(any(right))]
    return [*found, time_ms]


def are_right(modes: Modes, problem: LocalizationProblem) -> list[bool]:
    poses = (
        Pose(nearest_rotation(rotation), translation)
        for rotation, translation in zip(modes.rotation, modes.translation, strict=True)
    )
    return [pose_error(pose, problem.T_camera_map)[0] < RIGHT_M for pose in poses]


if __name__ == "__main__":
    main()
