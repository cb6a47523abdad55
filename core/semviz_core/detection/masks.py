"""Maps that models paint, a class for each pixel, to regions: one for each element."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.detection.boxes import softmax
from semviz_core.detection.model_classes import IGNORED, SIGN, ModelClasses
from semviz_core.detection.model_input import Maps, Placing
from semviz_core.detection.region import Region
from semviz_core.errors import SemvizError

_POLE_ROWS, _PIECE_ROWS = 8, 3
"""Fewest of a pole, and of a piece of one that goes on behind something else."""
_SLENDER = 2.0
"""A pole is at least so many times as high as wide."""
_SIGN_SIDE, _SIGN_PIXELS = 4, 16
_ASIDE = 1.0
"""A piece is of a pole whose axis it lies beside by at most so many widths of it."""
_LEAST_ASIDE_PX = 2.0


class _Piece(NamedTuple):
    """Pixels of a pole: those from other poles are left out."""

    corner: tuple[int, int]
    """Column and row of the first pixel."""
    mask: BoolArray

    @property
    def rows(self) -> tuple[int, int]:
        """First, and the one after the last."""
        return self.corner[1], self.corner[1] + len(self.mask)

    @property
    def width(self) -> float:
        """Usual number of its pixels in a row."""
        counts = self.mask.sum(axis=1)
        return float(np.median(counts[counts > 0]))


def segmentation_maps(output: NDArray[Any], classes: ModelClasses) -> Maps:
    """(k + 1, h, w) of logits (1, classes, h, w) or a map (1, h, w) of labels.

    How likely each pixel is one of the k targets that are ``wanted``, then the likeliest of what
    is ignored. Raises SemvizError where the shape is another or a label too high.
    """
    labels = len(classes)
    if output.ndim == 3 and len(output) == 1 and output.dtype.kind in "iu":
        if output.size and not (output.min() >= 0 and output.max() < labels):
            raise SemvizError(f"labels from {output.min()} to {output.max()}; it has {labels}")
        odds = np.equal(output, np.arange(labels)[:, None, None]).astype(np.float32)
    elif output.ndim == 4 and output.shape[:2] == (1, labels) and output.dtype.kind == "f":
        odds = softmax(output[0].astype(np.float32), 0)
    else:
        raise SemvizError(
            f"an output of shape {output.shape} and type {output.dtype}; with {labels} labels it "
            f"is logits (1, {labels}, height, width) or a map (1, height, width) of whole numbers"
        )
    wanted = [odds[classes.target == one].sum(axis=0) for one in classes.wanted]
    ignored = odds[classes.target == IGNORED]
    rest = ignored.max(axis=0) if len(ignored) else np.zeros(odds.shape[1:], np.float32)
    return np.stack([*wanted, rest])


def mask_regions(
    maps: Maps, classes: ModelClasses, placing: Placing, least_score: float
) -> list[Region]:
    """The elements in ``segmentation_maps``: pixels that are likelier that than anything else.

    Scores are means of the pixels' odds. Arms are cut off poles, pieces of one pole put together,
    specks dropped. Signs that touch stay one.
    """
    in_image = placing.maps(maps)
    regions: list[Region] = []
    for index, target in enumerate(classes.wanted):
        others = np.delete(in_image, index, axis=0).max(axis=0)
        mask = in_image[index] > others
        pieces = _poles(mask) if target in classes.lines else _signs(mask)
        regions += [_region(one, target, in_image[index]) for one in pieces]
    return [one for one in regions if one.score >= least_score]


def _region(piece: _Piece, target: int, odds: NDArray[np.float32]) -> Region:
    (left, top), (height, width) = piece.corner, piece.mask.shape
    inside = odds[top : top + height, left : left + width][piece.mask]
    return Region(
        class_id=None if target == SIGN else target,
        score=float(np.clip(inside.mean(), 0.0, 1.0)),
        box_px=np.array([left, top, left + width - 1, top + height - 1], np.float64),
        mask=piece.mask,
        corner_px=piece.corner,
    )


def _signs(mask: BoolArray) -> list[_Piece]:
    return [
        one
        for one in _components(mask)
        if min(one.mask.shape) >= _SIGN_SIDE and one.mask.sum() >= _SIGN_PIXELS
    ]


def _poles(mask: BoolArray) -> list[_Piece]:
    """Upright pieces, the longest first, each with those that go on along its axis."""
    pieces = [
        upright
        for one in _components(mask)
        if len(one.mask) >= _PIECE_ROWS
        for upright in _upright(one)
    ]
    poles: list[_Piece] = []
    for piece in sorted(pieces, key=lambda one: -len(one.mask)):
        rows = [row for row, pole in enumerate(poles) if _goes_on(pole, piece)]
        if rows:
            poles[rows[0]] = _together(poles[rows[0]], piece)
        else:
            poles.append(piece)
    return [one for one in poles if len(one.mask) >= max(_POLE_ROWS, _SLENDER * one.width)]


def _upright(piece: _Piece) -> list[_Piece]:
    """Without arms and bars across, which are about as thick as the pole is wide.

    What is no higher than twice its width in any column goes; poles side by side that only a bar
    holds together come apart.
    """
    import cv2

    whole = piece.mask.astype(np.uint8)
    length = 2 * int(np.ceil(piece.width)) + 1
    if length > len(whole):
        return [piece]
    opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, np.ones((length, 1), np.uint8))
    kept = cv2.dilate(opened, np.ones((1, 3), np.uint8)).astype(bool) & piece.mask  # with its edges
    left, top = piece.corner
    return [
        _Piece((one.corner[0] + left, one.corner[1] + top), one.mask)
        for one in _components(kept)
        if len(one.mask) >= _PIECE_ROWS
    ]


def _goes_on(pole: _Piece, piece: _Piece) -> bool:
    """Whether a shorter piece above or below lies on a pole's axis, is about as wide, and near."""
    (top, bottom), (first, end) = pole.rows, piece.rows
    gap = max(first - bottom, top - end)
    if not -2 <= gap <= bottom - top or not 0.4 <= piece.width / pole.width <= 2.5:
        return False
    slope, column = _axis(pole)
    row = (first + end - 1) / 2.0
    aside = abs(float(_centres(piece).mean()) - (column + slope * row))
    return bool(aside <= max(_LEAST_ASIDE_PX, _ASIDE * pole.width))


def _axis(pole: _Piece) -> FloatArray:
    """(2,) columns a row, and the column at row 0 of the image."""
    rows = np.nonzero(pole.mask.any(axis=1))[0] + pole.corner[1]
    if len(rows) < _POLE_ROWS:  # too short to tell a slope
        return np.array([0.0, _centres(pole).mean()])
    return np.polyfit(rows, _centres(pole), 1)


def _centres(piece: _Piece) -> FloatArray:
    """(rows with pixels,) their mean column in the image."""
    counts = piece.mask.sum(axis=1)
    sums = piece.mask @ np.arange(piece.mask.shape[1], dtype=np.float64)
    return np.asarray(sums[counts > 0] / counts[counts > 0] + piece.corner[0])


def _together(one: _Piece, other: _Piece) -> _Piece:
    low = np.minimum(one.corner, other.corner)
    ends = [np.add(piece.corner, piece.mask.shape[::-1]) for piece in (one, other)]
    width, height = np.maximum(*ends) - low
    mask = np.zeros((height, width), bool)
    for piece in (one, other):
        (left, top), (rows, columns) = np.subtract(piece.corner, low), piece.mask.shape
        mask[top : top + rows, left : left + columns] |= piece.mask
    return _Piece((int(low[0]), int(low[1])), mask)


def _components(mask: BoolArray) -> list[_Piece]:
    import cv2

    number, labels, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    pieces = []
    for label in range(1, number):
        left, top, width, height = (int(one) for one in boxes[label, :4])
        inside = labels[top : top + height, left : left + width] == label
        pieces.append(_Piece((left, top), inside))
    return pieces
