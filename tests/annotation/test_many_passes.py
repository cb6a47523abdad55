"""Drives that all pass one street: each costs the same however many there are."""

from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
import toy_city
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_city import CityDrive, Drift

from semviz_annotation.mapping.drives.alignment import align
from semviz_annotation.mapping.drives.corrections import Knots, PoseErrors
from semviz_annotation.mapping.drives.merge import Stack, numbered
from semviz_annotation.mapping.drives.regions import merge_elements
from semviz_annotation.mapping.drives.shift_votes import PARTNERS, compared
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray

WAY = np.column_stack([np.arange(200.0), np.zeros(200), np.full(200, 1.6)])


def passes(count: int, seed: int = 0) -> list[CityDrive]:
    truth = toy_city.city(1, seed)
    return [toy_city.drive(truth, WAY, Drift(0.3), seed + number) for number in range(count)]


def maps_of(drives: list[CityDrive]) -> list[SemanticMap]:
    return [one.semantic_map for one in drives]


def true_rows(drives: list[CityDrive]) -> IntArray:
    return np.concatenate([one.true_row for one in drives])


def compared_maps(maps: list[SemanticMap]) -> set[frozenset[str]]:
    """Return the digests of each two maps that are compared."""
    stack = Stack.of(maps)
    places = stack.places(stack.ends_m)
    rows = zip(places.drive.tolist(), stack.drive.tolist(), strict=True)
    digest = {place: maps[drive].digest for place, drive in rows}
    return {frozenset(digest[each] for each in both) for both in compared(places).tolist()}


def test_a_drive_is_compared_with_as_many_however_many_pass() -> None:
    few, many, most = (len(compared_maps(maps_of(passes(n)))) / n for n in (5, 40, 160))
    assert few == 2.0, "few drives are all compared with each other"
    assert most < 1.1 * many


def test_corrections_take_as_many_steps_however_many_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps = []
    solve = scipy.sparse.linalg.cg

    def counted(*args: Any, **options: Any) -> Any:
        return solve(*args, **options, callback=lambda c: steps.append(len(c)))

    monkeypatch.setattr(scipy.sparse.linalg, "cg", counted)
    for count in (10, 80):
        steps.clear()
        merge_elements(maps_of(passes(count)))
        assert len(steps) < 320, f"{count} drives, 16 systems"


def test_many_passes_map_each_landmark_once() -> None:
    drives = passes(60)
    merging, true_row = merge_elements(maps_of(drives)), true_rows(drives)
    row, landmark = np.unique(np.stack([true_row, merging.landmark])[:, true_row >= 0], axis=1)
    assert np.bincount(row).max() == 1, "landmarks that stand in the map twice"
    assert np.bincount(landmark).max() == 1, "landmarks of the map that are two"


def test_what_is_compared_does_not_follow_from_the_order_of_drives() -> None:
    drives = passes(4 * PARTNERS)
    order = np.random.default_rng(1).permutation(len(drives))
    mixed = [drives[number] for number in order]
    assert compared_maps(maps_of(drives)) == compared_maps(maps_of(mixed))
    merging, other = merge_elements(maps_of(drives)), merge_elements(maps_of(mixed))
    starts = np.cumsum([0] + [len(one.true_row) for one in drives])
    rows = np.concatenate([np.arange(starts[number], starts[number + 1]) for number in order])
    assert np.array_equal(numbered(merging.landmark[rows]), other.landmark)
    off_m = merging.alignment.ends_m[rows] - other.alignment.ends_m
    assert np.abs(off_m).max() < 1e-4


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 4), st.booleans())
def test_corrections_are_those_of_least_squares_over_landmarks_too(
    seed: int, count: int, stays: bool
) -> None:
    drives = passes(count, seed)
    stack, knots, true_row = (
        Stack.of(maps_of(drives)),
        Knots.along(maps_of(drives)),
        true_rows(drives),
    )
    own = true_row.max() + 1 + np.arange(len(true_row))
    landmark = numbered(np.where(true_row >= 0, true_row, own))
    information = stack.information(np.full(len(own), 0.1))
    model = knots.model(stack.ends_m, stack.drive, PoseErrors(), (0,) if stays else ())

    unknowns = [model.design.toarray(), -np.kron(np.eye(landmark.max() + 1)[landmark], np.eye(6))]
    pull = np.hstack(unknowns).T @ scipy.sparse.block_diag(information).toarray()
    normal = pull @ np.hstack(unknowns) + 1e-9 * np.eye(len(pull))  # ends of signs are free
    normal[: 4 * len(knots), : 4 * len(knots)] += model.prior.toarray()
    best = np.linalg.solve(normal, -pull @ np.nan_to_num(stack.ends_m).ravel())[: 4 * len(knots)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("semviz_annotation.mapping.drives.alignment._CAUCHY", np.inf)
        found = align(stack.ends_m, information, model, landmark).correction.ravel()
    assert np.abs(found - best).max() < 1e-4
