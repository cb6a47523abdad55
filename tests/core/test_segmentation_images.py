"""Data sets of semantic segmentation become elements: those that a rendered street truly shows."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from semviz_core.base.classes import POLE
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import ImageGroundTruth, match_detections
from semviz_core.research.training.annotated_images import (
    MASK_TABLE,
    SMALLEST_SIGN_PX,
    SegmentationImages,
)
from semviz_core.research.training.detector_crops import middle_crop
from semviz_core.simulation.detector import rendered_truth
from semviz_core.simulation.street import Street

FRAMES = (0, 20)
POLE_ID, SIGN_ID, GROUP_ID = 17, 20, 18
GROUP_PX = (slice(0, 40), slice(0, 60))
"""A group of poles is planted here: neither background nor an element."""


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(12)


def mask_of(street: Street, index: int) -> np.ndarray:
    """The ids that Cityscapes would give a street's image."""
    mask = np.zeros(street.image(index, "left").shape[:2], np.uint8) + 7  # road
    for region in rendered_truth(street, index, "left").regions:
        assert region.mask is not None
        (left, top), (height, width) = region.corner_px, region.mask.shape
        window = mask[top : top + height, left : left + width]
        window[region.mask] = POLE_ID if region.class_id == POLE else SIGN_ID
    mask[GROUP_PX] = GROUP_ID
    return mask


@pytest.fixture(scope="module")
def cityscapes(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "city"
    for kind in ("leftImg8bit", "gtFine"):
        (folder / kind / "train" / "ulm").mkdir(parents=True)
    for index in FRAMES:
        name = f"train/ulm/ulm_{index:06d}"
        image = folder / "leftImg8bit" / f"{name}_leftImg8bit.png"
        cv2.imwrite(str(image), street.image(index, "left")[..., ::-1])
        mask = folder / "gtFine" / f"{name}_gtFine_labelIds.png"
        cv2.imwrite(str(mask), mask_of(street, index))
    return folder


def prepared(folder: Path, target: Path) -> SegmentationImages:
    images = SegmentationImages.of(folder, target)
    for row in images.missing():
        images.prepare(row)
    assert not images.missing()
    return images


def test_masks_become_the_elements_that_are_there(
    cityscapes: Path, street: Street, tmp_path: Path
) -> None:
    """Poles and signs of some size are found where they are; a group of poles is ignored."""
    images = prepared(cityscapes, tmp_path)
    assert (images.count, images.held_out_count) == (1, 1)
    found = there = 0
    for labelled, index in ((images.image(0), FRAMES[0]), (images.held_out(0), FRAMES[1])):
        truth = rendered_truth(street, index, "left")
        sizes = [region.box_px[2:] - region.box_px[:2] for region in truth.regions]
        large = np.array([size.max() > 30.0 and size.min() > 2.0 for size in sizes])
        line = truth.elements.is_line
        large &= line | (np.array([size.min() for size in sizes]) > 2 * SMALLEST_SIGN_PX)
        matched = match_detections(labelled.elements, ImageGroundTruth.of(truth.elements))
        found += int(np.isin(np.flatnonzero(large), matched).sum())
        there += int(large.sum())
        assert labelled.regions is not None
        assert len(labelled.regions) == len(labelled.elements)
        assert labelled.ignored is not None
        assert labelled.ignored[GROUP_PX].all()
        assert not labelled.ignored[-20:, :20].any()  # the road is background
        assert np.abs(labelled.image.astype(int) - street.image(index, "left")).mean() < 3.0
        assert len(middle_crop(labelled, 0.5).elements) > 0
    assert there >= 6
    assert found >= 0.8 * there


def test_a_table_of_colours_says_the_same(cityscapes: Path, street: Street, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    colors = {POLE_ID: (192, 192, 128), SIGN_ID: (192, 128, 128), GROUP_ID: (1, 2, 3)}
    for index in FRAMES:
        cv2.imwrite(str(folder / "images" / f"{index:03d}.png"),
                    street.image(index, "left")[..., ::-1])  # fmt: skip
        ids = mask_of(street, index)
        mask = np.zeros((*ids.shape, 3), np.uint8)
        for id_, color in colors.items():
            mask[ids == id_] = color
        cv2.imwrite(str(folder / "masks" / f"{index:03d}_L.png"), mask[..., ::-1])
    (folder / MASK_TABLE).write_text(
        'images = "images/*.png"\nmasks = "masks/{name}_L.png"\n'
        '[classes]\n"#c0c080" = "pole"\n"#c08080" = "sign"\n"#010203" = "ignore"\n'
    )
    own = prepared(folder, tmp_path / "own").image(0)
    other = prepared(cityscapes, tmp_path / "city").image(0)
    np.testing.assert_array_equal(own.elements.anchor_px, other.elements.anchor_px)
    np.testing.assert_array_equal(own.elements.class_id, other.elements.class_id)
    text = (folder / MASK_TABLE).read_text()
    (folder / MASK_TABLE).write_text(text.split("[classes]")[0] + '[classes]\n5 = "pole"\n')
    with pytest.raises(SemvizError, match=r"holds colours, but .* gives ids"):
        SegmentationImages.of(folder, tmp_path / "again").prepare(0)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (None, "no such file"),
        ('images = "*.png"\nmasks = "m/{name}.png"\n[classes]\n5 = "pole"\n', "0 images"),
        ('images = "*.png"\nmasks = "m.png"\n[classes]\n5 = "pole"\n', "must hold {name}"),
        ('images = "*.png"\nmasks = "{name}"\n[classes]\nred = "pole"\n', "neither an id"),
        ('images = "*.png"\nmasks = "{name}"\n[classes]\n5 = "mast"\n', "classes.5"),
        ('images = "../*.png"\nmasks = "{name}"\n[classes]\n5 = "pole"\n', "within the folder"),
        ('images = "/tmp/*.png"\nmasks = "{name}"\n[classes]\n5 = "pole"\n', "within the folder"),
        ('images = ""\nmasks = "{name}"\n[classes]\n5 = "pole"\n', "within the folder"),
        ('images = "a**"\nmasks = "{name}"\n[classes]\n5 = "pole"\n', "images 'a\\*\\*'"),
    ],
)
def test_a_folder_that_is_no_data_set_is_refused(
    tmp_path: Path, table: str | None, why: str
) -> None:
    if table is not None:
        (tmp_path / MASK_TABLE).write_text(table)
    with pytest.raises(SemvizError, match=why) as refused:
        SegmentationImages.of(tmp_path, tmp_path / "prepared")
    assert "\n" not in str(refused.value)


TABLE_OF_IDS = 'images = "*.png"\nmasks = "{name}.png{name:>{9}}"\n[classes]\n5 = "pole"\n'


def test_only_the_name_is_replaced_in_the_pattern_of_masks(tmp_path: Path) -> None:
    """A format such as {name:>999999999} would take a gigabyte for each image."""
    (tmp_path / MASK_TABLE).write_text(TABLE_OF_IDS)
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").touch()
        (tmp_path / f"{name}.png{{name:>{{9}}}}").touch()
    assert len(SegmentationImages.of(tmp_path, tmp_path).items) == 2


@pytest.mark.parametrize("kind", ["images", "masks"])
@pytest.mark.parametrize("trick", ["bomb", "endless", "a pipe", "not an image"])
@pytest.mark.timeout(20)
def test_no_image_or_mask_of_a_data_set_is_decoded_beyond_limits(
    tmp_path: Path, kind: str, trick: str
) -> None:
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
        for name in ("a.png", "b.png"):
            cv2.imwrite(str(tmp_path / folder / name), np.zeros((40, 60), np.uint8))
    (tmp_path / MASK_TABLE).write_text(
        'images = "images/*.png"\nmasks = "masks/{name}.png"\n[classes]\n5 = "pole"\n'
    )
    SegmentationImages.of(tmp_path, tmp_path).prepare(0)
    path = tmp_path / kind / "a.png"
    images = SegmentationImages.of(tmp_path, tmp_path)
    content = path.read_bytes()
    path.unlink()
    match trick:
        case "bomb":
            path.write_bytes(content[:16] + struct.pack(">II", 60_000, 60_000) + content[24:])
        case "endless":
            path.symlink_to("/dev/zero")
        case "a pipe":
            os.mkfifo(path)
        case _:
            path.write_bytes(b"not an image")
    with pytest.raises(SemvizError, match=r"a\.png") as refused:
        images.prepare(0)
    assert "\n" not in str(refused.value)
