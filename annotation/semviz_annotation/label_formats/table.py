"""Write labels as a table (CSV) with the pixels of the labelled and of the recorded image.

One line for each label. Columns end with ``_px`` for the image that is labelled, which has no
distortion, and with ``_original_px`` for the image as recorded; (0, 0) is the centre of the
top-left pixel in both. Both ends of a pole are points; between them the recorded pole may bend.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from semviz_annotation.label_formats.writing import LabelExportContext, as_word
from semviz_core.base.frame import Dataset, Side
from semviz_core.common.arrays import FloatArray
from semviz_core.common.csv_text import csv_text
from semviz_core.common.files import replacing
from semviz_core.datasets.own_drive.image_folder import ImageFolder

OriginalPixels: TypeAlias = Callable[[int, Side, FloatArray], tuple[str, FloatArray]]
"""The recorded image of a frame and side, and its pixels (n, 2) at those of the labelled image."""
COLUMNS = (
    "frame",
    "side",
    "image",
    "element",
    "class",
    *(f"anchor_{axis}{which}_px" for which in ("", "_original") for axis in "uv"),
    "anchor_known",
    *(f"end_{axis}{which}_px" for which in ("", "_original") for axis in "uv"),
    "end_known",
)


def original_pixels(source: Dataset) -> OriginalPixels:
    """Return the way from a dataset's pixels to recorded ones, which only own drives have apart."""

    def to_original(index: int, side: Side, pixels_px: FloatArray) -> tuple[str, FloatArray]:
        if isinstance(source, ImageFolder):
            name = source.original_path(index, side).name
            return name, source.to_original(pixels_px, side)
        return f"{side}/{index:06d}.png", pixels_px

    return to_original


def write_table(context: LabelExportContext, path: Path, original: OriginalPixels) -> None:
    """Write the table; cells of a sign's missing end are empty."""
    with replacing(path) as temporary:
        table = csv_text([COLUMNS, *_rows(context, original)])
        temporary.write_text(table, encoding="utf-8", newline="")


def _rows(context: LabelExportContext, original: OriginalPixels) -> Iterator[Sequence[object]]:
    for labelled in context.images:
        for row in labelled.observations:
            ends = [row.anchor_px] if row.end_px is None else [row.anchor_px, row.end_px]
            pixels = np.array(ends, dtype=np.float64)
            name, recorded = original(labelled.frame_index, labelled.side, pixels)
            cells = np.hstack([pixels, recorded]).tolist()
            yield [
                labelled.frame_index,
                labelled.side,
                name,
                context.labels.element(row.element_id).number,
                context.class_name(row),
                *cells[0],
                as_word(row.anchor_known),
                *(cells[1] if row.end_px is not None else [""] * 4),
                as_word(row.end_known),
            ]
