"""What a detector missed and what it invented, each cut out of its image."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz.detector_evaluation import Evaluation
from semviz.palette import PRIOR, TRUTH
from semviz.reporting.html import Html, element, void_element
from semviz.reporting.pictures import JPEG_QUALITY, cased, trace
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.classes import DEFAULT_CLASSES
from semviz_core.elements import Elements2D
from semviz_core.evaluation.detection import FALSE, confused, matched
from semviz_core.evaluation.detection_figures import Judged

MARGIN_PX = 24.0
"""Of image around an element."""
LEAST_PX = 90.0
"""Height of a crop in the image's pixels."""
SHOWN = (320.0, 240.0)
"""Width and height that crops are drawn in, and so their shape."""
SHARP = 1.5
"""Crops have so many pixels for each of those, at most: some screens show more."""


@dataclass(frozen=True, eq=False)
class Fault:
    """Something missed (a row of the truth) or invented (a row of what was found)."""

    number: int
    """Of the image."""
    row: int
    score: float
    """Of the detection; of what was missed, that of the detection which scores too little, or 0."""
    distance_m: float
    """NaN where nobody knows."""
    words: str
    """What went wrong: ``taken for a rounded sign``."""


def missed(evaluation: Evaluation) -> list[Fault]:
    """The nearest first: they are the worst."""
    faults = [
        one for number in range(len(evaluation.images)) for one in _missed(evaluation, number)
    ]
    return sorted(faults, key=lambda one: (np.nan_to_num(one.distance_m, nan=1e9), one.number))


def invented(evaluation: Evaluation) -> list[Fault]:
    """The surest first."""
    numbers = range(len(evaluation.images))
    faults = [one for number in numbers for one in _invented(evaluation, number)]
    return sorted(faults, key=lambda one: (-one.score, one.number))


def _missed(evaluation: Evaluation, number: int) -> Iterator[Fault]:
    whole, above = evaluation.judged[number], evaluation.above[number]
    shown = confused(above.found, above.truth, above.matches)
    for row in above.missed.tolist():
        taken = np.flatnonzero(shown == row)
        weak = whole.found.score[whole.matches == row]
        words = "nothing found there"
        if len(taken):
            words = f"taken for a {_name(above.found, int(taken[0]))}"
        elif len(weak):
            words = f"found with a score of only {weak[0]:.2f}"
        score = float(weak[0]) if len(weak) else 0.0
        yield Fault(number, row, score, float(above.truth.distance_m[row]), words)


def _invented(evaluation: Evaluation, number: int) -> Iterator[Fault]:
    one = evaluation.above[number]
    shown = confused(one.found, one.truth, one.matches)
    for row in np.flatnonzero(one.matches == FALSE).tolist():
        truth = int(shown[row])
        distance = float(one.truth.distance_m[truth]) if truth >= 0 else float("nan")
        words = "nothing is there"
        if truth >= 0:
            words = f"is a {_name(one.truth.elements, truth)}"
        elif matched(one.found[[row]], one.truth)[0] >= 0:
            words = "found twice"
        yield Fault(number, row, float(one.found.score[row]), distance, words)


def missed_crop(evaluation: Evaluation, fault: Fault) -> Html:
    """With what is truly there in white and what was found in the colours of classes."""
    elements = evaluation.above[fault.number].truth.elements
    about = f"{_name(elements, fault.row)}{_away(fault)}: {fault.words}"
    return _crop(evaluation, fault, elements[[fault.row]], about)


def invented_crop(evaluation: Evaluation, fault: Fault) -> Html:
    """Likewise."""
    elements = evaluation.above[fault.number].found
    about = f"{_name(elements, fault.row)}, score {fault.score:.2f}: {fault.words}{_away(fault)}"
    return _crop(evaluation, fault, elements[[fault.row]], about)


def _crop(evaluation: Evaluation, fault: Fault, element_: Elements2D, about: str) -> Html:
    image, one = evaluation.images[fault.number], evaluation.above[fault.number]
    window = _Window.around(element_)
    drawn = element(
        "svg",
        *_ground(image.read(), window),
        *_marks(one, window),
        viewBox=f"0 0 {SHOWN[0]:g} {SHOWN[1]:g}",
        class_="picture",
        role="img",
        aria_label=about,
    )
    caption = element("figcaption", element("b", about), void_element("br"), image.name)
    return element("figure", drawn, caption)


@dataclass(frozen=True, eq=False)
class _Window:
    """A part of an image."""

    low_px: FloatArray
    """(2,) its top-left corner."""
    scale: float
    """Units of the drawing for a pixel."""

    @classmethod
    def around(cls, one: Elements2D) -> "_Window":
        ends = np.concatenate([one.anchor_px, one.end_px[one.is_line]])
        size = np.maximum(np.ptp(ends, axis=0) + 2.0 * MARGIN_PX, (1.0, LEAST_PX))
        scale = float(np.min(np.array(SHOWN) / size))
        middle = (ends.min(axis=0) + ends.max(axis=0)) / 2.0
        return cls(middle - np.array(SHOWN) / (2.0 * scale), scale)

    def drawn(self, points_px: FloatArray) -> FloatArray:
        """Where points (..., 2) of the image are drawn."""
        return np.asarray((points_px - self.low_px) * self.scale)


def _ground(image: ByteImage, window: _Window) -> Iterator[Html]:
    """What of the image is in the window, on grey."""
    import cv2

    yield element("rect", width="100%", height="100%", fill="#3A3D42")
    height, width = image.shape[:2]
    first = np.maximum(np.floor(window.low_px), 0.0).astype(int)
    last = np.ceil(window.low_px + np.array(SHOWN) / window.scale).astype(int)
    last = np.minimum(last + 1, [width, height])
    part = np.ascontiguousarray(image[first[1] : last[1], first[0] : last[0], ::-1])
    shrink = min(1.0, SHARP * window.scale)
    small = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    x, y = window.drawn(first - 0.5)  # a pixel's number is its middle
    size = (last - first) * window.scale
    yield element(
        "image",
        href=f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}",
        x=f"{x:.2f}",
        y=f"{y:.2f}",
        width=f"{size[0]:.2f}",
        height=f"{size[1]:.2f}",
        preserveAspectRatio="none",
    )


def _marks(one: Judged, window: _Window) -> Iterator[Html]:
    """What is truly there, broad and white, grey where it does not count; over it what was found,
    narrow."""
    true, found = one.truth.elements, one.found
    for counts, color in ((False, PRIOR.dark), (True, TRUTH.dark)):
        rows = np.flatnonzero(one.truth.counts == counts)
        traces = [_trace(true, row, window) for row in rows.tolist()]
        yield cased("".join(traces), color, 2.6)
    for kind in DEFAULT_CLASSES:
        rows = np.flatnonzero(found.class_id == kind.id)
        traces = [_trace(found, row, window) for row in rows.tolist()]
        yield cased("".join(traces), kind.color, 1.2)


def _trace(elements: Elements2D, row: int, window: _Window) -> str:
    """Path data; nothing where an element is far from the window."""
    ends = window.drawn(np.stack([elements.anchor_px[row], elements.end_px[row]]))
    low, high = np.nanmin(ends, axis=0), np.nanmax(ends, axis=0)
    if (high < -MARGIN_PX).any() or (low > np.array(SHOWN) + MARGIN_PX).any():
        return ""
    return trace(DEFAULT_CLASSES[int(elements.class_id[row])], *ends)


def _away(fault: Fault) -> str:
    return "" if np.isnan(fault.distance_m) else f", {fault.distance_m:.0f} m away"


def _name(elements: Elements2D, row: int) -> str:
    return DEFAULT_CLASSES[int(elements.class_id[row])].name
