"""What the assumed share of hidden bottoms costs and brings, if bottoms are hidden or not.

    python bench/hidden_ends.py --kitti /data/kitti --poles /data/pole_maps

Prints a table for docs/results/benchmark.md.
"""

import argparse
from dataclasses import replace
from itertools import islice
from pathlib import Path
from time import process_time

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    Difficulty,
    LocalizationProblem,
    valid_problems,
)
from semviz_core.research.evaluation.roads import kitti_road

SEED = 100_000
SHARES = (0.0, 0.06, 0.1, 0.2, 0.5)


def flagged(problem: LocalizationProblem) -> LocalizationProblem:
    """The same with hidden bottoms flagged, as annotators do."""
    observed = problem.observed
    known = np.asarray(observed.end_known & problem.end_visible)
    return replace(problem, observed=replace(observed, end_known=known))


def measured(problems: list[LocalizationProblem], share: float) -> str:
    """A row: frames ok, poses within 1 m, ok and wrong, median error, time."""
    localizer = Localizer("search", detector=DetectorModel(hidden_bottoms=share))
    errors, sure, start = [], [], process_time()
    for problem in problems:
        found = localizer.localize(problem.observed, problem.submap, problem.camera, problem.prior)
        pose = found.T_camera_map
        errors.append(np.inf if pose is None else pose_error(pose, problem.T_camera_map)[0])
        sure.append(found.status == "ok")
    error_m, is_sure = np.array(errors), np.array(sure)
    time_ms = 1e3 * (process_time() - start) / len(problems)
    return (
        f"{share:g} | {is_sure.mean():.1%} | {(error_m < 1.0).mean():.1%} | "
        f"{(is_sure & (error_m >= 1.0)).mean():.1%} | {np.median(error_m[is_sure]):.3f} m | "
        f"{time_ms:.1f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kitti", type=Path, required=True)
    parser.add_argument("--poles", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=150)
    options = parser.parse_args()
    calibration = options.kitti / "sequences" / "02" / "calib.txt"
    roads = [
        kitti_road(
            options.kitti / "poses" / f"{name}.txt",
            options.poles / f"kitti_{name}.npz",
            name,
            calibration,
        )
        for name in ("09", "10")
    ]

    def frames(hidden: float) -> list[LocalizationProblem]:
        level = Difficulty(hidden_bottoms=hidden)
        return list(islice(valid_problems(roads, level, SEED), options.frames))

    half = frames(0.5)
    sets = {
        "half hidden, not flagged": half,
        "a fifth hidden, not flagged": frames(0.2),
        "half hidden, flagged": [flagged(problem) for problem in half],
        "none hidden": frames(0.0),
    }
    print("bottoms | assumed | ok | below 1 m | ok and wrong | median of ok | time")
    measured(half[:2], 0.1)  # compiles
    for name, problems in sets.items():
        for share in SHARES:
            print(f"{name} | {measured(problems, share)}", flush=True)


if __name__ == "__main__":
    main()
