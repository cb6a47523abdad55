"""How far a followed mark is trusted: laws of growth, and the choice of views."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_annotation.assist.score import (
    MORE_VIEWS,
    growth,
    view_to_follow,
    views_beside,
)

AGAIN = 1.15
SIZES = st.lists(st.floats(5.0, 200.0), min_size=1, max_size=12)


@given(SIZES, st.floats(5.0, 400.0))
def test_growth_is_at_most_that_from_the_smallest_view_and_1_at_most_where_a_larger_one_is(
    sizes, now
) -> None:
    factor = growth(sizes, now, AGAIN)
    assert factor <= now / min(sizes) * (1.0 + 1e-9)
    if now <= min(sizes):
        assert factor <= 1.0


@given(st.lists(st.floats(1.0, AGAIN - 0.001), min_size=1, max_size=40))
def test_nobody_can_get_far_without_looking(steps) -> None:
    """A label that is accepted unseen has not grown by AGAIN since the last look."""
    sizes, since_look = [10.0], 10.0
    for step in steps:
        now = sizes[-1] * step
        if growth(sizes, now, AGAIN) < AGAIN:  # accepted unseen
            assert now / since_look < AGAIN * (1.0 + 1e-9)
        else:
            since_look = now
        sizes.append(now)


def test_behind_the_camera_nothing_is_sure() -> None:
    assert growth([10.0], 0.0, AGAIN) == np.inf
    assert growth([], 10.0, AGAIN) == np.inf


def test_larger_views_come_first_then_near_ones_then_the_same_camera() -> None:
    sizes = np.array([10.0, 10.0, 14.0, 14.0, 40.0])
    moments = np.array([1, 1, 3, 3, 2])
    other = np.array([True, False, True, False, False])
    assert view_to_follow(sizes, moments, other, now=12.0) == 3
    assert view_to_follow(sizes, moments, other, now=90.0) == 1
    assert views_beside(moments, [3]) == [0, 1, 4, 2]
    assert len(views_beside(np.arange(20), [])) == MORE_VIEWS


@pytest.mark.parametrize("now", [10.0, 11.4])
def test_one_look_serves_until_it_has_grown(now) -> None:
    assert growth([10.0, 10.9], now, AGAIN) == pytest.approx(now / 10.0)
