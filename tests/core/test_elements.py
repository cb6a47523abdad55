"""Elements: checks on the way in, choosing rows, moving to another frame."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.arrays import FloatArray
from semviz_core.classes import POLE, ROUNDED
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose

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
    for one in fields(Elements3D):
        whole, part = getattr(elements, one.name), getattr(chosen, one.name)
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
    for one in fields(Elements3D):
        np.testing.assert_allclose(
            getattr(back, one.name), getattr(elements, one.name), atol=1e-9, equal_nan=True
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
    values = {one.name: getattr(seen(), one.name) for one in fields(Elements2D)}
    return Elements2D(**(values | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"anchor_px": np.zeros((2, 2))}, r"anchor_px has shape \(2, 2\), expected \(3, 2\)"),
        ({"anchor_px": np.full((3, 2), np.nan)}, "anchor_px holds NaN"),
        ({"end_px": np.full((3, 2), np.inf)}, "end_px holds NaN or infinite"),
        ({"class_id": np.array([0.5, 1.0, 2.0])}, "class_id must hold whole numbers"),
        ({"score": np.array([np.nan, 1.0, 1.0])}, "score holds NaN"),
        ({"sigma_px": np.zeros((3, 2))}, "sigma_px must be positive"),
        ({"anchor_known": np.ones(3)}, "anchor_known must hold true or false"),
        ({"end_known": np.ones(3, dtype=bool)}, "end_known is set for elements without an end"),
    ],
)
def test_wrong_observations_are_refused(changes: dict[str, FloatArray], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        seen_with(**changes)


def test_two_map_elements_cannot_share_an_id() -> None:
    with pytest.raises(SemvizError, match="share an id"):
        Elements3D.from_ends([7, 7], np.zeros((2, 3)), np.ones((2, 3)), [POLE, POLE])


def test_elements_cannot_be_changed_and_do_not_freeze_what_they_were_given() -> None:
    anchors = np.zeros((1, 2))
    elements = Elements2D.from_ends(anchors, [NAN2], [ROUNDED])
    with pytest.raises(ValueError, match="read-only"):
        elements.anchor_px[0, 0] = 1.0
    anchors[0, 0] = 1.0


@pytest.mark.parametrize(
    "ends",
    [
        ([[1, 2]], [[3, 4]], 0),
        ([[1, 2]], [[3, 4], [5, 6]], [0, 0]),
        ([[1, 2]], [[3, 4]], [0.5]),
        ([[1, 2]], [[3, 4]], [np.nan]),
        ([[1, 2], [3]], [[3, 4], [5, 6]], [0, 0]),
        ([["a", "b"]], [[3, 4]], [0]),
        ([[1e200, 2]], [[3, 4]], [0]),
    ],
)
def test_what_are_no_ends_is_refused_in_our_words(ends: tuple[object, object, object]) -> None:
    with pytest.raises(SemvizError):
        Elements2D.from_ends(*ends)


def test_negative_variances_are_refused() -> None:
    good = mapped(0)
    with pytest.raises(SemvizError, match="negative variances"):
        replace(good, covariance_m2=good.covariance_m2 - np.eye(6))
