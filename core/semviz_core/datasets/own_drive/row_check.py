"""Measure on real matches how far rows of a rectified stereo pair are apart."""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.frame import Dataset
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.matching import matched_pixels

PAIRS = 5
MOST_APART_PX = 1.0
"""A median beyond this harms matching along rows, and depth."""
LEAST_MATCHES = 50
_REACH_PX = 20.0
"""Matches farther off their row are wrong matches, or those of no pair at all."""


@dataclass(frozen=True)
class RowCheck:
    """Matches of a few pairs, and how far they are off their row."""

    matches: int
    apart_px: float
    """Median of the absolute distances; NaN below ``LEAST_MATCHES``."""
    offset_px: float
    """Median distance, right minus left: of one sign if a camera is pitched or shifted."""

    @property
    def agrees(self) -> bool:
        """Whether rows agree; True if there are too few matches to tell."""
        return self.matches < LEAST_MATCHES or self.apart_px <= MOST_APART_PX


def check_rows(dataset: Dataset) -> RowCheck:
    """Match corners of up to ``PAIRS`` pairs of a stereo dataset; images that are damaged, not."""
    rows = np.unique(np.linspace(0, len(dataset.frames) - 1, PAIRS).round().astype(int))
    found = [np.zeros(0)]
    for row in rows.tolist():
        index = dataset.frames[row].index
        try:
            left, right = dataset.image(index, "left"), dataset.image(index, "right")
        except SemvizError:  # raised again when this image is shown
            continue
        found.append(_row_distances_px(left, right))
    distances = np.concatenate(found)
    if len(distances) < LEAST_MATCHES:
        return RowCheck(len(distances), float("nan"), float("nan"))
    return RowCheck(
        len(distances), float(np.median(np.abs(distances))), float(np.median(distances))
    )


def _row_distances_px(left: ByteImage, right: ByteImage) -> FloatArray:
    """Return the row in the right image minus that in the left one, of each match (n,)."""
    places = matched_pixels(left, right)
    ahead = places[:, 0, 0] > places[:, 1, 0]
    down = places[:, 1, 1] - places[:, 0, 1]
    return np.asarray(down[ahead & (np.abs(down) < _REACH_PX)], dtype=np.float64)
