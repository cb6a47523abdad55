"""Messages about a map over time: what the runs of several passes say about its elements."""

from typing import Literal

from semviz.inspector.views import Pixel
from semviz.inspector.views_run import EvidenceLine
from semviz.web.protocol import Event, Part
from semviz.workspace.maps.map_decisions import Answer
from semviz_annotation.mapping.passes.changes import ChangeKind


class PassView(Part):
    """A run that counts as a pass; ``date`` is empty if it is not known."""

    run: str
    date: str
    frames: int
    sure: int
    """Frames with the status ok; only these count."""


class LeftOutRun(Part):
    """A run that is no pass, and why."""

    run: str
    reason: str


class PassShot(Part):
    """A frame that shows an element, or the place where it should be."""

    run: str
    position: int
    frame: int
    date: str
    ends: tuple[Pixel, ...]
    """Of the element, by the pose of the frame: a sign's centre, or both ends of a pole."""
    is_seen: bool
    """Whether the frame detects it."""


class PassRow(Part):
    """What each pass saw of an element: frames that detect it, of those with it in view."""

    name: str
    class_id: int
    seen: tuple[int, ...]
    chances: tuple[int, ...]
    probability: tuple[float, ...]
    """That it exists in each pass, by all of them."""


class OverTimeChange(PassRow):
    """A change of the map. Places are metres in the map frame."""

    kind: ChangeKind
    element: int | None
    """Its id in the map; null for a new one."""
    since: int | None
    """The pass that first missed or first saw it; null if unsure."""
    existence: float
    place: Pixel
    was: Pixel | None
    """Where one that moved was."""
    title: str
    story: str
    sentence: str
    facts: tuple[EvidenceLine, ...]
    near: tuple[PassRow, ...]
    """Standing elements beside it."""
    before: PassShot | None
    after: PassShot | None


class StandingElement(Part):
    """An element of the map that has not changed."""

    name: str
    class_id: int
    place: Pixel


class OverTimeView(Part):
    """What the passes say about the map."""

    map: str
    elements: int
    passes: tuple[PassView, ...]
    changes: tuple[OverTimeChange, ...]
    """By kind, the surest first."""
    standing: tuple[StandingElement, ...]
    route: tuple[Pixel, ...]
    """The way of the drive that the map was made from, or else of the first pass."""


class OverTimeEvent(Event):
    """The map over time; without ``found``, ``progress`` says how far the search is, or why there
    is no answer."""

    type: Literal["over_time"] = "over_time"
    progress: str
    is_over: bool
    left_out: tuple[LeftOutRun, ...]
    found: OverTimeView | None


class ChangeAnswer(Part):
    """What somebody decided on a change, by its name."""

    name: str
    answer: Answer
    author: str
    time: str
    label: str
    """Of a label that is asked for: the frame to label, as text."""


class ChangeAnswersEvent(Event):
    """What is decided. ``note`` says where it is kept, or why nothing can be decided."""

    type: Literal["change_answers"] = "change_answers"
    answers: tuple[ChangeAnswer, ...]
    seen: int
    """Number of decisions that a page that gets this has seen."""
    can_undo: bool
    can_decide: bool
    note: str
    next_map: str
    """A free name for the changed map."""


class ChangedMapEvent(Event):
    """The changed map was written."""

    type: Literal["changed_map"] = "changed_map"
    name: str
    text: str
    diff: str
