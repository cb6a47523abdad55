"""Cut random crops from labelled images, and compute their target maps.

Crops vary in position, scale, mirroring, colour and camera. Targets also mark where the loss is
ignored.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.detection.heatmaps import BORDER, MASKS, STRIDE, cell_px, offset_code, size_code
from semviz_core.research.training.crop_elements import with_more_elements
from semviz_core.research.training.crop_light import as_bytes, as_taken, with_shade
from semviz_core.research.training.crop_surroundings import in_other_surroundings
from semviz_core.research.training.detector_images import IGNORED, Crop, LabelledImage, paint

HEIGHT, WIDTH = 384, 352
"""Size of a crop: as tall as images, so that it holds whole poles."""
SCALES = 0.65, 1.6
SHORTEST_PX, SMALLEST_PX = 8.0, 5.0
"""Shorter visible parts of poles, and smaller signs, are ignored."""
MARGIN_PX = 16.0
"""Margin that is ignored around a sign of unknown size that is cut off."""
OTHER_SURROUNDINGS, SHADED = 0.65, 0.35
"""Shares of crops with other surroundings, and with shade."""


def random_crop(
    labelled: LabelledImage, rng: np.random.Generator, surroundings: float = OTHER_SURROUNDINGS
) -> Crop:
    """Return a random part of an image, with random scale, mirroring, light and camera.

    With the probability ``surroundings`` its elements stand in other ones; that needs masks.
    """
    height, width = labelled.image.shape[:2]
    low, high = np.log(SCALES)
    scale = float(np.exp(rng.uniform(low, high)))
    corner = [_offset(rng, width * scale, WIDTH), _offset(rng, height * scale, HEIGHT)]
    crop = _cut(labelled, scale, corner, mirrored=bool(rng.random() < 0.5))
    return _elsewhere(crop, rng, surroundings)


def view_elsewhere(labelled: LabelledImage, rng: np.random.Generator) -> LabelledImage:
    """Return the whole image, which must have masks, with other surroundings, light and camera."""
    height, width = labelled.image.shape[:2]
    whole = _cut(labelled, 1.0, [0.0, 0.0], mirrored=False, size=(width, height))
    view = _elsewhere(whole, rng, 1.0)
    return LabelledImage(view.image, view.elements, ignored=view.rows == IGNORED)


def _elsewhere(crop: Crop, rng: np.random.Generator, surroundings: float) -> Crop:
    if crop.has_masks and rng.random() < surroundings:
        crop, fronts = in_other_surroundings(crop, rng)
        crop = with_more_elements(crop, fronts, rng)
    image = with_shade(crop.image, rng) if rng.random() < SHADED else crop.image
    return replace(crop, image=as_taken(image, rng))


def middle_crop(labelled: LabelledImage, share: float) -> Crop:
    """Return an unchanged part: from the left to the right end as ``share`` goes from 0 to 1."""
    height, width = labelled.image.shape[:2]
    return _cut(labelled, 1.0, [share * (width - WIDTH), (height - HEIGHT) / 2.0], mirrored=False)


def _offset(rng: np.random.Generator, available: float, size: int) -> float:
    """Draw the start of a crop of ``size`` in ``available`` pixels; negative if these are fewer."""
    return float(rng.uniform(min(0.0, available - size), max(0.0, available - size)))


def _cut(
    labelled: LabelledImage,
    scale: float,
    corner: list[float],
    mirrored: bool,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Crop:
    """Return a part of an image, with the width and height ``size``."""
    to_crop = _similarity(scale, corner, mirrored, size[0])
    image = as_bytes(
        cv2.warpAffine(
            labelled.image, to_crop, size, flags=cv2.INTER_LINEAR, borderValue=(BORDER,) * 3
        )
    )
    rows: NDArray[np.uint8] = np.zeros(labelled.image.shape[:2], np.uint8)
    if labelled.ignored is not None:
        rows[labelled.ignored] = IGNORED
    paint(rows, labelled.regions or ())
    rows = as_bytes(cv2.warpAffine(rows, to_crop, size, flags=cv2.INTER_NEAREST))
    has_masks = labelled.regions is not None
    elements, learned = _inside(labelled.elements, to_crop, size, rows if has_masks else None)
    return Crop(
        image, elements[learned], _renumbered(rows, elements, learned, has_masks), has_masks
    )


def _similarity(scale: float, corner: list[float], mirrored: bool, width: int) -> FloatArray:
    """Return the map (2, 3) from image to crop pixels; (0, 0) is the centre of a pixel."""
    shift = np.array([-corner[0], -corner[1]]) + (scale - 1.0) / 2.0
    if mirrored:
        return np.array([[-scale, 0.0, width - 1.0 - shift[0]], [0.0, scale, shift[1]]])
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])


def _inside(
    elements: Elements2D, to_crop: FloatArray, size: tuple[int, int], rows: ByteImage | None
) -> tuple[Elements2D, BoolArray]:
    """Return the elements, poles cut off at the edges, and which of them are trained on."""
    anchor = elements.anchor_px @ to_crop[:, :2].T + to_crop[:, 2]
    end = elements.end_px @ to_crop[:, :2].T + to_crop[:, 2]
    from_anchor, to_end = clipped(anchor, end, size)
    line, span = elements.is_line, end - anchor
    first = anchor + np.where(line, from_anchor, 0.0)[:, None] * np.where(line[:, None], span, 0.0)
    last = anchor + to_end[:, None] * span
    inside = (first >= 0.0).all(axis=1) & (first < size).all(axis=1)
    large = np.linalg.norm(last - first, axis=1) >= SHORTEST_PX
    if rows is not None:
        shown = np.bincount(rows.ravel(), minlength=256)[1 : 1 + len(elements)]
        large |= ~line & (shown >= SMALLEST_PX**2 / 2.0)
    else:
        large |= ~line
    cut = replace(
        elements,
        anchor_px=first,
        end_px=last,
        anchor_known=elements.anchor_known & (~line | (from_anchor == 0.0)),
        end_known=elements.end_known & (to_end == 1.0),
    )
    return cut, np.where(line, to_end > from_anchor, inside) & large


def clipped(
    anchor: FloatArray, end: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return the shares (m,) of the way from anchor to end at which it enters and leaves an image.

    ``size`` is its width and height. This is Liang and Barsky's clipping; the first is larger if
    the line misses the image.
    """
    span = end - anchor
    enter, leave = np.zeros(len(anchor)), np.ones(len(anchor))
    last = np.array(size) - 1.0
    for axis in (0, 1):
        with np.errstate(divide="ignore", invalid="ignore"):
            edges = (np.array([0.0, last[axis]]) - anchor[:, axis, None]) / span[:, axis, None]
        edges = np.sort(np.nan_to_num(edges, nan=0.0, posinf=1e9, neginf=-1e9), axis=1)
        enter, leave = np.maximum(enter, edges[:, 0]), np.minimum(leave, edges[:, 1])
    return enter, leave


def _renumbered(
    rows: ByteImage, elements: Elements2D, learned: BoolArray, has_masks: bool
) -> ByteImage:
    """Return ``rows`` renumbered to the learned elements, the others being ignored."""
    numbers = np.arange(256)
    numbers[1 : 1 + len(learned)] = np.where(learned, np.cumsum(learned), IGNORED)
    renumbered = numbers.astype(np.uint8)[rows]
    if not has_masks:
        for x, y in elements.anchor_px[~learned & ~elements.is_line]:
            left, top = int(x - MARGIN_PX), int(y - MARGIN_PX)
            right, bottom = int(x + MARGIN_PX), int(y + MARGIN_PX)
            renumbered[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = IGNORED
    return renumbered


LEAST_SIGMA, MOST_SIGMA = 0.8, 6.0
"""Limits of the heat's sigma, in cells."""
SIGN_SHARE, POLE_SHARE = 0.12, 0.06
"""Sigma of the heat over a sign's size, and over a pole's length."""
LEARNED_HEAT = 0.4
"""Least heat of cells that are trained on an element's geometry."""
_UNKNOWN_SIZE_PX = 24.0
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Targets:
    """Target maps of a crop of h x w cells; masks have twice as many along each side."""

    heat: Floats  # (classes, h, w) 1 at a middle
    counts: Floats  # (h, w) 0 where heat is ignored
    sign: Floats  # (4, h, w) codes of middle and size
    sign_weight: Floats  # (h, w)
    size_weight: Floats  # (h, w) 0 if unknown
    pole: Floats  # (5, h, w) codes of ends and width
    pole_weight: Floats  # (h, w)
    width_weight: Floats  # (h, w) 0 if unknown
    known: Floats  # (2, h, w) whether peak and bottom are visible
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
        number = {class_.id: position for position, class_ in enumerate(classes)}
        boxes = _boxes(crop)
        best = np.zeros((2, h, w))
        for row in range(len(crop.elements)):
            targets._add(crop, row, number[int(crop.elements.class_id[row])], boxes[row], best)
        targets.counts[:] = ~_grown(crop.rows == IGNORED) | (targets.heat.max(axis=0) > 0.3)
        return targets

    def _add(
        self, crop: Crop, row: int, number: int, size_px: FloatArray, best: FloatArray
    ) -> None:
        """Add an element; a cell that two elements claim goes to the one with more heat there."""
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
    """Return a Gaussian (h, w), 1 in the cell of the middle, elongated along a pole."""
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
    """Return width and height (2,) of each element: of a sign symmetric about its middle, so that
    occlusion does not count; of a pole the width, twice."""
    elements = crop.elements
    if not crop.has_masks:
        return [np.full(2, _UNKNOWN_SIZE_PX)] * len(elements)
    sizes = []
    for row, is_line in enumerate(elements.is_line.tolist()):
        mask = (crop.rows == row + 1).view(np.uint8)
        left, top, width, height = cv2.boundingRect(mask)
        if is_line:
            length = np.linalg.norm(elements.end_px[row] - elements.anchor_px[row])
            sizes.append(np.full(2, np.count_nonzero(mask) / length))
        else:
            beyond = np.array([left + width, top + height]) - 0.5 - elements.anchor_px[row]
            before = elements.anchor_px[row] + 0.5 - (left, top)
            sizes.append(2.0 * np.maximum(beyond, before))
    return sizes


def _masks(crop: Crop) -> tuple[Floats, Floats]:
    """Return the masks of poles and signs, and their weight."""
    if not crop.has_masks:
        shape = tuple(side * MASKS // STRIDE for side in crop.rows.shape)
        return np.zeros((2, *shape), np.float32), np.zeros(shape, np.float32)
    is_line = np.zeros(256, bool)
    is_line[1 : 1 + len(crop.elements)] = crop.elements.is_line
    shown = (crop.rows > 0) & (crop.rows < IGNORED)
    pole = shown & is_line[crop.rows]
    mask = np.stack([_cell_shares(pole), _cell_shares(shown & ~pole)])
    return mask, (_cell_shares(crop.rows == IGNORED) == 0.0).astype(np.float32)


def _cell_shares(mask: BoolArray) -> Floats:
    """Return the share of each mask cell's pixels."""
    step = STRIDE // MASKS
    cells = mask.shape[1] // step, mask.shape[0] // step
    return np.asarray(cv2.resize(mask.astype(np.float32), cells, interpolation=cv2.INTER_AREA))


def _grown(ignored: BoolArray) -> BoolArray:
    """Return (h, w) the cells in which, or next to which, a pixel is ignored."""
    height, width = ignored.shape
    cells = ignored.reshape(height // STRIDE, STRIDE, width // STRIDE, STRIDE).any((1, 3))
    grown = cv2.dilate(np.asarray(cells, np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(grown > 0)
