"""Boxes that models tell, YOLO's way or DETR's, to regions: one for each element."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.detection.model_classes import IGNORED, SIGN, ModelClasses
from semviz_core.detection.model_input import Placing
from semviz_core.detection.region import Region
from semviz_core.errors import SemvizError

MOST_BOXES = 300
"""The best so many are kept of what a model tells."""
Output = NDArray[Any]
"""What a model gives: floats of any width."""


class Boxes(NamedTuple):
    """What a model tells: the best class of each of its n boxes."""

    edges: FloatArray
    """(n, 4) left, top, right, bottom, pixels of the input from its corner."""
    label: IntArray
    """(n,) index of the model's class."""
    score: FloatArray
    """(n,)"""


def yolo_boxes(output: Output, labels: int, objectness: bool) -> Boxes:
    """Of (1, n, 5 + labels) with an objectness (v5), or (1, 4 + labels, n) without (v8 and later).

    Rows are centre, width and height in pixels of the input, then scores. Raises SemvizError
    where the shape is another or scores are none.
    """
    columns = labels + 4 + objectness
    shown = f"(1, boxes, {columns})" if objectness else f"(1, {columns}, boxes)"
    if output.ndim != 3 or len(output) != 1 or output.shape[2 if objectness else 1] != columns:
        raise SemvizError(f"an output of shape {output.shape}; with {labels} labels it is {shown}")
    rows = (output[0] if objectness else output[0].T).astype(np.float64)
    scores = rows[:, 4 + objectness :] * (rows[:, 4:5] if objectness else 1.0)
    if scores.size and not (scores.min() >= -1e-3 and scores.max() <= 1.0 + 1e-3):
        raise SemvizError(
            "scores that are not between 0 and 1: export the model with its last step"
        )
    return _best(_edges(rows[:, :4]), np.clip(scores, 0.0, 1.0))


def detr_boxes(logits: Output, boxes: Output, labels: int, input_size: tuple[int, int]) -> Boxes:
    """Of logits (1, n, labels) or (1, n, labels + 1) and boxes (1, n, 4), parts of the input.

    One logit more than labels is "nothing" and the scores are a softmax; else each is a sigmoid.
    Raises SemvizError where the shapes are others.
    """
    if logits.ndim != 3 or len(logits) != 1 or logits.shape[2] not in (labels, labels + 1):
        raise SemvizError(
            f"logits of shape {logits.shape}; with {labels} labels they are (1, boxes, {labels}), "
            f"or (1, boxes, {labels + 1}) with one for nothing"
        )
    if boxes.shape != (1, logits.shape[1], 4):
        raise SemvizError(f"boxes of shape {boxes.shape}; they are (1, {logits.shape[1]}, 4)")
    values = logits[0].astype(np.float64)
    alone = values.shape[1] == labels
    scores = sigmoid(values) if alone else softmax(values, 1)[:, :labels]
    width, height = input_size
    return _best(_edges(boxes[0].astype(np.float64)) * [width, height, width, height], scores)


def softmax(values: NDArray[Any], axis: int) -> NDArray[Any]:
    """Odds to probabilities that add up to 1 along an axis."""
    powers = np.exp(values - values.max(axis=axis, keepdims=True))
    return np.asarray(powers / powers.sum(axis=axis, keepdims=True))


def sigmoid(values: NDArray[Any]) -> NDArray[Any]:
    """Each by itself."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * values))


def box_regions(
    boxes: Boxes,
    classes: ModelClasses,
    placing: Placing,
    least_score: float,
    most_overlap: float = 1.0,
) -> list[Region]:
    """The boxes that count, best first; of two of a kind that overlap by more (IoU), the better.

    Poles and signs are kinds; a sign seen with two shapes is one sign.
    """
    target = classes.target[boxes.label]
    wanted = np.nonzero((target != IGNORED) & (boxes.score >= least_score))[0]
    best = wanted[np.argsort(-boxes.score[wanted], kind="stable")][:MOST_BOXES]
    box_px = placing.boxes_px(boxes.edges[best])
    is_line = np.isin(target[best], list(classes.lines))
    kept = np.asarray((box_px[:, 2:] > box_px[:, :2]).all(axis=1))
    for kind in (is_line, ~is_line):
        rows = np.nonzero(kind & kept)[0]
        kept[rows] = not_overlapped(box_px[rows], most_overlap)
    return [
        Region(
            class_id=None if target[row] == SIGN else int(target[row]),
            score=float(boxes.score[row]),
            box_px=box,
        )
        for row, box in zip(best[kept], box_px[kept], strict=True)
    ]


def not_overlapped(box_px: FloatArray, most_overlap: float) -> NDArray[np.bool_]:
    """(n,) whether no better one that is kept overlaps it by more (IoU); best first (NMS)."""
    low, high = box_px[:, None, :2], box_px[:, None, 2:]
    inner = np.minimum(high, box_px[:, 2:]) - np.maximum(low, box_px[:, :2])
    shared = np.clip(inner, 0.0, None).prod(axis=2)
    area = (box_px[:, 2:] - box_px[:, :2]).prod(axis=1)
    overlaps = shared > most_overlap * (area[:, None] + area - shared)
    kept = np.ones(len(box_px), bool)
    for row in range(len(box_px)):
        kept[row] = not (overlaps[row, :row] & kept[:row]).any()
    return kept


def _edges(centred: FloatArray) -> FloatArray:
    """Centre, width, height to left, top, right, bottom."""
    middle, half = centred[:, :2], np.abs(centred[:, 2:]) / 2.0
    return np.concatenate([middle - half, middle + half], axis=1)


def _best(edges: FloatArray, scores: FloatArray) -> Boxes:
    label = scores.argmax(axis=1)
    return Boxes(edges, label.astype(np.int64), np.take_along_axis(scores, label[:, None], 1)[:, 0])
