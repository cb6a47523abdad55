"""Messages about two runs: A, the base, and B, which is open and compared with it."""

from typing import Literal

from semviz.inspector.views import FrameView, RunHead
from semviz.inspector.views_frame import RightMapped
from semviz.runs.comparison import Change
from semviz.runs.differences import Kind
from semviz.runs.metrics import Trend
from semviz.web.protocol import Event, Part
from semviz_core.base.localization import Status


class ComparedAnswer(Part):
    """The result of one run for a frame."""

    status: Status
    error_m: float | None
    error_deg: float | None
    overconfident: bool


class ComparedFrame(Part):
    """A frame of both runs; ``position`` is that in B."""

    index: int
    position: int
    change: Change
    a: ComparedAnswer
    b: ComparedAnswer


class MetricRow(Part):
    """A metric of both runs, as text."""

    name: str
    label: str
    a: str
    b: str
    trend: Trend


class SetupRow(Part):
    """A setting or input of both runs."""

    what: str
    base: str
    other: str


class MapChangeView(Part):
    """A difference between the maps, with the broken and fixed frames that have it in view."""

    kind: Kind
    names: tuple[str, ...]
    was: tuple[str, ...]
    """Names in A, where they differ from those in B."""
    moved_m: float | None
    element: int | None
    base_element: int | None
    broken: tuple[int, ...]
    fixed: tuple[int, ...]


class ComparisonView(Part):
    """Everything about two runs that does not depend on the frame shown."""

    other: str
    base: RunHead
    frames: tuple[ComparedFrame, ...]
    only_base: tuple[int, ...]
    only_other: tuple[int, ...]
    metrics: tuple[MetricRow, ...]
    names: tuple[str, ...]
    """Names that a gate can use."""
    setups: tuple[SetupRow, ...]
    notes: tuple[str, ...]
    same_map: bool
    unchanged: int
    changes: tuple[MapChangeView, ...]
    more_changes: int
    base_ids: dict[int, int]
    """Ids in the map of A by those in B, where they differ."""
    command: str


class ComparisonEvent(Event):
    """The two runs were compared."""

    type: Literal["comparison"] = "comparison"
    comparison: ComparisonView


class BaseFrameView(Part):
    """A frame as A has it, and the submap in its right image."""

    frame: FrameView
    right: tuple[RightMapped, ...] | None


class BaseFrameEvent(Event):
    """The frame numbered ``index`` in A; null where A does not have it."""

    type: Literal["base_frame"] = "base_frame"
    index: int
    base: BaseFrameView | None


class GateView(Part):
    """A condition, its values as text, and whether it fails; null if that is unknown."""

    text: str
    fails: bool | None
    values: str


class GatesEvent(Event):
    """The conditions that the page sent."""

    type: Literal["gates"] = "gates"
    gates: tuple[GateView, ...]
