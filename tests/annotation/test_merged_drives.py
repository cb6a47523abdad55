"""Maps of several drives become one, whatever the errors of their poses."""

from dataclasses import replace

import numpy as np
import pytest
import toy_city
from numpy.typing import ArrayLike
from toy_city import CityDrive, Drift

from semviz_annotation.mapping.drives import regions
from semviz_annotation.mapping.drives.corrections import Knots, PoseErrors
from semviz_annotation.mapping.drives.merge import DEFAULT_OPTIONS, MergeOptions, Merging
from semviz_annotation.mapping.drives.merged_map import merge_maps
from semviz_annotation.mapping.drives.regions import merge_elements
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError

BLOCKS = 2
OFF = Drift(0.4)
NOTHING = Elements3D.from_ends([], np.zeros((0, 3)), np.zeros((0, 3)), [])


@pytest.fixture(scope="module")
def truth() -> Elements3D:
    return toy_city.city(BLOCKS, 7)


@pytest.fixture(scope="module")
def drives(truth: Elements3D) -> list[CityDrive]:
    ways = [toy_city.random_way(BLOCKS, 400.0, seed) for seed in range(8)]
    return [toy_city.drive(truth, way, OFF, seed) for seed, way in enumerate(ways)]


@pytest.fixture(scope="module")
def maps(drives: list[CityDrive]) -> dict[str, SemanticMap]:
    return {f"drive {number}": one.semantic_map for number, one in enumerate(drives)}


@pytest.fixture(scope="module")
def merging(drives: list[CityDrive]) -> Merging:
    return merge_elements([one.semantic_map for one in drives])


@pytest.fixture(scope="module")
def true_row(drives: list[CityDrive]) -> IntArray:
    return np.concatenate([one.true_row for one in drives])


def off_m(merging: Merging, true_row: IntArray, truth: Elements3D, merged: bool) -> float:
    """Return the RMS distance, on the ground, of the elements of one landmark from their mean."""
    real = true_row >= 0
    at_m = (merging.alignment.ends_m if merged else merging.stack.ends_m)[real, :2]
    row = true_row[real]
    count = np.bincount(row, minlength=len(truth))
    middle = [np.bincount(row, at_m[:, axis], len(truth)) / np.maximum(count, 1) for axis in (0, 1)]
    off = (at_m - np.column_stack(middle)[row])[count[row] > 1]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def test_each_landmark_stands_in_the_map_once(merging: Merging, true_row: IntArray) -> None:
    real = true_row >= 0
    row, landmark = np.unique(np.stack([true_row, merging.landmark])[:, real], axis=1)
    assert (np.bincount(row) > 1).sum() <= 1, "landmarks that stand in the map twice"
    assert np.bincount(landmark).max() == 1, "landmarks of the map that are two"


def test_drives_are_moved_together(merging: Merging, true_row: IntArray, truth: Elements3D) -> None:
    assert off_m(merging, true_row, truth, merged=False) > 0.4
    assert off_m(merging, true_row, truth, merged=True) < 0.15


def test_a_row_of_posts_is_told_by_what_stands_around(monkeypatch: pytest.MonkeyPatch) -> None:
    """Posts 2.5 m apart, in drives 1.4 m apart: the nearest post is the wrong one."""
    along = np.array([0.0, 2.5, 5.0, 7.5, 12.5, 15.0, 17.5])
    top = np.column_stack([along, np.full(7, 5.0), np.full(7, 3.0)])
    posts = Elements3D.from_ends(np.arange(1, 8), top, top - [0.0, 0.0, 3.0], np.zeros(7, int))
    way = np.column_stack([np.linspace(-20.0, 30.0, 51), np.zeros(51), np.full(51, 1.6)])
    first = SemanticMap(posts, MapFrame("street"), trajectory_m=way)
    merging = merge_elements([first, moved(first, [1.4, 0.2, 0.0])])
    assert np.array_equal(merging.landmark[:7], merging.landmark[7:])
    monkeypatch.setattr("semviz_annotation.mapping.drives.shift_votes.STRETCH_M", 0.0)
    alone = merge_elements([first, moved(first, [1.4, 0.2, 0.0])])
    assert not np.array_equal(alone.landmark[:7], alone.landmark[7:])


def moved(semantic_map: SemanticMap, by_m: ArrayLike) -> SemanticMap:
    elements, by_m = semantic_map.elements, np.asarray(by_m)
    return replace(
        semantic_map,
        elements=replace(elements, anchor_m=elements.anchor_m + by_m, end_m=elements.end_m + by_m),
        trajectory_m=semantic_map.trajectory_m + by_m,
    )


def test_a_drive_that_is_only_shifted_is_put_back_exactly(drives: list[CityDrive]) -> None:
    first = drives[0].semantic_map
    elements = first.elements
    shifted = moved(first, [0.7, -0.4, 0.2])
    merged, report, _ = merge_maps(
        {"still": first, "shifted": shifted}, MergeOptions(PoseErrors(2.0), fixed=(0,))
    )
    assert len(merged) == len(first)
    assert np.array_equal(merged.elements.id, np.sort(elements.id))
    order = np.argsort(elements.id)
    assert np.abs(merged.elements.anchor_m - elements.anchor_m[order]).max() < 0.02
    assert report.drives[0].moved_m < 1e-4
    assert report.drives[1].moved_m == pytest.approx(np.hypot(0.7, 0.4), abs=0.02)


def test_the_order_of_drives_changes_numbers_alone(maps: dict[str, SemanticMap]) -> None:
    turned = dict(reversed(maps.items()))
    one, other = merge_maps(maps)[0], merge_maps(turned)[0]
    places = [np.sort(np.round(each.elements.anchor_m[:, 0], 5)) for each in (one, other)]
    assert len(one) == len(other)
    assert np.abs(places[0] - places[1]).max() < 1e-4
    again = merge_maps(maps)[0]
    assert again.digest == one.digest


def in_regions(
    monkeypatch: pytest.MonkeyPatch,
    region_m: float,
    border_m: float,
    maps: list[SemanticMap],
    options: MergeOptions = DEFAULT_OPTIONS,
) -> Merging:
    monkeypatch.setattr(regions, "REGION_M", region_m)
    monkeypatch.setattr(regions, "BORDER_M", border_m)
    return merge_elements(maps, options)


@pytest.mark.parametrize("region_m", [60.0, 90.0])
def test_regions_find_what_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch, drives: list[CityDrive], merging: Merging, region_m: float
) -> None:
    maps = [one.semantic_map for one in drives]
    parts = in_regions(monkeypatch, region_m, 150.0, maps)
    assert np.array_equal(parts.landmark, merging.landmark)
    for name in ("ends_m", "landmark_m", "correction"):
        off = getattr(parts.alignment, name) - getattr(merging.alignment, name)
        assert 0.0 < np.sqrt((off**2).mean()) < 0.02, name


def test_regions_that_disagree_lose_nothing_and_join_no_drive_with_itself(
    monkeypatch: pytest.MonkeyPatch, drives: list[CityDrive], merging: Merging
) -> None:
    maps = [one.semantic_map for one in drives]
    parts = in_regions(monkeypatch, 40.0, 2.0, maps)
    assert not np.array_equal(parts.landmark, merging.landmark), "the regions agree"
    both = np.stack([parts.landmark, parts.stack.drive])
    assert len(np.unique(both, axis=1).T) == len(both.T)
    assert len(parts.alignment.landmark_m) == parts.landmark.max() + 1
    off = parts.alignment.landmark_m[parts.landmark] - parts.alignment.ends_m
    assert np.abs(off[:, :2]).max() < 1.5


def test_a_drive_that_stays_does_so_in_all_regions(
    monkeypatch: pytest.MonkeyPatch, drives: list[CityDrive]
) -> None:
    maps = [one.semantic_map for one in drives]
    parts = in_regions(monkeypatch, 130.0, 60.0, maps, MergeOptions(fixed=(3,)))
    moved_m = np.abs(parts.alignment.ends_m - np.nan_to_num(parts.stack.ends_m)).max(axis=1)
    stays = parts.stack.drive == 3
    assert moved_m[stays].max() < 1e-3
    assert moved_m[~stays].max() > 0.3


def test_a_drive_more_changes_its_regions_alone(
    monkeypatch: pytest.MonkeyPatch, drives: list[CityDrive]
) -> None:
    here = [one.semantic_map for one in drives]
    there = [moved(one, [1000.0, 0.0, 0.0]) for one in here]
    few = in_regions(monkeypatch, 500.0, 100.0, [*here, *there[:-1]])
    more = in_regions(monkeypatch, 500.0, 100.0, [*here, *there])
    n = sum(map(len, here))
    ends_m = [one.alignment.ends_m for one in (few, more)]
    assert np.array_equal(ends_m[0][:n], ends_m[1][:n])
    assert not np.allclose(ends_m[0][n:], ends_m[1][n : len(ends_m[0])])


def test_ids_of_the_first_map_and_all_origins_stay(maps: dict[str, SemanticMap]) -> None:
    given = {
        name: replace(
            one,
            provenance=tuple(
                Provenance((f"{name} {id_}",), (), 2.0) for id_ in one.elements.id.tolist()
            ),
            attributes={1: {"seen by": name}},
        )
        for name, one in maps.items()
    }
    merged, report, _ = merge_maps(given)
    assert set(given["drive 0"].elements.id.tolist()) <= set(merged.elements.id.tolist())
    labels = [label for origin in merged.provenance for label in origin.label_ids]
    assert len(labels) == len(set(labels)) == sum(len(one) for one in maps.values())
    assert merged.attributes[1] == {"seen by": "drive 0"}
    assert report.elements == len(merged)
    assert merged.elements.end_known.sum() == merged.elements.is_line.sum()
    assert len(merged.trajectory_m) == sum(len(one.trajectory_m) for one in maps.values())


def test_a_drive_elsewhere_stays_and_is_named(maps: dict[str, SemanticMap]) -> None:
    first = maps["drive 0"]
    far = moved(first, [5000.0, 0.0, 0.0])
    merged, report, _ = merge_maps({"here": first, "there": far})
    assert len(merged) == 2 * len(first)
    assert "there: " in str(report.drives[1])
    assert "none of them in another drive" in str(report.drives[1])
    assert report.drives[1].moved_m == pytest.approx(0.0, abs=1e-9)


def test_errors_beyond_what_is_stated_are_said(maps: dict[str, SemanticMap]) -> None:
    said = [
        "poses seem to be off" in "\n".join(merge_maps(maps, MergeOptions(errors))[1].lines())
        for errors in (PoseErrors(0.5), PoseErrors(0.1))
    ]
    assert said == [False, True]


def test_maps_with_places_on_earth_are_brought_into_one_frame(
    maps: dict[str, SemanticMap],
) -> None:
    origin = MapFrame("may", (49.0, 8.4, 110.0))
    east = MapFrame("june", (49.0, 8.4 + 100.0 / 73_150.0, 110.0))  # 100 m to the east, nearly
    first = replace(maps["drive 0"], frame=origin)
    other = replace(moved(first, [-100.0, 0.0, 0.0]), frame=east)
    merged, _, _ = merge_maps({"may": first, "june": other})
    assert merged.frame == origin
    assert len(merged) == len(first)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": MapFrame("elsewhere")}, "is in the frame elsewhere, not in city"),
        ({"triangle_center": "centroid"}, "the centre of triangular signs is another"),
        (
            {"elements": Elements3D.from_ends([], np.zeros((0, 3)), np.zeros((0, 3)), [])},
            "no element",
        ),
    ],
)
def test_what_cannot_be_merged_is_refused(
    maps: dict[str, SemanticMap], change: dict[str, object], message: str
) -> None:
    first = maps["drive 0"]
    with pytest.raises(SemvizError, match=message):
        merge_maps({"first": first, "second": replace(first, **change)})  # type: ignore[arg-type]


def test_knots_follow_the_way_and_a_map_without_one_moves_as_a_whole(
    maps: dict[str, SemanticMap],
) -> None:
    first = maps["drive 0"]
    knots = Knots.along([first, replace(first, trajectory_m=np.zeros((0, 3)))])
    assert (knots.drive == 1).sum() == 1
    own = knots.drive == 0
    assert (knots.parent[own] < np.flatnonzero(own)).all()
    assert (knots.parent[~own] == -1).all()
    steps = np.flatnonzero(knots.parent >= 0)
    gap_m = knots.position_m[steps] - knots.position_m[knots.parent[steps]]
    assert np.linalg.norm(gap_m, axis=1).max() < 25.0
