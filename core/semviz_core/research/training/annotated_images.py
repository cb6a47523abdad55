"""Labelled images from data sets of masks, or of boxes in COCO or YOLO form.

Cityscapes' layout is known. Other data sets need a table in their folder, ``segmentation.toml`` or
``boxes.toml``: where images and masks or boxes are, and what is a pole or a sign. Masks are cut
into elements. Elements and boxes are measured in the image once, like a detector's regions, and
stored. Data sets of boxes seldom hold all poles and signs of an image, so that only the boxes and
their surroundings are trained on.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import (
    MOST_TEXT_BYTES,
    first_line,
    read_image,
    read_limited,
    read_mask,
    shown,
)
from semviz_core.detection.detector import by_edges, is_pole
from semviz_core.detection.model_config import (
    SIGN,
    ImagePlacement,
    ModelClasses,
    first_error,
    read_settings,
)
from semviz_core.detection.postprocessing import mask_regions
from semviz_core.detection.regions import MeasuredElement, Region, elements
from semviz_core.research.training.detector_images import IGNORED, PreparedImages, paint
from semviz_core.subpixel.sampling import SampledImage

MASK_TABLE = "segmentation.toml"
SHORTEST_POLE_PX, SMALLEST_SIGN_PX = 12.0, 10.0
"""Shorter poles, and signs with a smaller side, are ignored: too small for their shape or axis."""
MOST_ELEMENTS = 250
"""Further elements of an image are ignored, the smallest first."""
Meaning = Literal["pole", "sign", "ignore"]


def is_within(path: str) -> bool:
    """Whether a path or pattern of a table is relative to its folder and stays in it."""
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts


class MaskTable(BaseModel):
    """The contents of ``segmentation.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    images: str
    """Pattern of the images, relative to the folder: ``train/*.png``."""
    masks: str
    """Path of an image's mask, with its name without ending as ``{name}``."""
    classes: dict[str, Meaning] = Field(min_length=1)
    """From ids (``2``) or colours (``#c0c080``) to their meaning; others are background."""

    def model_post_init(self, _: Any) -> None:
        if "{name}" not in self.masks:
            raise ValueError("masks must hold {name}, the image's name without ending")
        if not PurePosixPath(self.images).parts or not is_within(self.images):
            raise ValueError("images must be a pattern within the folder, like train/*.png")
        for key in self.classes:
            if not re.fullmatch(r"#[0-9a-fA-F]{6}|\d{1,5}", key):
                raise ValueError(
                    f"classes: {key!r} is neither an id like 2 nor a colour like #c0c080"
                )


CITYSCAPES = MaskTable(
    images="leftImg8bit/*/*/*_leftImg8bit.png",
    masks="gtFine/{name}_gtFine_labelIds.png",
    classes={"17": "pole", "20": "sign", "18": "ignore", "0": "ignore", "2": "ignore",
             "3": "ignore"},
)  # fmt: skip
"""Groups of poles (18) and what is outside (0, 2, 3) are ignored."""


@dataclass(frozen=True)
class SegmentationImages(PreparedImages[tuple[str, str]]):
    """Images of a data set with their masks, both relative to the folder."""

    table: MaskTable

    @classmethod
    def of(cls, folder: Path, prepared: Path) -> "SegmentationImages":
        """Find the images of a data set. Raise SemvizError if there are fewer than two."""
        table_path = folder / MASK_TABLE
        is_cityscapes = not table_path.exists() and (folder / "leftImg8bit").is_dir()
        table = CITYSCAPES if is_cityscapes else read_settings(table_path, MaskTable)
        pairs = tuple(
            (image.relative_to(folder).as_posix(), mask)
            for image in matching(folder, table.images, MASK_TABLE)
            for mask in [_mask_path(table, image, folder)]
            if os.path.isfile(folder / mask)  # noqa: PTH113 (Path.is_file raises if it is too long)
        )
        if len(pairs) < 2:
            raise SemvizError(
                f"{folder}: {len(pairs)} images {shown(table.images)} have a mask "
                f"{shown(table.masks)}; two are "
                "needed"
            )
        return cls(folder, prepared, pairs, table)

    def describe(self) -> dict[str, Any]:
        return self._described("segmentation", self.table.classes)

    def prepare(self, row: int) -> None:
        """Cut a mask into elements, and store them. Raise SemvizError if a file is unreadable."""
        image_path, mask_path = (self.folder / name for name in self.items[row])
        image, mask = read_image(image_path), read_mask(mask_path)
        meaning = meanings(mask, self.table.classes, mask_path)
        if meaning.shape != image.shape[:2]:
            raise SemvizError(f"{mask_path}: of another size than {image_path}")
        self._store(row, image, *labelled_mask(image, meaning))


def matching(folder: Path, pattern: str, table: str) -> list[Path]:
    """Return the images of a pattern. Raise SemvizError, naming ``table``, if it is none."""
    try:
        return sorted(folder.glob(pattern))
    except (ValueError, OSError, RecursionError, IndexError) as error:  # of ".", IndexError
        why = first_line(error)
        raise SemvizError(f"{folder / table}: images {shown(pattern)!r}: {why}") from None


def _mask_path(table: MaskTable, image: Path, folder: Path) -> str:
    if table is not CITYSCAPES:
        return table.masks.replace("{name}", image.stem)
    within = image.relative_to(folder / "leftImg8bit").as_posix()
    return table.masks.replace("{name}", within.removesuffix("_leftImg8bit.png"))


def meanings(mask: NDArray[Any], classes: Mapping[str, Meaning], path: Path) -> IntArray:
    """Return (height, width) ``POLE``, ``SIGN``, ``IGNORED`` or -9 for background.

    ``mask`` holds ids, or colours, blue first. Raise SemvizError if it is of the other kind.
    """
    values = {"pole": POLE, "sign": SIGN, "ignore": IGNORED}
    is_color = any(key.startswith("#") for key in classes)
    if is_color != (mask.ndim == 3):
        kinds = ("ids", "colours") if is_color else ("colours", "ids")
        raise SemvizError(f"{path}: holds {kinds[0]}, but {MASK_TABLE} gives {kinds[1]}")
    codes = mask.astype(np.int64)
    if is_color:
        codes = codes[..., 2] * 65536 + codes[..., 1] * 256 + codes[..., 0]
    meaning = np.full(codes.shape, _BACKGROUND)
    for key, name in classes.items():
        meaning[codes == (int(key[1:], 16) if is_color else int(key))] = values[name]
    return meaning


_BACKGROUND = -9


def labelled_mask(image: ByteImage, meaning: IntArray) -> tuple[NDArray[np.uint8], Any]:
    """Return (height, width) rows of elements (1 and up, ``IGNORED`` or 0), and the elements."""
    regions = _regions(meaning)
    signs = [region for region in regions if not is_pole(region)]
    sampled = SampledImage(image)
    kept: list[tuple[Region, MeasuredElement]] = []
    for region in sorted(regions, key=_pixels, reverse=True)[:MOST_ELEMENTS]:
        measured = by_edges(sampled, region, signs)
        if measured is not None and is_large(region):
            kept.append((region, measured))
    rows = np.where(meaning == _BACKGROUND, 0, IGNORED).astype(np.uint8)
    paint(rows, [region for region, _ in kept])
    return rows, elements(measured for _, measured in kept)


def _regions(meaning: IntArray) -> Sequence[Region]:
    classes = ModelClasses(np.array([SIGN, POLE]), frozenset([POLE]))
    masks = [meaning == target for target in classes.wanted]
    rest: BoolArray = ~np.logical_or.reduce(masks)
    height, width = meaning.shape
    size = (width, height)
    whole = ImagePlacement(size, size, np.ones(2), np.zeros(2))
    maps = np.stack([*masks, rest]).astype(np.float32)
    return mask_regions(maps, classes, whole, 0.0)


def _pixels(region: Region) -> int:
    return 0 if region.mask is None else int(region.mask.sum())


def is_large(region: Region) -> bool:
    """Return whether a region is large enough for its axis or shape to be measured."""
    width, height = region.box_px[2:] - region.box_px[:2] + 1.0
    if is_pole(region):
        return bool(height >= SHORTEST_POLE_PX)
    return bool(min(width, height) >= SMALLEST_SIGN_PX)


BOX_TABLE = "boxes.toml"
AROUND = 0.25
"""Share of a box's shorter side around it that is trained on too, as background."""
MOST_COCO_BYTES = 2**30
"""Of a COCO file: that of the whole training set of COCO has 0.45 GB."""


class BoxTable(BaseModel):
    """The contents of ``boxes.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["coco", "yolo"]
    images: str
    """COCO: the folder of the images. YOLO: their pattern, ``images/*.jpg``."""
    boxes: str
    """COCO: the JSON file. YOLO: path of an image's boxes, with its name without ending as
    ``{name}``."""
    classes: dict[str, Meaning] = Field(min_length=1)
    """From names (COCO) or numbers (YOLO) to their meaning; others are not looked at."""

    def model_post_init(self, _: Any) -> None:
        if self.format == "yolo" and "{name}" not in self.boxes:
            raise ValueError("boxes must hold {name}, the image's name without ending")
        for key, path in (("images", self.images), ("boxes", self.boxes)):
            if not is_within(path):
                raise ValueError(f"{key} must be within the folder: relative, and without ..")


@dataclass(frozen=True)
class Box:
    """A box of known meaning."""

    meaning: Meaning
    left_top: tuple[float, float]
    """From the image's corner, in pixels (COCO) or shares of the image's size (YOLO)."""
    size: tuple[float, float]


class _CocoImage(BaseModel):
    id: int
    file_name: str


class _CocoCategory(BaseModel):
    id: int
    name: str


class _CocoBox(BaseModel):
    image_id: int
    category_id: int
    bbox: tuple[float, float, float, float]
    iscrowd: bool = False


class _CocoFile(BaseModel):
    images: list[_CocoImage]
    categories: list[_CocoCategory]
    annotations: list[_CocoBox]


@dataclass(frozen=True)
class BoxImages(PreparedImages[tuple[str, tuple[Box, ...]]]):
    """Images of a data set, relative to the folder, with their boxes."""

    table: BoxTable

    @classmethod
    def of(cls, folder: Path, prepared: Path) -> Self:
        """Find images with boxes. Raise SemvizError if there are fewer than two, or a file is
        damaged."""
        table = read_settings(folder / BOX_TABLE, BoxTable)
        read = _coco if table.format == "coco" else _yolo
        found = sorted(read(folder, table), key=itemgetter(0))
        items = tuple((image, boxes) for image, boxes in found if boxes)
        if len(items) < 2:
            raise SemvizError(
                f"{folder}: {len(items)} images have boxes of the classes in {BOX_TABLE}; two are "
                "needed"
            )
        return cls(folder, prepared, items, table)

    def describe(self) -> dict[str, Any]:
        return self._described("boxes", self.table.classes)

    def prepare(self, row: int) -> None:
        """Measure and store the elements of an image. Raise SemvizError if it is unreadable."""
        name, boxes = self.items[row]
        path = self.folder / name
        image = read_image(path)
        height, width = image.shape[:2]
        unit = (width, height) if self.table.format == "yolo" else (1.0, 1.0)
        boxes_px = [(box.meaning, _box_px(box, np.array(unit))) for box in boxes]
        self._store(row, image, *labelled_boxes(image, boxes_px))


def labelled_boxes(
    image: ByteImage, boxes_px: list[tuple[Meaning, FloatArray]]
) -> tuple[NDArray[np.uint8], Elements2D]:
    """Return (height, width) 0 where boxes tell what is there, else ``IGNORED``, and the elements.

    Boxes (4,) are left, top, right, bottom: centres of the first and last pixels. A box that is
    small, or in which nothing can be measured, is ignored.
    """
    regions = {
        row: Region(POLE if meaning == "pole" else None, 1.0, box)
        for row, (meaning, box) in enumerate(boxes_px)
        if meaning != "ignore"
    }
    signs = [region for region in regions.values() if region.class_id is None]
    sampled = SampledImage(image)
    measured: dict[int, MeasuredElement] = {}
    for row, region in regions.items():
        element = by_edges(sampled, region, signs) if is_large(region) else None
        if element is not None:
            measured[row] = element
    rows = np.full(image.shape[:2], IGNORED, np.uint8)
    for row in measured:
        _fill(rows, boxes_px[row][1], AROUND, 0)
    for row, (_, box) in enumerate(boxes_px):
        if row not in measured:
            _fill(rows, box, AROUND, IGNORED)
    for row in measured:
        _fill(rows, boxes_px[row][1], 0.0, 0)
    return rows, elements(measured.values())


def _fill(rows: NDArray[np.uint8], box_px: FloatArray, around: float, value: int) -> None:
    """Set the pixels of a box, and those around it by a share of its shorter side."""
    margin = around * float((box_px[2:] - box_px[:2]).min() + 1.0)
    left, top = np.maximum(np.floor(box_px[:2] - margin), 0.0).astype(int)
    right, bottom = np.maximum(np.ceil(box_px[2:] + margin) + 1.0, 0.0).astype(int)
    rows[top:bottom, left:right] = value


def _box_px(box: Box, unit: FloatArray) -> FloatArray:
    """Return (4,) the centres of a box's first and last pixels."""
    left_top, size = np.array(box.left_top) * unit, np.array(box.size) * unit
    return np.concatenate([left_top, left_top + np.maximum(size - 1.0, 0.0)])


def _coco(folder: Path, table: BoxTable) -> Iterator[tuple[str, tuple[Box, ...]]]:
    """Yield each image of a COCO file with its boxes; groups of things are ignored.

    Items of the same image are one, lest it is both trained on and held out.
    """
    path = folder / table.boxes
    try:
        content = _CocoFile.model_validate_json(read_limited(path, MOST_COCO_BYTES))
    except ValidationError as error:
        raise SemvizError(f"{path}: {first_error(error)}; repair it") from None
    names = {category.id: category.name for category in content.categories}
    files = {image.id: image.file_name for image in content.images}
    boxes: dict[str, list[Box]] = {file: [] for file in files.values()}
    outside = next((file for file in boxes if not is_within(file)), None)
    if outside is not None:
        raise SemvizError(
            f"{path}: file_name {shown(outside, 80)!r} is not within "
            f"{shown(table.images)}; repair it"
        )
    for item, annotation in enumerate(content.annotations, 1):
        meaning = table.classes.get(names.get(annotation.category_id, ""))
        if annotation.image_id not in files:
            raise SemvizError(
                f"{path}, item {item}: image {annotation.image_id} is not in the file"
            )
        if meaning is not None:
            left, top, width, height = annotation.bbox
            box = _checked(
                "ignore" if annotation.iscrowd else meaning, (left, top), (width, height),
                f"{path}, item {item}",
            )  # fmt: skip
            boxes[files[annotation.image_id]].append(box)
    for file, found in boxes.items():
        yield f"{table.images}/{file}", tuple(found)


def _yolo(folder: Path, table: BoxTable) -> Iterator[tuple[str, tuple[Box, ...]]]:
    """Yield each image with the boxes of its text file: class, centre and size in shares."""
    for image in matching(folder, table.images, BOX_TABLE):
        path = folder / table.boxes.replace("{name}", image.stem)
        is_file = os.path.isfile(path)  # noqa: PTH113 (Path.is_file raises for too long a name)
        boxes = _yolo_boxes(path, table.classes) if is_file else ()
        yield image.relative_to(folder).as_posix(), tuple(boxes)


def _yolo_boxes(path: Path, classes: Mapping[str, Meaning]) -> Iterator[Box]:
    text = read_limited(path, MOST_TEXT_BYTES).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words:
            continue
        where = f"{path}, line {number}"
        try:
            u, v, width, height = map(float, words[1:])
        except ValueError:
            raise SemvizError(f"{where}: not a class and four numbers") from None
        meaning = classes.get(words[0])
        if meaning is not None:
            yield _checked(meaning, (u - width / 2.0, v - height / 2.0), (width, height), where)


def _checked(
    meaning: Meaning, left_top: tuple[float, float], size: tuple[float, float], where: str
) -> Box:
    if not np.isfinite([*left_top, *size]).all() or min(size) <= 0.0:
        raise SemvizError(f"{where}: a box needs four finite numbers and a size above 0")
    return Box(meaning, left_top, size)
