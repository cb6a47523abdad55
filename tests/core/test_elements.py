"""Elements: checks on the way in, choosing rows, moving to another frame."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, ROUNDED
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

NAN2, NAN3 = [np.nan] * 2, [np.nan] * 3


def seen() -> Elements2D:
    return Elements2D.from_ends(
        [[10, 20], [50, 60], [30, 5]], [[11, 90], NAN2, [31, 70]], [POLE, ROUNDED, POLE]
    )


def mapped(seed: int = 0, n: int = 6) -> Elements3D:
    rng = np.random.default_rng(seed)
    end = rng.normal(size=(n, 3))
    class_id = np.arange(n) % 2
    end[class_id == 1] = np.nan
    return Elements3D.from_ends(np.arange(n), rng.normal(size=(n, 3)), end, class_id)


def test_a_pole_has_an_end_and_a_sign_has_none() -> None:
    elements = seen()
    assert elements.is_line.tolist() == [True, False, True]
    assert elements.end_known.tolist() == [True, False, True]
    assert elements.anchor_known.all()
    assert mapped().is_line.tolist() == [True, False] * 3


def test_covariance_of_a_point_has_no_end() -> None:
    elements = Elements3D.from_ends([1, 2], [[0, 0, 5]] * 2, [[0, 0, 0], NAN3], [0, 1], 0.1)
    np.testing.assert_allclose(elements.covariance_m2[0], 0.01 * np.eye(6))
    np.testing.assert_allclose(np.diag(elements.covariance_m2[1]), [0.01] * 3 + [0.0] * 3)


@given(st.lists(st.integers(0, 5), unique=True))
def test_rows_are_chosen_in_every_field(rows: list[int]) -> None:
    elements = mapped()
    chosen = elements[rows]
    assert len(chosen) == len(rows)
    for field in fields(Elements3D):
        whole, part = getattr(elements, field.name), getattr(chosen, field.name)
        np.testing.assert_array_equal(part, whole[np.array(rows, dtype=int)])


@given(st.lists(st.booleans(), min_size=6, max_size=6))
def test_a_mask_chooses_like_its_indices(mask: list[bool]) -> None:
    elements = mapped()
    np.testing.assert_array_equal(elements[mask].id, elements[np.flatnonzero(mask)].id)


def test_no_elements_at_all_are_fine() -> None:
    assert len(seen()[[]]) == 0
    assert len(Elements2D.from_ends([], [], [])) == 0
    none = Elements3D.from_ends([], [], [], [])
    assert len(none.transformed(Pose.identity())) == 0


@given(st.integers(0, 2**32 - 1))
def test_moving_there_and_back_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = Pose.exp(rng.normal(size=6))
    elements = mapped(seed)
    back = elements.transformed(T).transformed(T.inverse())
    for field in fields(Elements3D):
        np.testing.assert_allclose(
            getattr(back, field.name), getattr(elements, field.name), atol=1e-9, equal_nan=True
        )


def test_covariance_moves_with_the_points() -> None:
    """The covariance of moved samples is the moved covariance of the samples."""
    rng = np.random.default_rng(3)
    T = Pose.exp(rng.normal(size=6))
    root = rng.normal(size=(6, 6))
    samples = rng.normal(size=(200, 6)) @ root.T
    moved = np.concatenate([T.apply(samples[:, :3]), T.apply(samples[:, 3:])], axis=1)
    element = Elements3D(
        id=np.array([1]),
        anchor_m=samples[:1, :3],
        end_m=samples[:1, 3:],
        class_id=np.array([POLE]),
        covariance_m2=np.cov(samples.T)[None],
        anchor_known=np.array([True]),
        end_known=np.array([True]),
    )
    np.testing.assert_allclose(element.transformed(T).covariance_m2[0], np.cov(moved.T), atol=1e-9)


def seen_with(**changes: object) -> Elements2D:
    values = {field.name: getattr(seen(), field.name) for field in fields(Elements2D)}
    return Elements2D(**(values | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"anchor_px": np.zeros((2, 2))}, "different lengths: anchor_px 2, end_px 3, class_id 3"),
        ({"anchor_px": np.zeros((3, 3))}, r"anchor_px has shape \(3, 3\), expected \(n, 2\)"),
        ({"anchor_px": np.zeros(3)}, r"anchor_px has shape \(3,\), expected \(n, 2\)"),
        ({"anchor_px": [[1, 2], [3, 4], [5, np.nan]]}, r"anchor_px holds NaN .* at \[2, 1\]"),
        ({"end_px": np.full((3, 2), np.inf)}, r"end_px holds NaN or infinite .* at \[0, 0\]"),
        ({"end_px": [[1, 2], [3, np.nan], [5, 6]]}, r"end_px\[1\] is NaN in part"),
        ({"class_id": np.array([0.0, 1.0, 2.0])}, r"whole numbers, not float64; use .astype\(int"),
        ({"class_id": ["pole", "pole", "pole"]}, "class_id must hold whole numbers"),
        ({"class_id": np.full(3, 2**63, np.uint64)}, "class_id holds numbers beyond 64 bits"),
        ({"score": np.array([np.nan, 1.0, 1.0])}, "score holds NaN"),
        ({"score": np.array([1.0, 90.0, 1.0])}, r"score\[1\] is 90; give a number from 0 to 1"),
        ({"sigma_px": np.zeros((3, 2))}, r"sigma_px\[0, 0\] is 0; give"),
        ({"sigma_px": [[1, 1], [1, -2], [1, 1]]}, r"sigma_px\[1, 1\] is -2; give"),
        ({"sigma_px": np.full((3, 2), 1e-200)}, "sigma_px.* is 1e-200; give"),
        ({"anchor_known": np.ones(3)}, r"true or false, not float64; use .astype\(bool"),
        ({"end_known": np.ones(3, dtype=bool)}, r"end_known\[1\] is set for elements without"),
    ],
)
def test_wrong_observations_are_refused(changes: dict[str, FloatArray], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        seen_with(**changes)


def test_elements_cannot_be_changed_and_do_not_freeze_what_they_were_given() -> None:
    anchors = np.zeros((1, 2))
    elements = Elements2D.from_ends(anchors, [NAN2], [ROUNDED])
    for frozen in (elements, elements[[0]], elements[:1]):
        with pytest.raises(ValueError, match="read-only"):
            frozen.anchor_px[0, 0] = 1.0
    anchors[0, 0] = 1.0


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        (([[1, 2]], [[3, 4]], 0), r"class_id has shape \(\), expected \(n\)"),
        (([[1, 2]], [[3, 4], [5, 6]], [0, 0]), "lengths: anchor_px 1, end_px 2"),
        (([[1, 2]], [[3, 4]], [0.5]), "class_id must hold whole numbers"),
        (([[1, 2]], [[3, 4]], [np.nan]), "class_id must hold whole numbers"),
        (([[1, 2], [3]], [[3, 4], [5, 6]], [0, 0]), "anchor_px is not an array of numbers"),
        (([["a", "b"]], [[3, 4]], [0]), "anchor_px is not an array of numbers"),
        (([["1", "2"]], [[3, 4]], [0]), "anchor_px is not an array of numbers"),
        (([[1 + 2j, 2]], [[3, 4]], [0]), "anchor_px is not an array of numbers"),
        (([[10**400, 2]], [[3, 4]], [0]), "anchor_px is not an array of numbers"),
        (([[1e200, 2]], [[3, 4]], [0]), r"anchor_px holds numbers beyond 1e\+12, first at \[0, 0"),
        (([[1, 2]], [[3, 4]], [0], -1.0), "sigma_px.* is -1; give a number"),
        (([[1, 2]], [[3, 4]], [0], [1.0, 2.0]), r"sigma_px has shape \(2,\), expected \(\)"),
    ],
)
def test_what_are_no_ends_is_refused_in_our_words(ends: tuple[Any, ...], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        Elements2D.from_ends(*ends)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        (([7, 7], np.zeros((2, 3)), np.ones((2, 3)), [POLE, POLE]), "share an id: 7"),
        (([1], np.zeros((1, 2)), np.ones((1, 3)), [POLE]), r"anchor_m has shape \(1, 2\)"),
        (([1], np.zeros((1, 3)), [[1.0, np.nan, 0.0]], [POLE]), r"end_m\[0\] is NaN in part"),
        (([1], np.zeros((1, 3)), np.ones((1, 3)), [POLE, POLE]), "id 1, .* class_id 2"),
        (([1], np.zeros((1, 3)), np.ones((1, 3)), [POLE], -0.1), "sigma_m is -0.1; give"),
        (([1], np.zeros((1, 3)), np.ones((1, 3)), [POLE], np.nan), "sigma_m holds NaN"),
    ],
)
def test_what_is_no_map_is_refused_in_our_words(ends: tuple[Any, ...], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        Elements3D.from_ends(*ends)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([6], "rows 6 to 6 of 6 elements"),
        ([-7, 0], "rows -7 to 0"),
        ([True, False], r"rows has shape \(2,\), expected \(6\)"),
        ([0.0], "rows must hold whole numbers"),
        (3, r"rows has shape \(\)"),
        ([1, 1], "share an id: 1"),
    ],
)
def test_rows_that_are_none_are_refused(rows: Any, message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        mapped()[rows]


@given(st.slices(6))
def test_a_slice_chooses_like_its_indices(rows: slice) -> None:
    np.testing.assert_array_equal(mapped()[rows].id, np.arange(6)[rows])


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["f4", ">f8", "i8"])
def test_arrays_of_any_kind_mean_the_same(order: Any, dtype: str) -> None:
    """float32, foreign byte order, whole numbers, columns of a larger array; elements are plain."""
    anchor = np.array([[10, 20, 7], [50, 60, 7]]).astype(dtype, order=order)[:, :2]
    elements = Elements2D.from_ends(anchor, anchor + 5, np.array([POLE, POLE], dtype=np.uint8))
    np.testing.assert_array_equal(elements.end_px, [[15, 25], [55, 65]])
    for field in fields(Elements2D):
        array = getattr(elements, field.name)
        assert array.flags.c_contiguous
        assert array.dtype.isnative


def test_negative_variances_are_refused() -> None:
    good = mapped(0)
    with pytest.raises(SemvizError, match="negative variances"):
        replace(good, covariance_m2=good.covariance_m2 - np.eye(6))
