"""Data sets of boxes become elements: those that a rendered street truly shows."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from semviz_core.base.classes import POLE
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_TEXT_BYTES
from semviz_core.detection.regions import Region
from semviz_core.metrics.detection import ImageGroundTruth, match_detections
from semviz_core.research.training.annotated_images import BOX_TABLE, BoxImages
from semviz_core.research.training.detector_crops import middle_crop
from semviz_core.simulation.detector import rendered_truth
from semviz_core.simulation.street import Street

FRAMES = (0, 20)
CLASSES = "[classes]\n{} = 'sign'\n{} = 'pole'\n{} = 'ignore'\n"


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(12)


@pytest.fixture(scope="module")
def images(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    (folder / "images").mkdir()
    for index in FRAMES:
        image = street.image(index, "left")[..., ::-1]
        cv2.imwrite(str(folder / "images" / f"{index:03d}.png"), image)
    return folder


def corner_box(region: Region) -> list[float]:
    """Left, top, width and height from the image's corner."""
    left, top, right, bottom = region.box_px.tolist()
    return [left, top, right - left + 1.0, bottom - top + 1.0]


def regions_of(street: Street, index: int) -> tuple[Region, ...]:
    return tuple(rendered_truth(street, index, "left").regions)


def write_yolo(folder: Path, street: Street) -> None:
    (folder / "labels").mkdir(exist_ok=True)
    height, width = street.image(FRAMES[0], "left").shape[:2]
    for index in FRAMES:
        lines = []
        for region in regions_of(street, index):
            left, top, w, h = corner_box(region)
            numbers = (left + w / 2) / width, (top + h / 2) / height, w / width, h / height
            lines.append(f"{int(region.class_id == POLE)} {' '.join(map(repr, numbers))}\n")
        (folder / "labels" / f"{index:03d}.txt").write_text("".join(lines) + "7 .5 .5 .1 .1\n")
    (folder / BOX_TABLE).write_text(
        "format = 'yolo'\nimages = 'images/*.png'\nboxes = 'labels/{name}.txt'\n"
        + CLASSES.format(0, 1, 2)
    )


def write_coco(folder: Path, street: Street) -> None:
    names = {1: "plate", 2: "post", 3: "car"}
    annotations = [
        {
            "id": 100 * index + row,
            "image_id": index,
            "category_id": 2 if region.class_id == POLE else 1,
            "bbox": corner_box(region),
        }
        for index in FRAMES
        for row, region in enumerate(regions_of(street, index))
    ]
    content = {
        "images": [{"id": index, "file_name": f"{index:03d}.png"} for index in FRAMES],
        "categories": [{"id": id_, "name": name} for id_, name in names.items()],
        "annotations": annotations,
    }
    (folder / "boxes.json").write_text(json.dumps(content))
    (folder / BOX_TABLE).write_text(
        "format = 'coco'\nimages = 'images'\nboxes = 'boxes.json'\n"
        + CLASSES.format("plate", "post", "tree")
    )


def prepared(folder: Path, target: Path) -> BoxImages:
    images = BoxImages.of(folder, target)
    for row in images.missing():
        images.prepare(row)
    assert not images.missing()
    return images


@pytest.mark.parametrize("write", [write_yolo, write_coco])
def test_boxes_become_the_elements_that_are_there(
    images: Path, street: Street, tmp_path: Path, write: Callable[[Path, Street], None]
) -> None:
    write(images, street)
    data = prepared(images, tmp_path)
    assert (data.count, data.held_out_count) == (1, 1)
    found = there = 0
    for labelled, index in ((data.image(0), FRAMES[0]), (data.held_out(0), FRAMES[1])):
        truth = rendered_truth(street, index, "left")
        sizes = [region.box_px[2:] - region.box_px[:2] for region in truth.regions]
        large = np.array([size.max() > 40.0 and size.min() > 2.0 for size in sizes])
        large &= truth.elements.is_line | np.array([size.min() > 20.0 for size in sizes])
        matched = match_detections(labelled.elements, ImageGroundTruth.of(truth.elements))
        found += int(np.isin(np.flatnonzero(large), matched).sum())
        there += int(large.sum())
        assert labelled.regions is None  # a box is no mask
        assert labelled.ignored is not None
        for anchor in labelled.elements.anchor_px[~labelled.elements.is_line].astype(int):
            assert not labelled.ignored[anchor[1], anchor[0]]
        assert labelled.ignored[-20:, :20].all()  # nobody says that nothing is there
        crop = middle_crop(labelled, 0.5)
        assert not crop.has_masks
    assert there >= 6
    assert found >= 0.8 * there


def test_both_forms_say_the_same(images: Path, street: Street, tmp_path: Path) -> None:
    write_yolo(images, street)
    yolo = prepared(images, tmp_path / "yolo").image(0)
    write_coco(images, street)
    coco = prepared(images, tmp_path / "coco").image(0)
    assert yolo.ignored is not None
    assert coco.ignored is not None
    np.testing.assert_array_equal(yolo.elements.class_id, coco.elements.class_id)
    np.testing.assert_allclose(yolo.elements.anchor_px, coco.elements.anchor_px, atol=1e-6)
    assert (yolo.ignored != coco.ignored).mean() < 1e-3  # a margin may round to another pixel


@pytest.mark.parametrize(
    ("table", "boxes", "why"),
    [
        ("boxes = 'labels/{name}.txt'", "0 .5 .5 .1\n", r"000\.txt, line 1: not a class and four"),
        ("boxes = 'labels/{name}.txt'", "0 .5 .5 nan .1\n", "line 1: a box needs four finite"),
        ("boxes = 'labels/{name}.txt'", "0 .5 .5 0 .1\n", "a size above 0"),
        ("boxes = 'labels/{name}.txt'", "9 .5 .5 .1 .1\n", "0 images have boxes of the classes"),
        ("boxes = 'labels.txt'", "", "boxes must hold {name}"),
        ("boxes = '/labels/{name}.txt'", "", "boxes must be within the folder"),
        ("boxes = '../labels/{name}.txt'", "", "boxes must be within the folder"),
        ("boxes = 'labels/{name}{x}.txt'", "", "0 images have boxes"),
        (f"boxes = '{{name}}{'x' * 300}'", "", "0 images have boxes"),
    ],
)
def test_a_damaged_data_set_is_refused_in_one_line(
    images: Path, tmp_path: Path, table: str, boxes: str, why: str
) -> None:
    (images / "labels").mkdir(exist_ok=True)
    for index in FRAMES:
        (images / "labels" / f"{index:03d}.txt").write_text(boxes)
    (images / BOX_TABLE).write_text(
        f"format = 'yolo'\nimages = 'images/*.png'\n{table}\n{CLASSES.format(0, 1, 2)}"
    )
    with pytest.raises(SemvizError, match=why) as refused:
        BoxImages.of(images, tmp_path / "prepared")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("{", "repair it"),
        ('{"images": [], "categories": [], "annotations": [{"image_id": 1, "category_id": 1, '
         '"bbox": [0, 0, 9, 9]}]}', "item 1: image 1 is not in the file"),
        ('{"images": [{"id": 1, "file_name": "../a.png"}], "categories": [], "annotations": []}',
         "file_name '../a.png' is not within images"),
        ('{"images": [{"id": 1, "file_name": "/a.png"}], "categories": [], "annotations": []}',
         "file_name '/a.png' is not within images"),
        ('{"images": [{"id": 1}], "categories": [], "annotations": []}', "file_name"),
    ],
)  # fmt: skip
def test_a_damaged_coco_file_is_named(tmp_path: Path, content: str, why: str) -> None:
    (tmp_path / "boxes.json").write_text(content)
    (tmp_path / BOX_TABLE).write_text(
        "format = 'coco'\nimages = 'images'\nboxes = 'boxes.json'\n[classes]\nplate = 'sign'\n"
    )
    with pytest.raises(SemvizError, match=why) as refused:
        BoxImages.of(tmp_path, tmp_path / "prepared")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("pattern", ["/images/*.png", "../*/*.png"])
@pytest.mark.parametrize("form", ["yolo", "coco"])
def test_images_outside_of_the_folder_are_refused(tmp_path: Path, form: str, pattern: str) -> None:
    (tmp_path / BOX_TABLE).write_text(
        f"format = '{form}'\nimages = '{pattern}'\nboxes = '{{name}}'\n[classes]\na = 'sign'\n"
    )
    with pytest.raises(SemvizError, match="images must be within the folder") as refused:
        BoxImages.of(tmp_path, tmp_path / "prepared")
    assert "\n" not in str(refused.value)


def test_an_image_that_a_coco_file_lists_twice_is_one(
    images: Path, street: Street, tmp_path: Path
) -> None:
    write_coco(images, street)
    once = BoxImages.of(images, tmp_path)
    content = json.loads((images / "boxes.json").read_text())
    content["images"].append({"id": 900, "file_name": content["images"][0]["file_name"]})
    content["annotations"][0]["image_id"] = 900
    (images / "boxes.json").write_text(json.dumps(content))
    assert BoxImages.of(images, tmp_path).items == once.items


def test_a_coco_file_may_be_larger_than_other_texts(
    images: Path, street: Street, tmp_path: Path
) -> None:
    write_coco(images, street)
    once = BoxImages.of(images, tmp_path)
    with (images / "boxes.json").open("a") as file:
        file.write(" " * (MOST_TEXT_BYTES + 1))
    assert BoxImages.of(images, tmp_path).items == once.items
