"""Measure on real matches how far rows of a rectified stereo pair are apart, and draw them."""

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

_LINE_EVERY_PX, _MAGNIFIED = 40, 10.0
_LINE_RGB, _ON_RGB, _OFF_RGB = (255, 255, 255), (40, 90, 230), (220, 40, 30)


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
    distances = rows_apart(matched_pairs(dataset, PAIRS))
    if len(distances) < LEAST_MATCHES:
        return RowCheck(len(distances), float("nan"), float("nan"))
    return RowCheck(
        len(distances), float(np.median(np.abs(distances))), float(np.median(distances))
    )


def matched_pairs(dataset: Dataset, pairs: int) -> FloatArray:
    """Return the matches (n, 2, 2), left and right, of up to ``pairs`` pairs along the drive."""
    rows = np.unique(np.linspace(0, len(dataset.frames) - 1, pairs).round().astype(int))
    found = [np.zeros((0, 2, 2))]
    for row in rows.tolist():
        index = dataset.frames[row].index
        try:
            left, right = dataset.image(index, "left"), dataset.image(index, "right")
        except SemvizError:  # raised again when this image is shown
            continue
        found.append(matches_near_rows(left, right))
    return np.concatenate(found)


def matches_near_rows(left: ByteImage, right: ByteImage) -> FloatArray:
    """Return the matches (n, 2, 2) of a rectified pair that lie ahead and near one row."""
    places = matched_pixels(left, right)
    ahead = places[:, 0, 0] > places[:, 1, 0]
    return np.asarray(places[ahead & (np.abs(rows_apart(places)) < _REACH_PX)], dtype=np.float64)


def rows_apart(places: FloatArray) -> FloatArray:
    """Return the row in the right image minus that in the left one, of each match (n,)."""
    return np.asarray(places[:, 1, 1] - places[:, 0, 1], dtype=np.float64)


def draw_rows(left: ByteImage, right: ByteImage) -> ByteImage:
    """Return both images side by side: rows as lines, matches blue on their row, red off it.

    A line beside each match shows how far it is off, ten times as long.
    """
    import cv2

    places = matches_near_rows(left, right)
    picture = np.ascontiguousarray(np.hstack([left, right]))
    height, width = picture.shape[:2]
    for row in range(_LINE_EVERY_PX // 2, height, _LINE_EVERY_PX):
        cv2.line(picture, (0, row), (width - 1, row), _LINE_RGB, 1)
    shift = left.shape[1]
    for (u, v), (u_right, v_right) in places.tolist():
        apart = v_right - v
        colour = _OFF_RGB if abs(apart) > MOST_APART_PX else _ON_RGB
        end = (round(u_right + shift), round(v_right + _MAGNIFIED * apart))
        cv2.circle(picture, (round(u), round(v)), 3, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, (round(u_right + shift), round(v_right)), 3, colour, 1, cv2.LINE_AA)
        cv2.line(picture, (round(u_right + shift), round(v_right)), end, colour, 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)
