"""Cut out a detector's missed detections and false positives from their images.

Missed detections come nearest first, false positives by score. The truth is drawn in white,
detections in class colours.
"""

import base64
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz.presentation.plots import PRIOR, TRUTH
from semviz.reports.frame_images import JPEG_QUALITY, cased, trace
from semviz.reports.html import Html, element, void_element
from semviz.research.detector_evaluation import Evaluation
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.metrics.detection import FALSE_POSITIVE, match_confused_classes, match_detections
from semviz_core.metrics.detection_summary import ImageEvaluation

MARGIN_PX = 24.0
"""Margin around an element, in the image's pixels."""
LEAST_PX = 90.0
"""Least height of a crop, in the image's pixels."""
SHOWN = (320.0, 240.0)
"""Displayed width and height of crops."""
SHARP = 1.5
"""Most pixels of a crop per displayed unit, for high-density screens."""


@dataclass(frozen=True, eq=False)
class DetectionError:
    """A missed detection or a false positive."""

    number: int
    """Of the image."""
    row: int
    """Of the ground truth if missed, of the detections if false."""
    score: float
    """Of the false positive; if missed, of the detection below the threshold, or 0."""
    distance_m: float
    """NaN if unknown."""
    words: str
    """Description, such as ``taken for a rounded sign``."""


def missed_detections(evaluation: Evaluation) -> list[DetectionError]:
    """Return the missed detections, nearest first."""
    faults = [
        fault for number in range(len(evaluation.images)) for fault in _missed(evaluation, number)
    ]
    return sorted(
        faults, key=lambda fault: (np.nan_to_num(fault.distance_m, nan=1e9), fault.number)
    )


def false_positives(evaluation: Evaluation) -> list[DetectionError]:
    """Return the false positives, highest score first."""
    numbers = range(len(evaluation.images))
    faults = [fault for number in numbers for fault in _false_positives(evaluation, number)]
    return sorted(faults, key=lambda fault: (-fault.score, fault.number))


def _missed(evaluation: Evaluation, number: int) -> Iterator[DetectionError]:
    whole, above = evaluation.evaluations[number], evaluation.above[number]
    confused = match_confused_classes(above.detections, above.truth, above.matches)
    for row in above.missed.tolist():
        confusions = np.flatnonzero(confused == row)
        weak = whole.detections.score[whole.matches == row]
        words = "nothing found there"
        if len(confusions):
            words = f"taken for a {_name(above.detections, int(confusions[0]))}"
        elif len(weak):
            words = f"found with a score of only {weak[0]:.2f}"
        score = float(weak[0]) if len(weak) else 0.0
        yield DetectionError(number, row, score, float(above.truth.distance_m[row]), words)


def _false_positives(evaluation: Evaluation, number: int) -> Iterator[DetectionError]:
    image = evaluation.above[number]
    confused = match_confused_classes(image.detections, image.truth, image.matches)
    for row in np.flatnonzero(image.matches == FALSE_POSITIVE).tolist():
        truth = int(confused[row])
        distance = float(image.truth.distance_m[truth]) if truth >= 0 else float("nan")
        words = "nothing is there"
        if truth >= 0:
            words = f"is a {_name(image.truth.elements, truth)}"
        elif match_detections(image.detections[[row]], image.truth)[0] >= 0:
            words = "found twice"
        yield DetectionError(number, row, float(image.detections.score[row]), distance, words)


def missed_detection_crop(evaluation: Evaluation, fault: DetectionError) -> Html:
    """Return the crop of a missed detection: ground truth in white, detections in class colours."""
    elements = evaluation.above[fault.number].truth.elements
    caption = f"{_name(elements, fault.row)}{_distance_text(fault)}: {fault.words}"
    return _crop(evaluation, fault, elements[[fault.row]], caption)


def false_positive_crop(evaluation: Evaluation, fault: DetectionError) -> Html:
    """Return the crop of a false positive: ground truth in white, detections in class colours."""
    elements = evaluation.above[fault.number].detections
    scored = f"{_name(elements, fault.row)}, score {fault.score:.2f}"
    caption = f"{scored}: {fault.words}{_distance_text(fault)}"
    return _crop(evaluation, fault, elements[[fault.row]], caption)


def _crop(evaluation: Evaluation, fault: DetectionError, element_: Elements2D, title: str) -> Html:
    image, evaluated = evaluation.images[fault.number], evaluation.above[fault.number]
    window = _Window.around(element_)
    drawn = element(
        "svg",
        *_background(image.read(), window),
        *_marks(evaluated, window),
        viewBox=f"0 0 {SHOWN[0]:g} {SHOWN[1]:g}",
        class_="picture",
        role="img",
        aria_label=title,
    )
    caption = element("figcaption", element("b", title), void_element("br"), image.name)
    return element("figure", drawn, caption)


@dataclass(frozen=True, eq=False)
class _Window:
    """A part of an image."""

    low_px: FloatArray
    """(2,) its top-left corner."""
    scale: float
    """Units of the drawing for a pixel."""

    @classmethod
    def around(cls, elements: Elements2D) -> "_Window":
        ends = np.concatenate([elements.anchor_px, elements.end_px[elements.is_line]])
        size = np.maximum(np.ptp(ends, axis=0) + 2.0 * MARGIN_PX, (1.0, LEAST_PX))
        scale = float(np.min(np.array(SHOWN) / size))
        middle = (ends.min(axis=0) + ends.max(axis=0)) / 2.0
        return cls(middle - np.array(SHOWN) / (2.0 * scale), scale)

    def drawn(self, points_px: FloatArray) -> FloatArray:
        """Return the drawing coordinates of image points (..., 2)."""
        return np.asarray((points_px - self.low_px) * self.scale)


def _background(image: ByteImage, window: _Window) -> Iterator[Html]:
    """Yield the part of the image within the window, on grey."""
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


def _marks(image: ImageEvaluation, window: _Window) -> Iterator[Html]:
    """Yield the ground truth in broad white (grey if it does not count), and the detections in
    narrow lines over it."""
    ground_truth, detections = image.truth.elements, image.detections
    for counts, color in ((False, PRIOR.dark), (True, TRUTH.dark)):
        rows = np.flatnonzero(image.truth.counts == counts)
        traces = [_trace(ground_truth, row, window) for row in rows.tolist()]
        yield cased("".join(traces), color, 2.6)
    for kind in DEFAULT_CLASSES:
        rows = np.flatnonzero(detections.class_id == kind.id)
        traces = [_trace(detections, row, window) for row in rows.tolist()]
        yield cased("".join(traces), kind.color, 1.2)


def _trace(elements: Elements2D, row: int, window: _Window) -> str:
    """Return the path of an element; empty if it is far from the window."""
    ends = window.drawn(np.stack([elements.anchor_px[row], elements.end_px[row]]))
    low, high = np.nanmin(ends, axis=0), np.nanmax(ends, axis=0)
    if (high < -MARGIN_PX).any() or (low > np.array(SHOWN) + MARGIN_PX).any():
        return ""
    return trace(DEFAULT_CLASSES[int(elements.class_id[row])], *ends)


def _distance_text(fault: DetectionError) -> str:
    return "" if np.isnan(fault.distance_m) else f", {fault.distance_m:.0f} m away"


def _name(elements: Elements2D, row: int) -> str:
    return DEFAULT_CLASSES[int(elements.class_id[row])].name
