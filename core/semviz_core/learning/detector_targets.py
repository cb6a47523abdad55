"""What the detector's maps should say of a crop, and where they may say anything."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.classes import ClassSet
from semviz_core.detection.maps import MASKS, STRIDE, cell_px, offset_code, size_code
from semviz_core.learning.detector_crops import Crop
from semviz_core.learning.street_images import IGNORED

LEAST_SIGMA, MOST_SIGMA = 0.8, 6.0
"""Of heat around a middle, in cells."""
SIGN_SHARE, POLE_SHARE = 0.12, 0.06
"""Of a sign's size and a pole's length: sigma of the heat."""
LEARNED_HEAT = 0.4
"""Cells with as much heat tell everything about the element."""
_UNKNOWN_SIZE_PX = 24.0
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Targets:
    """Of a crop of h x w cells, whose masks have twice as many along each side."""

    heat: Floats  # (classes, h, w) 1 at a middle
    counts: Floats  # (h, w) 0 where nothing is learned of heat
    sign: Floats  # (4, h, w) codes of middle and size
    sign_weight: Floats  # (h, w)
    size_weight: Floats  # (h, w) 0 where nobody knows
    pole: Floats  # (5, h, w) codes of ends and width
    pole_weight: Floats  # (h, w)
    width_weight: Floats  # (h, w) 0 where nobody knows
    known: Floats  # (2, h, w) whether peak and bottom can be seen
    mask: Floats  # (2, 2 h, 2 w) poles, signs
    mask_weight: Floats  # (2 h, 2 w)

    @classmethod
    def of(cls, crop: Crop, classes: ClassSet) -> "Targets":
        h, w = (side // STRIDE for side in crop.rows.shape)
        mask, mask_weight = _masks(crop)
        targets = cls(
            heat=_zeros(len(classes), h, w),
            counts=_zeros(h, w),
            sign=_zeros(4, h, w),
            sign_weight=_zeros(h, w),
            size_weight=_zeros(h, w),
            pole=_zeros(5, h, w),
            pole_weight=_zeros(h, w),
            width_weight=_zeros(h, w),
            known=_zeros(2, h, w),
            mask=mask,
            mask_weight=mask_weight,
        )
        number = {one.id: position for position, one in enumerate(classes)}
        boxes = _boxes(crop)
        best = np.zeros((2, h, w))
        for row in range(len(crop.elements)):
            targets._add(crop, row, number[int(crop.elements.class_id[row])], boxes[row], best)
        targets.counts[:] = ~_grown(crop.rows == IGNORED) | (targets.heat.max(axis=0) > 0.3)
        return targets

    def _add(
        self, crop: Crop, row: int, number: int, size_px: FloatArray, best: FloatArray
    ) -> None:
        """One element; where two want a cell, it is the one's with more heat there."""
        elements = crop.elements
        is_line = bool(elements.is_line[row])
        ends = np.stack([elements.anchor_px[row], elements.end_px[row]])
        middle = ends.mean(axis=0) if is_line else ends[0]
        heat = _heat(best.shape[1:], middle, ends[1] - ends[0] if is_line else None, size_px)
        self.heat[number] = np.maximum(self.heat[number], heat)
        rows, columns = np.nonzero((heat >= LEARNED_HEAT) & (heat > best[int(is_line)]))
        weight = best[int(is_line), rows, columns] = heat[rows, columns]
        cells = cell_px(np.stack([columns, rows], axis=1).astype(np.float64))
        sizes = size_code(np.maximum(size_px, 1.0))
        if is_line:
            self.pole[:4, rows, columns] = offset_code((ends - cells[:, None]).reshape(-1, 4)).T
            self.pole[4, rows, columns] = sizes[0]
            self.pole_weight[rows, columns] = weight
            self.width_weight[rows, columns] = weight * crop.has_masks
            self.known[0, rows, columns] = elements.anchor_known[row]
            self.known[1, rows, columns] = elements.end_known[row]
        else:
            self.sign[:2, rows, columns] = offset_code(middle - cells).T
            self.sign[2:, rows, columns] = sizes[:, None]
            self.sign_weight[rows, columns] = weight
            self.size_weight[rows, columns] = weight * crop.has_masks


def _zeros(*shape: int) -> Floats:
    return np.zeros(shape, np.float32)


def _heat(
    shape: tuple[int, ...], middle_px: FloatArray, axis_px: FloatArray | None, size_px: FloatArray
) -> FloatArray:
    """(h, w) a Gaussian, 1 in the cell of the middle, longer along a pole."""
    h, w = shape
    at = np.clip(np.floor((middle_px + 0.5) / STRIDE), 0, (w - 1, h - 1))
    rows, columns = np.ogrid[:h, :w]
    x, y = columns - at[0], rows - at[1]
    along = np.array([0.0, 1.0])
    sigma = across = float(np.clip(SIGN_SHARE * size_px.min() / STRIDE, LEAST_SIGMA, MOST_SIGMA))
    if axis_px is not None:
        length = float(np.linalg.norm(axis_px))
        along = axis_px / length
        sigma = float(np.clip(POLE_SHARE * length / STRIDE, LEAST_SIGMA, MOST_SIGMA))
        across = LEAST_SIGMA
    s = (x * along[0] + y * along[1]) / sigma
    t = (x * along[1] - y * along[0]) / across
    return np.asarray(np.exp(-(s**2 + t**2) / 2.0))


def _boxes(crop: Crop) -> list[FloatArray]:
    """(2,) width and height of each element: of signs to both sides of the middle, so that what
    hides a part does not count; of poles the width, twice."""
    elements = crop.elements
    if not crop.has_masks:
        return [np.full(2, _UNKNOWN_SIZE_PX)] * len(elements)
    found = []
    for row, is_line in enumerate(elements.is_line.tolist()):
        mask = (crop.rows == row + 1).view(np.uint8)
        left, top, width, height = cv2.boundingRect(mask)
        if is_line:
            length = np.linalg.norm(elements.end_px[row] - elements.anchor_px[row])
            found.append(np.full(2, np.count_nonzero(mask) / length))
        else:
            beyond = np.array([left + width, top + height]) - 0.5 - elements.anchor_px[row]
            before = elements.anchor_px[row] + 0.5 - (left, top)
            found.append(2.0 * np.maximum(beyond, before))
    return found


def _masks(crop: Crop) -> tuple[Floats, Floats]:
    """Of poles and signs, and where they count."""
    if not crop.has_masks:
        shape = tuple(side * MASKS // STRIDE for side in crop.rows.shape)
        return np.zeros((2, *shape), np.float32), np.zeros(shape, np.float32)
    is_line = np.zeros(256, bool)
    is_line[1 : 1 + len(crop.elements)] = crop.elements.is_line
    shown = (crop.rows > 0) & (crop.rows < IGNORED)
    pole = shown & is_line[crop.rows]
    mask = np.stack([_smaller(pole), _smaller(shown & ~pole)])
    return mask, (_smaller(crop.rows == IGNORED) == 0.0).astype(np.float32)


def _smaller(mask: BoolArray) -> Floats:
    """Shares of each mask cell's pixels."""
    step = STRIDE // MASKS
    height, width = mask.shape
    cells = mask.reshape(height // step, step, width // step, step)
    return np.asarray(cells.mean((1, 3), dtype=np.float32))


def _grown(ignored: BoolArray) -> BoolArray:
    """(h, w) cells of which a pixel, or one of a neighbour, is ignored."""
    height, width = ignored.shape
    cells = ignored.reshape(height // STRIDE, STRIDE, width // STRIDE, STRIDE).any((1, 3))
    grown = cv2.dilate(np.asarray(cells, np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(grown > 0)
