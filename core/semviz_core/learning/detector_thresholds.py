"""From which heat on the detector tells of an element: chosen for each class, on tuning images."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.classes import ClassSet
from semviz_core.detection.detector import Detector
from semviz_core.detection.labelled import LabelledImage
from semviz_core.detection.own import OwnFinder
from semviz_core.elements import Elements2D
from semviz_core.evaluation.detection import FALSE, Truth, matched

FALSE_AN_IMAGE = 0.15
"""Of all classes together, on tuning streets, some of which are nearly empty; elsewhere it is more.
To refuse a proposal takes a key, to draw what was not proposed several; and localization expects
false ones."""
LOWEST = 0.05
"""What has less heat is not looked at."""
PRICES: FloatArray = np.geomspace(0.02, 50.0, 60)
"""Of a false detection in an image, in recall: the lowest that keeps within the limit counts."""


@dataclass(frozen=True, eq=False)
class Found:
    """What was found in all images."""

    images: int
    class_id: IntArray
    """(k,)"""
    score: FloatArray
    """(k,)"""
    is_right: BoolArray
    """(k,)"""
    there: dict[int, int]
    """How many elements of each class there are."""


def chosen_thresholds(
    finder: OwnFinder, images: Iterable[LabelledImage], classes: ClassSet
) -> FloatArray:
    """(classes,) with the highest recall, summed over classes, at ``FALSE_AN_IMAGE``."""
    found = _found(finder, images, classes)
    for price in PRICES:
        chosen = [_best(found, one.id, float(price)) for one in classes]
        if sum(false for _, false in chosen) <= FALSE_AN_IMAGE:
            break
    return np.array([threshold for threshold, _ in chosen])


def _best(found: Found, class_id: int, price: float) -> tuple[float, float]:
    """The threshold of a class whose recall less the price of what is false is highest, and how
    many are false in an image then."""
    rows = np.flatnonzero(found.class_id == class_id)
    rows = rows[np.argsort(-found.score[rows], kind="stable")]
    recall = np.cumsum(found.is_right[rows]) / max(found.there.get(class_id, 0), 1)
    false = np.cumsum(~found.is_right[rows]) / max(found.images, 1)
    worth = np.concatenate([[0.0], recall - price * false])
    best = int(np.argmax(worth))
    if best == 0:
        return 1.0, 0.0
    beyond = found.score[rows[best]] if best < len(rows) else LOWEST
    between = 0.5 * (found.score[rows[best - 1]] + beyond)  # however weights are rounded
    return float(between), float(false[best - 1])


def _found(finder: OwnFinder, images: Iterable[LabelledImage], classes: ClassSet) -> Found:
    detector = Detector(replace(finder, least=np.full(len(classes), LOWEST)))
    class_id, score, is_right = [], [], []
    there: dict[int, int] = {}
    count = 0
    for labelled in images:
        count += 1
        seen = detector.detect(labelled.image)
        rows = matched(seen, Truth.of(labelled.elements))
        told = (rows >= 0) | ((rows == FALSE) & ~_in_doubt(seen, labelled))
        class_id.append(seen.class_id[told])
        score.append(seen.score[told])
        is_right.append(rows[told] >= 0)
        for one in labelled.elements.class_id.tolist():
            there[one] = there.get(one, 0) + 1
    return Found(
        count, np.concatenate(class_id), np.concatenate(score), np.concatenate(is_right), there
    )


def _in_doubt(seen: Elements2D, labelled: LabelledImage) -> BoolArray:
    """(k,) whether nobody says what is in the middle of each."""
    if labelled.ignored is None:
        return np.zeros(len(seen), bool)
    middle = np.where(seen.is_line[:, None], (seen.anchor_px + seen.end_px) / 2.0, seen.anchor_px)
    height, width = labelled.ignored.shape
    column, row = np.round(middle).astype(int).T
    doubt = np.zeros(len(seen), bool)
    for x, y in ((0, 0), (-2, 0), (2, 0), (0, -2), (0, 2)):  # a pixel beside a thin pole counts too
        at = np.clip(row + y, 0, height - 1), np.clip(column + x, 0, width - 1)
        doubt |= labelled.ignored[at]
    return doubt
