"""Turn the output of external models into regions: boxes (YOLO, DETR) and class maps.

Overlapping boxes are suppressed (NMS), best score first. In a class map each connected component
of a sign is a region. Arms and crossbars of poles are removed, and pieces along one axis joined.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.detection.model_config import IGNORED, SIGN, ImagePlacement, Maps, ModelClasses
from semviz_core.detection.regions import Region

MOST_BOXES = 300
"""Maximum number of boxes kept, by score."""
_PIXELS_AT_ONCE = 8192
"""Number of pixels of a class map that are turned into probabilities at a time: they fit into the
cache."""
_LEAST_LOG_RATIO = -3.0
"""Least logarithm of the probability of a pole or sign in a pixel, over that of the likeliest
class, at which probabilities are worked out there and beside it."""
Output = NDArray[Any]
"""A model's output: floats of any width."""


class Boxes(NamedTuple):
    """The n boxes of a model, each with its best class."""

    edges: FloatArray
    """(n, 4) left, top, right, bottom in pixels of the input, from its corner."""
    label: IntArray
    """(n,) index of the model's class."""
    score: FloatArray
    """(n,)"""


def yolo_boxes(output: Output, labels: int, objectness: bool) -> Boxes:
    """Return the boxes of (1, n, 5 + labels) with objectness (v5), or (1, 4 + labels, n) (v8 on).

    Rows are centre, width and height in pixels of the input, then scores. Raise SemvizError if the
    shape differs or the scores are not in [0, 1].
    """
    columns = labels + 4 + objectness
    shown = f"(1, boxes, {columns})" if objectness else f"(1, {columns}, boxes)"
    if output.ndim != 3 or len(output) != 1 or output.shape[2 if objectness else 1] != columns:
        raise SemvizError(f"an output of shape {output.shape}; with {labels} labels it is {shown}")
    rows = (output[0] if objectness else output[0].T).astype(np.float64)
    scores = rows[:, 4 + objectness :] * (rows[:, 4:5] if objectness else 1.0)
    if scores.size and not (scores.min() >= -1e-3 and scores.max() <= 1.0 + 1e-3):
        raise SemvizError("scores are not between 0 and 1: export the model with its last layer")
    return _best(_edges(rows[:, :4]), np.clip(scores, 0.0, 1.0))


def detr_boxes(logits: Output, boxes: Output, labels: int, input_size: tuple[int, int]) -> Boxes:
    """Return the boxes of logits (1, n, labels [+ 1]) and boxes (1, n, 4), shares of the input.

    With one logit more than labels, for "no object", scores are a softmax, else sigmoids. Raise
    SemvizError if the shapes differ.
    """
    if logits.ndim != 3 or len(logits) != 1 or logits.shape[2] not in (labels, labels + 1):
        raise SemvizError(
            f"logits of shape {logits.shape}; with {labels} labels they are (1, boxes, {labels}), "
            f"or (1, boxes, {labels + 1}) with one for no object"
        )
    if boxes.shape != (1, logits.shape[1], 4):
        raise SemvizError(f"boxes of shape {boxes.shape}; they are (1, {logits.shape[1]}, 4)")
    values = logits[0].astype(np.float64)
    alone = values.shape[1] == labels
    scores = sigmoid(values) if alone else softmax(values, 1)[:, :labels]
    width, height = input_size
    return _best(_edges(boxes[0].astype(np.float64)) * [width, height, width, height], scores)


def softmax(values: NDArray[Any], axis: int) -> NDArray[Any]:
    """Return probabilities of logits; they sum to 1 along an axis."""
    powers = np.exp(values - values.max(axis=axis, keepdims=True))
    return np.asarray(powers / powers.sum(axis=axis, keepdims=True))


def sigmoid(values: NDArray[Any]) -> NDArray[Any]:
    """Return the probability of each logit."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * values))


def box_regions(
    boxes: Boxes,
    classes: ModelClasses,
    placement: ImagePlacement,
    least_score: float,
    most_overlap: float = 1.0,
) -> list[Region]:
    """Return regions of the boxes above ``least_score``, best first.

    Of two boxes that overlap by more than ``most_overlap`` (IoU), the better is kept. Poles and
    signs never suppress each other; signs of different shapes do.
    """
    target = classes.target[boxes.label]
    wanted = np.nonzero((target != IGNORED) & (boxes.score >= least_score))[0]
    best = wanted[np.argsort(-boxes.score[wanted], kind="stable")][:MOST_BOXES]
    box_px = placement.boxes_px(boxes.edges[best])
    is_line = np.isin(target[best], list(classes.lines))
    kept = np.asarray((box_px[:, 2:] > box_px[:, :2]).all(axis=1))
    for kind in (is_line, ~is_line):
        rows = np.nonzero(kind & kept)[0]
        kept[rows] = suppress_overlaps(box_px[rows], most_overlap)
    return [
        Region(
            class_id=None if target[row] == SIGN else int(target[row]),
            score=float(boxes.score[row]),
            box_px=box,
        )
        for row, box in zip(best[kept], box_px[kept], strict=True)
    ]


def suppress_overlaps(box_px: FloatArray, most_overlap: float) -> NDArray[np.bool_]:
    """Return (n,) whether each box is kept (NMS): no better one overlaps it by more (IoU).

    Boxes are sorted, best first.
    """
    low, high = box_px[:, None, :2], box_px[:, None, 2:]
    inner = np.minimum(high, box_px[:, 2:]) - np.maximum(low, box_px[:, :2])
    intersection = np.clip(inner, 0.0, None).prod(axis=2)
    area = (box_px[:, 2:] - box_px[:, :2]).prod(axis=1)
    overlaps = intersection > most_overlap * (area[:, None] + area - intersection)
    kept = np.ones(len(box_px), bool)
    for row in range(len(box_px)):
        kept[row] = not (overlaps[row, :row] & kept[:row]).any()
    return kept


def _edges(centred: FloatArray) -> FloatArray:
    """Convert centre, width and height to left, top, right, bottom."""
    middle, half = centred[:, :2], np.abs(centred[:, 2:]) / 2.0
    return np.concatenate([middle - half, middle + half], axis=1)


def _best(edges: FloatArray, scores: FloatArray) -> Boxes:
    label = scores.argmax(axis=1)
    return Boxes(edges, label.astype(np.int64), np.take_along_axis(scores, label[:, None], 1)[:, 0])


_POLE_ROWS, _PIECE_ROWS = 8, 3
"""Least number of rows of a pole, and of a piece of a partly hidden pole."""
_SLENDER = 2.0
"""Least ratio of height to width of a pole."""
_SIGN_SIDE, _SIGN_PIXELS = 6, 25
"""Least side of a sign's mask, and number of its pixels: smaller ones show no shape."""
_ASIDE = 1.0
"""Largest distance, in widths of the pole, between a piece and the axis of its pole."""
_LEAST_ASIDE_PX = 2.0
_NEAR_ROWS = 60
"""Least number of rows of a pole so near that its mask may cover only its two edges."""
_SIDE_BY_SIDE, _MOST_GAP, _EDGES_SLENDER, _HALF_SEEN = 0.6, 1.5, 3.0, 0.15
"""Two edges of one thick pole share this part of the longer one's rows, their gap is at most so
many times as wide as both, they are together so slender, and the mean probability of a pole in the
gap is at least the last."""


@dataclass(frozen=True, eq=False)
class _Piece:
    """The pixels of one connected component, or of a joined pole."""

    corner: tuple[int, int]
    """Column and row of the first pixel."""
    mask: BoolArray

    @cached_property
    def rows(self) -> tuple[int, int]:
        """The first row, and the row after the last."""
        return self.corner[1], self.corner[1] + len(self.mask)

    @cached_property
    def width(self) -> float:
        """Median number of pixels in a row."""
        counts = np.sort(self._counts[self._counts > 0])
        return float(counts[(len(counts) - 1) // 2] + counts[len(counts) // 2]) / 2.0

    @cached_property
    def _counts(self) -> IntArray:
        """Number of pixels in each row."""
        return np.asarray(self.mask.sum(axis=1))

    @cached_property
    def centres(self) -> FloatArray:
        """Mean column in the image of each row with pixels."""
        counts = self._counts
        sums = self.mask @ np.arange(self.mask.shape[1], dtype=np.float64)
        return np.asarray(sums[counts > 0] / counts[counts > 0] + self.corner[0])

    @cached_property
    def middle(self) -> float:
        """Mean of the centres."""
        return float(self.centres.mean())

    @cached_property
    def axis(self) -> FloatArray:
        """(2,) slope in columns per row, and the column at row 0 of the image."""
        rows = np.flatnonzero(self._counts) + self.corner[1]
        if len(rows) < _POLE_ROWS:  # too short to tell a slope
            return np.array([0.0, self.middle])
        away = rows - rows.mean()
        slope = float(away @ self.centres) / float(away @ away)
        return np.array([slope, self.middle - slope * float(rows.mean())])


def segmentation_maps(output: NDArray[Any], classes: ModelClasses) -> Maps:
    """Return maps (k + 1, h, w) of logits (1, classes, h, w) or of a map (1, h, w) of labels.

    They hold the probability of each of the k ``wanted`` targets, then that of the likeliest
    ignored class; where no target is nearly as likely, 0 and 1. Raise SemvizError if the shape
    differs, a label is too high or logits are not finite.
    """
    labels = len(classes)
    if output.ndim == 3 and len(output) == 1 and output.dtype.kind in "iu":
        if output.size and not (output.min() >= 0 and output.max() < labels):
            raise SemvizError(f"labels from {output.min()} to {output.max()}; it has {labels}")
        values = output
    elif output.ndim == 4 and output.shape[:2] == (1, labels) and output.dtype.kind == "f":
        values = output[0]
    else:
        raise SemvizError(
            f"an output of shape {output.shape} and type {output.dtype}; with {labels} labels it "
            f"is logits (1, {labels}, height, width) or a map (1, height, width) of whole numbers"
        )
    each = values.reshape(len(values), -1)
    places = _of_interest(values, classes) if values.dtype.kind == "f" else np.arange(each.shape[1])
    maps = np.zeros((len(classes.wanted) + 1, *values.shape[1:]), np.float32)
    maps[-1] = 1.0
    pixels = maps.reshape(len(maps), -1)
    for first in range(0, len(places), _PIXELS_AT_ONCE):
        some = places[first : first + _PIXELS_AT_ONCE]
        pixels[:, some] = _maps_of_pixels(each.take(some, 1), classes)
    return maps


def _of_interest(logits: NDArray[Any], classes: ModelClasses) -> IntArray:
    """Return the indices of the pixels that may be of a region, and of those beside them.

    Between other pixels, interpolation makes no region likeliest. Raise SemvizError if the largest
    logit of a pixel is not finite.
    """
    import cv2

    most = logits.max(axis=0)
    if not np.isfinite(most).all():
        raise SemvizError("its output holds other than finite numbers")
    least = most + logits.dtype.type(_LEAST_LOG_RATIO)
    near = np.zeros(least.shape, np.uint8)
    for label in np.flatnonzero(classes.target != IGNORED).tolist():
        near |= logits[label] >= least
    return np.flatnonzero(cv2.dilate(near, np.ones((3, 3), np.uint8)))


def _maps_of_pixels(values: NDArray[Any], classes: ModelClasses) -> Maps:
    """Return maps (k + 1, n) of logits (classes, n) or labels (1, n) of n pixels."""
    total: NDArray[np.float32] | np.float32 = np.float32(1.0)
    if values.dtype.kind == "f":
        powers = values.astype(np.float32)
        np.exp(np.subtract(powers, powers.max(axis=0), out=powers), out=powers)
        total = powers.sum(axis=0)
    else:
        powers = np.equal(values, np.arange(len(classes))[:, None]).astype(np.float32)
    maps = np.zeros((len(classes.wanted) + 1, powers.shape[1]), np.float32)
    place = {target: row for row, target in enumerate(classes.wanted)}
    for label, target in enumerate(classes.target.tolist()):
        if target == IGNORED:
            np.maximum(maps[-1], powers[label], out=maps[-1])
        else:
            maps[place[target]] += powers[label]
    return np.asarray(maps / total)


def mask_regions(
    maps: Maps, classes: ModelClasses, placement: ImagePlacement, least_score: float
) -> list[Region]:
    """Return the regions in ``segmentation_maps``: pixels whose likeliest class is the target.

    Scores are means of the pixels' probabilities. Arms of poles are removed, pieces of one pole
    joined, specks dropped. Touching signs are one region.
    """
    in_image = placement.maps(maps)
    regions: list[Region] = []
    for index, target in enumerate(classes.wanted):
        mask = np.ones(in_image.shape[1:], np.bool_)
        for other in range(len(in_image)):
            if other != index:
                mask &= in_image[index] > in_image[other]
        pieces = _poles(mask, in_image[index]) if target in classes.lines else _signs(mask)
        regions += [_region(piece, target, in_image[index]) for piece in pieces]
    return [region for region in regions if region.score >= least_score]


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
        component
        for component in _components(mask)
        if min(component.mask.shape) >= _SIGN_SIDE and component.mask.sum() >= _SIGN_PIXELS
    ]


def _poles(mask: BoolArray, odds: NDArray[np.float32]) -> list[_Piece]:
    """Return upright pieces, longest first, each joined with those that continue its axis.

    Two edges of one thick pole are joined too: ``odds`` are the probabilities of a pole.
    """
    pieces = [
        upright
        for component in _components(mask)
        if len(component.mask) >= _PIECE_ROWS
        for upright in _upright(component)
    ]
    poles: list[_Piece] = []
    for piece in sorted(pieces, key=lambda piece: -len(piece.mask)):
        row = next((row for row, pole in enumerate(poles) if _continues(pole, piece)), None)
        if row is None:
            poles.append(piece)
        else:
            poles[row] = _joined(poles[row], piece)
    poles = _with_joined_edges(poles, odds)
    return [piece for piece in poles if len(piece.mask) >= max(_POLE_ROWS, _SLENDER * piece.width)]


def _upright(piece: _Piece) -> list[_Piece]:
    """Remove arms and crossbars, which are about as thick as the pole is wide.

    Columns with runs no higher than twice the width are dropped, so poles that only a bar connects
    are separated.
    """
    import cv2

    whole = piece.mask.astype(np.uint8)
    length = 2 * int(np.ceil(piece.width)) + 1
    if length > len(whole):
        return [piece]
    opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, np.ones((length, 1), np.uint8))
    kept = cv2.dilate(opened, np.ones((1, 3), np.uint8)).astype(bool) & piece.mask  # keeps edges
    left, top = piece.corner
    return [
        _Piece((component.corner[0] + left, component.corner[1] + top), component.mask)
        for component in _components(kept)
        if len(component.mask) >= _PIECE_ROWS
    ]


def _continues(pole: _Piece, piece: _Piece) -> bool:
    """Whether a shorter piece continues a pole: on its axis, of similar width, and near."""
    (top, bottom), (first, end) = pole.rows, piece.rows
    gap = max(first - bottom, top - end)
    if not -2 <= gap <= bottom - top or not 0.4 <= piece.width / pole.width <= 2.5:
        return False
    slope, column = pole.axis
    row = (first + end - 1) / 2.0
    offset = abs(piece.middle - (column + slope * row))
    return bool(offset <= max(_LEAST_ASIDE_PX, _ASIDE * pole.width))


def _with_joined_edges(poles: list[_Piece], odds: NDArray[np.float32]) -> list[_Piece]:
    """Return the poles, with two that are the edges of one thick pole as one."""
    whole: list[_Piece] = []
    for piece in poles:
        row = next(
            (row for row, pole in enumerate(whole) if _is_other_edge(pole, piece, odds)), None
        )
        if row is None:
            whole.append(piece)
        else:
            whole[row] = _joined(whole[row], piece)
    return whole


def _is_other_edge(pole: _Piece, piece: _Piece, odds: NDArray[np.float32]) -> bool:
    """Whether two pieces are the edges of one pole: side by side, and perhaps a pole between."""
    if min(len(pole.mask), len(piece.mask)) < _NEAR_ROWS:
        return False
    low, high = max(pole.rows[0], piece.rows[0]), min(pole.rows[1], piece.rows[1])
    if high - low < max(_NEAR_ROWS, _SIDE_BY_SIDE * max(len(pole.mask), len(piece.mask))):
        return False
    left, right = sorted((pole, piece), key=lambda each: each.middle)
    ends = [_last_columns(left, low, high), -_last_columns(right, low, high, mirrored=True)]
    between = [
        odds[row, first + 1 : last]
        for row, first, last in zip(range(low, high), *ends, strict=True)
        if 0 <= first + 1 < last
    ]
    gap = float(np.median([len(part) for part in between])) if between else 0.0
    if not 0.0 < gap <= _MOST_GAP * (left.width + right.width) + 2.0:
        return False
    slender = high - low >= _EDGES_SLENDER * (left.width + right.width + gap)
    return bool(slender and float(np.concatenate(between).mean()) >= _HALF_SEEN)


def _last_columns(piece: _Piece, low: int, high: int, mirrored: bool = False) -> IntArray:
    """Return (high - low,) the last column with pixels in each row; mirrored: minus the first."""
    mask = piece.mask[low - piece.corner[1] : high - piece.corner[1]]
    columns = np.arange(mask.shape[1]) + piece.corner[0]
    signed = -columns if mirrored else columns
    lowest = int(signed.min()) - 1
    return np.asarray(np.where(mask, signed, lowest).max(axis=1), np.int64)


def _joined(first: _Piece, second: _Piece) -> _Piece:
    low = np.minimum(first.corner, second.corner)
    ends = [np.add(piece.corner, piece.mask.shape[::-1]) for piece in (first, second)]
    width, height = np.maximum(*ends) - low
    mask = np.zeros((height, width), bool)
    for piece in (first, second):
        (left, top), (rows, columns) = np.subtract(piece.corner, low), piece.mask.shape
        mask[top : top + rows, left : left + columns] |= piece.mask
    return _Piece((int(low[0]), int(low[1])), mask)


def _components(mask: BoolArray) -> list[_Piece]:
    import cv2
    from scipy.ndimage import find_objects

    whole = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(whole)
    if not height:
        return []
    _, labels = cv2.connectedComponents(whole[: top + height, : left + width])
    return [
        _Piece((columns.start, rows.start), labels[rows, columns] == label)
        for label, (rows, columns) in enumerate(find_objects(labels), 1)
    ]
