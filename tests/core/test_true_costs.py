"""The paper's pipeline with right costs: as much of P on true pairs as its priors allow."""

import numpy as np
import pytest

from semviz_core.research.evaluation.problems import PAPER_20M, default_road, valid_problems
from semviz_core.research.paper.true_costs import PaperWithTrueCosts, TrueCosts


def test_true_pairs_get_the_most_that_uniform_priors_allow() -> None:
    """The smaller of a row's and a column's share, which is less than all of P."""
    coming = valid_problems([default_road()], PAPER_20M, 0)
    masses = []
    for problem in (next(coming) for _ in range(10)):
        frame = problem.observed, problem.submap, problem.camera, problem.prior
        soft = TrueCosts(problem.pairs).match(*frame)
        P, pairs = soft.probability, problem.pairs
        seen, mapped = soft.possible.sum(axis=0), soft.possible.sum(axis=1)
        most = np.minimum(1.0 / seen[pairs[:, 1]], 1.0 / mapped[pairs[:, 0]])
        once = np.bincount(pairs[:, 0])[pairs[:, 0]] == 1  # of duplicates, one suffices
        assert P[tuple(pairs[once].T)] == pytest.approx(most[once], rel=0.01)
        masses.append(P[tuple(pairs.T)].sum() / P.sum())
    assert 0.3 < np.mean(masses) < 0.9


def test_it_answers_as_the_papers_method_does() -> None:
    coming = valid_problems([default_road()], PAPER_20M, 0)
    results = [PaperWithTrueCosts().solve(next(coming)) for _ in range(10)]
    answered = [result for result in results if result.T_camera_map is not None]
    assert answered
    assert all(list(result.time_ms) == ["match", "search", "refine"] for result in answered)
