"""How much a run without a true pose can tell of a fault: what no test can exceed.

    python bench/diagnosis_limits.py --first-seed 5000     (the runs that bench/diagnosis.py judges)
    python bench/diagnosis_limits.py --first-seed 5000 --frames 100 --runs 12

The best possible test knows all true correspondences, the fault that it has to tell from none, and
its size: the smallest one that bench/diagnosis.py plants, of a shifted map the largest. The poses
are unknown, but for priors and odometry. What is left of the effect of the fault once all poses may
follow it is the log-likelihood ratio to expect: 3 nats are odds of 20 to 1. A wrong extrinsic
and a time offset change nothing but the true poses, so without these they leave 0 nats. A roll of
the mounting turns gravity in all frames, and so does a wrong gravity prior: 0 nats tell them apart.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import tests_support  # noqa: F401
import tyro
from support.planted_causes import SIGMA_FACTOR
from support.planted_runs import FRAMES, PlantedRun, plant_in_run

from semviz_core.base.camera import Camera
from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.reference import FrameReference, pair_errors
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.research.evaluation.problems import DETECTOR
from semviz_core.research.evaluation.roads import simulated_road

FOCAL, CENTER = (cause.camera for cause in CALIBRATIONS[:2])
COMPASS_RAD = float(np.deg2rad(3.0))
LIMITS = (3.0, 20.0)
"""Odds of 20 to 1, and what a common cause of a run needs to be named."""


@dataclass(frozen=True)
class Options:
    runs: int = 24
    frames: int = FRAMES
    """Of each run."""
    first_seed: int = 2000


class Rows:
    """All residual rows of a run, whitened, by its poses; an effect has one value for each row."""

    def __init__(self, drive: PlantedRun, has_compass: bool = False) -> None:
        self.has_compass = has_compass
        self.cases = [
            FrameReference.of(found, drive.semantic_map, truth, DETECTOR)
            for found, truth in drive.frames
        ]
        self.steps = [step for step in drive.odometry if step is not None]
        n = len(self.cases)
        blocks = [*self._detections(), *self._priors(), *self._steps()]
        size = [len(block) for block in blocks]
        self.kind = np.repeat(["seen"] * n + ["prior"] * n + ["step"] * (n - 1), size)
        self._basis, _ = np.linalg.qr(np.concatenate(blocks))

    def nats(self, effect: FloatArray) -> float:
        """Return the expected log-likelihood ratio of a fault and none."""
        left = effect - self._basis @ (self._basis.T @ effect)
        return 0.5 * float(left @ left)

    def nats_of_sigma(self, factor: float) -> float:
        """Return that of detections ``factor`` times less accurate than stated."""
        share = (self._basis[self.kind == "seen"] ** 2).sum(axis=1)
        used = (self._basis[self.kind == "seen"] != 0.0).any(axis=1)
        free = float((1.0 - share)[used].sum())
        return free * (0.5 * (factor**2 - 1.0) - np.log(factor))

    def effect(self, kind: str, values: list[FloatArray]) -> FloatArray:
        """Return an effect on the rows of one kind, given for each frame or step."""
        found = np.zeros(len(self.kind))
        found[self.kind == kind] = np.concatenate(values)
        return found

    def _placed(self, by_pose: FloatArray, row: int) -> FloatArray:
        placed = np.zeros((len(by_pose), 6 * len(self.cases)))
        placed[:, 6 * row : 6 * row + 6] = by_pose
        return placed

    def _detections(self) -> Iterator[FloatArray]:
        for row, case in enumerate(self.cases):
            errors = pair_errors(case.problem, _pose(case), case.same_class)
            white = np.linalg.solve(np.linalg.cholesky(errors.covariance_px2), errors.by_pose)
            yield self._placed(white.reshape(-1, 6), row)

    def _priors(self) -> Iterator[FloatArray]:
        for row, case in enumerate(self.cases):
            residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
            prior = case.prior
            if self.has_compass:
                prior = replace(prior, heading_rad=0.0, heading_sigma_rad=COMPASS_RAD)
            prior_rows(PriorRecord.of(prior), *_pose(case).writable(), residual, jacobian)
            yield self._placed(jacobian[:6], row)

    def _steps(self) -> Iterator[FloatArray]:
        for row, (before, now) in enumerate(pairwise(self.cases)):
            motion = _pose(now) @ _pose(before).inverse()
            by_pose = self._placed(adjoint(motion), row) - self._placed(np.eye(6), row + 1)
            yield np.linalg.solve(np.linalg.cholesky(self.steps[row].covariance), by_pose)

    def seen_through(self, camera: Callable[[Camera], Camera]) -> FloatArray:
        """Return the effect of another camera."""
        values = []
        for case in self.cases:
            result = case.localization
            problem = PoseProblem.of(
                camera(result.camera), result.observed, case.nearby, case.detector
            )
            first, other = (
                pair_errors(of, _pose(case), case.same_class) for of in (case.problem, problem)
            )
            change = (other.residual_px - first.residual_px)[..., None]
            white = np.linalg.solve(np.linalg.cholesky(first.covariance_px2), change)
            values.append(white.ravel())
        return self.effect("seen", values)

    def stepped(self, longer: float, turn_rad: float) -> FloatArray:
        """Return the effect of odometry that is too long by a share, and turns too far a step."""
        values = []
        for step in self.steps:
            turned = np.array([0.0, 0.0, 0.0, 0.0, turn_rad, 0.0])
            turned[:3] = longer * step.T_now_before.translation
            values.append(np.linalg.solve(np.linalg.cholesky(step.covariance), turned))
        return self.effect("step", values)

    def told(self, change: list[float]) -> FloatArray:
        """Return the effect of priors that are off alike, in sigmas of their rows."""
        return self.effect("prior", [np.array(change)] * len(self.cases))


def _pose(case: FrameReference) -> Pose:
    assert case.truth is not None
    return case.truth


def faults(drive: PlantedRun) -> dict[str, float]:
    """Return the nats of each fault."""
    rows, compass = Rows(drive), Rows(drive, has_compass=True)
    shift = 2.0 / rows.cases[0].prior.horizontal_sigma_m
    assert FOCAL is not None
    assert CENTER is not None
    return {
        "misaligned map, 2 m": rows.nats(rows.told([shift, 0.0, 0.0, 0.0, 0.0, 0.0])),
        "heading prior, 15 deg": compass.nats(compass.told([0.0] * 5 + [15.0 / 3.0])),
        "odometry, 3 % too long": rows.nats(rows.stepped(0.03, 0.0)),
        "odometry, 0.3 deg per step": rows.nats(rows.stepped(0.0, float(np.deg2rad(0.3)))),
        "focal length, 2 %": rows.nats(rows.seen_through(lambda cam: FOCAL(cam, np.array([0.02])))),
        "principal point, 6 px": rows.nats(
            rows.seen_through(lambda cam: CENTER(cam, np.array([6.0, 0.0])))
        ),
        "detection sigma, 4 times": rows.nats_of_sigma(SIGMA_FACTOR),
    }


def main(options: Options) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(8)]
    drives: list[PlantedRun] = []
    seed = options.first_seed
    while len(drives) < options.runs:
        drive = plant_in_run("healthy", seed, roads[seed % 8], options.frames)
        drives += [] if drive is None else [drive]
        seed += 1
    found = [faults(drive) for drive in drives]
    print(f"{'fault':<28}{'nats: quartiles':>24}{'3 or more':>12}{'20 or more':>12}")
    for name in found[0]:
        nats = np.array([one[name] for one in found])
        quartiles = " ".join(f"{value:7.1f}" for value in np.percentile(nats, [25, 50, 75]))
        shares = "".join(f"{(nats >= limit).mean():>12.0%}" for limit in LIMITS)
        print(f"{name:<28}{quartiles:>24}{shares}")


if __name__ == "__main__":
    main(tyro.cli(Options))
