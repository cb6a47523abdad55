"""Write labels as a table (CSV) with the pixels of the labelled and of the recorded image.

One line for each label. Columns end with ``_px`` for the image that is labelled, which has no
distortion, and with ``_original_px`` for the image as recorded; (0, 0) is the centre of the
top-left pixel in both. Both ends of a pole are points; between them the recorded pole may bend.
"""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from semviz_annotation.label_formats.writing import LabelExportContext, as_word
from semviz_core.base.frame import Dataset, Side
from semviz_core.common.arrays import FloatArray
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
            path, camera = source.original_path(index, side), source.camera_of.get(index)
            name = path.name if camera is None else f"{camera}/{path.name}"
            return name, source.to_original(pixels_px, index, side)
        return f"{side}/{index:06d}.png", pixels_px

    return to_original


def write_table(context: LabelExportContext, path: Path, original: OriginalPixels) -> None:
    """Write the table; cells of a sign's missing end are empty."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for labelled in context.images:
            for row in labelled.observations:
                ends = [row.anchor_px] if row.end_px is None else [row.anchor_px, row.end_px]
                pixels = np.array(ends, dtype=np.float64)
                name, recorded = original(labelled.frame_index, labelled.side, pixels)
                cells = np.hstack([pixels, recorded]).tolist()
                end = cells[1] if row.end_px is not None else [""] * 4
                element = context.labels.element(row.element_id)
                writer.writerow(
                    [
                        labelled.frame_index,
                        labelled.side,
                        name,
                        element.number,
                        context.class_name(row),
                        *cells[0],
                        as_word(row.anchor_known),
                        *end,
                        as_word(row.end_known),
                    ]
                )
