"""What can be told of a frame: kinds of failure, with evidence in numbers."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from semviz_core.arrays import IntArray
from semviz_core.pose import Pose

Kind = Literal[
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
    "wrong matches",
    "search miss",
    "refinement diverged",
    "ambiguous geometry",
    "unexplained",
]
"""``false or not mapped``: a detection of nothing that is mapped; one frame without known ids
cannot tell which. ``unexplained``: the answer is wrong, and no link of the chain is seen broken."""
Knowledge = Literal["pose and ids", "pose", "nothing"]
"""What is known of the truth."""


FALSE, UNKNOWN = -1, -2
"""In place of an id: nothing real; not known what."""


class Evidence(NamedTuple):
    """One number behind a verdict."""

    name: str
    value: float
    unit: str = ""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, whether it did harm or not."""

    kind: Kind
    sentence: str
    evidence: tuple[Evidence, ...] = ()
    elements: tuple[int, ...] = ()
    """Ids of the map elements concerned."""
    rows: tuple[int, ...] = ()
    """Observed rows concerned."""


@dataclass(frozen=True)
class Verdict:
    """What became of a frame: its first broken link, or that it is healthy."""

    fault: Fault
    sure: float
    """Share of verdicts of this kind that were right where faults were planted."""
    noticed: tuple[Fault, ...] = ()
    """All that is wrong with detections and map, harmful or not."""

    @property
    def kind(self) -> Kind:
        return self.fault.kind

    @property
    def sentence(self) -> str:
        return self.fault.sentence

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        return self.fault.evidence


@dataclass(frozen=True, eq=False)
class Truth:
    """What is known of a frame by other means."""

    T_camera_map: Pose
    element_id: IntArray | None = None
    """(m,) map element of each observed row, else FALSE or UNKNOWN; None where none is known."""

    @property
    def knowledge(self) -> Knowledge:
        return "pose" if self.element_id is None else "pose and ids"
