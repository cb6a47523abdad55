"""Start poses and weighted PnPL as a layer: optimum, exact gradient, and what has none."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from semviz_core.base.pose import Pose
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.localization.matched.matches import Matches
from semviz_core.localization.matched.p3p_ransac import Objective, paper_pnpl
from semviz_core.research.evaluation.problems import LocalizationProblem, make_problem
from semviz_core.research.paper.matcher_torch import sinkhorn
from semviz_core.research.paper.training import (
    StartPoses,
    correspondence_loss,
    differentiable_pnpl,
    pose_loss,
    start_poses,
    whole_loss,
)
from semviz_core.research.training.batch import Batch

FRAMES = 3
LEAST_PAIRS = 7


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Matrices are small: more threads only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@cache
def problems() -> list[LocalizationProblem]:
    """Frames with many true pairs."""
    found = (make_problem(seed) for seed in range(200))
    some = (sample for sample in found if len(sample.pairs) >= LEAST_PAIRS and sample.is_valid)
    return [sample for sample, _ in zip(some, range(FRAMES), strict=False)]


@cache
def batch() -> Batch:
    def sample(of: LocalizationProblem) -> Sample:
        plain = Sample.of(of.observed, of.submap, of.camera, of.prior)
        return plain.with_truth(of.T_camera_map, of.pairs)

    return Batch.of([sample(problem) for problem in problems()])


def mostly_true() -> Tensor:
    """(b, m, n) a P that is sure of the true pairs, and spread thinly over others of the class."""
    truth = batch().truth
    assert truth is not None
    some = torch.from_numpy(np.random.default_rng(0).random(truth.pairs.shape))
    return torch.where(truth.pairs, 0.5 + 0.4 * some, 1e-4 * some) * batch().same_class


def near_truth() -> StartPoses:
    truth = batch().truth
    assert truth is not None
    off = Pose.exp([0.2, -0.1, 0.3, 0.004, -0.01, 0.006])
    rotation, translation = truth.rotation.numpy(), truth.translation.numpy()
    turned = translation @ off.rotation.T + off.translation
    return StartPoses(off.rotation @ rotation, turned, np.ones(len(rotation), dtype=bool))


def loss_of(P: Tensor, start: StartPoses) -> Tensor:
    truth = batch().truth
    assert truth is not None
    rotation, translation, ok = differentiable_pnpl(P, batch(), start)
    loss = pose_loss(rotation, translation, truth.rotation, truth.translation)
    return torch.where(ok, loss, 0.0)


def test_the_optimum_is_that_of_the_paper_s_pnpl() -> None:
    P, start = mostly_true(), near_truth()
    rotation, translation, ok = (
        tensor.numpy() for tensor in differentiable_pnpl(P, batch(), start)
    )
    assert ok.all()
    for k, problem in enumerate(problems()):
        pairs = np.argwhere(P[k].numpy() > 0.0)
        matches = Matches.checked(
            problem.observed, problem.submap, problem.camera, pairs, P[k].numpy()[tuple(pairs.T)]
        )
        to_local = Pose(np.eye(3), problem.prior.position_m).inverse()
        found = Pose(rotation[k], translation[k])
        expected = paper_pnpl(
            matches, matches.score, Pose(start.rotation[k], start.translation[k]) @ to_local
        )
        off = found @ to_local @ expected.T_camera_map.inverse()
        assert np.abs(off.log()).max() < 2e-5  # where L-BFGS stops; float32 rays
        objective = Objective.of(matches, matches.score, problem.prior.position_m)
        cost, _ = objective(np.append(found.log()[3:], found.translation))
        assert cost < expected.cost + 1e-9


def test_gradient_is_that_of_the_optimum_solved_anew() -> None:
    """Against finite differences, in float64: relative error below 1e-5."""
    start, P = near_truth(), mostly_true().requires_grad_()
    loss_of(P, start).sum().backward()
    assert P.grad is not None
    rng, step = np.random.default_rng(1), 1e-6
    for k in range(FRAMES):
        every = np.argwhere(P[k].detach().numpy() > 0.0)
        for i, j in every[rng.choice(len(every), 12, replace=False)].tolist():
            losses = []
            for sign in (1.0, -1.0):
                moved = P.detach().clone()
                moved[k, i, j] += sign * step
                losses.append(float(loss_of(moved, start)[k]))
            slope = (losses[0] - losses[1]) / (2.0 * step)
            size = float(P.grad[k].abs().max())
            assert float(P.grad[k, i, j]) == pytest.approx(slope, rel=1e-5, abs=1e-5 * size)


def test_what_has_no_optimum_is_told_and_has_no_gradient() -> None:
    start, P = near_truth(), mostly_true()
    P[1] = 0.0
    P[2] = torch.where(torch.arange(P.shape[1])[:, None] < 2, P[2], 0.0)  # two elements fix nothing
    P.requires_grad_()
    rotation, _, ok = differentiable_pnpl(P, batch(), start)
    assert ok.tolist() == [True, False, False]
    np.testing.assert_array_equal(rotation[1].detach().numpy(), start.rotation[1])
    loss_of(P, start).sum().backward()
    assert P.grad is not None
    assert (P.grad[1:] == 0.0).all()
    assert P.grad[0].abs().max() > 0.0


@pytest.mark.parametrize("wrong", ["nan", "no start", "infinite"])
def test_bad_numbers_in_one_frame_stay_there(wrong: str) -> None:
    start, P = near_truth(), mostly_true()
    if wrong == "no start":
        start.ok[0] = False
    else:
        P[0, 0, 0] = torch.nan if wrong == "nan" else torch.inf
    P.requires_grad_()
    loss_of(P, start).sum().backward()
    assert P.grad is not None
    assert (P.grad[0] == 0.0).all()
    assert (P.grad[1:].abs().amax(dim=(1, 2)) > 0.0).all()


def test_whatever_costs_a_network_has_there_is_a_gradient() -> None:
    """All layers in turn; bench/paper_gradients.py does ten thousand batches of it."""
    truth, rng = batch().truth, np.random.default_rng(0)
    assert truth is not None
    for seed in range(20):
        noise = torch.from_numpy(rng.standard_normal(truth.pairs.shape)).abs()
        scale, gap = 10.0 ** rng.uniform(-2.0, 2.0), rng.uniform(0.0, 3.0)
        cost = (scale * noise + gap * ~truth.pairs).float().requires_grad_()
        possible = batch().same_class if seed % 2 else batch().possible
        P = sinkhorn(cost, possible)
        rotation, translation, ok = differentiable_pnpl(P, batch(), start_poses(P, batch(), seed))
        pose = pose_loss(rotation, translation, truth.rotation, truth.translation)
        matched = correspondence_loss(P, truth.pairs, possible)
        loss = whole_loss(matched, pose, ok, gamma=1.0)
        loss.backward()
        assert torch.isfinite(loss)
        assert cost.grad is not None
        assert torch.isfinite(cost.grad).all()
        assert (cost.grad[~possible] == 0.0).all()


def test_ransac_starts_near_the_truth_and_again_in_the_same_place() -> None:
    truth = batch().truth
    assert truth is not None
    start, again, other = (start_poses(mostly_true(), batch(), seed) for seed in (3, 3, 4))
    assert start.ok.all()
    off = np.linalg.norm(start.translation - truth.translation.numpy(), axis=1)
    assert np.median(off) < 2.0
    np.testing.assert_array_equal(start.translation, again.translation)
    assert not np.array_equal(start.translation, other.translation)


def test_a_frame_starts_as_it_would_alone() -> None:
    together = start_poses(mostly_true(), batch(), 5)
    problem = problems()[1]
    m, n = len(problem.observed), len(problem.submap)
    alone = Batch.of([Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)])
    start = start_poses(mostly_true()[1:2, :m, :n], alone, 6)
    np.testing.assert_array_equal(start.rotation[0], together.rotation[1])


def test_too_few_pairs_are_no_start() -> None:
    P = mostly_true()
    P[0, 1:] = 0.0
    start = start_poses(P, batch(), 0)
    assert start.ok.tolist() == [False, True, True]
    np.testing.assert_array_equal(start.rotation[0], np.eye(3))


def test_an_optimum_far_from_its_start_is_no_refinement() -> None:
    """A P of uniform priors has it there, however right the network is."""
    truth = batch().truth
    assert truth is not None
    cost = (3.0 * ~truth.pairs).double().requires_grad_()
    P = sinkhorn(cost, batch().same_class)
    rotation, _, ok = differentiable_pnpl(P, batch(), near_truth())
    assert not ok.any()
    np.testing.assert_array_equal(rotation.detach().numpy(), near_truth().rotation)
    loss_of(P, near_truth()).sum().backward()
    assert cost.grad is not None
    assert (cost.grad == 0.0).all()
