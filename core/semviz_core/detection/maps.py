"""The maps in which the own network answers, and the regions that they tell.

A map has a cell for each 4 x 4 pixels. Heat is high in the middle of an element: of a sign, or of
the visible part of a pole. That cell also tells how far from its centre everything else is, in a
scale that is even for small offsets and logarithmic for large ones: ends of poles are up to 200 px
away, and there a few per cent will do.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.classes import ClassSet
from semviz_core.detection.region import Region

Maps = NDArray[np.float32]
STRIDE = 4
BORDER = 114
"""Grey of what is outside an image."""
MASKS = 2
"""Masks have so many cells along each side of a map's cell."""
MOST = 100
"""Regions in an image, at most."""
UNIT_PX = 4.0
"""Smaller offsets are told evenly."""
_LARGEST = 6.5  # exp of it is thousands of pixels
_GROWN_PX = 2.0  # masks reach so far beyond boxes
_SAME_PX = 3.0  # axes that are closer are of one pole
_SAME_SHARE = 0.5  # of the shorter one's length, or of a sign's size


@dataclass(frozen=True)
class Channels:
    """Which channels of the maps tell what."""

    classes: int

    @property
    def heat(self) -> slice:
        """Logit, for each class, that an element's middle is here."""
        return slice(0, self.classes)

    @property
    def middle(self) -> slice:
        """From here to a sign's middle, x and y."""
        return self._after(0, 2)

    @property
    def size(self) -> slice:
        """Logarithms of a sign's width and height."""
        return self._after(2, 2)

    @property
    def ends(self) -> slice:
        """From here to a pole's peak and bottom, or what is visible of it: x, y, x, y."""
        return self._after(4, 4)

    @property
    def width(self) -> slice:
        """Logarithm of a pole's width."""
        return self._after(8, 1)

    @property
    def known(self) -> slice:
        """Logits that a pole's peak and bottom can be seen."""
        return self._after(9, 2)

    @property
    def mask(self) -> slice:
        """Logits of poles' pixels, then of signs', each four of a cell: 2 x 2 pixels' each."""
        return self._after(11, 2 * MASKS**2)

    @property
    def count(self) -> int:
        return self.classes + 11 + 2 * MASKS**2

    def _after(self, first: int, count: int) -> slice:
        return slice(self.classes + first, self.classes + first + count)


def cell_px(cells: FloatArray) -> FloatArray:
    """Pixels of the centres of cells."""
    return cells * STRIDE + (STRIDE - 1) / 2.0


def offset_code(offset_px: FloatArray) -> FloatArray:
    """How maps tell offsets."""
    return np.asarray(np.arcsinh(offset_px / UNIT_PX))


def size_code(size_px: FloatArray) -> FloatArray:
    """How maps tell sizes."""
    return np.asarray(np.log(size_px / UNIT_PX))


def regions_in(
    maps: Maps, masks: Maps, threshold: FloatArray, classes: ClassSet, shape: tuple[int, int]
) -> list[Region]:
    """What is told, the best first, in an image of ``shape`` (height, width).

    ``maps`` (channels, h, w), ``masks`` (2, 2 h, 2 w) logits, ``threshold`` (classes,) of heat.
    """
    channels = Channels(len(classes))
    number, row, column, score = _peaks(maps[channels.heat], threshold)
    told = maps[:, row, column].T.astype(np.float64)
    is_line = np.array([one.kind == "line" for one in classes])[number]
    found = _found(told, np.stack([column, row], axis=1), channels, is_line, shape)
    ids = [one.id for one in classes]
    return [
        _region(found, one, ids[number[one]], float(score[one]), masks)
        for one in _first_of_each(found)
    ]


@dataclass(frozen=True, eq=False)
class _Found:
    """What k cells tell, the surest first."""

    is_line: BoolArray
    ends_px: FloatArray  # (k, 2, 2) of poles
    width_px: FloatArray  # (k,)
    middle_px: FloatArray  # (k, 2)
    size_px: FloatArray  # (k,) the smaller side of a sign
    box_px: FloatArray  # (k, 4)
    known: BoolArray  # (k, 2)


def _peaks(
    heat: Maps, threshold: FloatArray
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Class number, row, column and score (k,) of cells that none around them excels."""
    score = 1.0 / (1.0 + np.exp(-heat.astype(np.float64)))
    highest = np.stack([cv2.dilate(one, np.ones((3, 3), np.uint8)) for one in score])
    number, row, column = np.nonzero((score == highest) & (score >= threshold[:, None, None]))
    best = np.argsort(-score[number, row, column], kind="stable")[:MOST]
    number, row, column = number[best], row[best], column[best]
    return number, row, column, score[number, row, column]


def _found(
    told: FloatArray,
    cells: NDArray[np.intp],
    channels: Channels,
    is_line: BoolArray,
    shape: tuple[int, int],
) -> _Found:
    here = cell_px(cells.astype(np.float64))
    ends = here[:, None] + _offset(told[:, channels.ends]).reshape(-1, 2, 2)
    last = np.array([shape[1], shape[0]]) - 1.0
    ends = np.clip(ends, 0.0, last)
    middle = here + _offset(told[:, channels.middle])
    size, width = _size(told[:, channels.size]), _size(told[:, channels.width])
    low = np.where(is_line[:, None], ends.min(axis=1) - (width / 2.0) * (1, 0), middle - size / 2.0)
    high = np.where(
        is_line[:, None], ends.max(axis=1) + (width / 2.0) * (1, 0), middle + size / 2.0
    )
    box = np.concatenate([low, high], axis=1)  # beyond the image, too: its middle is the sign's
    known = told[:, channels.known] > 0.0
    return _Found(is_line, ends, width[:, 0], middle, size.min(axis=1), box, known)


def _offset(code: FloatArray) -> FloatArray:
    return np.asarray(UNIT_PX * np.sinh(np.clip(code, -_LARGEST, _LARGEST)))


def _size(code: FloatArray) -> FloatArray:
    return np.asarray(UNIT_PX * np.exp(np.clip(code, -_LARGEST, _LARGEST)))


def _first_of_each(found: _Found) -> list[int]:
    """Rows without those that tell what a surer one does: of poles cells along the axis, of signs
    other classes."""
    kept: list[int] = []
    for row, is_line in enumerate(found.is_line.tolist()):
        same = _same_pole if is_line else _same_sign
        if not any(found.is_line[one] == is_line and same(found, one, row) for one in kept):
            kept.append(row)
    return kept


def _same_sign(found: _Found, one: int, other: int) -> bool:
    apart = np.linalg.norm(found.middle_px[one] - found.middle_px[other])
    return bool(apart < _SAME_SHARE * min(found.size_px[one], found.size_px[other]))


def _same_pole(found: _Found, one: int, other: int) -> bool:
    """Whether the other's middle lies on the axis of the one, and they go side by side."""
    axis = found.ends_px[one, 1] - found.ends_px[one, 0]
    length = max(float(np.linalg.norm(axis)), 1e-9)
    along, across = axis / length, np.array([axis[1], -axis[0]]) / length
    ends = found.ends_px[other] - found.ends_px[one, 0]
    if abs(ends.mean(axis=0) @ across) > max(_SAME_PX, found.width_px[one] / 2.0):
        return False
    low, high = np.sort(ends @ along)
    return bool(min(high, length) - max(low, 0.0) > _SAME_SHARE * min(high - low, length))


def _region(found: _Found, row: int, class_id: int, score: float, masks: Maps) -> Region:
    is_line = bool(found.is_line[row])
    mask, corner_px = _mask(found, row, masks[0 if is_line else 1])
    return Region(
        class_id=class_id,
        score=score,
        box_px=found.box_px[row],
        mask=mask,
        corner_px=corner_px,
        ends_px=found.ends_px[row] if is_line else None,
        ends_known=(bool(found.known[row, 0]), bool(found.known[row, 1])) if is_line else None,
    )


def _mask(found: _Found, row: int, logit: Maps) -> tuple[BoolArray | None, tuple[int, int]]:
    """The element's pixels within its box, of a pole those near its axis; None if there are none.
    And where they begin."""
    step = STRIDE // MASKS
    left, top, right, bottom = found.box_px[row]
    first = np.floor(np.maximum([left - _GROWN_PX, top - _GROWN_PX], 0.0) / step).astype(int)
    last = np.ceil((np.array([right, bottom]) + _GROWN_PX + 1.0) / step).astype(int)
    window = logit[first[1] : last[1], first[0] : last[0]]
    height, width = window.shape
    mask = cv2.resize(window, (width * step, height * step), interpolation=cv2.INTER_LINEAR) > 0.0
    corner = first * step
    if found.is_line[row]:
        mask &= _near_axis(mask.shape, corner, found.ends_px[row], found.width_px[row] + _GROWN_PX)
    if not mask.any():
        return None, (0, 0)
    return mask, (int(corner[0]), int(corner[1]))


def _near_axis(
    shape: tuple[int, ...], corner: NDArray[np.int_], ends_px: FloatArray, within_px: float
) -> BoolArray:
    """(height, width) pixels so close to the line through two points."""
    (x, y), axis = ends_px[0] - corner, ends_px[1] - ends_px[0]
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    across = (columns - x) * axis[1] - (rows - y) * axis[0]
    return np.asarray(np.abs(across) <= within_px * np.linalg.norm(axis))
