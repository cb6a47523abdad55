"""Summarize a detector over many images: by class, threshold and distance, with sigma calibration.

Sigma calibration compares errors with their predicted sigma, in bins of sigma.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from semviz_core.base.classes import ClassSet, ElementClass
from semviz_core.base.elements import Elements2D, joined
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.metrics import detection
from semviz_core.metrics.detection import ClassAccuracy, ImageErrors, rms

SIGMA_LIMITS_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
"""Limits of the sigma bins."""


@dataclass(frozen=True)
class SigmaBin:
    """Errors of similar sigma."""

    sigma_px: float
    """Root mean square of sigma."""
    error_px: float
    """Root mean square of the errors; equals sigma if calibrated."""
    ratio: float
    """Root mean square of error over sigma; 1 if calibrated."""
    errors: int
    """Number of errors in the bin."""


def sigma_calibration(detections: Elements2D, true: Elements2D) -> dict[str, tuple[SigmaBin, ...]]:
    """Return the sigma bins of k detections with their true elements (k,), without empty bins.

    For a sign, both image axes count. For a pole, its ends' errors across the true line count, and
    those along it if an end is visible and reported as known.
    """
    pairs = errors_and_sigmas(detections, true)
    return {name: tuple(_bins(error, sigma)) for name, (error, sigma) in pairs.items()}


def errors_and_sigmas(
    detections: Elements2D, true: Elements2D
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return errors and their predicted sigmas, by group of ``sigma_calibration``."""
    line, point = detections.is_line, ~detections.is_line
    offset = detections.anchor_px[point] - true.anchor_px[point]
    across, along = _pole_errors(detections[line], true[line])
    sigma = detections.sigma_px[line]
    known = np.stack(
        [_both_know("anchor", detections, true), _both_know("end", detections, true)], axis=1
    )
    return {
        "signs": (offset.ravel(), detections.sigma_px[point].ravel()),
        "poles, across": (across.ravel(), np.repeat(sigma[:, 0], 2)),
        "poles, along": (
            along[known[line]],
            np.repeat(sigma[:, 1:], 2, axis=1)[known[line]],
        ),
    }


def _pole_errors(detections: Elements2D, true: Elements2D) -> tuple[FloatArray, FloatArray]:
    """Return the ends' errors (k, 2) across the true line, and (k, 2) along it."""
    axis = true.end_px - true.anchor_px
    unit = unit_vectors(axis)
    normal = np.stack([unit[:, 1], -unit[:, 0]], axis=1)
    offset = np.stack(
        [detections.anchor_px - true.anchor_px, detections.end_px - true.end_px], axis=1
    )
    return np.einsum("kei,ki->ke", offset, normal), np.einsum("kei,ki->ke", offset, unit)


def _both_know(end: str, detections: Elements2D, true: Elements2D) -> BoolArray:
    """Return (k,) whether an end is known in both."""
    return np.asarray(getattr(detections, f"{end}_known") & getattr(true, f"{end}_known"))


def _bins(error_px: FloatArray, sigma_px: FloatArray) -> Iterator[SigmaBin]:
    bin_index = np.searchsorted(SIGMA_LIMITS_PX, sigma_px, side="right")
    for index in np.unique(bin_index):
        sigma, error = sigma_px[bin_index == index], error_px[bin_index == index]
        yield SigmaBin(rms(sigma) or 0.0, rms(error) or 0.0, rms(error / sigma) or 0.0, len(error))


FALSE_A_FRAME = 0.2
"""False positives per frame, of all classes together, at which recall is stated."""
CURVE_RATES = (*np.arange(0.0, 0.5, 0.02).round(2).tolist(),
               *np.arange(0.5, 2.01, 0.1).round(1).tolist())  # fmt: skip
"""False positives per frame at which the recall curve has points."""
DISTANCES_M = (3.0, 10.0, 20.0, 30.0, 40.0, 60.0, 100.0, 200.0)
"""Limits of the distance bins of recall."""


@dataclass(frozen=True, eq=False)
class ImageEvaluation:
    """The detections and the true elements of one image."""

    detections: Elements2D
    truth: detection.ImageGroundTruth
    seconds: float | None
    """CPU time of the detector; None if its detections were stored before."""

    @cached_property
    def matches(self) -> IntArray:
        """(m,) as ``match_detections``."""
        return detection.match_detections(self.detections, self.truth)

    @cached_property
    def missed(self) -> IntArray:
        """Rows of elements that count and were not detected."""
        matched = np.isin(np.arange(len(self.truth.counts)), self.matches)
        return np.flatnonzero(self.truth.counts & ~matched)

    def above(self, threshold: float) -> "ImageEvaluation":
        """Return the same with the detections of at least this score."""
        kept = self.detections.score >= threshold
        return ImageEvaluation(self.detections[kept], self.truth, self.seconds)


@dataclass(frozen=True)
class Share:
    """A count, its total and their ratio."""

    count: int
    of: int
    share: float | None = field(init=False)
    """None if the total is 0."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "share", self.count / self.of if self.of else None)


@dataclass(frozen=True)
class EndsFigures:
    """How well a detector recognizes visible and hidden ends of poles."""

    seen: Share
    """Share of the visible ends that are reported as known."""
    hidden: Share
    """Share of the hidden or cut-off ends that are reported as unknown."""
    along_rmse_px: float | None
    """Root mean square error along the pole, of visible ends that are reported as known."""


@dataclass(frozen=True)
class ClassFigures:
    """Figures of one class."""

    recall: Share
    precision: Share
    """Without detections of ignored elements."""
    false_a_frame: float
    """False positives per frame."""
    accuracy: ClassAccuracy
    """Errors of the correct detections."""
    recall_by_distance: tuple[Share, ...]
    """One for each bin of ``DISTANCES_M``, without elements of unknown distance."""
    peaks: EndsFigures | None
    bottoms: EndsFigures | None
    """For poles; None for signs."""


@dataclass(frozen=True)
class CurvePoint:
    """Recall at the threshold with this number of false positives per frame."""

    false_a_frame: float
    threshold: float
    recall: dict[str, float | None]
    """By class."""


@dataclass(frozen=True)
class DetectionFigures:
    """All figures of a detector, for detections that score ``threshold`` or more."""

    frames: int
    threshold: float
    false_a_frame: float
    """False positives per frame, of all classes together."""
    classes: dict[str, ClassFigures]
    confusion: tuple[tuple[int, ...], ...]
    """Rows: true class, then no element. Columns: detected class, then no detection."""
    curve: tuple[CurvePoint, ...]
    """Up to the largest rate that the detector reaches."""
    sigma: dict[str, tuple[SigmaBin, ...]]
    """Calibration of sigma: for signs, across poles and along them."""
    time_ms_median: float | None
    time_ms_p95: float | None
    """None if no image was timed."""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return asdict(self)


def detection_figures(
    images: Sequence[ImageEvaluation], classes: ClassSet, threshold: float | None = None
) -> DetectionFigures:
    """Return the figures over one image or more.

    Default threshold: the lowest with at most ``FALSE_A_FRAME``, chosen on these images.
    """
    if threshold is None:
        threshold = threshold_at(images, FALSE_A_FRAME)
    above = [image.above(threshold) for image in images]
    pairs = _pairs(above)
    times = np.array([image.seconds for image in images if image.seconds is not None]) * 1e3
    return DetectionFigures(
        frames=len(images),
        threshold=threshold,
        false_a_frame=len(_false_positive_scores(above)) / len(images),
        classes={class_.name: _class_figures(above, pairs, class_) for class_ in classes},
        confusion=_confusion(above, classes),
        curve=tuple(_curve(images, classes)),
        sigma=sigma_calibration(*pairs),
        time_ms_median=float(np.median(times)) if len(times) else None,
        time_ms_p95=float(np.percentile(times, 95.0)) if len(times) else None,
    )


def threshold_at(images: Sequence[ImageEvaluation], false_a_frame: float) -> float:
    """Return the lowest score with at most this many false positives per frame; 0 if all pass.

    Matches do not depend on lower scores, so neither do false positives.
    """
    allowed = int(false_a_frame * len(images) + 1e-9)
    false = np.sort(_false_positive_scores(images))[::-1]
    if len(false) <= allowed:
        return 0.0
    scores = np.concatenate([image.detections.score for image in images])
    higher = scores[scores > false[allowed]]
    return float(higher.min()) if len(higher) else float(np.nextafter(false[allowed], 2.0))


def _false_positive_scores(images: Iterable[ImageEvaluation]) -> FloatArray:
    return np.concatenate(
        [image.detections.score[image.matches == detection.FALSE_POSITIVE] for image in images]
    )


def _curve(images: Sequence[ImageEvaluation], classes: ClassSet) -> Iterable[CurvePoint]:
    """Yield points up to the number of false positives that the detector reaches."""
    most = len(_false_positive_scores(images)) / len(images)
    score = np.concatenate([image.detections.score[image.matches >= 0] for image in images])
    kind = np.concatenate([image.detections.class_id[image.matches >= 0] for image in images])
    true = np.concatenate([image.truth.elements.class_id[image.truth.counts] for image in images])
    for rate in CURVE_RATES:
        threshold = threshold_at(images, rate)
        recall = {
            class_.name: Share(
                int(((kind == class_.id) & (score >= threshold)).sum()),
                int((true == class_.id).sum()),
            ).share
            for class_ in classes
        }
        yield CurvePoint(rate, threshold, recall)
        if rate >= most:
            return


def _pairs(images: Sequence[ImageEvaluation]) -> tuple[Elements2D, Elements2D]:
    """Return the k correct detections of all images, and their true elements (k,)."""
    empty = Elements2D.from_ends([], [], [])
    detections, true = empty, empty
    for image in images:
        rows = image.matches >= 0
        detections = joined(detections, image.detections[rows])
        true = joined(true, image.truth.elements[image.matches[rows]])
    return detections, true


def _class_figures(
    images: Sequence[ImageEvaluation], pairs: tuple[Elements2D, Elements2D], kind: ElementClass
) -> ClassFigures:
    class_id = kind.id
    rows = pairs[1].class_id == class_id
    detections, true = pairs[0][rows], pairs[1][rows]
    of_class = [image.detections.class_id == class_id for image in images]
    false = sum(
        int((image.matches[rows] == detection.FALSE_POSITIVE).sum())
        for image, rows in zip(images, of_class, strict=True)
    )
    counted = sum(int(_counted(image, class_id).sum()) for image in images)
    is_line = kind.kind == "line"
    return ClassFigures(
        recall=Share(len(detections), counted),
        precision=Share(len(detections), len(detections) + false),
        false_a_frame=false / len(images),
        accuracy=ClassAccuracy.of(
            [
                ImageErrors.between(*ends)
                for ends in zip(_ends(detections), _ends(true), strict=True)
            ]
        ),
        recall_by_distance=tuple(_recall_by_distance(images, class_id)),
        peaks=_ends_figures(detections, true, "anchor") if is_line else None,
        bottoms=_ends_figures(detections, true, "end") if is_line else None,
    )


def _counted(image: ImageEvaluation, class_id: int) -> BoolArray:
    """Return (n,) which true elements count and are of a class."""
    return np.asarray(image.truth.counts & (image.truth.elements.class_id == class_id))


def _ends(elements: Elements2D) -> FloatArray:
    """Return (k, 2, 2) anchors and ends."""
    return np.stack([elements.anchor_px, elements.end_px], axis=1)


def _recall_by_distance(images: Sequence[ImageEvaluation], class_id: int) -> Iterable[Share]:
    empty = np.zeros(0)
    all_counted, matched = [empty], [empty]
    for image in images:
        counted = np.flatnonzero(_counted(image, class_id))
        all_counted.append(image.truth.distance_m[counted])
        matched.append(image.truth.distance_m[counted[np.isin(counted, image.matches)]])
    limits = np.array(DISTANCES_M)
    counts = (
        np.histogram(np.concatenate(some), limits)[0].tolist() for some in (matched, all_counted)
    )
    return (Share(count, of) for count, of in zip(*counts, strict=True))


def _ends_figures(detections: Elements2D, true: Elements2D, end: str) -> EndsFigures:
    """Return the figures of the peaks (``anchor``) or bottoms (``end``) of poles."""
    reported, visible = getattr(detections, f"{end}_known"), getattr(true, f"{end}_known")
    axis = true.end_px - true.anchor_px
    along = unit_vectors(axis)
    offset = getattr(detections, f"{end}_px") - getattr(true, f"{end}_px")
    both = reported & visible
    error = (offset * along).sum(axis=1)[both]
    return EndsFigures(
        seen=Share(int(both.sum()), int(visible.sum())),
        hidden=Share(int((~reported & ~visible).sum()), int((~visible).sum())),
        along_rmse_px=float(np.sqrt(np.square(error).mean())) if both.any() else None,
    )


def _confusion(images: Sequence[ImageEvaluation], classes: ClassSet) -> tuple[tuple[int, ...], ...]:
    """Return (k + 1, k + 1) counts by true and detected class."""
    place = {class_.id: row for row, class_ in enumerate(classes)}
    background = len(classes)
    table = np.zeros((background + 1, background + 1), dtype=np.int64)
    for image in images:
        kinds = [place[int(class_id)] for class_id in image.truth.elements.class_id]
        shown = np.where(
            image.matches == detection.FALSE_POSITIVE,
            detection.match_confused_classes(image.detections, image.truth, image.matches),
            image.matches,
        )
        for row, class_id in zip(shown.tolist(), image.detections.class_id.tolist(), strict=True):
            if row != detection.IGNORED:
                table[
                    background if row == detection.FALSE_POSITIVE else kinds[row], place[class_id]
                ] += 1
        for row in image.missed.tolist():
            if row not in shown:
                table[kinds[row], background] += 1
    return tuple(map(tuple, table.tolist()))
