"""Other surroundings of crops: elements stay; added posts and signs are labelled as painted."""

from dataclasses import replace

import numpy as np
import pytest

from semviz_core.base.classes import POLE, RECTANGULAR
from semviz_core.base.elements import Elements2D
from semviz_core.research.training.crop_elements import with_more_elements
from semviz_core.research.training.crop_facades import paint_fronts
from semviz_core.research.training.crop_light import as_taken, fractal, with_shade
from semviz_core.research.training.crop_paint import pole_color, wide_and_high
from semviz_core.research.training.crop_surroundings import in_other_surroundings
from semviz_core.research.training.detector_images import IGNORED, Crop

HEIGHT, WIDTH = 384, 352


def a_crop() -> Crop:
    """A pole, a sign, and pixels that nobody knows, on grey."""
    image, rows = np.full((HEIGHT, WIDTH, 3), 120, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    rows[60:301, 98:105], rows[100:141, 200:241], rows[200:260, 280:340] = 1, 2, IGNORED
    image[rows == 1], image[rows == 2], image[rows == IGNORED] = 30, 240, 77
    elements = Elements2D.from_ends(
        [[101.0, 60.0], [220.0, 120.0]], [[101.0, 300.0], [np.nan, np.nan]], [POLE, RECTANGULAR]
    )
    return Crop(image, elements, rows, has_masks=True)


def in_another_place(crop: Crop, seed: int) -> Crop:
    rng = np.random.default_rng(seed)
    return with_more_elements(*in_other_surroundings(crop, rng), rng)


@pytest.fixture(scope="module")
def changed() -> list[Crop]:
    return [in_another_place(a_crop(), seed) for seed in range(30)]


def test_elements_keep_their_place_and_unknown_pixels_their_colour(changed: list[Crop]) -> None:
    before = a_crop()
    for crop in changed:
        old = (before.rows > 0) & (before.rows < IGNORED)
        np.testing.assert_array_equal(crop.rows[old], before.rows[old])
        np.testing.assert_array_equal(crop.rows == IGNORED, before.rows == IGNORED)
        np.testing.assert_array_equal(crop.image[before.rows == IGNORED], 77)
        np.testing.assert_array_equal(crop.elements.anchor_px[:2], before.elements.anchor_px)
    assert np.mean([(crop.image != before.image).mean() for crop in changed]) > 0.2


def test_added_posts_are_labelled_where_they_are_painted(changed: list[Crop]) -> None:
    added = 0
    for crop in changed:
        for row in added_rows(crop, is_line=True):
            added += 1
            ends = np.stack([crop.elements.anchor_px[row], crop.elements.end_px[row]])
            v, u = np.nonzero(crop.rows == row + 1)
            span = ends[1] - ends[0]
            across = ((np.stack([u, v], 1) - ends[0]) @ [span[1], -span[0]]) / np.hypot(*span)
            assert abs(across.mean()) < 1.0 or _is_cut(crop, row)
            assert crop.elements.class_id[row] == POLE
    assert added > 20


def added_rows(crop: Crop, is_line: bool) -> list[int]:
    return [row for row in range(2, len(crop.elements)) if crop.elements.is_line[row] == is_line]


def test_added_signs_are_labelled_at_the_middle_of_their_box(changed: list[Crop]) -> None:
    off, classes = [], set()
    for crop in changed:
        for row in added_rows(crop, is_line=False):
            v, u = np.nonzero(crop.rows == row + 1)
            box = np.array([[u.min(), v.min()], [u.max(), v.max()]])
            if not _is_cut(crop, row):
                off.append(np.abs(box.mean(axis=0) - crop.elements.anchor_px[row]).max())
            classes.add(int(crop.elements.class_id[row]))
    assert len(off) > 5
    assert len(classes) == 3
    assert np.median(off) < 0.7
    assert max(off) < 3.0


def _is_cut(crop: Crop, row: int) -> bool:
    """Whether the crop's border or another element hides a side of a post."""
    v, u = np.nonzero(crop.rows == row + 1)
    beside = crop.rows[v[:, None], np.clip(u[:, None] + [-1, 1], 0, WIDTH - 1)]
    at_border = u.min() == 0 or u.max() == WIDTH - 1
    return bool(at_border or np.isin(beside, [0, row + 1], invert=True).any())


def test_posts_differ_from_what_is_beside_them(changed: list[Crop]) -> None:
    contrast = []
    for crop in changed:
        for row in added_rows(crop, is_line=True):
            mine = crop.rows == row + 1
            near = np.zeros_like(mine)
            v, u = np.nonzero(mine)
            near[max(0, v.min()) : v.max(), max(0, u.min() - 6) : u.max() + 7] = True
            other = crop.image[near & (crop.rows == 0)]
            contrast.append(np.abs(crop.image[mine].mean(0) - other.mean(0)).mean())
    assert np.mean(np.array(contrast) > 10.0) > 0.8


def test_fronts_are_wider_than_poles_and_paint_only_what_is_behind() -> None:
    behind = np.zeros((HEIGHT, WIDTH), bool)
    behind[:, : WIDTH // 2] = True
    changed = 0.0
    for seed in range(12):
        image = np.full((HEIGHT, WIDTH, 3), 99.0, np.float32)
        feet = np.array([[0.25 * WIDTH, 0.7 * HEIGHT]])
        painted = paint_fronts(image, behind, feet, np.random.default_rng(seed))
        np.testing.assert_array_equal(image[~behind], 99.0)
        assert not painted[int(0.7 * HEIGHT) :, WIDTH // 4].any(), "a front hides a pole's foot"
        changed += (image[behind] != 99.0).mean() / 12
    assert changed > 0.1
    sides = [wide_and_high(10.0, 300.0, np.random.default_rng(seed)) for seed in range(99)]
    assert min(wide / high for wide, high in sides) > 0.4


def test_added_posts_stand_before_fronts_and_not_on_them() -> None:
    crop = a_crop()
    for seed in range(12):
        on_fronts = with_more_elements(
            crop, np.ones(crop.rows.shape, bool), np.random.default_rng(seed)
        )
        elements = on_fronts.elements[2:]
        bottoms = elements.end_px[elements.is_line]
        assert (bottoms[:, 1] > HEIGHT - 5.0).all(), "a post stands on a front"


@pytest.mark.parametrize(("level", "least"), [(12.0, 6.0), (40.0, 14.0), (200.0, 22.0)])
def test_a_pole_differs_from_what_is_beside_it_by_less_in_the_shade(
    level: float, least: float
) -> None:
    beside = np.full(3, level)
    off = [
        np.abs(pole_color(beside, np.random.default_rng(seed)) - beside).mean()
        for seed in range(300)
    ]
    assert np.mean(np.array(off) >= least) > 0.95
    assert np.quantile(off, 0.1) < 2.5 * least


def test_the_same_numbers_give_the_same_crop() -> None:
    first, second = (in_another_place(a_crop(), 3) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.rows, second.rows)


def test_light_changes_images_and_not_their_size() -> None:
    image = a_crop().image
    taken = [as_taken(image, np.random.default_rng(seed)) for seed in range(20)]
    assert all(each.shape == image.shape and each.dtype == np.uint8 for each in taken)
    assert any((each == each[..., :1]).all() for each in taken), "no grey camera"
    shaded = [with_shade(image, np.random.default_rng(seed)) for seed in range(8)]
    assert all((each <= image).all() for each in shaded)
    assert any(each.min() < 0.6 * image.min() for each in shaded)


def test_texture_has_unit_scale() -> None:
    textures = [fractal(np.random.default_rng(seed), (200, 300), 20.0) for seed in range(10)]
    assert 0.6 < np.mean([texture.std() for texture in textures]) < 1.5
    assert abs(np.mean([texture.mean() for texture in textures])) < 0.2


def test_a_crop_full_of_elements_gets_nothing_over_them() -> None:
    crop = a_crop()
    full = replace(crop, rows=np.where(crop.rows == 0, IGNORED, crop.rows).astype(np.uint8))
    for seed in range(8):
        assert len(in_another_place(full, seed).elements) == 2
