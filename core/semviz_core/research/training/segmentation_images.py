"""Labelled images from data sets of semantic segmentation.

Cityscapes' layout is known; other data sets need ``segmentation.toml`` in their folder: where
images and masks are, and which ids or colours are poles and signs. Masks are cut into elements
once, and measured in the image like a detector's regions; images and elements are then stored.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.base.classes import POLE
from semviz_core.common.arrays import BoolArray, ByteImage, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, read_image, read_mask, shown
from semviz_core.detection.detector import by_edges, is_pole
from semviz_core.detection.model_config import SIGN, ImagePlacement, ModelClasses, read_settings
from semviz_core.detection.postprocessing import mask_regions
from semviz_core.detection.regions import MeasuredElement, Region, elements
from semviz_core.research.training.detector_images import IGNORED, PreparedImages, paint
from semviz_core.subpixel.sampling import SampledImage

TABLE = "segmentation.toml"
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
        table_path = folder / TABLE
        is_cityscapes = not table_path.exists() and (folder / "leftImg8bit").is_dir()
        table = CITYSCAPES if is_cityscapes else read_settings(table_path, MaskTable)
        pairs = tuple(
            (image.relative_to(folder).as_posix(), mask)
            for image in matching(folder, table.images, TABLE)
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
        raise SemvizError(f"{path}: holds {kinds[0]}, but {TABLE} gives {kinds[1]}")
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
