"""What is seen in a workspace's frames: what people labelled, what a detector found in the images,
or what one would find.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Literal

from semviz.workspace import Workspace
from semviz_core.arrays import IntArray
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.semantic_map import SemanticMap

if TYPE_CHECKING:
    from semviz_annotation.proposals import Proposals

Observe = Callable[[Frame], tuple[Elements2D, IntArray]]
"""What is seen in a frame's left image, and the true map element (m,) of each: -1 where it is
nothing real, or not known of a label; -2 where it is not known of a detection."""
Observations = Literal["labels", "detected", "simulated"]
Noise = Literal["paper", "low"]


def observe_labels(workspace: Workspace, semantic_map: SemanticMap) -> Observe:
    """What people labelled in the left image."""
    from semviz_annotation.observe import observe

    labels = workspace.read_labels()
    return lambda frame: observe(labels, frame.index, "left", semantic_map)


def detected(workspace: Workspace, frames: Iterable[Frame]) -> "Proposals":
    """What ``semviz detect`` found or, where it was never at work, what others propose.

    Raises SemvizError where nothing is, or where nobody looked at the left image of one of
    ``frames``.
    """
    from semviz_annotation.proposals import Proposals, load_proposals

    proposals = load_proposals(workspace.proposals_path, workspace.classes)
    looked = proposals.looked
    if looked is None and not len(proposals):
        raise SemvizError(
            f"{workspace.path}: nothing is detected yet; run 'semviz detect {workspace.path}'"
        )
    for frame in frames:
        if looked is not None and (frame.index, "left") not in looked.images:
            raise SemvizError(
                f"{workspace.path}: no detector looked at frame {frame.index}; run 'semviz detect "
                f"{workspace.path}' again, or leave it out with --frames"
            )
    return Proposals.of(proposals.found, looked)


def observe_detected(
    workspace: Workspace, semantic_map: SemanticMap, found: "Proposals", least_score: float = 0.0
) -> Observe:
    """What is proposed for the left image with at least a score."""
    from semviz.identifying import identifying
    from semviz_annotation.detections import as_elements

    identify = identifying(workspace, semantic_map)

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        rows = found.in_frame(frame.index, "left")
        elements = as_elements([row for row in rows if row.score >= least_score])
        return elements, identify(frame, elements)

    return observe


def observe_simulated(workspace: Workspace, noise: Noise, seed: int) -> Observe:
    """What a detector as good as the paper's (or better) would see of a simulated street."""
    from semviz_core.sources.street.detector import SimulatedDetector

    detector = SimulatedDetector(workspace.street, noise, seed)

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        detection = detector.detect(frame.index)
        return detection.observed, detection.element_id

    return observe


def observations_of(told: str) -> Observations:
    """What a run saw, by what its ``RunInfo.observations`` tells."""
    if told.startswith("detected"):
        return "detected"
    return "labels" if told == "labels" else "simulated"


def detector_model(observations: Observations) -> DetectorModel:
    """What is true of whoever, or whatever, sees."""
    if observations == "labels":
        return DetectorModel()
    if observations == "detected":
        from semviz_core.detection.rates import DETECTOR_MODEL as MEASURED

        return MEASURED
    from semviz_core.sources.street.detector import DETECTOR_MODEL

    return DETECTOR_MODEL
