"""Refinement of a detection in one or both images, with its probability.

The detection is moved onto the edges in the image, and searched for in the other image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_annotation.assist.appearance import end_on_line
from semviz_annotation.assist.marked_image import Mark, MarkedImage, ProposedMark
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.snap import CLEAR, best_snap, end_evidence
from semviz_annotation.assist.stereo_matching import ImageCorrespondences, find_correspondence
from semviz_annotation.mapping.placement.triangulation import TriangulationFailure, triangulate
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray

_MIN_CORRESPONDENCE = 0.5
"""Least probability of a correspondence."""
END = 0.8
"""Least probability at which a pole's end counts as known."""
_STRAY_SIGMAS = 6.0
"""An outline whose centre is farther from the detection belongs to something else, for example to
the inner edge of a sign's border."""
_SAME_END_PX = 6.0
"""Largest difference along the pole between the ends in two images that are the same point."""
_MOST_LOGIT = 5.0
_MOST_GAP_PX = 10.0


@dataclass(frozen=True, eq=False)
class RawDetection:
    """A detection in one image, as the detector made it."""

    image: MarkedImage
    mark: Mark
    score: float
    sigma_px: float
    """Standard deviation of a sign's centre along each axis, or across a pole."""
    sigma_along_px: float | None = None
    """Standard deviation of a pole's known ends along it; None if unknown."""


@dataclass(frozen=True, eq=False)
class RefinedDetection:
    """A detection in one or both images, with the joint evidence."""

    detector_marks: tuple[Mark, ...]
    """Marks in the images of the detection, then in the other image if it was found there. The
    known ends of a pole are those that the detector states."""
    what: str
    evidence: FloatArray
    ends: Mapping[int, FloatArray]
    """Evidence for each stated end of a pole, peak (0) and bottom (1)."""
    depth_m: float | None
    """Depth of its anchor in the first image; None if only one image shows it."""

    @cached_property
    def marks(self) -> tuple[Mark, ...]:
        """``detector_marks``, where an end is known only if it is likely enough."""
        reliable = {
            k for k, evidence in self.ends.items() if probability("found end", evidence) >= END
        }
        return tuple(
            replace(
                mark,
                anchor_known=mark.anchor_known and (mark.end_px is None or 0 in reliable),
                end_known=mark.end_known and 1 in reliable,
            )
            for mark in self.detector_marks
        )

    @property
    def score(self) -> float:
        """Estimated probability that the element exists, with every mark within 2 px of it and the
        known ends of a pole within 6 px along it."""
        return probability(self.what, self.evidence)

    @property
    def proposed(self) -> tuple[ProposedMark, ...]:
        return tuple(ProposedMark(mark, self.score) for mark in self.marks)


def refine_detection(
    detections: Sequence[RawDetection], other: MarkedImage | None, element_class: ElementClass
) -> RefinedDetection:
    """Return a detection in one or two images, moved onto the edges there.

    ``other`` is the second image of a detection in one image. An end of a pole counts as known if
    both images show it at the same point of the pole.
    """
    kind = "pole" if element_class.kind == "line" else "sign"
    marks, clear = zip(
        *(_snap_detection(detection, element_class) for detection in detections), strict=True
    )
    scores = [_logit(detection.score) for detection in detections]
    images = [detection.image for detection in detections]
    if len(detections) == 2:
        correspondences = find_correspondence(images[0], images[1], marks[0], element_class)
        alike = _agreement(correspondences, marks[1])
        pair = _with_common_ends(images[0], images[1], *marks)
        return _refined(detections, images, pair, f"found pair {kind}", [*scores, *clear, *alike])
    correspondences = (
        None if other is None else find_correspondence(images[0], other, marks[0], element_class)
    )
    if other is None or correspondences is None or correspondences.best.score < _MIN_CORRESPONDENCE:
        return _refined(detections, images, marks, f"found alone {kind}", [*scores, *clear])
    pair = (marks[0], correspondences.best.mark)
    evidence = [*scores, *clear, _logit(correspondences.best.score)]
    return _refined(detections, [*images, other], pair, f"found one {kind}", evidence)


def _refined(
    detections: Sequence[RawDetection],
    images: Sequence[MarkedImage],
    marks: tuple[Mark, ...],
    what: str,
    evidence: Sequence[float],
) -> RefinedDetection:
    stated = [
        detection.sigma_along_px for detection in detections if detection.sigma_along_px is not None
    ]
    sigma_px = max(stated, default=None)
    known = [
        marks[0].end_px is not None and all(mark.anchor_known for mark in marks),
        marks[0].end_px is not None and all(mark.end_known for mark in marks),
    ]
    ends = {k: end_evidence(images, marks, k, sigma_px) for k in range(2) if known[k]}
    depth_m = None if len(marks) < 2 else _depth_m(images, marks)
    return RefinedDetection(marks, what, np.array(evidence), ends, depth_m)


def _depth_m(images: Sequence[MarkedImage], marks: Sequence[Mark]) -> float:
    """Return the depth in the first of two images; infinite if it is not observable."""
    views = [image.view for image in images]
    place = triangulate(views, [mark.at(n) for n, mark in enumerate(marks)], min_angle_rad=0.0)
    if isinstance(place, TriangulationFailure):
        return float("inf")
    depth = float(views[0].depth_m(place.anchor_m[None])[0])
    return depth if depth > 0.0 else float("inf")


def _snap_detection(detection: RawDetection, element_class: ElementClass) -> tuple[Mark, float]:
    """Return a mark on the edges, if these are clear, and the logit of their probability."""
    best = best_snap(detection.image, detection.mark, element_class)
    if best is None:
        return detection.mark, -_MOST_LOGIT
    is_sign = detection.mark.end_px is None
    clear = probability("snap sign" if is_sign else "snap pole", best.evidence)
    is_other = is_sign and best.snapped.moved_px > _STRAY_SIGMAS * detection.sigma_px
    return (detection.mark if is_other or clear < CLEAR else best.snapped.mark), _logit(clear)


def _agreement(correspondences: ImageCorrespondences | None, mark: Mark) -> tuple[float, float]:
    """Return the logit of the closest correspondence, and the log of its distance to ``mark``."""
    proposals = () if correspondences is None else (correspondences.best, correspondences.runner_up)
    near = [
        (min(proposal.mark.gap_px(mark), _MOST_GAP_PX), proposal)
        for proposal in proposals
        if proposal is not None
    ]
    if not near:
        return -_MOST_LOGIT, float(np.log1p(_MOST_GAP_PX))
    gap, nearest = min(near, key=lambda each: each[0])
    return _logit(nearest.score), float(np.log1p(gap))


def _with_common_ends(
    source: MarkedImage, target: MarkedImage, source_mark: Mark, target_mark: Mark
) -> tuple[Mark, Mark]:
    """Return the marks with those ends known that both images show at the same point."""
    known = [True, True]
    if source_mark.end_px is not None and target_mark.end_px is not None:
        first_px, second_px = source_mark.ends_px, target_mark.ends_px
        along = (second_px[1] - second_px[0]) / max(
            float(np.linalg.norm(second_px[1] - second_px[0])), 1e-9
        )
        for k in range(2):
            place = end_on_line(source.view, target.view, first_px, second_px, k)
            known[k] = place is None or abs(float((place - second_px[k]) @ along)) < _SAME_END_PX
    peak = known[0] and source_mark.anchor_known and target_mark.anchor_known
    bottom = known[1] and source_mark.end_known and target_mark.end_known
    first, second = (
        replace(mark, anchor_known=peak, end_known=bottom) for mark in (source_mark, target_mark)
    )
    return first, second


def _logit(share: float) -> float:
    least = 1.0 / (1.0 + np.exp(_MOST_LOGIT))
    bounded = float(np.clip(share, least, 1.0 - least))
    return float(np.log(bounded / (1.0 - bounded)))
