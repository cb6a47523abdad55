"""Labelled images from data sets of semantic segmentation.

Cityscapes' layout is known; other data sets need ``segmentation.toml`` in their folder: where
images and masks are, and which ids or colours are poles and signs. Masks are cut into elements
once, and measured in the image like a detector's regions; images and elements are then stored.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.base.classes import POLE
from semviz_core.common.arrays import BoolArray, ByteImage, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.detection.detector import by_edges, is_pole
from semviz_core.detection.model_config import SIGN, ImagePlacement, ModelClasses, read_settings
from semviz_core.detection.postprocessing import mask_regions
from semviz_core.detection.regions import MeasuredElement, Region, elements
from semviz_core.research.training.detector_images import (
    IGNORED,
    LabelledImage,
    paint,
    read_labelled,
    stored_arrays,
)
from semviz_core.subpixel.sampling import SampledImage

TABLE = "segmentation.toml"
HELD_OUT_SHARE = 0.1
"""Share of images that is held out: the last by name, which in Cityscapes are other cities."""
SHORTEST_POLE_PX, SMALLEST_SIGN_PX = 12.0, 10.0
"""Shorter poles, and signs with a smaller side, are ignored: too small for their shape or axis."""
MOST_ELEMENTS = 250
"""Further elements of an image are ignored, the smallest first."""
Meaning = Literal["pole", "sign", "ignore"]


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
class SegmentationImages:
    """Images of a data set with their masks; see ``LabelledImages``."""

    folder: Path
    prepared: Path
    """Folder that ``prepare`` fills."""
    pairs: tuple[tuple[str, str], ...]
    """Image and mask, relative to the folder."""
    table: MaskTable

    @classmethod
    def of(cls, folder: Path, prepared: Path) -> "SegmentationImages":
        """Find the images of a data set. Raise SemvizError if there are fewer than two."""
        table_path = folder / TABLE
        is_cityscapes = not table_path.exists() and (folder / "leftImg8bit").is_dir()
        table = CITYSCAPES if is_cityscapes else read_settings(table_path, MaskTable)
        pairs = tuple(
            (image.relative_to(folder).as_posix(), mask)
            for image in sorted(folder.glob(table.images))
            for mask in [_mask_path(table, image, folder)]
            if (folder / mask).is_file()
        )
        if len(pairs) < 2:
            raise SemvizError(
                f"{folder}: {len(pairs)} images {table.images} have a mask {table.masks}; two are "
                "needed"
            )
        return cls(folder, prepared, pairs, table)

    @property
    def held_out_count(self) -> int:
        return max(1, round(HELD_OUT_SHARE * len(self.pairs)))

    @property
    def count(self) -> int:
        return len(self.pairs) - self.held_out_count

    def image(self, number: int) -> LabelledImage:
        return self._read(number)

    def held_out(self, number: int) -> LabelledImage:
        return self._read(self.count + number)

    def describe(self) -> dict[str, Any]:
        return {
            "segmentation": self.folder.name,
            "images": self.count,
            "held_out_images": self.held_out_count,
            "classes": dict(self.table.classes),
            "content": self._digest,
        }

    @cached_property
    def _digest(self) -> str:
        return hashlib.sha256(repr(self.pairs).encode()).hexdigest()[:12]

    def missing(self) -> list[int]:
        """Return the rows of images that are not prepared yet."""
        return [row for row in range(len(self.pairs)) if not self._path(row).is_file()]

    def prepare(self, row: int) -> None:
        """Cut a mask into elements, and store them. Raise SemvizError if a file is unreadable."""
        image_path, mask_path = (self.folder / name for name in self.pairs[row])
        image = _read(image_path, cv2.IMREAD_COLOR)[..., ::-1]
        meaning = meanings(_read(mask_path, cv2.IMREAD_UNCHANGED), self.table.classes, mask_path)
        if meaning.shape != image.shape[:2]:
            raise SemvizError(f"{mask_path}: of another size than {image_path}")
        arrays = stored_arrays(image, *labelled_mask(image, meaning))
        with replacing(self._path(row)) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # none is named allow_pickle

    def _path(self, row: int) -> Path:
        return self.prepared / f"{self._digest}-{row}.npz"

    def _read(self, row: int) -> LabelledImage:
        return read_labelled(self._path(row))


def _mask_path(table: MaskTable, image: Path, folder: Path) -> str:
    if table is not CITYSCAPES:
        return table.masks.format(name=image.stem)
    within = image.relative_to(folder / "leftImg8bit").as_posix()
    return table.masks.format(name=within.removesuffix("_leftImg8bit.png"))


def _read(path: Path, flag: int) -> NDArray[Any]:
    image = cv2.imread(str(path), flag)
    if image is None:
        raise SemvizError(f"{path}: not a readable image; repair or remove it")
    return np.asarray(image)


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
        if measured is not None and _is_large(region):
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


def _is_large(region: Region) -> bool:
    width, height = region.box_px[2:] - region.box_px[:2] + 1.0
    if is_pole(region):
        return bool(height >= SHORTEST_POLE_PX)
    return bool(min(width, height) >= SMALLEST_SIGN_PX)
