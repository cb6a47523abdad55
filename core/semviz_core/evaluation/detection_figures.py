"""What a detector reaches over many images: per class, at every threshold, and by distance."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.classes import ClassSet, ElementClass
from semviz_core.elements import Elements2D, joined
from semviz_core.evaluation.detection import FALSE, IGNORED, Truth, confused, matched
from semviz_core.evaluation.image_errors import ClassAccuracy, ImageErrors
from semviz_core.evaluation.sigma_check import SigmaBin, check_sigma

FALSE_A_FRAME = 0.2
"""The rate of false detections, of all classes together, that recall is stated at."""
CURVE_RATES = (*np.arange(0.0, 0.5, 0.02).round(2).tolist(),
               *np.arange(0.5, 2.01, 0.1).round(1).tolist())  # fmt: skip
"""False detections a frame at which the curve is drawn."""
DISTANCES_M = (3.0, 10.0, 20.0, 30.0, 40.0, 60.0, 100.0, 200.0)
"""Limits of the bins that recall is told in."""


@dataclass(frozen=True, eq=False)
class Judged:
    """One image: what was found in it and what is there."""

    found: Elements2D
    truth: Truth
    seconds: float
    """That the detector took of the processor."""

    @cached_property
    def matches(self) -> IntArray:
        """(m,) as ``matched``."""
        return matched(self.found, self.truth)

    @cached_property
    def missed(self) -> IntArray:
        """Rows of what counts and was not found."""
        found = np.isin(np.arange(len(self.truth.counts)), self.matches)
        return np.flatnonzero(self.truth.counts & ~found)

    def above(self, threshold: float) -> "Judged":
        """The same with the detections that score so much or more."""
        return Judged(self.found[self.found.score >= threshold], self.truth, self.seconds)


@dataclass(frozen=True)
class Share:
    """So many of so many."""

    count: int
    of: int
    share: float | None = field(init=False)
    """None of nothing."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "share", self.count / self.of if self.of else None)


@dataclass(frozen=True)
class EndsFigures:
    """How well a detector knows whether it sees an end of a pole."""

    seen: Share
    """Of the ends that can be seen, so many were said to be seen."""
    hidden: Share
    """Of the ends that are hidden or cut off, so many were said to be."""
    along_rmse_px: float | None
    """Of ends that can be seen and were said to be: how far along the pole they are off."""


@dataclass(frozen=True)
class ClassFigures:
    """Of one class."""

    recall: Share
    precision: Share
    """Of the detections, without those of what does not count."""
    false_a_frame: float
    accuracy: ClassAccuracy
    """Of what was found."""
    recall_by_distance: tuple[Share, ...]
    """One for each bin of ``DISTANCES_M``; what has no known distance is in none."""
    peaks: EndsFigures | None
    bottoms: EndsFigures | None
    """Of poles."""


@dataclass(frozen=True)
class CurvePoint:
    """What is found with a threshold that lets through so many false detections a frame."""

    false_a_frame: float
    threshold: float
    recall: dict[str, float | None]
    """By class."""


@dataclass(frozen=True)
class DetectionFigures:
    """All there is to say. Figures are of the detections that score ``threshold`` or more."""

    frames: int
    threshold: float
    false_a_frame: float
    """Of all classes together."""
    classes: dict[str, ClassFigures]
    confusion: tuple[tuple[int, ...], ...]
    """Row: true class, the last one nothing. Column: found as, the last one nothing."""
    curve: tuple[CurvePoint, ...]
    """Up to the rate that the detector reaches at all."""
    sigma: dict[str, tuple[SigmaBin, ...]]
    """How honest sigma is: of signs, across poles and along them."""
    time_ms_median: float
    time_ms_p95: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def detection_figures(
    images: Sequence[Judged], classes: ClassSet, threshold: float | None = None
) -> DetectionFigures:
    """Over one image or more.

    ``threshold`` None: the lowest that lets through ``FALSE_A_FRAME``, chosen on these images.
    """
    if threshold is None:
        threshold = threshold_at(images, FALSE_A_FRAME)
    above = [one.above(threshold) for one in images]
    pairs = _pairs(above)
    times = np.array([one.seconds for one in images]) * 1e3
    return DetectionFigures(
        frames=len(images),
        threshold=threshold,
        false_a_frame=len(_scores_of_false(above)) / len(images),
        classes={one.name: _class_figures(above, pairs, one) for one in classes},
        confusion=_confusion(above, classes),
        curve=tuple(_curve(images, classes)),
        sigma=check_sigma(*pairs),
        time_ms_median=float(np.median(times)),
        time_ms_p95=float(np.percentile(times, 95.0)),
    )


def threshold_at(images: Sequence[Judged], false_a_frame: float) -> float:
    """The lowest score of a detection that lets through no more false ones; 0 where all may.

    Matches do not depend on worse detections, so neither does what is false.
    """
    allowed = int(false_a_frame * len(images) + 1e-9)
    false = np.sort(_scores_of_false(images))[::-1]
    if len(false) <= allowed:
        return 0.0
    scores = np.concatenate([one.found.score for one in images])
    higher = scores[scores > false[allowed]]
    return float(higher.min()) if len(higher) else float(np.nextafter(false[allowed], 2.0))


def _scores_of_false(images: Iterable[Judged]) -> FloatArray:
    return np.concatenate([one.found.score[one.matches == FALSE] for one in images])


def _curve(images: Sequence[Judged], classes: ClassSet) -> Iterable[CurvePoint]:
    """Where the detector makes so many false detections at all."""
    most = len(_scores_of_false(images)) / len(images)
    score = np.concatenate([one.found.score[one.matches >= 0] for one in images])
    kind = np.concatenate([one.found.class_id[one.matches >= 0] for one in images])
    true = np.concatenate([one.truth.elements.class_id[one.truth.counts] for one in images])
    for rate in CURVE_RATES:
        threshold = threshold_at(images, rate)
        recall = {
            one.name: Share(
                int(((kind == one.id) & (score >= threshold)).sum()), int((true == one.id).sum())
            ).share
            for one in classes
        }
        yield CurvePoint(rate, threshold, recall)
        if rate >= most:
            return


def _pairs(images: Sequence[Judged]) -> tuple[Elements2D, Elements2D]:
    """The k right detections of all images, and what each of them truly is."""
    nothing = Elements2D.from_ends([], [], [])
    found, true = nothing, nothing
    for one in images:
        rows = one.matches >= 0
        found = joined(found, one.found[rows])
        true = joined(true, one.truth.elements[one.matches[rows]])
    return found, true


def _class_figures(
    images: Sequence[Judged], pairs: tuple[Elements2D, Elements2D], kind: ElementClass
) -> ClassFigures:
    class_id = kind.id
    rows = pairs[1].class_id == class_id
    found, true = pairs[0][rows], pairs[1][rows]
    of_class = [one.found.class_id == class_id for one in images]
    false = sum(
        int((one.matches[rows] == FALSE).sum()) for one, rows in zip(images, of_class, strict=True)
    )
    counted = sum(int(_counted(one, class_id).sum()) for one in images)
    is_line = kind.kind == "line"
    return ClassFigures(
        recall=Share(len(found), counted),
        precision=Share(len(found), len(found) + false),
        false_a_frame=false / len(images),
        accuracy=ClassAccuracy.of(
            [ImageErrors.between(*ends) for ends in zip(_ends(found), _ends(true), strict=True)]
        ),
        recall_by_distance=tuple(_recall_by_distance(images, class_id)),
        peaks=_ends_figures(found, true, "anchor") if is_line else None,
        bottoms=_ends_figures(found, true, "end") if is_line else None,
    )


def _counted(one: Judged, class_id: int) -> BoolArray:
    """(n,) truth that counts, of a class."""
    return np.asarray(one.truth.counts & (one.truth.elements.class_id == class_id))


def _ends(elements: Elements2D) -> FloatArray:
    """(k, 2, 2) anchors and ends."""
    return np.stack([elements.anchor_px, elements.end_px], axis=1)


def _recall_by_distance(images: Sequence[Judged], class_id: int) -> Iterable[Share]:
    nothing = np.zeros(0)
    all_of, found = [nothing], [nothing]
    for one in images:
        counted = np.flatnonzero(_counted(one, class_id))
        all_of.append(one.truth.distance_m[counted])
        found.append(one.truth.distance_m[counted[np.isin(counted, one.matches)]])
    limits = np.array(DISTANCES_M)
    counts = (np.histogram(np.concatenate(some), limits)[0].tolist() for some in (found, all_of))
    return (Share(count, of) for count, of in zip(*counts, strict=True))


def _ends_figures(found: Elements2D, true: Elements2D, end: str) -> EndsFigures:
    """Of the peaks (``anchor``) or bottoms (``end``) of poles."""
    said, seen = getattr(found, f"{end}_known"), getattr(true, f"{end}_known")
    axis = true.end_px - true.anchor_px
    along = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    offset = getattr(found, f"{end}_px") - getattr(true, f"{end}_px")
    both = said & seen
    error = (offset * along).sum(axis=1)[both]
    return EndsFigures(
        seen=Share(int(both.sum()), int(seen.sum())),
        hidden=Share(int((~said & ~seen).sum()), int((~seen).sum())),
        along_rmse_px=float(np.sqrt(np.square(error).mean())) if both.any() else None,
    )


def _confusion(images: Sequence[Judged], classes: ClassSet) -> tuple[tuple[int, ...], ...]:
    """(k + 1, k + 1): what was found as what."""
    place = {one.id: row for row, one in enumerate(classes)}
    nothing = len(classes)
    table = np.zeros((nothing + 1, nothing + 1), dtype=np.int64)
    for one in images:
        kinds = [place[int(class_id)] for class_id in one.truth.elements.class_id]
        shown = np.where(
            one.matches == FALSE, confused(one.found, one.truth, one.matches), one.matches
        )
        for row, class_id in zip(shown.tolist(), one.found.class_id.tolist(), strict=True):
            if row != IGNORED:
                table[nothing if row == FALSE else kinds[row], place[class_id]] += 1
        for row in one.missed.tolist():
            if row not in shown:
                table[kinds[row], nothing] += 1
    return tuple(map(tuple, table.tolist()))
