"""The map: its crop is what brute force finds, its digest notices every change."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError

FRAME = MapFrame("test")


def make_map(n: int = 8, seed: int = 0) -> SemanticMap:
    rng = np.random.default_rng(seed)
    anchor = rng.uniform(-50, 50, (n, 3))
    end = anchor - [0.0, 0.0, 5.0]
    class_id = np.where(np.arange(n) % 2 == 0, POLE, TRIANGULAR)
    end[class_id == TRIANGULAR] = np.nan
    return SemanticMap(Elements3D.from_ends(np.arange(n) * 3, anchor, end, class_id), FRAME)


@given(
    st.integers(0, 60),
    st.integers(0, 2**32 - 1),
    st.tuples(st.floats(-80, 80), st.floats(-80, 80), st.floats(-80, 80)),
    st.floats(0.0, 120.0),
)
def test_crop_is_what_brute_force_finds(
    n: int, seed: int, center: tuple[float, float, float], radius_m: float
) -> None:
    semantic_map = make_map(n, seed)
    anchors = semantic_map.elements.anchor_m
    distance = np.linalg.norm(anchors[:, :2] - np.array(center)[:2], axis=1)
    expected = semantic_map.elements.id[distance <= radius_m]
    for point in (np.array(center), np.array(center)[:2]):
        np.testing.assert_array_equal(semantic_map.crop(point, radius_m).id, expected)


@pytest.mark.parametrize(
    ("center", "radius_m", "message"),
    [
        ([0.0, np.nan], 5.0, "center_m holds NaN"),
        ([0.0], 5.0, r"center_m has shape \(1,\)"),
        (3.0, 5.0, r"center_m has shape \(\)"),
        ([0.0, 0.0], -1.0, "radius_m is -1; give"),
        ([0.0, 0.0], np.nan, "radius_m holds NaN"),
        ([0.0, 0.0], "near", "radius_m is not an array of numbers"),
    ],
)
def test_what_is_no_circle_is_refused(center: Any, radius_m: Any, message: str) -> None:
    for crop in (make_map().crop, make_map().road_near):
        with pytest.raises(SemvizError, match=message):
            crop(center, radius_m)


@given(st.integers(0, 300), st.integers(0, 2**32 - 1), st.floats(0.0, 12.0))
def test_the_road_near_is_all_of_it_once(n: int, seed: int, radius_m: float) -> None:
    """Each returned point is near and driven; each driven point near is at most a cube away."""
    driven = np.random.default_rng(seed).uniform(-8.0, 8.0, (n, 3)) * [1.0, 1.0, 0.5]
    road = replace(make_map(), trajectory_m=driven).road_near([1.0, 2.0, 100.0], radius_m)
    assert (np.linalg.norm(road[:, :2] - [1.0, 2.0], axis=1) <= radius_m).all()
    assert {tuple(pose) for pose in road} <= {tuple(point) for point in driven}
    assert len(np.unique(np.floor(road), axis=0)) == len(road)
    everything = replace(make_map(), trajectory_m=driven).road_near([1.0, 2.0], 100.0)
    cubes = {tuple(cube) for cube in np.floor(everything)}
    assert cubes == {tuple(cube) for cube in np.floor(driven)}


def test_a_bridge_and_the_road_below_are_both_near() -> None:
    x = np.arange(-20.0, 21.0)[:, None]
    below, above = x * [1.0, 0.0, 0.0] + 0.5, x * [0.0, 1.0, 0.0] + [0.5, 0.5, 6.0]
    halt = np.full((50, 3), 0.7)  # a drive that stood still
    drive = np.concatenate([below, halt, above])
    road = replace(make_map(), trajectory_m=drive).road_near([0.5, 0.5], 3.0)
    assert sorted(road[:, 2].tolist()) == [0.5] * 7 + [6.0] * 7


def test_digest_is_of_the_content() -> None:
    assert make_map().digest == make_map().digest


@pytest.mark.parametrize("name", [field.name for field in fields(Elements3D)])
def test_digest_notices_a_change_in_any_field(name: str) -> None:
    original = make_map()
    array = getattr(original.elements, name).copy()
    row = 1 if name == "class_id" else 0  # a pole's end is known; a sign may be of another class
    if array.dtype == np.bool_:
        array[row] = ~array[row]
    elif name == "class_id":
        array[row] = TRIANGULAR + 1
    else:
        array[row] = array[row] + (100 if name == "id" else 1e-12)
    changed = replace(original, elements=replace(original.elements, **{name: array}))
    assert changed.digest != original.digest


def test_digest_notices_the_frame() -> None:
    assert replace(make_map(), frame=MapFrame("other")).digest != make_map().digest


def test_unknown_classes_are_refused() -> None:
    elements = Elements3D.from_ends([1], [[0, 0, 0]], [[np.nan] * 3], [99])
    with pytest.raises(SemvizError, match="unknown classes"):
        SemanticMap(elements, FRAME)


def test_provenance_is_for_each_element_or_none() -> None:
    with pytest.raises(SemvizError, match="provenance"):
        replace(make_map(), provenance=(Provenance(),))


def test_trajectory_is_checked() -> None:
    with pytest.raises(SemvizError, match="trajectory_m"):
        replace(make_map(), trajectory_m=np.zeros((4, 2)))


@pytest.mark.parametrize(
    ("end_m", "class_id", "words"),
    [
        ([np.nan] * 3, POLE, "P-07 has no end; give a pole two ends"),
        ([0.0, 0.0, 0.0], TRIANGULAR, "T-07 has an end, but is a point"),
    ],
)
def test_poles_have_two_ends_and_signs_one(end_m, class_id, words):
    elements = Elements3D.from_ends([7], [[0.0, 0.0, 3.0]], [end_m], [class_id])
    with pytest.raises(SemvizError, match=words):
        SemanticMap(elements, FRAME)
