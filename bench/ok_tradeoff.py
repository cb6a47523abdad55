"""How many frames can be `ok` at how few wrong ones, beside an oracle that knows the posterior.

    python bench/ok_tradeoff.py --kitti-poses ... --pole-maps ... [--plot ok-tradeoff.png]

The oracle has the modes of the widest search and the one at the true pose. Each counts as a
Gaussian of its covariance, with its likelihood; many samples of their mixture tell for each mode
what share of the posterior is within 1 m and 2 deg of it. The oracle answers with the largest, and
orders the frames by it. `search` is ordered by its gap to the next mode, and by its own status.
A curve gives, for each share of frames answered, the share of these that is wrong: no method whose
likelihood is this one can be below the oracle's but by chance.
"""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from semviz_core.base.detector_model import NoiseName
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.localization.heading_votes import WIDE
from semviz_core.localization.least_squares import information
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import Modes, mode_near, search
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    valid_problems,
)
from semviz_core.research.training.simulated_samples import KittiFiles

SUITES = {"normal": Difficulty(), **HARD_SETS}
RIGHT_M, RIGHT_DEG = 1.0, 2.0
SAMPLES = 4000
ANY_TURN = np.diag([1e-6] * 3 + [0.3] * 3)
"""Information of an angle that may be any: poses without pairs have no other heading."""
SHARES = np.linspace(0.2, 0.95, 16)


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    sequences: tuple[str, ...] = ("09", "10")
    suites: tuple[str, ...] = ("normal", "GPS 50 m")
    noise: tuple[NoiseName, ...] = ("low", "paper")
    frames: int = 500
    """Of each suite and noise, with four detections or more."""
    first_seed: int = 1000
    plot: Path | None = None


class Told(NamedTuple):
    """Of one frame: is the answer right, how sure is it, and is it ok."""

    right: bool
    gap_nats: float
    ok: bool
    oracle_right: bool
    oracle_sure: float


def main(options: Options) -> None:
    files = KittiFiles(options.kitti_poses, options.pole_maps)
    roads = [files.road(sequence) for sequence in options.sequences]
    cases = [(suite, noise) for suite in options.suites for noise in options.noise]
    figure = Figure(figsize=(4 * len(cases), 3.6), layout="tight")
    axes = figure.subplots(1, len(cases), sharey=True, squeeze=False)
    for (suite, noise), panel in zip(cases, axes[0], strict=True):
        level = replace(SUITES[suite], noise=noise)
        coming = islice(valid_problems(roads, level, options.first_seed), options.frames)
        told = [asked(problem, np.random.default_rng(seed)) for seed, problem in enumerate(coming)]
        show(f"{suite}, {noise}", told, panel)
    axes[0][0].set_ylabel("wrong, of those answered (%)")
    axes[0][0].legend()
    if options.plot:
        figure.savefig(options.plot, dpi=110)


def asked(problem: LocalizationProblem, rng: np.random.Generator) -> Told:
    frame = problem.observed, problem.submap, problem.camera, problem.prior
    found = Localizer(detector=DETECTOR).localize(*frame)
    right = found.T_camera_map is not None and is_right(found.T_camera_map, problem)
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    modes = [search(scene, problem.prior, WIDE)]
    modes.append(mode_near(scene, problem.prior, problem.T_camera_map))
    best, sure = most_likely(scene, problem, modes, rng)
    return Told(right, gap(found), found.status == "ok", is_right(best, problem), sure)


def is_right(pose: Pose, problem: LocalizationProblem) -> bool:
    off_m, off_deg = pose_error(pose, problem.T_camera_map)
    return off_m < RIGHT_M and off_deg < RIGHT_DEG


def gap(found: Localization) -> float:
    """Return the nats between the answer and the next mode; less than any without an answer."""
    if found.T_camera_map is None or found.search is None:
        return -1.0
    score = found.search.score
    return float(score[0] - score[1]) if len(score) > 1 else 100.0


def most_likely(
    scene: PoseProblem,
    problem: LocalizationProblem,
    found: list[Modes],
    rng: np.random.Generator,
) -> tuple[Pose, float]:
    """Return the mode near which most of the posterior is, and the share of the posterior."""
    poses, covariances, nats = [], [], []
    for modes in found:
        for row in range(len(modes.score)):
            pose = Pose(modes.rotation[row], modes.translation[row])
            if any(max(np.abs((pose @ other.inverse()).log())) < 1e-3 for other in poses):
                continue  # the mode at the true pose was found
            of_pose = information(scene, problem.prior, pose, modes.pairs(row)) + ANY_TURN
            poses.append(pose)
            covariances.append(np.linalg.inv(of_pose))
            nats.append(float(modes.score[row] - 0.5 * np.linalg.slogdet(of_pose)[1]))
    weight = np.exp(np.array(nats) - max(nats))
    drawn = rng.multinomial(SAMPLES, weight / weight.sum())
    share = np.zeros(len(poses))
    for mode, covariance, count in zip(poses, covariances, drawn, strict=True):
        off = rng.multivariate_normal(np.zeros(6), covariance, count)
        for k, answer in enumerate(poses):
            share[k] += within(mode, off, answer).sum() / SAMPLES
    return poses[int(share.argmax())], float(share.max())


def within(mode: Pose, off: FloatArray, answer: Pose) -> BoolArray:
    """Return which samples, left perturbations ``off`` (s, 6) of a mode, are near an answer."""
    apart_m = mode.inverse().translation - answer.inverse().translation
    apart_rad = (mode @ answer.inverse()).log()[3:]
    distance_m = np.linalg.norm(apart_m - off[:, :3] @ mode.rotation, axis=1)
    angle_deg = np.rad2deg(np.linalg.norm(apart_rad + off[:, 3:], axis=1))
    return (distance_m < RIGHT_M) & (angle_deg < RIGHT_DEG)


def show(title: str, told: list[Told], panel: Axes) -> None:
    right, gap_nats, ok, oracle_right, oracle_sure = (
        np.array(column) for column in zip(*told, strict=True)
    )
    wrong_of_ok = (~right & ok).sum() / max(ok.sum(), 1)
    by_gap, by_oracle = wrong_by_share(gap_nats, right), wrong_by_share(oracle_sure, oracle_right)
    panel.plot(1e2 * SHARES, 1e2 * by_oracle, label="oracle")
    panel.plot(1e2 * SHARES, 1e2 * by_gap, label="search, by its gap")
    panel.plot([1e2 * ok.mean()], [1e2 * wrong_of_ok], "k*", label="search, ok")
    panel.set(title=title, xlabel="answered (%)", ylim=(0.0, 15.0))
    at_ok = np.array([ok.mean()])
    print(
        f"{title:<16} {len(told)} frames  ok {ok.mean():.1%}, of these wrong {wrong_of_ok:.2%}  "
        f"as many by the gap alone {wrong_by_share(gap_nats, right, at_ok)[0]:.2%}, "
        f"by the oracle {wrong_by_share(oracle_sure, oracle_right, at_ok)[0]:.2%}  "
        f"oracle answers {most_at(oracle_sure, oracle_right, wrong_of_ok):.1%} with as few wrong",
        flush=True,
    )


def wrong_by_share(sure: FloatArray, right: BoolArray, shares: FloatArray = SHARES) -> FloatArray:
    """Return, for each share of frames answered, the surest first, the share that is wrong."""
    wrong = np.cumsum(~right[np.argsort(-sure, kind="stable")])
    count = np.maximum(np.round(shares * len(right)).astype(int), 1)
    return wrong[count - 1] / count


def most_at(sure: FloatArray, right: BoolArray, wrong_share: float) -> float:
    """Return the largest share of frames that can be answered, the surest first, at no more than
    ``wrong_share`` of wrong ones."""
    wrong = np.cumsum(~right[np.argsort(-sure, kind="stable")])
    count = np.arange(1, len(right) + 1)
    fine = wrong <= wrong_share * count
    return float(count[fine].max(initial=0) / len(right))


if __name__ == "__main__":
    main(tyro.cli(Options))
