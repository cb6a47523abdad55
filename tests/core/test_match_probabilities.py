"""Correspondence probabilities: rows and columns sum to one, and say what the poses say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semviz_core.localization.match_probabilities import posterior_match, sinkhorn_with_dustbin

GAINS = st.tuples(st.integers(1, 6), st.integers(1, 9)).flatmap(
    lambda shape: arrays(
        np.float64, shape, elements=st.one_of(st.just(-np.inf), st.floats(-10.0, 25.0))
    )
)


@settings(max_examples=60, deadline=None)
@given(gain=GAINS)
def test_rows_and_columns_sum_to_one(gain: np.ndarray) -> None:
    probability = sinkhorn_with_dustbin(gain)
    np.testing.assert_allclose(probability[:-1].sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(probability[:, :-1].sum(axis=0), 1.0, atol=1e-9)
    assert probability.min() >= 0.0
    assert probability[-1, -1] == 0.0
    assert (probability[:-1, :-1][np.isneginf(gain)] == 0.0).all()


def test_a_sure_pair_is_sure_and_a_lone_one_goes_to_the_dustbin() -> None:
    probability = sinkhorn_with_dustbin(np.array([[15.0, -np.inf], [-np.inf, -8.0]]))
    assert probability[0, 0] > 0.99
    assert probability[1, 2] > 0.99
    assert probability[2, 1] > 0.99


def test_one_mapped_element_is_shared_by_two_observed_ones() -> None:
    probability = sinkhorn_with_dustbin(np.array([[12.0], [12.0]]))
    assert probability[0, 0] == pytest.approx(probability[1, 0])
    assert 0.45 < probability[0, 0] <= 0.5


def test_two_equal_poses_split_the_probability() -> None:
    gain = np.full((2, 1, 2), -np.inf)
    gain[0, 0, 0] = gain[1, 0, 1] = 12.0
    match = posterior_match(np.array([50.0, 50.0]), gain, np.ones((1, 2), dtype=bool))
    np.testing.assert_allclose(match.probability[0, :2], 0.5, atol=0.01)
    np.testing.assert_allclose(match.probability[:-1].sum(axis=1), 1.0)
    assert match.order.tolist() == [[0, 0], [0, 1]]


def test_cost_is_infinite_exactly_where_classes_differ() -> None:
    gain = np.array([[[5.0, -np.inf, -np.inf]]])
    match = posterior_match(np.zeros(1), gain, np.array([[True, True, False]]))
    assert np.isfinite(match.cost[0, :2]).all()
    assert match.cost[0, 0] == pytest.approx(-5.0)
    assert match.cost[0, 1] > 0.0
    assert np.isinf(match.cost[0, 2])
