"""Accuracy of the learned pair matcher on each set of problems.

    python bench/pair_matcher.py [WEIGHTS] [--kitti-poses DIR --pole-maps DIR]
        [--problems N] [--report]

For detections with a true match: how often it is the most likely one, or among the 5 or 10 most
likely; AUC of "unmatched" for detections without one; how often the pose of a couple of the
surest pairs is within 2.5 m, from where refinement converges; processor time per frame. Half of the
problems have the paper's noise, half the low one. Simulated roads are held out. KITTI's are 00, 02,
05, 06, 08 with seeds from 200 on (for tuning), or with --report 09, 10 from seed 1000 on.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Match
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.localization.correspondences.matcher import (
    PairMatcher,
    couple_poses,
    load_pair_matcher,
)
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.upright import assumed_upright, likely_ups, upright_view
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.evaluation.roads import BenchmarkRoad, kitti_road, simulated_road

SETS = {"normal": Difficulty(), **HARD_SETS}
TUNING, REPORTING = ("00", "02", "05", "06", "08"), ("09", "10")
TUNING_SEED, REPORTING_SEED = 200, 1000
HELD_OUT_ROADS = range(1, 6)
FEW = (1, 5, 10)
NEAR_M = 2.5


def main() -> None:
    options = parsed()
    matcher = load_pair_matcher(options.weights, DEFAULT_CLASSES)
    roads = list(chosen_roads(options))
    first_seed = REPORTING_SEED if options.report else TUNING_SEED
    heads = [f"top-{few}" for few in FEW]
    print(f"{'':20}", *(f"{head:>7}" for head in (*heads, "AUC", "a pose", "ms", "p95")))
    for name, level in SETS.items():
        problems = made(level, roads, first_seed, options.problems)
        print(f"{name:20}", *(f"{value:7.1f}" for value in measured(matcher, problems)), flush=True)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("weights", nargs="?", type=Path)
    parser.add_argument("--kitti-poses", type=Path)
    parser.add_argument("--pole-maps", type=Path)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--report", action="store_true")
    return parser.parse_args()


def chosen_roads(options: argparse.Namespace) -> Iterator[BenchmarkRoad]:
    if options.kitti_poses is None:
        yield from (simulated_road(number) for number in HELD_OUT_ROADS)
        return
    for name in REPORTING if options.report else TUNING:
        poses, pole_map = f"{name}.txt", f"kitti_{name}.npz"
        yield kitti_road(options.kitti_poses / poses, options.pole_maps / pole_map, name)


def made(
    level: Difficulty, roads: list[BenchmarkRoad], seed: int, number: int
) -> list[LocalizationProblem]:
    """The first ``number`` valid ones with a true pair."""
    found: list[LocalizationProblem] = []
    while len(found) < number:
        noisy = replace(level, noise="paper") if len(found) % 2 else level
        problem = make_problem(seed, noisy, roads[seed % len(roads)])
        seed += 1
        if problem.is_valid and len(problem.pairs):
            found.append(problem)
    return found


def measured(matcher: PairMatcher, problems: list[LocalizationProblem]) -> list[float]:
    """Percentages as in the heading, and milliseconds."""
    ranks, alone, paired, near, time_ms = [], [], [], [], []
    matcher.match(*asked(problems[0]))
    for problem in problems:
        start = process_time()
        found = matcher.match(*asked(problem))
        time_ms.append((process_time() - start) * 1e3)
        pairs = problem.pairs
        true = found.probability[pairs[:, 0], pairs[:, 1]]
        ranks.append((found.probability[pairs[:, 0], :-1] > true[:, None]).sum(axis=1))
        alone.append(found.probability[:-1, -1])
        paired.append(np.isin(np.arange(len(problem.observed)), pairs[:, 0]))
        near.append(bool((distances(found, problem) < NEAR_M).any()))
    rank = np.concatenate(ranks)
    hits = [100.0 * float(np.mean(rank < few)) for few in FEW]
    right = [100.0 * float(np.mean(near))]
    times = [float(np.median(time_ms)), float(np.percentile(time_ms, 95))]
    return [*hits, 100.0 * auc(np.concatenate(alone), np.concatenate(paired)), *right, *times]


def asked(problem: LocalizationProblem) -> tuple[Elements2D, Elements3D, Camera, Prior]:
    return problem.observed, problem.submap, problem.camera, problem.prior


def distances(found: Match, problem: LocalizationProblem) -> FloatArray:
    """(h,) of the couples' poses from the camera, on the ground (m)."""
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    prior = PriorRecord.of(assumed_upright(problem.prior))
    ups, up_sigma_rad = likely_ups(scene, prior)
    view = upright_view(scene, ups[0], up_sigma_rad)
    pose, _ = couple_poses(scene, view, prior, found.order, found.probability)
    off = pose[:, :2] - problem.T_camera_map.inverse().translation[:2]
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def auc(alone: FloatArray, paired: BoolArray) -> float:
    with_pair, without = alone[paired], alone[~paired]
    return float((with_pair[:, None] < without).mean()) if len(without) else float("nan")


if __name__ == "__main__":
    main()
