"""Collect the observations of a workspace's frames, and identify their map elements.

Observations are labels, proposals, or a simulated detector's output. In a map made from labels,
the labels of a frame give a detection's true element; on a simulated street, the street does.
In a map made from detections, those that it was made from are known. Elsewhere elements are
identified by the map itself, seen from the true pose: a map fault then looks like a detector fault.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from semviz.runs.images import project_elements
from semviz.workspace.settings import StreetSettings
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.build import uses_detections
from semviz_annotation.mapping.quality.label_links import map_rows, observe
from semviz_core.base.detector_model import DetectorCalibration, NoiseName
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame, Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import FALSE_POSITIVE, UNKNOWN_ID
from semviz_core.metrics.detection import ImageGroundTruth, match_confused_classes, match_detections

if TYPE_CHECKING:
    from semviz_annotation.labels.proposals import Proposals
    from semviz_annotation.mapping.association.detection_tracks import LabelsOfMap
    from semviz_core.simulation.street import Street

Observe = Callable[[Frame], tuple[Elements2D, IntArray]]
"""Return the observations (m) of a frame's left image, and the true map element (m,) of each: -1
for a false positive or a label without map element, -2 for a detection of unknown truth."""


def observe_labels(workspace: Workspace, semantic_map: SemanticMap, side: Side = "left") -> Observe:
    """Observe the labels of one image, without elements that a person left out of maps."""
    from semviz_annotation.mapping.quality.label_links import observe

    labels = workspace.read_labels().without_left_out()
    return lambda frame: observe(labels, frame.index, side, semantic_map)


def read_detections(workspace: Workspace, frames: Iterable[Frame]) -> "Proposals":
    """Return the detections of ``semviz detect``, or imported proposals if it was never run.

    Raise SemvizError if there are none, or if the left image of one of ``frames`` was not
    processed.
    """
    from semviz_annotation.labels.proposals import Proposals, load_proposals

    proposals = load_proposals(workspace.proposals_path, workspace.classes)
    processed = proposals.processed
    if processed is None and not len(proposals):
        raise SemvizError(
            f"{workspace.path}: no detections yet; run 'semviz detect {workspace.path}'"
        )
    for frame in frames:
        if processed is not None and (frame.index, "left") not in processed.images:
            raise SemvizError(
                f"{workspace.path}: frame {frame.index} was not processed; run 'semviz detect "
                f"{workspace.path}' again, or leave it out with --frames"
            )
    return Proposals.of(proposals.detections, processed)


def read_labels_of(workspace: Workspace, semantic_map: SemanticMap) -> "LabelsOfMap":
    """Return the labels of a workspace and, for a map of detections, its tracks."""
    from semviz_annotation.labels.proposals import load_proposals
    from semviz_annotation.mapping.association.detection_tracks import LabelsOfMap, labels_of_map

    labels = workspace.read_labels()
    if not uses_detections(semantic_map):
        return LabelsOfMap(labels, {})
    detections = load_proposals(workspace.proposals_path, workspace.classes)
    return labels_of_map(labels, semantic_map, detections, workspace.source)


def observe_detected(
    workspace: Workspace,
    semantic_map: SemanticMap,
    detections: "Proposals",
    least_score: float = 0.0,
    calibration: DetectorCalibration | None = None,
    side: Side = "left",
) -> Observe:
    """Observe the detections in one image with at least ``least_score``, once calibrated; those in
    a right image are not identified."""
    from semviz_annotation.labels.detections import as_elements

    identify = identify_detections(workspace, semantic_map)
    of_map = map_rows(semantic_map).of_observation if uses_detections(semantic_map) else {}

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        rows = detections.in_frame(frame.index, side)
        elements = as_elements(rows, semantic_map.triangle_center)
        if calibration is not None:
            elements = calibration.calibrated(elements)
        mapped = np.array([of_map.get(row.id, -1) for row in rows], dtype=np.int64)
        chosen = elements.score >= least_score
        elements, mapped = elements[chosen], mapped[chosen]
        unknown = np.full(len(elements), UNKNOWN_ID)
        element_id = identify(frame, elements) if side == "left" else unknown
        return elements, np.where(mapped >= 0, semantic_map.elements.id[mapped], element_id)

    return observe


def observe_simulated(
    workspace: Workspace, semantic_map: SemanticMap, noise: NoiseName, seed: int
) -> Observe:
    """Observe a simulated street, as the map defines it, with a simulated detector's noise."""
    from semviz_core.simulation.detector import SimulatedDetector

    street = workspace.street.following(semantic_map.triangle_center)
    detector = SimulatedDetector(street, noise, seed)

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        detection = detector.detect(frame.index)
        return detection.observed, detection.element_id

    return observe


Identify = Callable[[Frame, Elements2D], IntArray]
"""Return the map element (m,) of each detection in a frame's left image, or ``FALSE_POSITIVE``, or
``UNKNOWN_ID``."""
FAR_M = 120.0
"""Map elements farther from the camera are ignored."""

_Visible = tuple[Elements2D, IntArray]
"""Elements (n) visible in an image, and the map id (n,) of each, or ``UNKNOWN_ID``."""


def identify_detections(workspace: Workspace, semantic_map: SemanticMap) -> Identify:
    """Return the function that identifies detections in a workspace's images."""
    is_street = isinstance(workspace.settings.source, StreetSettings)
    center = semantic_map.triangle_center
    street = workspace.street.following(center) if is_street else None
    labels = workspace.read_labels()
    from_labels = bool(semantic_map.provenance) and not uses_detections(semantic_map)

    def visible(frame: Frame) -> _Visible:
        if from_labels and labels.in_frame(frame.index, "left"):
            elements, ids = observe(labels, frame.index, "left", semantic_map)
            return elements, np.where(ids < 0, UNKNOWN_ID, ids)
        if street is not None and not semantic_map.provenance:
            return _on_street(street, frame.index)
        return _mapped(workspace, semantic_map, frame)

    def identify(frame: Frame, detections: Elements2D) -> IntArray:
        elements, ids = visible(frame)
        rows = matched_rows(detections, elements)
        element_id = np.where(rows < 0, UNKNOWN_ID, np.append(ids, UNKNOWN_ID)[rows])
        if street is None:
            return element_id
        is_real = matched_rows(detections, _on_street(street, frame.index)[0]) >= 0
        return np.where((element_id == UNKNOWN_ID) & ~is_real, FALSE_POSITIVE, element_id)

    return identify


def matched_rows(detections: Elements2D, elements: Elements2D) -> IntArray:
    """(m,) row of the element that each detection matches as in detector evaluation, else -1.

    Classes may differ, and elements at any distance count.
    """
    everything: BoolArray = np.ones(len(elements), dtype=bool)
    truth = replace(ImageGroundTruth.of(elements), counts=everything)
    rows = match_detections(detections, truth)
    return np.where(rows < 0, match_confused_classes(detections, truth, rows), rows)


def _on_street(street: "Street", index: int) -> _Visible:
    from semviz_core.simulation.detector import street_truth

    elements, ids = street_truth(street, index, "left").elements, street.labels(index, "left")[1]
    return elements, np.append(ids, np.full(len(elements) - len(ids), UNKNOWN_ID))


def _mapped(workspace: Workspace, semantic_map: SemanticMap, frame: Frame) -> _Visible:
    """Return the map elements visible from the frame's true pose; none if the pose is unknown."""
    camera, pose = workspace.source.rig.left, frame.T_map_camera
    if pose is None:
        return Elements2D.from_ends([], [], []), np.zeros(0, dtype=np.int64)
    nearby = semantic_map.crop(pose.translation, FAR_M)
    projected = project_elements(nearby, pose.inverse(), camera)
    rows = np.flatnonzero(projected.shown & np.isfinite(projected.anchor_px).all(axis=1))
    elements = Elements2D.from_ends(
        projected.anchor_px[rows], projected.end_px[rows], nearby.class_id[rows]
    )
    return elements, nearby.id[rows]
