"""Optimal transport: totals of rows and columns, what the matrix scaling says, exact gradients."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from semviz_core.localization.match_probabilities import sinkhorn_with_dustbin
from semviz_core.research.paper import matcher_torch
from semviz_core.research.paper.matcher import uniform_transport
from semviz_core.research.paper.matcher_torch import sinkhorn, sinkhorn_with_dustbins


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Matrices are small: more threads only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def drawn(seed: int, *shape: int, scale: float = 1.0) -> Tensor:
    return scale * torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def everything(b: int, m: int, n: int) -> Tensor:
    return torch.ones(b, m, n, dtype=torch.bool)


def two_classes() -> Tensor:
    """Four seen and seven mapped elements of two classes, the last of each padded; and one item
    with a class that only one side has."""
    seen = torch.tensor([[0, 0, 1, -1], [0, 2, 2, 2]])
    mapped = torch.tensor([[0, 1, 1, 0, 0, 1, -2], [0, 0, 0, 1, 1, 1, 2]])
    return seen[:, :, None] == mapped[:, None, :]


@settings(max_examples=25, deadline=None)
@given(m=st.integers(1, 8), n=st.integers(1, 20), scale=st.floats(0.01, 30.0), seed=st.integers(0))
def test_rows_and_columns_of_eq_4_share_what_there_is(
    m: int, n: int, scale: float, seed: int
) -> None:
    P = sinkhorn(drawn(seed, 3, m, n, scale=scale).abs(), everything(3, m, n))
    torch.testing.assert_close(P.sum(dim=1), torch.full_like(P[:, 0], 1.0 / n))
    torch.testing.assert_close(
        P.sum(dim=2), torch.full_like(P[:, :, 0], 1.0 / m), rtol=0.02, atol=0
    )
    assert (P >= 0.0).all()


def test_classes_are_transports_of_their_own() -> None:
    cost, possible = drawn(1, 2, 4, 7).abs(), two_classes()
    P = sinkhorn(cost, possible)
    assert (P[~possible] == 0.0).all()
    for rows, columns in (([0, 1], [0, 3, 4]), ([2], [1, 2, 5])):
        alone = cost[0][rows][:, columns][None]
        expected = sinkhorn(alone, torch.ones_like(alone, dtype=torch.bool))[0]
        torch.testing.assert_close(P[0][rows][:, columns], expected)
    torch.testing.assert_close(P[1, 1:].sum(dim=1), torch.full((3,), 1.0 / 3.0).double())


def test_one_frame_alone_has_the_same_p() -> None:
    cost, possible = drawn(4, 2, 4, 7).abs().clamp_max(2.0), two_classes()
    P = sinkhorn(cost, possible)
    for k in range(2):
        alone = uniform_transport(cost[k].numpy(), possible[k].numpy())
        np.testing.assert_allclose(P[k].numpy(), alone, atol=1e-9)


def test_order_does_not_matter() -> None:
    cost, row, column = drawn(2, 1, 4, 6).abs(), [2, 0, 3, 1], [5, 1, 0, 4, 2, 3]
    P = sinkhorn(cost, everything(1, 4, 6))
    turned = sinkhorn(cost[:, row][:, :, column], everything(1, 4, 6))
    torch.testing.assert_close(turned, P[:, row][:, :, column])


def test_of_low_entropy_only_the_cheapest_pairs_are_left() -> None:
    cost = 5.0 - 5.0 * torch.eye(4, dtype=torch.float64)[None]
    torch.testing.assert_close(sinkhorn(cost, everything(1, 4, 4)), torch.eye(4)[None].double() / 4)


@settings(max_examples=25, deadline=None)
@given(m=st.integers(1, 6), n=st.integers(1, 9), seed=st.integers(0), least=st.floats(-8.0, 0.0))
def test_dustbins_take_what_the_matrix_scaling_gives_them(
    m: int, n: int, seed: int, least: float
) -> None:
    rng = np.random.default_rng(seed)
    score, possible = rng.uniform(least, 5.0, (m, n)), rng.random((m, n)) < 0.7
    seen_bin, mapped_bin = rng.normal(0.0, 1.0, m), rng.normal(0.0, 1.0, n)
    log_odds = np.where(possible, score - seen_bin[:, None] - mapped_bin, -np.inf)
    given_arrays: list[Any] = [score, seen_bin, mapped_bin, possible]
    found = sinkhorn_with_dustbins(*(torch.from_numpy(array)[None] for array in given_arrays))
    probability = found[0].exp().numpy()
    np.testing.assert_allclose(probability, sinkhorn_with_dustbin(log_odds), atol=3e-4)
    np.testing.assert_allclose(probability[:-1].sum(axis=1), 1.0, atol=1e-8)
    np.testing.assert_allclose(probability[:, :-1].sum(axis=0), 1.0, atol=1e-8)
    assert (probability[:-1, :-1][~possible] == 0.0).all()


def test_an_element_without_a_pair_is_in_its_dustbin_for_certain() -> None:
    score, possible = torch.zeros(2, 4, 7), two_classes()
    log_P = sinkhorn_with_dustbins(score, torch.ones(2, 4), torch.ones(2, 7), possible)
    assert log_P[0, 3, 7] == log_P[0, 4, 6] == 0.0
    assert log_P[0, 4, 7] == -torch.inf
    assert log_P.dtype == torch.float32


@pytest.fixture
def converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Further than it pays off, since finite differences need the digits."""
    monkeypatch.setattr(matcher_torch, "TOLERANCE", 1e-12)


@pytest.mark.usefixtures("converged")
@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_gradient_of_eq_3_is_exact(scale: float) -> None:
    """Against finite differences, in float64: relative error below 1e-5."""
    possible = two_classes()
    cost = drawn(3, 2, 4, 7, scale=scale).abs().requires_grad_()
    check = torch.autograd.gradcheck(
        lambda costs: sinkhorn(costs, possible), (cost,), eps=1e-5, atol=1e-7, rtol=1e-5
    )
    assert check


@pytest.mark.usefixtures("converged")
@pytest.mark.parametrize("scale", [0.3, 3.0, 10.0])
def test_gradient_with_dustbins_is_exact(scale: float) -> None:
    possible = two_classes()
    inputs = [drawn(k, *shape, scale=scale) for k, shape in enumerate(((2, 4, 7), (2, 4), (2, 7)))]

    def kept(*given_tensors: Tensor) -> Tensor:
        log_P = sinkhorn_with_dustbins(*given_tensors, possible)
        return log_P[torch.isfinite(log_P)]

    inputs = [input_.requires_grad_() for input_ in inputs]
    assert torch.autograd.gradcheck(kept, inputs, eps=1e-5, atol=1e-7, rtol=1e-5)


def test_no_gradient_comes_from_pairs_that_are_out_of_reach() -> None:
    possible = two_classes()
    cost = drawn(5, 2, 4, 7).abs().requires_grad_()
    (sinkhorn(cost, possible) ** 2).sum().backward()
    assert cost.grad is not None
    assert (cost.grad[~possible] == 0.0).all()
    assert torch.isfinite(cost.grad).all()
    score = drawn(6, 2, 4, 7).requires_grad_()
    log_P = sinkhorn_with_dustbins(score, torch.zeros(2, 4), torch.zeros(2, 7), possible)
    torch.where(possible, log_P[:, :4, :7], 0.0).sum().backward()
    assert score.grad is not None
    assert (score.grad[~possible] == 0.0).all()
    assert torch.isfinite(score.grad).all()


def test_very_sure_and_very_large_numbers_stay_numbers() -> None:
    for scale in (1e-6, 1e3, 1e6):
        cost = drawn(7, 4, 6, 15, scale=scale).abs().requires_grad_()
        P = sinkhorn(cost, everything(4, 6, 15))
        (P**2).sum().backward()
        assert cost.grad is not None
        assert torch.isfinite(P).all()
        assert torch.isfinite(cost.grad).all()
