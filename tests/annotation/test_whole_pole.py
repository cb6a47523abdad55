"""The whole pole under one point, in painted scenes."""

import numpy as np
import pytest
from painted_scenes import RECTIFIED, scenery, shot_of, upright

from semviz_annotation.assist.marked_image import MarkedImage
from semviz_annotation.assist.snap import whole_pole
from semviz_core.base.classes import DEFAULT_CLASSES, POLE
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray


def scene(top_m: float = -1.6, width_m: float = 0.16) -> tuple[MarkedImage, FloatArray]:
    """A pole 10 m ahead before a calm background, and its ends in the image."""
    wall = (upright(0.0, 40.0, 80.0, -30.0, 30.0), (150, 170, 190))
    pole = (upright(0.6, 10.0, width_m, top_m, 1.2), (60, 64, 70))
    image = shot_of(RECTIFIED, Pose.identity(), [wall, *scenery(4)[:40], pole])
    return image, image.view.project(np.array([[0.6, top_m, 10.0], [0.6, 1.2, 10.0]]))


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
@pytest.mark.parametrize("aside_px", [-2.0, 1.5])
def test_a_point_anywhere_on_a_pole_gives_all_of_it(share: float, aside_px: float) -> None:
    image, ends = scene()
    point = ends[0] + share * (ends[1] - ends[0]) + [aside_px, 0.0]
    found = whole_pole(image, point, DEFAULT_CLASSES[POLE])
    assert found is not None
    assert np.abs(found.ends_px - ends).max() < 2.0
    assert found.anchor_known
    assert found.end_known


def test_a_pole_that_leaves_the_image_is_cut_off_there() -> None:
    image, ends = scene(top_m=-6.0)
    found = whole_pole(image, 0.5 * (np.array([ends[0, 0], 0.0]) + ends[1]), DEFAULT_CLASSES[POLE])
    assert found is not None
    assert not found.anchor_known
    assert found.anchor_px[1] == pytest.approx(-0.5, abs=1.0)
    assert found.end_known


def test_beside_a_pole_and_at_a_plain_wall_is_none() -> None:
    image, ends = scene()
    middle = ends.mean(axis=0)
    assert whole_pole(image, middle + np.array([40.0, 0.0]), DEFAULT_CLASSES[POLE]) is None
    assert whole_pole(image, np.array([-20.0, 60.0]), DEFAULT_CLASSES[POLE]) is None
