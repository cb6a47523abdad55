"""Labelled images for detector training: rendered streets, data sets and labels, combined.

Rendered streets are stored on disk, because rendering takes a hundred times as long as cutting
a crop. Images of several kinds take turns, so that few images of one kind count as much as many
of another. A number gives the same image in every process.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side
from semviz_core.common.arrays import BoolArray, ByteImage, bool_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.detection.regions import Region
from semviz_core.simulation.detector import rendered_truth
from semviz_core.simulation.layout import Section, StreetOptions
from semviz_core.simulation.objects import SectionKind
from semviz_core.simulation.street import Street


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image with its elements."""

    image: ByteImage
    """(height, width, 3) sRGB."""
    elements: Elements2D
    """(m,) all elements outside the ``ignored`` pixels."""
    regions: tuple[Region, ...] | None = None
    """(m,) with masks; None if only points and lines are labelled. Sizes and masks are then not
    trained."""
    ignored: BoolArray | None = None
    """(height, width) True for pixels that are not trained on: far, tiny or unlabelled elements."""

    def __post_init__(self) -> None:
        if self.regions is not None and len(self.regions) != len(self.elements):
            raise SemvizError(
                f"{len(self.elements)} elements and {len(self.regions)} regions: give one each"
            )
        if self.ignored is not None:
            shape = self.image.shape[:2]
            object.__setattr__(self, "ignored", bool_array(self.ignored, shape, "ignored"))


@dataclass(frozen=True, eq=False)
class Crop:
    """A part of an image with its elements."""

    image: ByteImage
    """(height, width, 3) sRGB."""
    elements: Elements2D
    """(m,) poles are cut off at the edges."""
    rows: ByteImage
    """(height, width) 1 + the row of the pixel's element, ``IGNORED``, or 0 for none."""
    has_masks: bool


class LabelledImages(Protocol):
    """Labelled images as a pure function of their number. Picklable to few bytes, since worker
    processes use them."""

    @property
    def count(self) -> int:
        """Number of training images, at least 1."""

    @property
    def held_out_count(self) -> int:
        """Number of validation images, at least 1."""

    def image(self, number: int) -> LabelledImage:
        """Return training image ``number`` < ``count``. Raise SemvizError if it is unreadable."""

    def held_out(self, number: int) -> LabelledImage:
        """Return validation image ``number`` < ``held_out_count``, which is never trained on."""

    def describe(self) -> dict[str, Any]:
        """Return the origin of the images as JSON, stored in checkpoints and model cards. It
        differs if images or labels do."""


@dataclass(frozen=True)
class ConcatImages:
    """Images of each kind in turn, so that a kind with few images counts as much as others."""

    kinds: tuple[LabelledImages, ...]

    @property
    def count(self) -> int:
        return len(self.kinds) * max(kind.count for kind in self.kinds)

    @property
    def held_out_count(self) -> int:
        return len(self.kinds) * max(kind.held_out_count for kind in self.kinds)

    def image(self, number: int) -> LabelledImage:
        row, kind = divmod(number, len(self.kinds))
        return self.kinds[kind].image(row % self.kinds[kind].count)

    def held_out(self, number: int) -> LabelledImage:
        row, kind = divmod(number, len(self.kinds))
        return self.kinds[kind].held_out(row % self.kinds[kind].held_out_count)

    def describe(self) -> dict[str, Any]:
        return {"in_turn": [kind.describe() for kind in self.kinds]}


TRAINING_SEED, TUNING_SEED = 10_000, 20_000
"""First seeds of the streets for training, and of those on which thresholds are chosen. Published
figures use other streets."""
IMAGES = 10
"""Images per street: every ``FRAMES_APART``th frame, left and right alternately."""
FRAMES_APART = 6
KINDS: tuple[SectionKind, ...] = ("normal", "normal", "normal", "normal", "row", "sparse")
"""Kinds of street sections; a street has one of them."""
QUALITY = 95
IGNORED = 255
"""Value of ignored pixels in row maps. Other pixels hold 1 + the element's row, or 0 for none."""
FORMAT = 1


@dataclass(frozen=True)
class StreetImages:
    """Labelled images of streets, in a folder that ``render`` fills."""

    folder: Path
    streets: int = 400
    tuning: int = 20
    """Number of validation streets."""

    @property
    def seeds(self) -> list[int]:
        """Seeds of all streets."""
        training = range(TRAINING_SEED, TRAINING_SEED + self.streets)
        return [*training, *range(TUNING_SEED, TUNING_SEED + self.tuning)]

    @property
    def count(self) -> int:
        return self.streets * IMAGES

    @property
    def held_out_count(self) -> int:
        return self.tuning * IMAGES

    def missing(self) -> list[int]:
        """Return the seeds of streets that are not rendered yet."""
        return [seed for seed in self.seeds if not self.path(seed).is_file()]

    def path(self, seed: int) -> Path:
        """Return the path of a street's images."""
        return self.folder / f"street-{seed}.npz"

    def render(self, seed: int) -> None:
        """Write a street's file. Raise SemvizError if it cannot be written."""
        rng = np.random.default_rng([seed, 1])
        kind = KINDS[rng.integers(len(KINDS))]
        options = StreetOptions(sections=(Section(kind, 100.0),))
        street = Street(seed, options, "box")  # as the network learns triangles
        arrays: dict[str, NDArray[Any]] = {"format": np.array(FORMAT)}
        for number in range(IMAGES):
            side: Side = "left" if number % 2 == 0 else "right"
            seen = _rendered(street, number * FRAMES_APART, side)
            arrays |= {f"{name}_{number}": array for name, array in seen.items()}
        save_arrays(self.path(seed), arrays)

    def image(self, number: int) -> LabelledImage:
        return self._read(TRAINING_SEED + number // IMAGES, number % IMAGES)

    def held_out(self, number: int) -> LabelledImage:
        return self._read(TUNING_SEED + number // IMAGES, number % IMAGES)

    def describe(self) -> dict[str, Any]:
        return {
            "streets": self.streets,
            "first_seed": TRAINING_SEED,
            "images_a_street": IMAGES,
            "held_out_streets": self.tuning,
            "first_held_out_seed": TUNING_SEED,
            "range_m": list(RANGE_M),
            "format": FORMAT,
        }

    def _read(self, seed: int, number: int) -> LabelledImage:
        return read_labelled(self.path(seed), f"_{number}")


HELD_OUT_SHARE = 0.1
"""Share of a data set that is held out: the last images by name, often other places."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class PreparedImages(ABC, Generic[Item]):
    """Images of a data set whose elements ``prepare`` measures once; see ``LabelledImages``."""

    folder: Path
    prepared: Path
    """Folder that ``prepare`` fills."""
    items: tuple[Item, ...]
    """Where each image and what is known of it are."""

    @abstractmethod
    def prepare(self, row: int) -> None:
        """Measure and store an image's elements. Raise SemvizError if a file is unreadable."""

    @abstractmethod
    def describe(self) -> dict[str, Any]: ...

    @property
    def held_out_count(self) -> int:
        return max(1, round(HELD_OUT_SHARE * len(self.items)))

    @property
    def count(self) -> int:
        return len(self.items) - self.held_out_count

    def image(self, number: int) -> LabelledImage:
        return read_labelled(self.path(number))

    def held_out(self, number: int) -> LabelledImage:
        return read_labelled(self.path(self.count + number))

    def missing(self) -> list[int]:
        """Return the rows of images that are not prepared yet."""
        return [row for row in range(len(self.items)) if not self.path(row).is_file()]

    def path(self, row: int) -> Path:
        """Return where an image's elements are stored."""
        return self.prepared / f"{self.digest}-{row}.npz"

    def _described(self, kind: str, classes: Mapping[str, str]) -> dict[str, Any]:
        """Return the description of a data set, whose name has the key ``kind``."""
        return {
            kind: self.folder.name,
            "images": self.count,
            "held_out_images": self.held_out_count,
            "classes": dict(classes),
            "content": self.digest,
        }

    def _store(
        self, row: int, image: ByteImage, rows: NDArray[np.uint8], elements: Elements2D
    ) -> None:
        """Store the elements of an image; ``rows`` as in ``stored_arrays``."""
        save_arrays(self.path(row), stored_arrays(image, rows, elements))

    @cached_property
    def digest(self) -> str:
        return hashlib.sha256(repr(self.items).encode()).hexdigest()[:12]


def read_labelled(path: Path, ending: str = "") -> LabelledImage:
    """Read an image written as ``stored_arrays``; ``ending`` follows the arrays' names.

    Raise SemvizError if the file is missing or damaged.
    """
    try:
        with np.load(path) as file:
            image, rows, *arrays = (file[f"{name}{ending}"] for name in _NAMES)
    except (OSError, ValueError, KeyError):
        raise SemvizError(
            f"{path}: missing or damaged; delete it, and 'semviz detect train' makes it anew"
        ) from None
    return _labelled(_decoded(image), _decoded(rows), *arrays)


def stored_arrays(
    image: ByteImage, rows: NDArray[np.uint8], elements: Elements2D
) -> dict[str, NDArray[Any]]:
    """Return an image's arrays by name; ``rows`` hold 1 + an element's row, ``IGNORED`` or 0.

    Without any element's row, an image has points and lines only, no masks.
    """
    values = (
        _encoded(image[..., ::-1], ".jpg"), _encoded(rows, ".png"),
        elements.anchor_px, elements.end_px, elements.class_id,
        elements.anchor_known, elements.end_known,
    )  # fmt: skip
    return dict(zip(_NAMES, values, strict=True))


def save_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays as NPZ, whole or not at all. Raise SemvizError if that fails."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # none is named allow_pickle


_NAMES = ("image", "rows", "anchor", "end", "class", "anchor_known", "end_known")


def _rendered(street: Street, index: int, side: Side) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of an image by name."""
    truth = rendered_truth(street, index, side)
    distance = street.distance_m(truth.element_id, index, side)
    counts = (distance >= RANGE_M[0]) & (distance <= RANGE_M[1])
    elements = truth.elements[counts]
    regions = [
        region
        for region, is_counted in zip(truth.regions, counts.tolist(), strict=True)
        if is_counted
    ]
    rows = _ignored(street, truth.element_id[counts], index, side) * np.uint8(IGNORED)
    paint(rows, regions)
    return stored_arrays(street.image(index, side), rows, elements)


def _ignored(street: Street, counting: NDArray[np.int64], index: int, side: Side) -> BoolArray:
    """Return (height, width) the pixels of elements that do not count: far, or nearly hidden."""
    order, ranks = street.painted(index, side)
    known = set(counting.tolist())
    return np.isin(order, [rank for id, rank in ranks.items() if id not in known])


def paint(rows: ByteImage, regions: list[Region] | tuple[Region, ...]) -> None:
    """Write each region's mask into ``rows`` (height, width) as 1 + its number."""
    for number, region in enumerate(regions, start=1):
        assert region.mask is not None
        (left, top), (height, width) = region.corner_px, region.mask.shape
        rows[top : top + height, left : left + width][region.mask] = number


def _labelled(
    image: ByteImage,
    rows: ByteImage,
    anchor_px: NDArray[np.float64],
    end_px: NDArray[np.float64],
    class_id: NDArray[np.int64],
    anchor_known: BoolArray,
    end_known: BoolArray,
) -> LabelledImage:
    m = len(class_id)
    elements = Elements2D(
        anchor_px, end_px, class_id, np.ones(m), np.ones((m, 2)), anchor_known, end_known
    )
    has_masks = m == 0 or bool(((rows > 0) & (rows < IGNORED)).any())
    regions = tuple(_region(elements, row, rows) for row in range(m)) if has_masks else None
    return LabelledImage(image[..., ::-1], elements, regions, rows == IGNORED)


def _region(elements: Elements2D, row: int, rows: ByteImage) -> Region:
    """Return the region of an element; pixels shared by elements belong to only one of them."""
    mask = rows == row + 1
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    ends = np.stack([elements.anchor_px[row], elements.end_px[row]])
    return Region(
        class_id=int(elements.class_id[row]),
        score=1.0,
        box_px=np.array([left, top, left + width - 1, top + height - 1], dtype=np.float64),
        mask=mask[top : top + height, left : left + width],
        corner_px=(left, top),
        ends_px=ends if elements.is_line[row] else None,
        ends_known=(bool(elements.anchor_known[row]), bool(elements.end_known[row])),
    )


def _encoded(image: NDArray[np.uint8], ending: str) -> NDArray[np.uint8]:
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, *sampling] if ending == ".jpg" else []
    return cast(NDArray[np.uint8], cv2.imencode(ending, np.ascontiguousarray(image), quality)[1])


def _decoded(content: NDArray[np.uint8]) -> ByteImage:
    return cast(ByteImage, cv2.imdecode(content, cv2.IMREAD_UNCHANGED))
