"""What is seen in a workspace's frames: what people labelled, or what a detector would find."""

from collections.abc import Callable
from typing import Literal

from semviz.workspace import Workspace
from semviz_core.arrays import IntArray
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D
from semviz_core.frame import Frame
from semviz_core.semantic_map import SemanticMap

Observe = Callable[[Frame], tuple[Elements2D, IntArray]]
"""What is seen in a frame's left image, and the true map element (m,) of each, or -1."""
Observations = Literal["labels", "simulated"]
Noise = Literal["paper", "low"]


def observe_labels(workspace: Workspace, semantic_map: SemanticMap) -> Observe:
    """What people labelled in the left image."""
    from semviz_annotation.observe import observe

    labels = workspace.read_labels()
    return lambda frame: observe(labels, frame.index, "left", semantic_map)


def observe_simulated(workspace: Workspace, noise: Noise, seed: int) -> Observe:
    """What a detector as good as the paper's (or better) would see of a simulated street."""
    from semviz_core.sources.street.detector import SimulatedDetector

    detector = SimulatedDetector(workspace.street, noise, seed)

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        detection = detector.detect(frame.index)
        return detection.observed, detection.element_id

    return observe


def detector_model(observations: Observations) -> DetectorModel:
    """What is true of whoever, or whatever, sees."""
    if observations == "labels":
        return DetectorModel()
    from semviz_core.sources.street.detector import DETECTOR_MODEL

    return DETECTOR_MODEL
