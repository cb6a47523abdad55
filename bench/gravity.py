"""Gravity of single frames, by the prior and the observed poles: is its covariance honest?

    python bench/gravity.py [--frames 500] [--sets usual,clutter] [--first-seed 0]

Frames are those of `bench/held_out.py`; the prior knows gravity to 1.5 deg, false poles lean.
`NEES`: squared error by the covariance per degree of freedom, 1 if it is honest; without the worst
1 % of frames beside it. `beyond 3 sigma`: of 0.3 % of honest Gaussian errors' share 1.1 % in two
dimensions. `prior`: error of the prior alone.
"""

from dataclasses import dataclass

import numpy as np
import tyro
from held_out import DETECTOR, SETS, make_problem

from semviz_core.common.arrays import FloatArray
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.upright import gravity
from semviz_core.research.evaluation.problems import LocalizationProblem


@dataclass(frozen=True)
class Options:
    frames: int = 500
    sets: str = "usual,four,clutter,3 px,all"
    first_seed: int = 0


def main(options: Options) -> None:
    everything = []
    print(f"{'':16}{'error, deg':>12}{'prior':>8}{'NEES':>8}{'of 99 %':>9}{'beyond 3 sigma':>16}")
    for name in options.sets.split(","):
        seeds = range(options.first_seed, options.first_seed + options.frames)
        told = np.array([of_frame(make_problem(seed, SETS[name])) for seed in seeds])
        everything.append(told)
        show(name, told)
    show("all of these", np.concatenate(everything))


def of_frame(problem: LocalizationProblem) -> FloatArray:
    """Return the error of gravity, that of the prior (rad), and the squared one by the
    covariance."""
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    prior = PriorRecord.of(problem.prior)
    true = problem.T_camera_map.rotation[:, 2]
    up, covariance = gravity(scene, prior)
    off = prior.value["across_up"] @ (up - true)
    given = prior.value["across_up"] @ (prior.value["up_camera"] - true)
    chi2 = off @ np.linalg.solve(covariance, off)
    return np.array([np.linalg.norm(off), np.linalg.norm(given), chi2])


def show(name: str, told: FloatArray) -> None:
    error, of_prior = np.rad2deg(np.median(told[:, :2], axis=0))
    chi2 = np.sort(told[:, 2])
    most = chi2[: int(0.99 * len(chi2))]
    print(
        f"{name:16}{error:>12.2f}{of_prior:>8.2f}{0.5 * chi2.mean():>8.2f}{0.5 * most.mean():>9.2f}"
        f"{(chi2 > 11.8).mean():>16.1%}",
        flush=True,
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
