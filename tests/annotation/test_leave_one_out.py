"""Each label against the others of its element."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.street_labels import careful, label_street

from semviz_annotation.labels.labels import Labels, Observation, new_id
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.placement.observations import (
    ObservationArray,
    ViewArray,
    collect_observations,
)
from semviz_annotation.mapping.placement.reprojection import residuals
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_annotation.mapping.quality.check import delete_each, leave_one_out, mapping_accuracy
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.semantic_map import Provenance
from semviz_core.simulation.street import Street

CLICK_PX = 5.0
SQUARES = PlaceOptions(outlier_sigmas=np.inf)


street = cache(Street)


@cache
def labelled(seed: int, sigma_px: float = 0.5) -> Labels:
    """By a careful person, in every third frame of a street."""
    see = careful(street(seed), sigma_px, seed)
    return label_street(see, range(0, 60, 3), memory=1000).labels


def alone(observations: ObservationArray, row: int) -> ObservationArray:
    """One observation of its landmark, which alone is left."""
    return observations.where(np.arange(len(observations)) == row)


@pytest.mark.parametrize("options", [SQUARES, PlaceOptions()], ids=["squares", "robust"])
def test_leaving_out_is_placing_without(options):
    """The linear step against really placing the landmark again from all other views."""
    views, observations, _, _ = collect_observations(labelled(1), street(1))
    placed = triangulate_landmarks(views, observations, options)
    quick = delete_each(views, observations, placed.anchor_m, placed.end_m, options)
    rng = np.random.default_rng(0)
    enough = np.flatnonzero(
        (observations.seen >= 6)[observations.landmark] & np.isfinite(quick.normalized)
    )
    off = []
    for row in rng.choice(enough, 60, replace=False):
        kept = observations.where(np.arange(len(observations)) != row)
        only = np.arange(observations.count) == observations.landmark[row]
        again = triangulate_landmarks(views, kept.only(only), options)
        if not again.ok[0]:
            continue
        result = alone(observations, row).only(only)
        at = residuals(views, result, again.anchor_m, np.nan_to_num(again.end_m))
        squares = at.error_px[0] ** 2
        ends = (squares[0] + squares[2], squares[1] + squares[3])
        px = np.sqrt(max(ends) if result.is_line[0] else squares[:2].sum())
        off.append(quick.residual_px[row] - px)
    assert len(off) > 50
    assert np.median(np.abs(off)) < 0.01
    assert np.max(np.abs(off)) < 0.3


def planted(observations: ObservationArray, row: int, rng: np.random.Generator) -> ObservationArray:
    """With one click 5 px off: anywhere, but across a pole at an end that is hidden, since where
    on the line that is means nothing."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    by = CLICK_PX * np.array([np.cos(angle), np.sin(angle)])
    at_end = observations.is_line[row] and rng.random() < 0.5
    known = observations.end_known if at_end else observations.anchor_known
    if not known[row]:
        u, v = observations.end_px[row] - observations.anchor_px[row]
        by = CLICK_PX * np.array([-v, u]) / np.hypot(u, v)
    name = "end_px" if at_end else "anchor_px"
    pixels = getattr(observations, name).copy()
    pixels[row] += by
    return replace(observations, **{name: pixels})


def normalized(views: ViewArray, observations: ObservationArray) -> np.ndarray:
    """(k,), 0 where the others say nothing."""
    placed = triangulate_landmarks(views, observations, PlaceOptions())
    deleted = delete_each(views, observations, placed.anchor_m, placed.end_m, PlaceOptions())
    return np.nan_to_num(deleted.normalized)


def test_a_wrong_click_comes_first():
    """200 clicks 5 px off, each among about 600 good ones (0.5 px); the other landmarks stay."""
    first = []
    for seed in (1, 2):
        views, observations, _, _ = collect_observations(labelled(seed), street(seed))
        rng = np.random.default_rng(seed)
        good = normalized(views, observations)
        for row in rng.choice(np.flatnonzero(good), 100, replace=False):
            landmark = np.arange(observations.count) == observations.landmark[row]
            mine = np.flatnonzero(landmark[observations.landmark])
            wrong = normalized(views, planted(observations, row, rng).only(landmark))
            others = np.delete(good, mine).max()
            first.append(mine[wrong.argmax()] == row and wrong.max() > others)
    assert np.mean(first) >= 0.99


def test_a_wrong_click_comes_first_of_all_labels():
    """The same from labels to the list that people read."""
    labels = labelled(2)
    semantic_map, _ = build_map(labels, street(2))
    for row in list(labels.observations.values())[100:500:150]:
        u, v = row.anchor_px
        wrong = labels_with(labels, replace(row, anchor_px=(u + CLICK_PX, v)))
        worst = leave_one_out(semantic_map, wrong, street(2))[0]
        assert worst.observation_id == row.id
        assert 3.0 < worst.residual_px < 7.0


def test_good_clicks_are_no_news():
    """Errors of 1 px, as told: their normalized residuals are those of normal numbers."""
    labels = labelled(2, 1.0)
    found = leave_one_out(build_map(labels, street(2))[0], labels, street(2))
    values = np.array([residual.normalized for residual in found])
    assert abs(values.mean()) < 0.15
    assert 0.8 < values.std() < 1.2
    assert (np.diff(values) <= 0.0).all()


def test_what_is_said_of_a_label(world):
    labels = world.labels()
    semantic_map, _ = build_map(labels, world)
    row = next(
        observation for observation in labels.observations.values() if observation.end_px is None
    )
    moved = replace(row, anchor_px=(row.anchor_px[0] + 3.0, row.anchor_px[1] - 4.0))
    labels = labels_with(labels, moved)
    worst = leave_one_out(semantic_map, labels, world)[0]
    assert (worst.observation_id, worst.frame_index, worst.side) == (
        row.id, row.frame_index, row.side
    )  # fmt: skip
    assert worst.element_id == labels.element(row.element_id).number
    assert worst.residual_px == pytest.approx(5.0, abs=0.1)
    other = [index for index in labels.frames if index != row.frame_index]
    rest = leave_one_out(semantic_map, labels, world, other)
    assert row.frame_index not in {observation.frame_index for observation in rest}
    assert rest[0].residual_px < 1e-3


def test_an_end_that_is_seen_once_tells_nothing(world):
    """Shown by one image alone, a bottom has nothing to be compared with."""
    labels = world.labels()
    semantic_map, _ = build_map(labels, world)
    poles = [
        observation
        for observation in labels.observations.values()
        if observation.end_px is not None
    ]
    for row in poles:
        labels = labels_with(labels, replace(row, end_known=row.id == poles[0].id))
    longer = replace(poles[0], end_px=tuple(np.multiply(poles[0].end_px, (1.0, 1.01)).tolist()))
    assert leave_one_out(semantic_map, labels_with(labels, longer), world)[0].residual_px < 1.0


def test_too_few_labels_say_nothing(world):
    semantic_map, _ = build_map(world.labels(), world)
    assert leave_one_out(semantic_map, world.labels(), world) == ()  # other ids: not its labels
    labels = world.labels()
    semantic_map, _ = build_map(labels, world)
    assert leave_one_out(semantic_map, labels, world, [0]) == ()
    assert leave_one_out(replace(semantic_map, provenance=()), labels, world) == ()


def test_parts_of_one_label_element_are_told_apart(world):
    """Two landmarks were given one name, in other frames; the map was built with them split."""
    labels = world.labels(sigma_px=0.2)
    numbers = {element.id: element.number for element in labels.elements.values()}
    joined = next(name for name, number in numbers.items() if number == 3)
    other = next(name for name, number in numbers.items() if number == 4)
    parts = [row for row in labels.of_element(joined) if row.frame_index < 2]
    rest = [row for row in labels.of_element(other) if row.frame_index >= 2]
    mixed = Labels.from_rows(
        [
            *(element for element in labels.elements.values() if element.id != other),
            *(row for row in labels.observations.values() if row.element_id not in (joined, other)),
            *parts,
            *(replace(row, element_id=joined) for row in rest),
        ]
    )
    built, _ = build_map(labels, world)
    provenance = [Provenance((joined,), tuple(row.id for row in rows)) for rows in (parts, rest)]
    split = replace(built, provenance=(*provenance, *built.provenance[2:]))
    found = leave_one_out(split, mixed, world)
    assert found[0].residual_px < 2.0
    assert {row.element_id for row in found} == {3, 4, 7, 9}
    assert mapping_accuracy(split, mixed, world).classes["pole"].lateral_rmse_px < 1.0
    assert [3 in observe(mixed, frame, "left", split)[1] for frame in (0, 3)] == [True, False]
    assert [4 in observe(mixed, frame, "left", split)[1] for frame in (0, 3)] == [False, True]
    joins = replace(split, provenance=(Provenance((joined,), provenance[0].observation_ids),
                                       Provenance((new_id(),), provenance[1].observation_ids),
                                       *built.provenance[2:]))  # fmt: skip
    assert leave_one_out(joins, mixed, world) == found  # a part that went to another element
    unknown = replace(split, provenance=(Provenance((joined,)), Provenance((joined,)),
                                         *built.provenance[2:]))  # fmt: skip
    assert 4 not in {row.element_id for row in leave_one_out(unknown, mixed, world)}


def labels_with(labels: Labels, row: Observation) -> Labels:
    """With one observation replaced."""
    rows = {**labels.observations, row.id: row}
    return Labels.from_rows([*labels.elements.values(), *rows.values()])
