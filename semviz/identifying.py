"""Which element of the map each detection truly is, as far as somebody knows.

A map that was made from labels has their elements: in frames that are labelled, the labels tell. Of
a simulated street's own map, the street tells. Elsewhere the map itself tells, seen from the true
pose; a fault of the map can then not be told from one of the detector.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from semviz.projection import project_elements
from semviz.workspace import StreetSettings, Workspace
from semviz_annotation.observe import observe
from semviz_core.arrays import BoolArray, IntArray
from semviz_core.elements import Elements2D
from semviz_core.evaluation.detection import Truth, confused, matched
from semviz_core.explaining.told import FALSE, UNKNOWN
from semviz_core.frame import Frame
from semviz_core.semantic_map import SemanticMap

if TYPE_CHECKING:
    from semviz_core.sources.street.street import Street

Identify = Callable[[Frame, Elements2D], IntArray]
"""The map element (m,) of each detection in a frame's left image, else ``FALSE`` (it is nothing
real) or ``UNKNOWN``."""
FAR_M = 120.0
"""From the camera: elements of the map beyond are not looked for."""

_Known = tuple[Elements2D, IntArray]
"""What is to be seen in an image, and the id of each in the map, or ``UNKNOWN``."""


def identifying(workspace: Workspace, semantic_map: SemanticMap) -> Identify:
    """For the detections in a workspace's images."""
    is_street = isinstance(workspace.settings.source, StreetSettings)
    street = workspace.street if is_street else None
    labels = workspace.read_labels()
    from_labels = bool(semantic_map.provenance)

    def known(frame: Frame) -> _Known:
        if from_labels and labels.in_frame(frame.index, "left"):
            elements, ids = observe(labels, frame.index, "left", semantic_map)
            return elements, np.where(ids < 0, UNKNOWN, ids)
        if street is not None and not from_labels:
            return _on_street(street, frame.index)
        return _mapped(workspace, semantic_map, frame)

    def identify(frame: Frame, found: Elements2D) -> IntArray:
        elements, ids = known(frame)
        rows = _whose(found, elements)
        whose = np.where(rows < 0, UNKNOWN, np.append(ids, UNKNOWN)[rows])
        if street is None:
            return whose
        is_real = _whose(found, _on_street(street, frame.index)[0]) >= 0
        return np.where((whose == UNKNOWN) & ~is_real, FALSE, whose)

    return identify


def _whose(found: Elements2D, elements: Elements2D) -> IntArray:
    """(m,) row of the element that each detection is by the rule of evaluation, -1 where none.

    It may be called something else, and how far away it is does not matter.
    """
    everything: BoolArray = np.ones(len(elements), dtype=bool)
    truth = replace(Truth.of(elements), counts=everything)
    rows = matched(found, truth)
    return np.where(rows < 0, confused(found, truth, rows), rows)


def _on_street(street: "Street", index: int) -> _Known:
    from semviz_core.evaluation.street_truth import street_truth

    elements, ids = street_truth(street, index, "left").elements, street.labels(index, "left")[1]
    return elements, np.append(ids, np.full(len(elements) - len(ids), UNKNOWN))


def _mapped(workspace: Workspace, semantic_map: SemanticMap, frame: Frame) -> _Known:
    """The map from the frame's true pose; nothing where that is not known."""
    camera, pose = workspace.source.rig.left, frame.T_map_camera
    if pose is None:
        return Elements2D.from_ends([], [], []), np.zeros(0, dtype=np.int64)
    nearby = semantic_map.crop(pose.translation, FAR_M)
    seen = project_elements(nearby, pose.inverse(), camera)
    rows = np.flatnonzero(seen.shown & np.isfinite(seen.anchor_px).all(axis=1))
    elements = Elements2D.from_ends(seen.anchor_px[rows], seen.end_px[rows], nearby.class_id[rows])
    return elements, nearby.id[rows]
