"""Decode the output maps of the shipped network into regions.

A map has one cell per 4 x 4 pixels. Heat is high at the centre of an element: of a sign, or of the
visible part of a pole. The same cell holds the offsets from its centre to the other points. Small
offsets are coded linearly, large ones logarithmically: ends of poles are up to 200 px away, and a
few per cent of accuracy suffice there.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import ClassSet
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.detection.regions import Region

Maps = NDArray[np.float32]
STRIDE = 4
BORDER = 114
"""Grey value outside the image."""
MASKS = 2
"""Number of mask cells along each side of a map's cell."""
MAX_REGIONS = 100
"""Maximum number of regions in an image."""
UNIT_PX = 4.0
"""Smaller offsets are coded about linearly."""
_LARGEST = 6.5  # exp of it is thousands of pixels
_GROWN_PX = 2.0  # masks reach this far beyond boxes
_SAME_AXIS_PX = 3.0  # closer axes are of one pole
_SAME_SHARE = 0.5  # of the shorter length, or of a sign's size


@dataclass(frozen=True)
class Channels:
    """The meaning of the maps' channels."""

    classes: int

    @property
    def heat(self) -> slice:
        """Logit, for each class, of an element's centre in this cell."""
        return slice(0, self.classes)

    @property
    def middle(self) -> slice:
        """Offset to a sign's centre, x and y."""
        return self._after(0, 2)

    @property
    def size(self) -> slice:
        """Logarithms of a sign's width and height."""
        return self._after(2, 2)

    @property
    def ends(self) -> slice:
        """Offsets to the upper and lower end of a pole's visible part: x, y, x, y."""
        return self._after(4, 4)

    @property
    def width(self) -> slice:
        """Logarithm of a pole's width."""
        return self._after(8, 1)

    @property
    def known(self) -> slice:
        """Logits of a pole's peak and bottom being visible."""
        return self._after(9, 2)

    @property
    def mask(self) -> slice:
        """Logits of pole pixels, then of sign pixels, 2 x 2 per cell."""
        return self._after(11, 2 * MASKS**2)

    @property
    def count(self) -> int:
        return self.classes + 11 + 2 * MASKS**2

    def _after(self, first: int, count: int) -> slice:
        return slice(self.classes + first, self.classes + first + count)


def cell_px(cells: FloatArray) -> FloatArray:
    """Return the pixel coordinates of the centres of cells."""
    return cells * STRIDE + (STRIDE - 1) / 2.0


def offset_code(offset_px: FloatArray) -> FloatArray:
    """Return the code of offsets in the maps."""
    return np.asarray(np.arcsinh(offset_px / UNIT_PX))


def size_code(size_px: FloatArray) -> FloatArray:
    """Return the code of sizes in the maps."""
    return np.asarray(np.log(size_px / UNIT_PX))


def regions_in(
    maps: Maps, masks: Maps, threshold: FloatArray, classes: ClassSet, shape: tuple[int, int]
) -> list[Region]:
    """Return the regions in an image of ``shape`` (height, width), best score first.

    ``maps`` (channels, h, w) and ``masks`` (2, 2 h, 2 w) hold logits, ``threshold`` (classes,) is
    the least heat of a region.
    """
    channels = Channels(len(classes))
    number, row, column, score = _peaks(maps[channels.heat], threshold)
    values = maps[:, row, column].T.astype(np.float64)
    is_line = np.array([class_.kind == "line" for class_ in classes])[number]
    decoded = _decode(values, np.stack([column, row], axis=1), channels, is_line, shape)
    ids = [class_.id for class_ in classes]
    return [
        _region(decoded, row, ids[number[row]], float(score[row]), masks)
        for row in _without_duplicates(decoded)
    ]


@dataclass(frozen=True, eq=False)
class _DecodedCells:
    """The content of k cells, best score first."""

    is_line: BoolArray
    ends_px: FloatArray  # (k, 2, 2) of poles
    width_px: FloatArray  # (k,)
    center_px: FloatArray  # (k, 2) of signs
    size_px: FloatArray  # (k,) the smaller side of a sign
    box_px: FloatArray  # (k, 4)
    known: BoolArray  # (k, 2)


def _peaks(
    heat: Maps, threshold: FloatArray
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return class number, row, column and score (k,) of the local maxima of heat."""
    score = 1.0 / (1.0 + np.exp(-heat.astype(np.float64)))
    highest = np.stack(
        [cv2.dilate(class_score, np.ones((3, 3), np.uint8)) for class_score in score]
    )
    number, row, column = np.nonzero((score == highest) & (score >= threshold[:, None, None]))
    best = np.argsort(-score[number, row, column], kind="stable")[:MAX_REGIONS]
    number, row, column = number[best], row[best], column[best]
    return number, row, column, score[number, row, column]


def _decode(
    values: FloatArray,
    cells: NDArray[np.intp],
    channels: Channels,
    is_line: BoolArray,
    shape: tuple[int, int],
) -> _DecodedCells:
    here = cell_px(cells.astype(np.float64))
    ends = here[:, None] + _offset(values[:, channels.ends]).reshape(-1, 2, 2)
    last = np.array([shape[1], shape[0]]) - 1.0
    ends = np.clip(ends, 0.0, last)
    middle = here + _offset(values[:, channels.middle])
    size, width = _size(values[:, channels.size]), _size(values[:, channels.width])
    low = np.where(is_line[:, None], ends.min(axis=1) - (width / 2.0) * (1, 0), middle - size / 2.0)
    high = np.where(
        is_line[:, None], ends.max(axis=1) + (width / 2.0) * (1, 0), middle + size / 2.0
    )
    box = np.concatenate([low, high], axis=1)  # may exceed the image: its centre is the sign's
    known = values[:, channels.known] > 0.0
    return _DecodedCells(is_line, ends, width[:, 0], middle, size.min(axis=1), box, known)


def _offset(code: FloatArray) -> FloatArray:
    return np.asarray(UNIT_PX * np.sinh(np.clip(code, -_LARGEST, _LARGEST)))


def _size(code: FloatArray) -> FloatArray:
    return np.asarray(UNIT_PX * np.exp(np.clip(code, -_LARGEST, _LARGEST)))


def _without_duplicates(decoded: _DecodedCells) -> list[int]:
    """Return rows without duplicates: cells along one pole, other classes of one sign."""
    kept: list[int] = []
    for row, is_line in enumerate(decoded.is_line.tolist()):
        same = _same_pole if is_line else _same_sign
        if not any(
            decoded.is_line[other] == is_line and same(decoded, other, row) for other in kept
        ):
            kept.append(row)
    return kept


def _same_sign(decoded: _DecodedCells, first: int, second: int) -> bool:
    apart = np.linalg.norm(decoded.center_px[first] - decoded.center_px[second])
    return bool(apart < _SAME_SHARE * min(decoded.size_px[first], decoded.size_px[second]))


def _same_pole(decoded: _DecodedCells, first: int, second: int) -> bool:
    """Whether the second pole's midpoint is on the first one's axis, and their ranges overlap."""
    axis = decoded.ends_px[first, 1] - decoded.ends_px[first, 0]
    length = max(float(np.linalg.norm(axis)), 1e-9)
    along, across = axis / length, np.array([axis[1], -axis[0]]) / length
    ends = decoded.ends_px[second] - decoded.ends_px[first, 0]
    if abs(ends.mean(axis=0) @ across) > max(_SAME_AXIS_PX, decoded.width_px[first] / 2.0):
        return False
    low, high = np.sort(ends @ along)
    return bool(min(high, length) - max(low, 0.0) > _SAME_SHARE * min(high - low, length))


def _region(decoded: _DecodedCells, row: int, class_id: int, score: float, masks: Maps) -> Region:
    is_line = bool(decoded.is_line[row])
    mask, corner_px = _mask(decoded, row, masks[0 if is_line else 1])
    return Region(
        class_id=class_id,
        score=score,
        box_px=decoded.box_px[row],
        mask=mask,
        corner_px=corner_px,
        ends_px=decoded.ends_px[row] if is_line else None,
        ends_known=(bool(decoded.known[row, 0]), bool(decoded.known[row, 1])) if is_line else None,
    )


def _mask(
    decoded: _DecodedCells, row: int, logit: Maps
) -> tuple[BoolArray | None, tuple[int, int]]:
    """Return the mask of an element within its box, near the axis for a pole, and its corner.

    The mask is None if it is empty.
    """
    step = STRIDE // MASKS
    left, top, right, bottom = decoded.box_px[row]
    first = np.floor(np.maximum([left - _GROWN_PX, top - _GROWN_PX], 0.0) / step).astype(int)
    last = np.ceil((np.array([right, bottom]) + _GROWN_PX + 1.0) / step).astype(int)
    window = logit[first[1] : last[1], first[0] : last[0]]
    height, width = window.shape
    mask = cv2.resize(window, (width * step, height * step), interpolation=cv2.INTER_LINEAR) > 0.0
    corner = first * step
    if decoded.is_line[row]:
        mask &= _near_axis(
            mask.shape, corner, decoded.ends_px[row], decoded.width_px[row] + _GROWN_PX
        )
    if not mask.any():
        return None, (0, 0)
    return mask, (int(corner[0]), int(corner[1]))


def _near_axis(
    shape: tuple[int, ...], corner: NDArray[np.int_], ends_px: FloatArray, within_px: float
) -> BoolArray:
    """Return (height, width) whether pixels are within a distance of the line of two points."""
    (x, y), axis = ends_px[0] - corner, ends_px[1] - ends_px[0]
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    across = (columns - x) * axis[1] - (rows - y) * axis[0]
    return np.asarray(np.abs(across) <= within_px * np.linalg.norm(axis))
