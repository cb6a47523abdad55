"""How two people's labels agree: laws of distances, pairs and means, and planted disagreements."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_annotation.labels.agreement import (
    MATCH_PX,
    agreement_in,
    distance,
    mean_label,
    pairs_in,
)
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import LabelElement, Observation, new_id

POLE, TRIANGLE, RECTANGLE = 0, 1, 2
coordinates = st.floats(0.0, 400.0, allow_subnormal=False)
shifts = st.floats(-8.0, 8.0, allow_subnormal=False)


@st.composite
def poles(draw: st.DrawFn) -> Observation:
    """An upright pole of some length, with ends that may be hidden."""
    u, v = draw(coordinates), draw(coordinates)
    end = (u + draw(shifts), v + draw(st.floats(40.0, 300.0)))
    known = draw(st.booleans()), draw(st.booleans())
    return Observation(new_id(), new_id(), 0, "left", (u, v), end, *known)


@st.composite
def signs(draw: st.DrawFn) -> Observation:
    anchor = draw(coordinates), draw(coordinates)
    return Observation(new_id(), new_id(), 0, "left", anchor, None, True, False)


@st.composite
def twins(draw: st.DrawFn) -> tuple[Observation, Observation]:
    """One element as two people label it, a few pixels apart."""
    first = draw(poles() | signs())
    du, dv, tilt = draw(shifts), draw(shifts), draw(shifts)
    u, v = first.anchor_px
    second = replace(first, id=new_id(), element_id=new_id(), anchor_px=(u + du, v + dv))
    if first.end_px is not None:
        u, v = first.end_px
        second = replace(second, end_px=(u + du + tilt, v - dv))
    return first, second


def labels_of(*rows: Observation, class_id: int | None = None) -> Labels:
    elements = [
        LabelElement(
            row.element_id,
            number + 1,
            class_id if class_id is not None else POLE if row.end_px else TRIANGLE,
        )
        for number, row in enumerate(rows)
    ]
    return Labels().with_rows([*elements, *rows])


@settings(deadline=None)
@given(twins())
def test_distances_are_the_same_whoever_is_first(both: tuple[Observation, Observation]) -> None:
    first, second = both
    assert distance(first, second) == pytest.approx(distance(second, first), abs=1e-9)
    assert distance(first, first) == pytest.approx((0.0, 0.0), abs=1e-9)


@settings(deadline=None)
@given(twins())
def test_the_mean_is_half_way_between_both(both: tuple[Observation, Observation]) -> None:
    first, second = both
    mean, other = mean_label(first, second), mean_label(second, first)
    assert mean.anchor_px == pytest.approx(other.anchor_px, abs=1e-6)
    assert (mean.end_px or ()) == pytest.approx(other.end_px or (), abs=1e-6)
    assert mean_label(first, first).anchor_px == pytest.approx(first.anchor_px, abs=1e-6)
    apart = distance(first, second)
    for row in (first, second):
        near = distance(mean, row)
        assert near.px <= apart.px / 2.0 + 0.25  # exactly half where the middle of both is one
        assert near.angle_rad <= apart.angle_rad + 1e-9
    assert (mean.anchor_known, mean.end_known) == (first.anchor_known, first.end_known)


def test_a_pole_across_is_measured_at_the_middle_and_an_angle_between_the_lines() -> None:
    row = Observation(new_id(), new_id(), 0, "left", (100.0, 0.0), (100.0, 100.0), True, True)
    beside = replace(row, anchor_px=(103.0, 20.0), end_px=(103.0, 180.0))
    assert distance(row, beside) == pytest.approx((3.0, 0.0))
    turned = replace(row, anchor_px=(95.0, 0.0), end_px=(105.0, 100.0))
    found = distance(row, turned)
    assert found.px == pytest.approx(0.0, abs=1e-9)
    assert math.degrees(found.angle_rad) == pytest.approx(math.degrees(math.atan(0.1)))
    below = replace(row, anchor_px=(100.0, 150.0), end_px=(100.0, 200.0))
    assert distance(row, below).px == math.inf
    upside_down = replace(row, anchor_px=row.end_px or (0, 0), end_px=row.anchor_px)
    assert distance(row, upside_down) == pytest.approx((0.0, 0.0), abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(st.lists(twins(), max_size=5), st.lists(poles() | signs(), max_size=2))
def test_pairs_are_one_to_one_and_the_same_whoever_is_first(
    both: list[tuple[Observation, Observation]], alone: list[Observation]
) -> None:
    first = labels_of(*(row for row, _ in both), *alone)
    second = labels_of(*(row for _, row in both))
    here, there = agreement_in([0], first, second), agreement_in([0], second, first)
    for found, mine, theirs in ((here, first, second), (there, second, first)):
        assert len(found.both) + found.missed[1] == len(mine.elements)
        assert len(found.both) + found.missed[0] == len(theirs.elements)
    assert here.missed == there.missed[::-1]
    assert len(here.both) == len(there.both)
    total = sum(pair.worst_px for pair in here.both)
    assert total == pytest.approx(sum(pair.worst_px for pair in there.both), abs=1e-6)
    assert all(pair.worst_px <= MATCH_PX for pair in here.both)
    itself = agreement_in([0], first, first)
    assert itself.missed == (0, 0)
    assert itself.distances(True).sum() + itself.distances(False).sum() == pytest.approx(
        0, abs=1e-6
    )


def test_planted_disagreements_are_each_counted_once() -> None:
    sign = Observation(new_id(), new_id(), 0, "left", (50.0, 50.0), None, True, False)
    pole = Observation(new_id(), new_id(), 0, "left", (200.0, 10.0), (200.0, 90.0), True, True)
    missed = replace(sign, id=new_id(), element_id=new_id(), anchor_px=(300.0, 50.0))
    invented = replace(sign, id=new_id(), element_id=new_id(), anchor_px=(350.0, 50.0))
    hidden = replace(pole, id=new_id(), element_id=new_id(), end_known=False)
    first = labels_of(sign, pole, missed)
    other_class = labels_of(replace(sign, anchor_px=(52.0, 50.0)), class_id=RECTANGLE)
    second = Labels().with_rows(
        [
            *other_class.rows(),
            LabelElement(hidden.element_id, 7, POLE),
            LabelElement(invented.element_id, 8, TRIANGLE),
            hidden,
            invented,
        ]
    )
    found = agreement_in([0], first, second)
    assert (len(found.both), found.missed, found.class_disagreements) == (2, (1, 1), 1)
    assert sum(not view.same_ends for view in found.views) == 1
    assert found.distances(False)[:, 0] == pytest.approx([2.0])
    assert np.allclose(found.distances(True), 0.0)


def test_both_images_of_an_element_are_one_pair() -> None:
    left = Observation(new_id(), new_id(), 0, "left", (50.0, 50.0), None, True, False)
    right = replace(left, id=new_id(), side="right", anchor_px=(40.0, 50.0))
    other = replace(left, id=new_id(), element_id=new_id(), anchor_px=(51.0, 50.0))
    element = LabelElement(left.element_id, 1, TRIANGLE)
    first = Labels().with_rows([element, left, right])
    second = labels_of(other)
    (pair,) = pairs_in(0, first, second)
    assert [(view.side, view.first is None, view.second is None) for view in pair.views] == [
        ("left", False, False),
        ("right", False, True),
    ]
