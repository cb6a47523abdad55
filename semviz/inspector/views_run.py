"""Messages about whole runs: all, one with its elements, forecast and decisions, or two compared.

Of two runs, A is the base, and B is open and compared with it.
"""

from typing import Literal

from semviz.inspector.views import FrameView, Pixel, RunHead
from semviz.inspector.views_frame import RightMapped
from semviz.runs.comparison import Change
from semviz.runs.differences import Kind
from semviz.runs.metrics import Trend
from semviz.web.protocol import Event, Part
from semviz_annotation.storage.operations import EditBase
from semviz_core.base.localization import Status


class RunsEvent(Event):
    """The runs that can be opened."""

    type: Literal["runs"] = "runs"
    names: tuple[str, ...]


class ReadingEvent(Event):
    """A run is read through before it opens: what is done, and the share of it that is done."""

    type: Literal["reading"] = "reading"
    name: str
    step: str
    share: float


class RunFaultView(Part):
    """A fault of the map or the camera, with the frame that shows it best."""

    kind: str
    sentence: str
    evidence: tuple[tuple[str, str], ...]
    frames: tuple[int, ...]
    element: int | None
    observed: int | None
    position: int


class ElementRow(Part):
    """A map element over the run: numbers of frames, and its effect on the error."""

    id: int
    name: str
    class_id: int
    in_view: int
    seen: int
    used: int
    outlier: int
    share: float | None
    median_px: float | None
    cost_m: float | None
    blamed: tuple[tuple[str, int], ...]
    """Kinds of fault that diagnoses blame it for, and in how many frames; most first."""
    duplicate: str
    """Name of the nearest element of its class at the same position; empty if there is none."""
    duplicate_m: float | None
    log_odds: float | None
    """That it exists, of an element made from detections alone."""
    existence: str
    """The same as a probability; empty without."""
    position: int | None
    """The frame that shows it best."""


class RunFindings(Part):
    """The diagnosis of a run; ``compared`` counts the frames that it is based on."""

    compared: int
    faults: tuple[RunFaultView, ...]
    rows: tuple[ElementRow, ...]


class ElementsEvent(Event):
    """The diagnosis of the run, or its progress."""

    type: Literal["elements"] = "elements"
    progress: str
    found: RunFindings | None


class ElementFramesEvent(Event):
    """Positions of the frames that detect an element, or whose estimate uses it."""

    type: Literal["element_frames"] = "element_frames"
    element: int
    name: str
    positions: tuple[int, ...]


class StoryCause(Part):
    """A cause of wrong frames; ``frames`` and ``examples`` are positions."""

    kind: str
    sentence: str
    where: str
    """Its frames as text."""
    is_of_run: bool
    frames: tuple[int, ...]
    examples: tuple[int, ...]
    parts: tuple[int, ...]
    """Parts of the route with its frames, the one with most first."""


class StoryPart(Part):
    """A part of the route: map points (m), its frames and wrong frames, and the worst one."""

    points: tuple[Pixel, ...]
    frames: int
    wrong: int
    position: int


class StoryView(Part):
    """The story of a run. Counts are of frames."""

    headline: str
    detail: str
    length_m: float
    seconds: float | None
    """Duration; null without time stamps."""
    median_m: float | None
    ok: int
    ambiguous: int
    cannot: int
    overconfident: int | None
    """Null without ground truth."""
    causes: tuple[StoryCause, ...]
    harmless: tuple[StoryCause, ...]
    """What the whole run shows that makes no frame wrong by itself; ``frames`` show it."""
    route: tuple[StoryPart, ...]


class StoryEvent(Event):
    """The story of the run, None if it is as before, and the progress of its diagnosis.

    It has no causes of the run as a whole while ``progress`` has text.
    """

    type: Literal["story"] = "story"
    progress: str
    diagnosed: int
    """Frames that causes of the whole run are looked for in."""
    found: StoryView | None


class SuggestedElement(Part):
    """A landmark worth adding to the map, and the first frame that it improves."""

    position: int | None
    text: str


class ForecastView(Part):
    """Expected error of each frame (m), limits of its levels, and landmarks to add."""

    limits: tuple[float, ...]
    expected_m: tuple[float | None, ...]
    mean_m: float
    suggested: tuple[SuggestedElement, ...]


class ForecastEvent(Event):
    """The expected error along the route, or the progress of its computation."""

    type: Literal["forecast"] = "forecast"
    progress: str
    found: ForecastView | None


class EvidenceLine(Part):
    """A value of the evidence, as text."""

    name: str
    value: str


class DecidedElement(Part):
    """An element of a decision; ``map_id`` is null if it is not in the map."""

    name: str
    class_id: int | None
    map_id: int | None


class AnswerOption(Part):
    """A possible answer to a decision."""

    name: str
    title: str


class DecisionView(Part):
    """A decision of map building (``by``) or a finding of lint (``severity``)."""

    key: str
    kind: str
    by: str | None
    severity: str | None
    reason: str
    evidence: tuple[EvidenceLine, ...]
    elements: tuple[DecidedElement, ...]
    answers: tuple[AnswerOption, ...]
    undo: bool
    """Whether it was answered here, so that the answer can be undone."""


class DecisionsEvent(Event):
    """Decisions and findings of the map, and where answers are saved."""

    type: Literal["decisions"] = "decisions"
    entries: tuple[DecisionView, ...]
    note: str
    seen: EditBase
    """What the page has seen of the labels, for its answers."""


class RebuildView(Part):
    """The map being built again; ``run`` names the new run."""

    is_over: bool
    progress: str
    run: str | None


class LabelEditsEvent(Event):
    """Label edits newer than the map; ``workspace`` is empty if the labels are not found."""

    type: Literal["label_edits"] = "label_edits"
    workspace: str
    edits: int
    undoable: int
    seen: EditBase | None
    """What the page has seen of the labels, for its edits; None if they are not found."""
    rebuild: RebuildView | None


class LabelPageEvent(Event):
    """The address of the page that shows a label, relative to this page."""

    type: Literal["label_page"] = "label_page"
    address: str


class MapSavedEvent(Event):
    """The new map was saved as the map of the workspace."""

    type: Literal["map_saved"] = "map_saved"
    text: str


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
