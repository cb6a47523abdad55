"""The map: its crop is what brute force finds, its digest notices every change."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.classes import POLE, TRIANGULAR
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import MapFrame, Provenance, SemanticMap

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


def test_digest_is_of_the_content() -> None:
    assert make_map().digest == make_map().digest


@pytest.mark.parametrize("name", [one.name for one in fields(Elements3D)])
def test_digest_notices_a_change_in_any_field(name: str) -> None:
    original = make_map()
    array = getattr(original.elements, name).copy()
    row = 0  # a pole: its end is known
    if array.dtype == np.bool_:
        array[row] = ~array[row]
    elif name == "class_id":
        array[row] = POLE + 2
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
