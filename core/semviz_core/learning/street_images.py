"""Rendered streets kept on disk, so that a training renders each image only once.

To render an image takes a hundred times as long as to cut something out of it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, ByteImage
from semviz_core.detection.labelled import LabelledImage
from semviz_core.detection.region import Region
from semviz_core.detection.rendered import rendered_truth
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.sources.source import Side
from semviz_core.sources.street.detector import RANGE_M
from semviz_core.sources.street.layout import Section, StreetOptions
from semviz_core.sources.street.street import Street
from semviz_core.sources.street.things import SectionKind

TRAINING_SEED, TUNING_SEED = 10_000, 20_000
"""Streets to learn from have seeds from the one on, those that thresholds are chosen on from the
other; those of published figures are neither."""
IMAGES = 10
"""Of each street, every ``FRAMES_APART``th frame, left and right by turns."""
FRAMES_APART = 6
KINDS: tuple[SectionKind, ...] = ("normal", "normal", "normal", "normal", "row", "sparse")
"""A street's furniture is one of these."""
QUALITY = 95
IGNORED = 255
"""In maps of which element a pixel shows; otherwise 1 + its row, 0 for none."""
FORMAT = 1


@dataclass(frozen=True)
class StreetImages:
    """Labelled images of streets, in a folder that ``render`` fills."""

    folder: Path
    streets: int = 400
    tuning: int = 20
    """Streets of images that are never trained on."""

    @property
    def seeds(self) -> list[int]:
        """Of all streets."""
        training = range(TRAINING_SEED, TRAINING_SEED + self.streets)
        return [*training, *range(TUNING_SEED, TUNING_SEED + self.tuning)]

    @property
    def count(self) -> int:
        return self.streets * IMAGES

    @property
    def held_out_count(self) -> int:
        return self.tuning * IMAGES

    def missing(self) -> list[int]:
        """Seeds of streets that are still to be rendered."""
        return [seed for seed in self.seeds if not self.path(seed).is_file()]

    def path(self, seed: int) -> Path:
        """Where a street's images are."""
        return self.folder / f"street-{seed}.npz"

    def render(self, seed: int) -> None:
        """Write a street's file. Raises SemvizError where it cannot be written."""
        rng = np.random.default_rng([seed, 1])
        kind = KINDS[rng.integers(len(KINDS))]
        street = Street(seed, StreetOptions(sections=(Section(kind, 100.0),)))
        arrays: dict[str, NDArray[Any]] = {"format": np.array(FORMAT)}
        for number in range(IMAGES):
            side: Side = "left" if number % 2 == 0 else "right"
            seen = _seen(street, number * FRAMES_APART, side)
            arrays |= {f"{name}_{number}": array for name, array in seen.items()}
        with replacing(self.path(seed)) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # allow_pickle is none of them

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
        path = self.path(seed)
        try:
            with np.load(path) as file:
                image, rows, *arrays = (file[f"{name}_{number}"] for name in _NAMES)
        except (OSError, ValueError, KeyError):
            raise SemvizError(
                f"{path}: missing or damaged; delete it, and 'semviz detect train' renders it anew"
            ) from None
        return _labelled(_decoded(image), _decoded(rows), *arrays)


_NAMES = ("image", "rows", "anchor", "end", "class", "anchor_known", "end_known")


def _seen(street: Street, index: int, side: Side) -> dict[str, NDArray[Any]]:
    """What is kept of an image."""
    truth = rendered_truth(street, index, side)
    away = street.distance_m(truth.element_id, index, side)
    counts = (away >= RANGE_M[0]) & (away <= RANGE_M[1])
    elements = truth.elements[counts]
    regions = [one for one, does in zip(truth.regions, counts.tolist(), strict=True) if does]
    rows = _ignored(street, truth.element_id[counts], index, side) * np.uint8(IGNORED)
    paint(rows, regions)
    values = (
        _encoded(street.image(index, side)[..., ::-1], ".jpg"), _encoded(rows, ".png"),
        elements.anchor_px, elements.end_px, elements.class_id,
        elements.anchor_known, elements.end_known,
    )  # fmt: skip
    return dict(zip(_NAMES, values, strict=True))


def _ignored(street: Street, counting: NDArray[np.int64], index: int, side: Side) -> BoolArray:
    """(height, width) pixels of elements that do not count: far, or all but hidden."""
    order, ranks = street.painted(index, side)
    known = set(counting.tolist())
    return np.isin(order, [rank for id, rank in ranks.items() if id not in known])


def paint(rows: ByteImage, regions: list[Region] | tuple[Region, ...]) -> None:
    """Each region's mask into ``rows`` (height, width): 1 + its number."""
    for number, one in enumerate(regions, start=1):
        assert one.mask is not None
        (left, top), (height, width) = one.corner_px, one.mask.shape
        rows[top : top + height, left : left + width][one.mask] = number


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
    regions = tuple(_region(elements, row, rows) for row in range(m))
    return LabelledImage(image[..., ::-1], elements, regions, rows == IGNORED)


def _region(elements: Elements2D, row: int, rows: ByteImage) -> Region:
    """The pixels of an element. Some may be nobody's, where elements share a pixel."""
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
