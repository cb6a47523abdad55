"""Kinds of fault, with their evidence as numbers, and the diagnosis of a frame.

A fault may or may not have caused a failure. A diagnosis is the first failed stage of a frame, or
states that the frame is healthy.
"""

from dataclasses import dataclass
from typing import Literal

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import IntArray

FaultKind = Literal[
    "healthy",
    "too few elements",
    "missed detection",
    "false detection",
    "wrong class",
    "false or not mapped",
    "not in the submap",
    "moved in the map",
    "missing in the map",
    "twice in the map",
    "wrong calibration",
    "wrong heading prior",
    "wrong gravity prior",
    "wrong height prior",
    "wrong position prior",
    "wrong detection sigma",
    "misaligned map",
    "time offset",
    "wrong extrinsic",
    "wrong odometry",
    "wrong matches",
    "search miss",
    "refinement diverged",
    "ambiguous geometry",
    "unexplained",
]
"""``false or not mapped``: a detection without a map element; without known ids, one frame cannot
tell which of both it is. ``unexplained``: the pose is wrong, but no stage fails its check."""
GroundTruthLevel = Literal["pose and ids", "pose", "nothing"]
"""Which ground truth is known."""


FALSE_POSITIVE, UNKNOWN_ID = -1, -2
"""Stand for the element id of a false positive and of an unknown element."""


@dataclass(frozen=True, order=True)
class EvidenceItem:
    """One number behind a diagnosis."""

    name: str
    value: float
    unit: str = ""


@dataclass(frozen=True)
class Fault:
    """One defect, whether or not it caused a failure."""

    kind: FaultKind
    sentence: str
    evidence: tuple[EvidenceItem, ...] = ()
    elements: tuple[int, ...] = ()
    """Ids of the map elements concerned."""
    rows: tuple[int, ...] = ()
    """Observed rows concerned."""


@dataclass(frozen=True)
class RunFault(Fault):
    """A fault that recurs; ``rows`` has one observed row for each of ``frames``, if it has any."""

    frames: tuple[int, ...] = ()
    """Positions in the run of the frames with the fault."""
    rivals: tuple[FaultKind, ...] = ()
    """Other kinds that the run cannot tell from this one; the sentence names them."""


@dataclass(frozen=True)
class FrameDiagnosis:
    """Why a frame failed: its first failed stage, or that it is healthy."""

    fault: Fault
    confidence: float
    """Share of diagnoses of this kind that were right on planted faults."""
    secondary_faults: tuple[Fault, ...] = ()
    """All faults of detections and map, whether or not they caused a failure."""

    @property
    def kind(self) -> FaultKind:
        return self.fault.kind

    @property
    def sentence(self) -> str:
        return self.fault.sentence

    @property
    def evidence(self) -> tuple[EvidenceItem, ...]:
        return self.fault.evidence


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The ground truth of a frame."""

    T_camera_map: Pose
    element_id: IntArray | None = None
    """(m,) map element of each observed row, else FALSE_POSITIVE or UNKNOWN_ID; None if all are
    unknown."""

    @property
    def knowledge(self) -> GroundTruthLevel:
        return "pose" if self.element_id is None else "pose and ids"
