"""Elements that are half out of view are never sure, whatever the image search says."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_annotation.assist.expected_position import (
    matched_element,
    not_sure_if_cut,
    visible_share,
)
from semviz_annotation.assist.marked_image import SURE, Mark, MarkedImage, ProposedMark
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR
from semviz_core.base.pose import Pose

CAMERA = Camera(480, 320, np.array([[500.0, 0.0, 240.0], [0.0, 500.0, 160.0], [0.0, 0.0, 1.0]]))
VIEW = PosedView(CAMERA, Pose.identity())
SURELY = ProposedMark(Mark((1.0, 1.0)), 0.99)


def element(anchor: tuple[float, float, float], end: tuple[float, float, float] | None = None):  # type: ignore[no-untyped-def]
    bottom = np.full(3, np.nan) if end is None else np.array(end)
    return Triangulated(np.array(anchor), bottom, np.eye(6), True, end is not None, 0.1, 0.2)


def sign_at(u: float, v: float, depth_m: float = 10.0):  # type: ignore[no-untyped-def]
    """A sign whose centre is at pixel (u, v), which may lie outside the image."""
    x, y = (u - 240.0) / 500.0 * depth_m, (v - 160.0) / 500.0 * depth_m
    return element((x, y, depth_m))


def marked_where(half_px: float) -> tuple[MarkedImage, Mark]:
    """An image 10 m before a square sign, in its middle."""
    rgb = np.full((320, 480, 3), 200, np.uint8)
    low, high = (np.array([160, 240])[:, None] + np.array([-half_px, half_px + 1])).T.astype(int)
    rgb[low[0] : high[0], low[1] : high[1]] = 40
    return MarkedImage.of(VIEW, rgb), Mark((240.0, 160.0))


USUAL = marked_where(15.0)


def is_sure(seen: Triangulated, marked: tuple[MarkedImage, Mark] = USUAL) -> bool:
    class_ = DEFAULT_CLASSES[POLE if seen.is_line else RECTANGULAR]
    proposed = not_sure_if_cut(SURELY, seen, VIEW, marked, class_)
    assert proposed is not None
    return proposed.score >= SURE


@given(st.floats(-200, 680), st.floats(-200, 520), st.floats(2, 60))
def test_a_sign_whose_centre_is_outside_the_image_is_never_sure(u, v, depth_m):
    seen = sign_at(u, v, depth_m)
    share = visible_share(seen, VIEW)
    assert 0.0 <= share <= 1.0
    if not CAMERA.contains(np.array([[u, v]]))[0]:
        assert share <= 0.5 + 1e-9
        assert not is_sure(seen)


def test_a_sign_in_the_middle_stays_sure_and_one_at_the_border_does_not():
    assert is_sure(sign_at(240.0, 160.0))
    assert is_sure(sign_at(20.0, 160.0))
    assert not is_sure(sign_at(2.0, 160.0))


def test_a_large_sign_is_cut_farther_from_the_border():
    board = marked_where(44.0)
    assert is_sure(sign_at(12.0, 160.0))
    assert not is_sure(sign_at(12.0, 160.0), board)
    assert is_sure(sign_at(240.0, 160.0), board)


@pytest.mark.parametrize(("top_m", "sure"), [(-2.0, True), (-5.0, True), (-10.0, False)])
def test_a_pole_is_sure_while_half_of_it_is_in_view(top_m, sure):
    pole = element((0.0, top_m, 10.0), (0.0, 3.0, 10.0))
    whole_px, seen_px = 50.0 * (3.0 - top_m), 150.0 + min(160.5, -50.0 * top_m)
    assert visible_share(pole, VIEW) == pytest.approx(seen_px / whole_px)
    assert is_sure(pole) is sure


def test_what_is_behind_the_camera_or_unknown():
    assert visible_share(element((0.0, 0.0, -5.0)), VIEW) == 0.0
    sign = USUAL, DEFAULT_CLASSES[RECTANGULAR]
    assert not_sure_if_cut(SURELY, None, VIEW, *sign) is SURELY
    assert not_sure_if_cut(None, sign_at(0.0, 0.0), VIEW, *sign) is None


def test_two_marks_tell_how_far_a_sign_is_and_thus_how_much_is_in_view():
    right = PosedView(CAMERA, Pose.from_rotvec([0.0, 0.0, 0.0], [-0.5, 0.0, 0.0]))
    found = replace(SURELY, mark=Mark((3.0, 160.0)))
    seen = matched_element(VIEW, Mark((53.0, 160.0)), right, found)
    assert seen is not None
    assert seen.anchor_m[2] == pytest.approx(5.0)
    proposed = not_sure_if_cut(found, seen, right, USUAL, DEFAULT_CLASSES[RECTANGULAR])
    assert proposed is not None
    assert proposed.score < SURE
    assert matched_element(VIEW, Mark((53.0, 160.0)), right, None) is None
