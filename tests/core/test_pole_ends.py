"""Poles whose mask ends early: followed to their visible ends, or said to be unknown."""

import numpy as np
import pytest
from drawn_shapes import METAL, background, drawn, pole_polygon

from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.detection.detector import measure
from semviz_core.detection.regions import Region
from semviz_core.subpixel.sampling import SampledImage

SEEDS = range(12)


def early_mask(ends: FloatArray, width_px: float, upper: float, lower: float) -> Region:
    """The mask of a pole without a share of its length at the upper and the lower end."""
    step = ends[1] - ends[0]
    top, bottom = ends[0] + upper * step, ends[1] - lower * step
    rows = np.arange(round(top[1]), round(bottom[1]) + 1)
    middles = top[0] + (rows - top[1]) * step[0] / step[1]
    left = int(middles.min() - width_px / 2.0)
    columns = np.arange(left, int(middles.max() + width_px / 2.0) + 2)
    mask = np.abs(columns - middles[:, None]) <= width_px / 2.0
    box = np.array([columns[0], rows[0], columns[-1], rows[-1]], np.float64)
    return Region(POLE, 0.9, box, mask, (left, int(rows[0])))


def planted(seed: int) -> tuple[ByteImage, FloatArray, float]:
    rng = np.random.default_rng(seed)
    x, width = rng.uniform(70.0, 130.0), rng.uniform(3.0, 8.0)
    ends = np.array([[x, 20.0], [x + rng.uniform(-5.0, 5.0), 130.0]])
    return drawn(background(rng), pole_polygon(ends, width), METAL), ends, width


def top_off(found: Elements2D, ends: FloatArray) -> float:
    return float(np.linalg.norm(found.anchor_px[0] - ends[0]))


@pytest.mark.parametrize("upper", [0.2, 0.5, 0.7])
def test_a_pole_is_followed_beyond_a_mask_that_ends_early(upper: float) -> None:
    off = []
    for seed in SEEDS:
        image, ends, width = planted(seed)
        found = measure(SampledImage(image), [early_mask(ends, width, upper, 0.0)])
        off.append(top_off(found, ends))
        assert found.anchor_known[0]
    assert np.mean(np.array(off) < 1.5) > 0.9
    assert max(off) < 6.0


def test_both_ends_are_followed_and_the_axis_stays_exact() -> None:
    for seed in SEEDS:
        image, ends, width = planted(seed)
        found = measure(SampledImage(image), [early_mask(ends, width, 0.35, 0.25)])
        assert top_off(found, ends) < 3.0
        assert np.linalg.norm(found.end_px[0] - ends[1]) < 3.0


def test_a_small_gap_does_not_end_a_pole() -> None:
    for seed in SEEDS:
        image, ends, width = planted(seed)
        clean = background(np.random.default_rng(seed))
        image[50:54] = clean[50:54]  # four rows without the pole, above the mask
        found = measure(SampledImage(image), [early_mask(ends, width, 0.5, 0.0)])
        assert top_off(found, ends) < 3.0


def test_a_pole_does_not_grow_where_nothing_continues_it() -> None:
    for seed in SEEDS:
        image, ends, width = planted(seed)
        found = measure(SampledImage(image), [early_mask(ends, width, 0.0, 0.0)])
        assert top_off(found, ends) < 3.0


def test_a_pole_that_goes_on_to_the_border_has_no_known_peak() -> None:
    for seed in SEEDS:
        image, ends, width = planted(seed)
        step = (ends[1] - ends[0]) / (ends[1, 1] - ends[0, 1])
        beyond = np.array([ends[0] - 30.0 * step, ends[1]])  # 10 px above the image
        image = drawn(image, pole_polygon(beyond, width), METAL)
        found = measure(SampledImage(image), [early_mask(ends, width, 0.4, 0.0)])
        assert not found.anchor_known[0]
        assert found.anchor_px[0, 1] == pytest.approx(-0.5, abs=0.1)


def crown(rng: np.random.Generator, image: ByteImage, rows: int) -> ByteImage:
    """Leaves, dark and bright, over the upper rows of an image."""
    leaves = rng.choice([30.0, 60.0, 90.0, 140.0], (rows // 2, image.shape[1] // 2))
    grown = np.kron(leaves, np.ones((2, 2)))[:rows, : image.shape[1]]
    covered = image.copy()
    covered[: len(grown), : grown.shape[1]] = (grown[..., None] * [0.6, 1.0, 0.4]).astype(np.uint8)
    return covered


def test_most_ends_in_the_crown_of_a_tree_are_not_known_or_their_sigma_is_large() -> None:
    wrong = 0
    for seed in SEEDS:
        image, ends, width = planted(seed)
        image = crown(np.random.default_rng(seed + 100), image, 60)  # the mask ends there
        found = measure(SampledImage(image), [early_mask(ends, width, 0.4, 0.0)])
        wrong += bool(found.anchor_known[0] and top_off(found, ends) > 3.0 * found.sigma_px[0, 1])
    assert wrong <= len(SEEDS) // 3  # without the test for occluders: all
