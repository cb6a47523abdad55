"""Evaluate a detector on images with known content, or calibrate it and choose its minimum score.

Images are rendered streets, labelled workspaces or mapped ones, made or read on demand. Streets are
ones that nothing was trained or tuned on.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from time import process_time
from typing import Any

import numpy as np

from semviz.annotator import element_positions
from semviz.annotator.panes import Cameras
from semviz.presentation.terminal import Table, track
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_elements
from semviz_annotation.labels.labels import Labels, Observation, proposal_id
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.classes import DEFAULT_CLASSES, OLDER_CENTER, TriangleCenter, with_center
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.elements import Elements2D, joined
from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.detection.detector import Detector
from semviz_core.metrics import detection_calibration, detection_summary
from semviz_core.metrics.detection import HELD_OUT_SEED, REACH_M, ImageGroundTruth
from semviz_core.metrics.detection_calibration import CalibrationImage, FittedCalibration
from semviz_core.simulation.detector import street_truth
from semviz_core.simulation.street import Street


@dataclass(frozen=True, eq=False)
class EvaluationImage:
    """An image and its ground truth, rendered or read on demand."""

    place: str
    """The street or workspace."""
    frame_index: int
    side: Side
    read: Callable[[], ByteImage]
    """Raise SemvizError if the image cannot be read."""
    truth: Callable[[], ImageGroundTruth]
    is_complete: bool = True
    """Whether the ground truth is believed to hold all elements."""
    stored: "StoredDetections | None" = None
    """What ``semviz detect`` found in the image before, if it did."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the points of triangular signs are, in the truth and the stored detections."""

    @property
    def name(self) -> str:
        return f"{self.place}, frame {self.frame_index}, {self.side}"


@dataclass(frozen=True, eq=False)
class StoredDetections:
    """The detections of an image that are in the workspace's proposals."""

    detector: str
    elements: Elements2D


def with_stored(
    images: Sequence[EvaluationImage], proposals: Proposals
) -> tuple[EvaluationImage, ...]:
    """Return images of one workspace with its stored detections, where it was processed."""
    processed = proposals.processed
    if processed is None:
        return tuple(images)
    return tuple(
        replace(
            image,
            stored=StoredDetections(processed.detector, as_elements(rows, image.triangle_center)),
        )
        if (image.frame_index, image.side) in processed.images
        else image
        for image in images
        for rows in [proposals.in_frame(image.frame_index, image.side)]
    )


def street_images(
    streets: int, frames_a_street: int, sides: Sequence[Side], reach_m: float = REACH_M
) -> tuple[EvaluationImage, ...]:
    """Return evenly spread images of the first ``streets`` streets kept for evaluation."""
    return tuple(
        EvaluationImage(
            street.map_frame.name,
            index,
            side,
            partial(street.image, index, side),
            partial(street_truth, street, index, side, reach_m),
            triangle_center=street.triangle_center,
        )
        for street in map(Street, range(HELD_OUT_SEED, HELD_OUT_SEED + streets))
        for index in _spread(len(street.frames), frames_a_street)
        for side in sides
    )


def _spread(count: int, chosen: int) -> list[int]:
    """Return ``chosen`` of ``count`` indices, or all, spread evenly."""
    few = min(count, chosen)
    return [int((number + 0.5) * count / few) for number in range(few)]


def labelled_images(
    workspace: Workspace,
    frames: range | None,
    sides: Sequence[Side],
    reach_m: float = REACH_M,
    ignored: Collection[int] = (),
) -> tuple[EvaluationImage, ...]:
    """Return the images of a workspace that people labelled or reviewed.

    Unlabelled elements that should be visible do not count, unless a person dismissed them; nor do
    elements to be left out of maps, and those with ``ignored`` numbers. Raise SemvizError if there
    are no images, or an ignored element is not labelled.
    """
    labelled = _LabelledWorkspace(workspace, reach_m, frozenset(ignored))
    images = tuple(labelled.images(frames, sides))
    if not images:
        selection = "" if frames is None else f" in frames {frames.start}:{frames.stop}"
        raise SemvizError(
            f"{workspace.path}: nothing is labelled{selection}; label images with "
            f"'semviz annotate {workspace.path}'"
        )
    return images


class _LabelledWorkspace:
    """The labels of a workspace with the positions of their elements."""

    def __init__(self, workspace: Workspace, reach_m: float, ignored: frozenset[int]) -> None:
        self._reach_m, self._ignored = reach_m, ignored
        self._name, self._source = workspace.name, workspace.source
        self._labels: Labels = workspace.read_labels()
        known = {element.number for element in self._labels.elements.values()}
        if not ignored <= known:
            missing = ", ".join(map(str, sorted(ignored - known)))
            raise SemvizError(
                f"{workspace.path}: no element {missing} to ignore; name labelled ones"
            )
        self._cameras = Cameras(self._source.rig, self._source.frames)
        self._places = element_positions.ElementPositions(self._cameras)

    def images(self, frames: range | None, sides: Sequence[Side]) -> Iterator[EvaluationImage]:
        """Yield the images in order of time."""
        if self._source.rig.right is None:
            sides = ("left",)
        for frame in self._source.frames:
            index = frame.index
            state = self._labels.review(index)
            for side in sides if frames is None or index in frames else ():
                if self._labels.in_frame(index, side) or state == "reviewed, empty":
                    yield EvaluationImage(
                        self._name,
                        index,
                        side,
                        partial(self._source.image, index, side),
                        partial(self._truth, index, side),
                        is_complete=state != "in work",
                        triangle_center=self._labels.triangle_center,
                    )

    def _truth(self, index: int, side: Side) -> ImageGroundTruth:
        rows = self._labels.in_frame(index, side)
        labelled, _ = observe(self._labels, index, side)
        unlabelled, ids = self._unlabelled(index, side)
        left_out = [self._is_left_out(row) for row in rows]
        distance = [
            float("nan") if is_left_out else self._distance_m(row.element_id, index)
            for row, is_left_out in zip(rows, left_out, strict=True)
        ]
        distance += [self._distance_m(element_id, index) for element_id in ids]
        return ImageGroundTruth.of(
            joined(labelled, unlabelled),
            distance_m=np.array(distance, dtype=np.float64),
            ignored=np.array(left_out + [True] * len(ids), dtype=bool),
            reach_m=self._reach_m,
        )

    def _is_left_out(self, row: Observation) -> bool:
        if self._labels.elements[row.element_id].number in self._ignored:
            return True
        decisions = self._labels.decisions_of(row.element_id)
        return any(decision.verdict == "leave out" for decision in decisions)

    def _distance_m(self, element_id: str, index: int) -> float:
        """Return the horizontal distance from the left camera; NaN if a position is unknown."""
        place = self._places.of_element(self._labels, element_id)
        pose = self._cameras.T_map_camera[index]
        if pose is None or not isinstance(place, Triangulated):
            return float("nan")
        return float(np.linalg.norm((place.anchor_m - pose.translation)[:2]))

    def _unlabelled(self, index: int, side: Side) -> tuple[Elements2D, list[str]]:
        """Return mapped elements that should be visible, but are neither labelled nor dismissed.

        Their ids are those of label elements.
        """
        T_camera_map = self._cameras.T_camera_map(index)
        if T_camera_map is None or self._labels.review(index) == "reviewed, empty":
            return Elements2D.from_ends([], [], []), []
        near = self._places.near(self._labels, index)
        projected = element_positions.projected_elements(
            index, side, T_camera_map, self._cameras.rig, self._labels, near
        )
        kept = [element for element in projected if not self._is_dismissed(element, index)]
        ids = [element.element_id for element in kept]
        elements = Elements2D.from_ends(
            _points(element.anchor_px for element in kept),
            _points(element.end_px or (np.nan, np.nan) for element in kept),
            [self._labels.element(element_id).class_id for element_id in ids],
        )
        return elements, ids

    def _is_dismissed(self, element: element_positions.ProjectedElement, index: int) -> bool:
        """Return whether a person stated that the element is not visible. Occluded ones may be, in
        part."""
        dismissal = self._labels.dismissals.get(
            proposal_id(element.element_id, index, element.side)
        )
        return dismissal is not None and dismissal.why != "occluded"


def _points(pixels: Iterator[tuple[float, float]]) -> FloatArray:
    return np.array(list(pixels), dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The evaluation of a detector."""

    settings: dict[str, str]
    """What was measured and how, for display."""
    notes: tuple[str, ...]
    """Caveats of the figures."""
    images: tuple[EvaluationImage, ...]
    evaluations: tuple[detection_summary.ImageEvaluation, ...]
    """All detections of each image."""
    figures: detection_summary.DetectionFigures

    @cached_property
    def above(self) -> tuple[detection_summary.ImageEvaluation, ...]:
        """Each image with the detections above the threshold."""
        return tuple(image.above(self.figures.threshold) for image in self.evaluations)

    def as_json(self) -> dict[str, Any]:
        """Return the object that ``semviz detect evaluate --json`` prints."""
        return {
            "settings": self.settings,
            "notes": list(self.notes),
            "figures": self.figures.as_dict(),
        }


def evaluate(
    detector: Detector | None,
    measuring: str,
    images: Sequence[EvaluationImage],
    least_score: float | None = None,
    extra_settings: Mapping[str, str] | None = None,
) -> Evaluation:
    """Evaluate ``detector`` on at least one image; None: evaluate the stored detections.

    ``least_score`` is the threshold of ``detection_figures``. ``measuring`` and ``extra_settings``
    are added to the settings. Times are CPU times; a first call is not counted.
    """
    if detector is not None:
        detector.detect(images[0].read())
    evaluations = tuple(
        evaluate_image(detector, image) for image in track(images, "looking", len(images))
    )
    figures = detection_summary.detection_figures(evaluations, DEFAULT_CLASSES, least_score)
    settings = {
        "model": stored_detector(images) if detector is None else detector.model.name,
        "measuring": measuring,
        "images": _where(images),
        "threshold": _threshold(figures.threshold, least_score),
        **(extra_settings or {}),
    }
    return Evaluation(settings, tuple(_notes(images)), tuple(images), evaluations, figures)


def stored_detector(images: Sequence[EvaluationImage]) -> str:
    """Return the name of the detector whose stored detections the images have."""
    stored = {image.stored.detector for image in images if image.stored is not None}
    return ", ".join(sorted(stored))


def evaluate_image(
    detector: Detector | None, image: EvaluationImage
) -> detection_summary.ImageEvaluation:
    """Detect in an image, or take its stored detections if ``detector`` is None."""
    truth = image.truth()
    if detector is None:
        if image.stored is None:
            raise SemvizError(f"{image.name}: not processed; run 'semviz detect' again")
        return detection_summary.ImageEvaluation(image.stored.elements, truth, None)
    pixels = image.read()
    start_s = process_time()
    try:
        detections = detector.detect(pixels)
    except SemvizError as error:
        raise SemvizError(f"{image.name}: {error}") from None
    seconds = process_time() - start_s
    detections = with_center(detections, detector.triangle_center, image.triangle_center)
    return detection_summary.ImageEvaluation(detections, truth, seconds)


def _threshold(threshold: float, given: float | None) -> str:
    if given is not None:
        return f"{given:g}, as given"
    if threshold == 0.0:
        limit = detection_summary.FALSE_A_FRAME
        return f"none, what the model tells is within {limit:g} false a frame"
    return f"{threshold:.3f}, chosen on these images"


def _where(images: Sequence[EvaluationImage]) -> str:
    """Return for example ``100 of 20 places, street-30000 to street-30019``."""
    places = list(dict.fromkeys(image.place for image in images))
    if len(places) == 1:
        return f"{len(images)} of {places[0]}"
    return f"{len(images)} of {len(places)} places, {places[0]} to {places[-1]}"


def _notes(images: Sequence[EvaluationImage]) -> list[str]:
    partial = sum(not image.is_complete for image in images)
    if not partial:
        return []
    return [
        f"{partial} of {len(images)} images are labelled but not reviewed; what is not labelled "
        "in them counts as false"
    ]


CHOSEN = "<- chosen"


def calibration_images(
    detector: Detector | None, images: Sequence[EvaluationImage]
) -> list[CalibrationImage]:
    """Detect in images, or take their stored detections if ``detector`` is None."""
    evaluated = ((evaluate_image(detector, image), image.is_complete) for image in images)
    return [
        CalibrationImage.of(seen.detections, seen.truth, is_complete)
        for seen, is_complete in track(evaluated, "looking", len(images))
    ]


@dataclass(frozen=True, eq=False)
class DetectorChoice:
    """The calibration of a detector, with the figures it was chosen by."""

    fitted: FittedCalibration
    calibration: DetectorCalibration
    most_false: float | None
    """Limit of false detections per image, if one was given."""

    def as_text(self) -> str:
        """Return the thresholds with their figures, why one was chosen, and the sigma scale."""
        scale, best = self.calibration.sigma_scale, self.fitted.best
        why = "the most right detections minus false ones"
        if self.most_false is not None:
            why = f"the lowest with at most {self.most_false:g} false an image"
        return "\n\n".join(
            [
                f"{self.calibration.detector} on {self.calibration.truth}",
                self._table().as_text(),
                f"minimum score {best.rates.least_score:g}: {why}; scores are probabilities now",
                f"sigma, measured over stated: across poles {scale.pole_across:.2f}, along them "
                f"{scale.pole_along:.2f}, signs {scale.sign:.2f}",
            ]
        )

    def _table(self) -> Table:
        rows = tuple(
            (
                f"{row.rates.least_score:g}",
                f"{row.recall:.0%}".replace("%", " %"),
                f"{row.precision:.0%}".replace("%", " %"),
                f"{row.right:.2f}",
                f"{row.rates.false_detections:.2f}",
                f"{row.surplus:+.2f}",
                f"{row.rates.recall_near:.2f}",
                f"{row.rates.recall_far:.2f}",
                f"{row.rates.hidden_bottoms:.2f}",
                CHOSEN if row is self.fitted.best else "",
            )
            for row in self.fitted.figures
        )
        header = (
            "score from", "recall to 40 m", "precision", "right an image", "false", "right - false",
            "in view: near", "far", "hidden bottoms", "",
        )  # fmt: skip
        return Table("Minimum scores", header, rows, words=0)


def choose(
    images: Sequence[CalibrationImage],
    detector: str,
    settings: tuple[str, str],
    truth: str,
    most_false: float | None = None,
) -> DetectorChoice:
    """Return the calibration on one image or more.

    ``settings`` are the hash of the model's files and the measuring, ``truth`` describes the
    images. Raise SemvizError if too few detections are known to be right or false.
    """
    fitted = detection_calibration.fit_calibration(images, most_false)
    calibration = DetectorCalibration(
        detector=detector,
        model=settings[0],
        measuring=settings[1],
        truth=truth,
        least_score=fitted.best.rates.least_score,
        scores=fitted.scores,
        sigma_scale=fitted.sigma_scale,
        rates=tuple(row.rates for row in fitted.figures),
    )
    return DetectorChoice(fitted, calibration, most_false)
