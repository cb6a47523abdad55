"""The whole pole under one point, or of which a half is labelled, in painted scenes."""

from dataclasses import replace

import numpy as np
import pytest
from painted_scenes import RECTIFIED, scenery, shot_of, upright

from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_annotation.assist.snap import whole_pole
from semviz_annotation.assist.whole_ends import whole_marks
from semviz_core.base.classes import DEFAULT_CLASSES, POLE
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray

TOP_M, BOTTOM_M = (0.6, -1.6, 10.0), (0.6, 1.2, 10.0)
WIDTHS_PX = [8.0, 8.0]


def scene(
    top_m: float = TOP_M[1], width_m: float = 0.16, T_camera_map: Pose | None = None
) -> tuple[MarkedImage, FloatArray]:
    """A pole 10 m ahead before a calm background, and its ends in the image."""
    wall = (upright(0.0, 40.0, 80.0, -30.0, 30.0), (150, 170, 190))
    pole = (upright(0.6, 10.0, width_m, top_m, 1.2), (60, 64, 70))
    image = shot_of(RECTIFIED, T_camera_map or Pose.identity(), [wall, *scenery(4)[:40], pole])
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


def halves(ends: list[FloatArray], end: int) -> list[Mark]:
    """The marks of a pole without its upper (0) or lower half."""
    marks = []
    for each in ends:
        cut = each.copy()
        cut[end] = each.mean(axis=0)
        marks.append(Mark(pixel(cut[0]), pixel(cut[1])))
    return marks


def both_scenes() -> tuple[list[MarkedImage], list[FloatArray]]:
    """The images of a stereo pair, and the ends of the pole there."""
    images = [scene(T_camera_map=Pose.exp(np.r_[-u, np.zeros(5)]))[0] for u in (0.0, 0.5)]
    return images, [image.view.project(np.array([TOP_M, BOTTOM_M])) for image in images]


@pytest.mark.parametrize("end", [0, 1])
def test_a_pole_that_is_labelled_by_half_is_seen_whole_in_both_images(end: int) -> None:
    images, ends = both_scenes()
    found = whole_marks(images, halves(ends, end), WIDTHS_PX)
    for mark, true in zip(found, ends, strict=True):
        assert np.abs(mark.ends_px - true).max() < 3.0
    whole = [Mark(pixel(each[0]), pixel(each[1])) for each in ends]
    assert whole_marks(images, whole, WIDTHS_PX) == whole


def test_an_end_that_one_image_shows_is_taken_for_the_other_unless_hidden_or_outside() -> None:
    images, ends = both_scenes()
    pixels = images[1].image.copy()
    pixels[: int(ends[1][:, 1].mean()) + 2] = (150, 170, 190)  # the upper half is hidden
    images[1] = replace(images[1], image=pixels)
    found = whole_marks(images, halves(ends, 0), WIDTHS_PX)
    assert np.abs(found[1].ends_px - ends[1]).max() < 4.0
    assert found[1].anchor_known
    hidden = [replace(mark, anchor_known=False) for mark in halves(ends, 0)]
    assert whole_marks(images, hidden, WIDTHS_PX)[1] == hidden[1]
    beyond = halves([ends[0], ends[1] - [0.0, ends[1][:, 1].mean()]], 0)
    assert whole_marks(images, beyond, WIDTHS_PX)[1].anchor_px == beyond[1].anchor_px


def test_a_faint_end_counts_where_both_ways_to_follow_a_pole_lead_to_it() -> None:
    """A far pole in haze; the other image does not show its lower half."""
    wall = (upright(0.0, 60.0, 120.0, -60.0, 60.0), (150, 170, 190))
    pole = (upright(2.52, 42.0, 0.16, -1.6, 1.2), (135, 155, 175))
    shot = shot_of(RECTIFIED, Pose.identity(), [wall, pole])
    noise = np.random.default_rng(1).normal(0.0, 6.0, shot.image.shape)
    noisy = np.clip(shot.image + noise, 0.0, 255.0).astype(np.uint8)
    ends = shot.view.project(np.array([[2.52, -1.6, 42.0], [2.52, 1.2, 42.0]]))
    hidden = noisy.copy()
    hidden[int(ends[:, 1].mean()) + 1 :] = (150, 170, 190)
    images = [replace(shot, image=pixels) for pixels in (noisy, hidden)]
    found = whole_marks(images, halves([ends, ends], 1), [1.9, 1.9])
    for mark in found:
        assert np.abs(mark.ends_px - ends).max() < 2.0
