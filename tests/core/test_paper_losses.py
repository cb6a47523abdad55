"""The paper's losses: values that are known, and gradients that are numbers everywhere."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from semviz_core.base.pose import angle_between, so3_exp
from semviz_core.research.paper.training import correspondence_loss, pose_loss, whole_loss

ANGLES = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3)


def rotation(*rotvecs: list[float]) -> Tensor:
    return torch.from_numpy(np.stack([so3_exp(np.array(rotvec)) for rotvec in rotvecs]))


def test_it_is_eq_9_where_all_are_pairs() -> None:
    P = torch.from_numpy(np.random.default_rng(0).dirichlet(np.ones(16)).reshape(1, 4, 4))
    pairs = torch.eye(4, dtype=torch.bool)[None]
    as_written = ((1.0 - 2.0 * pairs.double()) * P).sum()
    found = correspondence_loss(P, pairs, torch.ones_like(pairs))
    assert float(found) == pytest.approx(float(as_written))


def test_all_that_uniform_priors_allow_is_the_best_in_every_block() -> None:
    possible = torch.zeros(1, 3, 6, dtype=torch.bool)
    possible[0, :2, :5] = possible[0, 2, 5] = True
    pairs = torch.zeros_like(possible)
    pairs[0, 0, 3] = pairs[0, 1, 0] = pairs[0, 2, 5] = True
    P = torch.where(pairs, torch.tensor([0.2, 0.2, 1.0])[:, None], 0.0)
    assert float(correspondence_loss(P, pairs, possible)) == pytest.approx(-1.0)
    assert float(correspondence_loss(torch.zeros_like(P), pairs, possible)) == 1.0


@settings(max_examples=40, deadline=None)
@given(first=ANGLES, other=ANGLES)
def test_pose_loss_is_angle_plus_distance(first: list[float], other: list[float]) -> None:
    moved = torch.tensor([[3.0, 4.0, 0.0]], dtype=torch.float64)
    found = pose_loss(rotation(first), moved, rotation(other), torch.zeros_like(moved))
    angle = angle_between(so3_exp(np.array(first)), so3_exp(np.array(other)))
    assert float(found) == pytest.approx(5.0 + angle, abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi])
def test_gradients_are_numbers_at_every_angle(angle: float) -> None:
    R, t = rotation([0.0, angle, 0.0]).requires_grad_(), torch.zeros(1, 3).requires_grad_()
    pose_loss(R, t, rotation([0.0, 0.0, 0.0]), torch.zeros(1, 3)).sum().backward()
    assert R.grad is not None
    assert t.grad is not None
    assert torch.isfinite(R.grad).all()
    assert R.grad.abs().max() < 10.0
    assert torch.isfinite(t.grad).all()


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 0.5, 3.0])
def test_the_angle_grows_as_the_rotation_turns_on(angle: float) -> None:
    turn = torch.tensor([angle], dtype=torch.float64, requires_grad=True)
    zero, like = torch.zeros_like(turn), torch.ones_like(turn)
    rows = [torch.cos(turn), -torch.sin(turn), zero, torch.sin(turn), torch.cos(turn), zero]
    R = torch.stack([*rows, zero, zero, like]).reshape(1, 3, 3)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    pose_loss(R, origin, rotation([0.0, 0.0, 0.0]), origin).sum().backward()
    assert turn.grad is not None
    assert float(turn.grad) == pytest.approx(1.0, abs=1e-5)


def test_failed_poses_add_nothing() -> None:
    pose = torch.tensor([2.0, torch.nan], requires_grad=True)
    ok = torch.tensor([True, False])
    loss = whole_loss(torch.tensor([0.5, 0.1]), pose, ok, 1.0)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(1.3)
    assert pose.grad is not None
    assert pose.grad.tolist() == [0.5, 0.0]
