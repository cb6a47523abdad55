"""Problems with given matches, most of them wrong: the input of a solver behind a matcher."""

from dataclasses import dataclass

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.research.evaluation import problems
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
