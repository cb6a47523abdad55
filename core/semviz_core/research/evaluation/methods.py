"""Methods under test, the problems of methods behind a matcher, and the lower bound of errors.

A module with methods offers them by name: ``METHODS: dict[str, Callable[[], Method]]`` for
single frames, ``MATCHED_METHODS`` for frames whose matches are given, most of them wrong. Calling
an entry makes the method. It raises ImportError where a library is missing, and SemvizError where
weights are.

The Cramer-Rao bound is the least covariance any unbiased method can reach with perfect matches.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Protocol

import numpy as np

from semviz_core.base.localization import Localization, Status
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.localization.least_squares import fit_pairs, information
from semviz_core.localization.localizer import Localizer, known_methods
from semviz_core.localization.problem import PoseProblem
from semviz_core.research.evaluation import problems
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem
from semviz_core.research.evaluation.roads import BenchmarkRoad

LEAST_TRUE, MOST_TRUE = 6, 20
"""Limits of the number of true matches in a problem."""
TRUE_SCORE, FALSE_SCORE = (3.0, 2.0), (2.0, 3.0)
"""Beta distributions of the scores: true matches score higher on average (0.6 and 0.4)."""


@dataclass(frozen=True, eq=False)
class MatchedProblem:
    """The input of a solver, and which matches are true."""

    problem: problems.LocalizationProblem
    pairs: IntArray
    """(k, 2) matches (row of observed, row of submap), of the same class."""
    score: FloatArray
    """(k,) in [0, 1]."""
    true: BoolArray
    """(k,) ground truth."""


def make_matched_problem(
    seed: int,
    outliers: float = 0.8,
    difficulty: problems.Difficulty | None = None,
    road: BenchmarkRoad | None = None,
    *,
    informative_scores: bool = True,
) -> MatchedProblem:
    """Return the first frame drawn from ``seed`` with enough true matches, plus wrong ones.

    ``outliers`` is the share of wrong matches; it is lower if the classes do not allow so many.
    """
    problem = _with_enough(seed, difficulty, road)
    rng = np.random.default_rng([seed, 4])
    wrong = _wrong_pairs(problem)
    count = round(len(problem.pairs) * outliers / (1.0 - outliers))
    wrong = wrong[rng.permutation(len(wrong))[:count]]
    pairs = np.concatenate([problem.pairs, wrong])
    true = np.arange(len(pairs)) < len(problem.pairs)
    score = np.where(true, rng.beta(*TRUE_SCORE, len(pairs)), rng.beta(*FALSE_SCORE, len(pairs)))
    if not informative_scores:
        score = np.full(len(pairs), 0.5)
    order = rng.permutation(len(pairs))
    return MatchedProblem(problem, pairs[order], score[order], true[order])


def _with_enough(
    seed: int, difficulty: problems.Difficulty | None, road: BenchmarkRoad | None
) -> problems.LocalizationProblem:
    road = road or problems.default_road()
    frames = np.random.default_rng([seed, 5]).permutation(len(road))
    for index in frames.tolist():
        problem = problems.make_problem(seed, difficulty, road, index)
        if LEAST_TRUE <= len(problem.pairs) <= MOST_TRUE:
            return problem
    raise SemvizError(f"no frame of road {road.name} has {LEAST_TRUE} to {MOST_TRUE} true matches")


def _wrong_pairs(problem: problems.LocalizationProblem) -> IntArray:
    """Return wrong pairs (k, 2) of one class, without those of a duplicate of the true element."""
    observed, submap = problem.observed, problem.submap
    possible = observed.class_id[:, None] == submap.class_id
    for i, j in problem.pairs:
        near = np.linalg.norm(submap.anchor_m - submap.anchor_m[j], axis=1) < 1.0
        possible[i, near] = False
    return np.asarray(np.argwhere(possible), dtype=np.int64)


_LEAST_INFORMATION = 1e-6  # 1 / (1000 m)^2, 1 / (57000 deg)^2: such a pose is not fixed at all


def bound_covariance(problem: LocalizationProblem, *, with_prior: bool = True) -> FloatArray | None:
    """Return the Cramer-Rao bound (6, 6) of the left perturbation of T_camera_map.

    It follows from the true pairs with the noise of detections and map, and from the prior if
    ``with_prior``; hidden bottoms do not count. None if some direction is not fixed.
    """
    known = problem.observed.end_known & problem.end_visible
    pose_problem = PoseProblem.of(
        problem.camera, replace(problem.observed, end_known=known), problem.submap
    )
    prior = problem.prior if with_prior else None
    fisher = information(pose_problem, prior, problem.T_camera_map, problem.pairs)
    if np.linalg.eigvalsh(fisher)[0] < _LEAST_INFORMATION:
        return None
    return np.asarray(np.linalg.inv(fisher), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MethodResult:
    """The result of a method on one frame."""

    T_camera_map: Pose | None
    """None if and only if the status is ``cannot``."""
    covariance: FloatArray | None
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians. None without a pose,
    or if the method does not estimate it."""
    status: Status
    reason: str
    """One sentence."""
    time_ms: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage, in order."""

    def __post_init__(self) -> None:
        if (self.T_camera_map is None) != (self.status == "cannot"):
            raise ValueError("an answer has a pose exactly when its status is not 'cannot'")

    @classmethod
    def of(cls, localization: Localization) -> "MethodResult":
        return cls(
            localization.T_camera_map,
            localization.covariance,
            localization.status,
            localization.reason,
            localization.time_ms,
        )


class Method(Protocol):
    """A method that localizes single frames from observed elements, submap and prior."""

    @property
    def name(self) -> str: ...

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        """Return the result, never using ``T_camera_map``, ``pairs`` or ``end_visible``."""
        ...


class MatchedMethod(Protocol):
    """A method that localizes frames whose matches are given, some of them wrong."""

    @property
    def name(self) -> str: ...

    @property
    def with_prior(self) -> bool:
        """Whether the method, and so the bound it is compared with, uses the prior."""
        ...

    def solve(self, problem: MatchedProblem) -> MethodResult:
        """Return the result, never using the truth in ``problem.problem`` or ``problem.true``."""
        ...


@dataclass(frozen=True)
class LocalizerMethod:
    """``Localizer`` with the rates of the problems' detector; ``name`` is its method.

    Raise SemvizError if a learned method has no weights.
    """

    name: str
    seed: int = 0
    weights: Path | None = None
    localizer: Localizer = field(init=False)

    def __post_init__(self) -> None:
        localizer = Localizer(self.name, self.seed, weights=self.weights, detector=DETECTOR)
        object.__setattr__(self, "localizer", localizer)

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        frame = problem.observed, problem.submap, problem.camera, problem.prior
        return MethodResult.of(self.localizer.localize(*frame))


@dataclass(frozen=True)
class TrueMatches:
    """Maximum likelihood with the true pairs, the result of perfect association.

    A reference, not a method: it uses the ground truth, also of hidden bottoms.
    """

    name: str = "true matches"
    with_prior: bool = True

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        start = perf_counter()
        known = problem.observed.end_known & problem.end_visible
        observed = replace(problem.observed, end_known=known)
        pose_problem = PoseProblem.of(problem.camera, observed, problem.submap)
        prior = problem.prior if self.with_prior else None
        fit = fit_pairs(pose_problem, prior, problem.T_camera_map, problem.pairs)
        time_ms = {"fit": (perf_counter() - start) * 1e3}
        if np.linalg.eigvalsh(fit.information)[0] < 1e-9:
            return MethodResult(None, None, "cannot", "The pairs do not fix a pose.", time_ms)
        covariance = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
        reason = f"{len(problem.pairs)} true pairs fitted."
        return MethodResult(fit.T_camera_map, covariance, "ok", reason, time_ms)


@dataclass(frozen=True)
class Bound:
    """The true pose plus an error drawn from the Cramer-Rao bound: an efficient estimator.

    A reference, not a method: it uses the ground truth. A frame's error is the same in every run.
    """

    name: str = "bound"
    with_prior: bool = True

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        covariance = bound_covariance(problem, with_prior=self.with_prior)
        if covariance is None:
            return MethodResult(None, None, "cannot", "Nothing bounds the pose.")
        seed = np.frombuffer(problem.T_camera_map.translation.tobytes(), dtype=np.uint32)
        error = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance)
        pose = Pose.exp(error) @ problem.T_camera_map
        return MethodResult(pose, covariance, "ok", "Drawn from the bound.")


@dataclass(frozen=True)
class ReferenceOnFrame:
    """A reference for frames with given matches, which it does not use."""

    reference: TrueMatches | Bound

    @property
    def name(self) -> str:
        return self.reference.name

    @property
    def with_prior(self) -> bool:
        return self.reference.with_prior

    def solve(self, problem: MatchedProblem) -> MethodResult:
        return self.reference.solve(problem.problem)


METHODS: dict[str, Callable[[], Method]] = {
    **{name: partial(LocalizerMethod, name) for name in known_methods()},
    "true matches": TrueMatches,
    "bound": Bound,
}
MATCHED_METHODS: dict[str, Callable[[], MatchedMethod]] = {
    "true matches": lambda: ReferenceOnFrame(TrueMatches()),
    "true matches alone": lambda: ReferenceOnFrame(TrueMatches("true matches alone", False)),
    "bound": lambda: ReferenceOnFrame(Bound()),
    "bound alone": lambda: ReferenceOnFrame(Bound("bound alone", False)),
}
"""``alone``: without the prior."""
BOUNDS = ("bound", "bound alone")
"""Bounds, which are meaningless if the noise is not the stated one."""
