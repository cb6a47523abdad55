"""Signs of unknown shape from masks: the image decides on the shape, or that there is no sign."""

import cv2
import numpy as np
import pytest
from drawn_shapes import OUTLINES, background, drawn

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.detection.detector import measure
from semviz_core.detection.regions import Region
from semviz_core.subpixel.sampling import SampledImage

SEEDS = range(12)
COLORS = {TRIANGULAR: (190, 30, 40), RECTANGULAR: (30, 60, 160), ROUNDED: (190, 30, 40)}


def of_mask(mask: BoolArray, class_id: int | None = None) -> Region:
    rows, columns = np.nonzero(mask)
    left, top = int(columns.min()), int(rows.min())
    right, bottom = int(columns.max()), int(rows.max())
    box = np.array([left, top, right, bottom], np.float64)
    return Region(class_id, 0.8, box, mask[top : bottom + 1, left : right + 1], (left, top))


def filled(polygon: FloatArray, shape: tuple[int, int]) -> BoolArray:
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 1)
    return mask > 0


def planted(seed: int, class_id: int) -> tuple[ByteImage, FloatArray, BoolArray]:
    rng = np.random.default_rng(seed)
    middle, half = rng.uniform([70.0, 50.0], [130.0, 80.0]), rng.uniform(9.0, 20.0)
    outline = OUTLINES[class_id] * half + middle
    image = drawn(background(rng), outline, COLORS[class_id])
    return image, middle, filled(outline, (image.shape[0], image.shape[1]))


@pytest.mark.parametrize("class_id", [TRIANGULAR, RECTANGULAR, ROUNDED])
def test_the_shape_and_middle_are_found_although_the_mask_runs_into_a_post(class_id: int) -> None:
    right = 0
    for seed in SEEDS:
        image, middle, mask = planted(seed, class_id)
        rows, columns = np.nonzero(mask)
        post = int(columns.mean())
        mask[rows.max() : rows.max() + 25, post - 3 : post + 3] = True
        found = measure(SampledImage(image), [of_mask(mask)])
        if len(found) == 1 and found.class_id[0] == class_id:
            right += 1
            assert 0.4 <= found.score[0] <= 0.8  # the model's, times the probability of the shape
            assert np.linalg.norm(found.anchor_px[0] - middle) < 1.0
    assert right >= len(SEEDS) // 2  # of others, triangles most of all, the shape stays unclear


def test_specks_and_ragged_masks_are_no_signs() -> None:
    found = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        image = background(rng)
        leaves = rng.choice([40.0, 80.0, 130.0], (80, 100))
        image = np.clip(image * 0.5 + np.kron(leaves, np.ones((2, 2)))[..., None], 0, 255)
        noise = cv2.GaussianBlur(rng.normal(size=image.shape[:2]), (0, 0), 4.0)
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        near = np.hypot(u - 100, v - 60) < rng.uniform(4.0, 25.0)
        mask = near & (noise > -0.05)
        if mask.sum() >= 9:
            found += len(measure(SampledImage(image.astype(np.uint8)), [of_mask(mask)]))
    assert found <= 3


@pytest.mark.parametrize("class_id", [None, ROUNDED])
def test_a_sign_of_four_pixels_is_too_small_whoever_tells_its_class(class_id: int | None) -> None:
    image = background(np.random.default_rng(1))
    mask = np.zeros(image.shape[:2], bool)
    mask[60:64, 80:84] = True
    image[mask] = (190, 30, 40)
    assert len(measure(SampledImage(image), [of_mask(mask, class_id)])) == 0


def test_a_class_that_the_model_tells_is_kept_with_its_score() -> None:
    image, _, mask = planted(0, ROUNDED)
    found = measure(SampledImage(image), [of_mask(mask, RECTANGULAR)])
    assert found.class_id.tolist() == [RECTANGULAR]
    assert found.score.tolist() == [0.8]
