"""The pose of weighted PnPL with the prior: its optimum, and the gradient by the weights."""

import numpy as np
import pytest
import torch

from semviz_core.base.pose import Pose
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import Difficulty, LocalizationProblem, make_problem
from semviz_core.research.pair_matcher.training import PosePairs, pose_of_weights

STEP = 1e-3
"""Of weights, in central differences of fourth order."""


PRECISE = Difficulty(sigma_px=0.2, hidden_bottoms=0.0, map_view_sigma_m=0.01, map_sigma_m=0.01)


def problems(number: int, level: Difficulty | None = None) -> list[LocalizationProblem]:
    made = (make_problem(seed, level or Difficulty(noise="paper")) for seed in range(100))
    return [one for one in made if len(one.pairs) >= 3][:number]


def layer(problem: LocalizationProblem) -> PosePairs:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
    return PosePairs.of(scene, PriorRecord.of(problem.prior), problem.pairs, problem.T_camera_map)


def loss(pairs: PosePairs, weight: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    rotation, translation, ok = pose_of_weights(weight, pairs)
    assert ok
    return (by * torch.cat([rotation.flatten(), translation])).sum()


def finite_differences(pairs: PosePairs, weight: torch.Tensor, by: torch.Tensor) -> list[float]:
    def at(k: int, shift: float) -> float:
        moved = weight.clone()
        moved[k] += shift
        return float(loss(pairs, moved, by))

    return [
        (8.0 * (at(k, STEP) - at(k, -STEP)) - at(k, 2 * STEP) + at(k, -2 * STEP)) / (12 * STEP)
        for k in range(len(weight))
    ]


def test_the_gradient_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for problem in problems(12):
        pairs = layer(problem)
        weight = torch.tensor(rng.uniform(0.3, 1.0, len(pairs.pairs)), requires_grad=True)
        by = torch.tensor(rng.normal(size=12))
        loss(pairs, weight, by).backward()  # type: ignore[no-untyped-call]
        assert weight.grad is not None

        slopes = finite_differences(pairs, weight.detach(), by)
        off = np.abs(weight.grad.numpy() - slopes) / np.abs(slopes).max()
        errors += off.tolist()
        # planted: Gauss-Newton's matrix or a clipped column would fail the limit below
        assert np.abs(0.99 * weight.grad.numpy() - slopes).max() / np.abs(slopes).max() > 1e-3
    assert np.median(errors) < 1e-6
    assert np.max(errors) < 1e-3


def test_its_optimum_is_near_that_of_the_solver() -> None:
    off = []
    for problem in problems(8, PRECISE):
        pairs = layer(problem)
        found = pairs.optimum(np.ones(len(pairs.pairs)))
        assert found is not None
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
        best = fit_pairs(scene, problem.prior, problem.T_camera_map, problem.pairs).T_camera_map
        off.append(pose_error(Pose(found[0], found[1]), best)[0])
        assert np.abs(pairs.slope(np.ones(len(pairs.pairs)), *found[:2])).max() < 1e-4
    assert np.median(off) < 0.1  # whose loss is robust


def test_without_weight_the_prior_alone_fixes_the_place() -> None:
    problem = problems(1)[0]
    pairs = layer(problem)
    assert pairs.optimum(np.zeros(len(pairs.pairs))) is None  # no heading: nothing fixes it
    weight = torch.zeros(len(pairs.pairs), dtype=torch.float64, requires_grad=True)
    rotation, translation, ok = pose_of_weights(weight, pairs)
    assert not ok
    (rotation.sum() + translation.sum()).backward()  # type: ignore[no-untyped-call]
    assert weight.grad is not None
    assert (weight.grad == 0.0).all()
    assert translation.detach().numpy() == pytest.approx(pairs.start.translation)
