"""Labels that several landmarks explain: pairs that are wrong alike, and what stands in one
line."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.labels.edits import DecideElements
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, new_id
from semviz_annotation.labels.rows import Rules, review_decision
from semviz_annotation.mapping.association import tracks
from semviz_annotation.mapping.build import BuildOptions, build_map

NEAR, BEHIND = np.array([30.9, -4.7, 2.6]), np.array([40.8, -5.3, 2.9])
MACHINE = BuildOptions(sigma_px=1.3, min_frames=2)


def relabelled(
    labels: Labels, name: Callable[[int, Observation], int | None], new: tuple[int, ...]
) -> Labels:
    """Under the numbers that ``name`` gives each observation from its own; None leaves it out."""
    elements = {element.number: element for element in labels.elements.values()}
    for number in new:
        elements[number] = LabelElement(new_id(), number, elements[1].class_id)
    rows = []
    for row in labels.observations.values():
        number = name(labels.element(row.element_id).number, row)
        if number is not None:
            rows.append(replace(row, element_id=elements[number].id))
    named = {row.element_id for row in rows}
    return Labels.from_rows(
        [*(element for element in elements.values() if element.id in named), *rows]
    )


def wrong_pairs(world) -> Labels:
    """In frames 0 and 1, the left image's sight of 1 and the right one's of 2 are called 10 and
    11, and nothing else is found."""

    def name(number: int, row: Observation) -> int | None:
        if row.frame_index > 1:
            return number
        return 10 + row.frame_index if (row.side == "left") == (number == 1) else None

    return relabelled(world.labels(sigma_px=0.5), name, (10, 11))


@pytest.fixture
def two(make_world):
    return make_world({1: (1, NEAR, None), 2: (1, BEHIND, None)}, count=6)


def test_pairs_that_are_wrong_alike_are_no_landmark(two, monkeypatch):
    labels = wrong_pairs(two)
    built, report = build_map(labels, two, MACHINE)
    assert list(built.elements.id) == [1, 2]
    assert np.allclose(built.elements.anchor_m, [NEAR, BEHIND], atol=0.5)
    assert report.used == len(labels.observations)
    splits = [decision for decision in built.decisions if decision.kind == "split"]
    assert [split.numbers for split in splits] == [(10,), (11,)]
    assert all("which is number 2" in split.reason for split in splits)
    for split in splits:
        (moved,) = split.observation_ids
        assert labels.observation(moved).side == "right"
        assert moved in built.provenance[1].observation_ids
    monkeypatch.setattr(tracks, "_resolve_shared", lambda tracks, options: tracks)
    assert len(build_map(labels, two, MACHINE)[0]) == 3


def test_what_people_keep_is_not_contested(two):
    labels = wrong_pairs(two)
    kept = tuple(
        review_decision(element.id, "keep")
        for element in labels.elements.values()
        if element.number >= 10
    )
    built, _ = build_map(
        labels.changed(DecideElements(kept).changes(labels, Rules())), two, MACHINE
    )
    assert list(built.elements.id) == [1, 2, 10]


def test_a_label_that_may_be_of_either_is_of_none(make_world):
    """In frame 0 one stands right behind the other, and one label is all that shows of them."""
    eye = np.array([0.0, 0.0, 1.65])
    hidden = eye + 1.4 * (NEAR - eye)
    world = make_world({1: (1, NEAR, None), 2: (1, hidden, None)}, count=6)

    def name(number: int, row: Observation) -> int | None:
        if row.frame_index == 0:
            return 10 if (number, row.side) == (1, "left") else None
        return number

    labels = relabelled(world.labels(sigma_px=0.5), name, (10,))
    built, _ = build_map(labels, world, MACHINE)
    (left_out,) = built.decisions
    assert (left_out.kind, left_out.numbers) == ("leave out", (10,))
    assert left_out.reason == "its labels are not clearly of one landmark"
    alone = relabelled(labels, lambda number, row: None if number == 2 else number, ())
    built, _ = build_map(alone, world, MACHINE)
    assert [decision.numbers for decision in built.decisions] == [(1, 10)]
