"""Describe labels, elements, frames and operations for the page."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from semviz.annotator.association import NearbyElement
from semviz.annotator.detector_proposals import Disagreement
from semviz.annotator.frame_quality import FrameFacts
from semviz.annotator.map_review import MapSummary
from semviz.annotator.panes import Pane, Panes
from semviz.web.protocol import ImageSize, Part
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import (
    Dismissal,
    LabelElement,
    Labels,
    Observation,
    Pixel,
    Review,
    ReviewDecision,
    ReviewState,
    Row,
)
from semviz_annotation.labels.rows import row_elements
from semviz_annotation.storage.store import Operation
from semviz_core.base.classes import ClassSet, ElementClass, TriangleCenter
from semviz_core.base.frame import Side
from semviz_core.datasets.rig_cameras import camera_names

VERBS = {
    "add": "Draw",
    "add many": "Accept",
    "move": "Move",
    "set known": "Flag",
    "swap ends": "Swap ends of",
    "delete": "Delete",
    "delete element": "Delete",
    "delete many": "Delete",
    "link": "Link",
    "unlink": "Unlink",
    "set class": "Class of",
    "dismiss": "Dismiss",
    "take back": "Revoke the decision on",
    "accept tracks": "Accept",
    "reject tracks": "Reject",
    "align labels": "Align",
}
OF_SEVERAL = ("add many", "delete many", "import", "accept tracks", "reject tracks")
"""Kinds of operations that may change several elements at once."""


class ElementRef(Part):
    """Name and class of an element."""

    id: str
    name: str
    class_id: int


class ObservationView(Part):
    """A label in one image."""

    id: str
    anchor: Pixel
    end: Pixel | None
    anchor_known: bool
    end_known: bool
    frame: int
    side: Side


class ReviewDecisionView(Part):
    """A person's decision about an element, applied in every map build."""

    id: str
    text: str


class ElementView(ElementRef):
    """An element labelled in the images on the page, with its observations there."""

    observations: dict[Side, ObservationView]
    views: int
    """Number of its observations in all images."""
    review_decisions: list[ReviewDecisionView]
    left_out: bool
    """Whether a person decided that no map has it: it is drawn only while it is selected."""


class NearbyView(ElementRef):
    """An element to continue, with the nearest frame in which it is labelled."""

    labelled_in: int


class PaneView(Part):
    """An image on the page."""

    frame: int
    side: Side
    camera: str = ""
    """Of a rig."""


class WorstLabel(Part):
    """The label furthest from the projection of its element."""

    px: float
    element: str | None


class FrameSummary(Part):
    """A frame in the list of frames: its review state and its quality."""

    index: int
    state: ReviewState
    elements: int
    worst: WorstLabel | None = None
    """None until the frame has been assessed, as are the next two."""
    proposed: int | None = None
    disagreement: Disagreement | None = None


class OperationView(Part):
    """One line of the history, and the frame it changed."""

    number: int
    text: str
    author: str
    time: str
    """UTC, ISO 8601."""
    kind: str
    frame: int | None


class LabelsView(Part):
    """The state of the labels and all frames, without the marks of a frame."""

    operation: int
    """Number of the last operation."""
    hash: str
    """Of that operation."""
    counts: dict[int, int]
    """Number of elements by class."""
    mapped: int
    can_undo: bool
    can_redo: bool
    history: list[OperationView]
    """The last operations, newest first."""
    map: MapSummary
    frames: list[FrameSummary]
    """All frames; in an update, the changed ones."""


class WorkspaceView(Part):
    """What does not change while the page is open."""

    name: str
    key: str
    """Prefix of this workspace's entries in the browser's storage."""
    source: str
    author: str
    classes: list[ElementClass]
    triangle_center: TriangleCenter
    """What the point of a triangular sign is."""
    images: dict[Side, ImageSize]
    has_right: bool
    cameras: list[str]
    """Of a rig."""


def label_element_name(element: LabelElement, classes: ClassSet) -> str:
    """Return an element's name, for example ``P-04``."""
    return classes.element_name(element.class_id, element.number)


def element_ref(element: LabelElement, classes: ClassSet) -> ElementRef:
    """Return name and class of an element."""
    name = label_element_name(element, classes)
    return ElementRef(id=element.id, name=name, class_id=element.class_id)


def pane_views(panes: Panes, frame_index: int) -> dict[Side, PaneView]:
    """Return the images on the page."""
    return {
        side: PaneView(
            frame=pane.frame_index, side=pane.side, camera=panes.camera(pane.frame_index)
        )
        for side, pane in panes.of(frame_index).items()
    }


def element_views(
    labels: Labels, panes: Mapping[Side, Pane], classes: ClassSet
) -> list[ElementView]:
    """Return the elements labelled in the images on the page, by number, with observations."""
    observations: dict[str, dict[Side, ObservationView]] = {}
    for side, pane in panes.items():
        for row in labels.in_frame(pane.frame_index, pane.side):
            observations.setdefault(row.element_id, {})[side] = observation_view(row)
    elements = sorted(map(labels.element, observations), key=lambda element: element.number)
    return [
        ElementView(
            id=element.id,
            name=label_element_name(element, classes),
            class_id=element.class_id,
            observations=observations[element.id],
            views=len(labels.of_element(element.id)),
            review_decisions=_review_decision_views(element, labels, classes),
            left_out=labels.is_left_out(element.id),
        )
        for element in elements
    ]


def _review_decision_views(
    element: LabelElement, labels: Labels, classes: ClassSet
) -> list[ReviewDecisionView]:
    texts = {
        "apart": "apart from ",
        "keep": "kept as one landmark",
        "leave out": "left out of maps",
    }
    decisions = []
    for row in labels.decisions_of(element.id):
        others = [labels.elements[id_] for id_ in row_elements(row) if id_ != element.id]
        names = [label_element_name(other, classes) for other in others]
        decisions.append(ReviewDecisionView(id=row.id, text="".join([texts[row.verdict], *names])))
    return decisions


def nearby_views(
    nearby: Iterable[NearbyElement], labels: Labels, classes: ClassSet
) -> list[NearbyView]:
    """Return the elements to continue, with the nearest frame in which each is labelled."""
    return [
        NearbyView(
            **element_ref(labels.element(near.element_id), classes).model_dump(),
            labelled_in=near.labelled_in,
        )
        for near in nearby
    ]


def frame_summary(labels: Labels, index: int, facts: FrameFacts | None) -> FrameSummary:
    """Return a frame's review state, and its quality if known."""
    here = {row.element_id for row in labels.in_frame(index)}
    elements = sum(not labels.is_left_out(element_id) for element_id in here)
    state = labels.review(index)
    if facts is None:
        return FrameSummary(index=index, state=state, elements=elements)
    return FrameSummary(
        index=index,
        state=state,
        elements=elements,
        worst=WorstLabel(px=facts.worst_px, element=facts.worst_id),
        proposed=facts.proposed,
        disagreement=facts.disagreement,
    )


def class_counts(labels: Labels) -> dict[int, int]:
    """Return the number of elements by class, without those that are left out of maps."""
    rows = labels.elements.values()
    return dict(Counter(row.class_id for row in rows if not labels.is_left_out(row.id)))


def operation_view(operation: Operation, labels: Labels, classes: ClassSet) -> OperationView:
    """Return one line of the history, and the frame it changed."""
    return OperationView(
        number=operation.number,
        text=_describe(operation, labels, classes),
        author=operation.author,
        time=operation.time,
        kind=operation.kind,
        frame=frame_of(operation, labels),
    )


def frame_of(operation: Operation, labels: Labels) -> int | None:
    """Return the frame that an operation changed, the first if several; None for none."""
    frames = frames_touched(operation)
    if frames:
        return frames[0]
    element_ids = (id_ for row in _rows(operation) for id_ in row_elements(row))
    rows = next((rows for id_ in element_ids if (rows := labels.of_element(id_))), ())
    return rows[0].frame_index if rows else None


def note_on(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """Return a message about an operation; empty for most.

    It tells what a deletion removed and what is left, and what an undo could not restore.
    """
    if operation.kind == "undo" and operation.text:
        return f"Undone operation {operation.undoes}; left as it is: {operation.text}."
    if operation.kind in ("accept tracks", "reject tracks"):
        return _note_on_tracks(operation, labels, classes)
    if operation.kind not in ("delete", "delete element"):
        return ""
    befores = [change.before for change in operation.changes]
    deleted = [row for row in befores if isinstance(row, Observation)]
    subject = _subject(operation, labels, classes)
    left = len(labels.of_element(deleted[0].element_id)) if deleted else 0
    if left:
        return f"Deleted {subject}. {_count(left, 'view')} left. Ctrl Z brings it back."
    frames = len({row.frame_index for row in deleted})
    extent = f"{_count(len(deleted), 'view')} in {_count(frames, 'frame')}"
    return f"Deleted {subject} with {extent}. Ctrl Z brings all back."


def _note_on_tracks(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``Accepted P-26 in 9 frames. Ctrl Z undoes it.``, or how many tracks."""
    rows = [change.after for change in operation.changes]
    elements = [row for row in rows if isinstance(row, LabelElement)]
    frames = _count(len(frames_touched(operation)), "frame")
    name = label_element_name(elements[0], classes)
    subject, them = (name, "it") if len(elements) == 1 else (f"{len(elements)} tracks", "them")
    if operation.kind == "accept tracks":
        return f"Accepted {subject} in {frames}. Ctrl Z undoes it."
    return f"Rejected {subject} in {frames}: no map will have {them}. Ctrl Z undoes it."


def observations_added(operation: Operation) -> int:
    """Return how many observations an operation added; negative for removed ones."""
    changes = operation.changes
    after = sum(isinstance(change.after, Observation) for change in changes)
    return after - sum(isinstance(change.before, Observation) for change in changes)


def frames_touched(operation: Operation) -> list[int]:
    """Return all frames whose labels or review an operation changed, ascending."""
    rows = _rows(operation)
    return sorted(
        {row.frame_index for row in rows if isinstance(row, Observation | Dismissal | Review)}
    )


def frames_of_decisions(operation: Operation, labels: Labels) -> set[int]:
    """Return the frames of elements about which an operation changed a decision."""
    rows = (row for row in _rows(operation) if isinstance(row, ReviewDecision))
    elements = {element_id for row in rows for element_id in row_elements(row)}
    return {row.frame_index for id_ in elements for row in labels.of_element(id_)}


def _rows(operation: Operation) -> Sequence[Row]:
    rows = [row for change in operation.changes for row in (change.after, change.before)]
    return [row for row in rows if row is not None]


def _describe(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    if operation.undoes is not None:
        return f"Undo {operation.undoes}"
    if operation.redoes is not None:
        return f"Redo {operation.redoes}"
    if operation.kind == "review":
        frame = frame_of(operation, labels)
        state = labels.review(frame) if frame is not None else "unseen"
        return f"Frame {frame} {_review_state(operation) or state}"
    if operation.kind == "name":
        return f"Name this state “{operation.text}”"
    if operation.kind == "restore":
        return f"Restore {operation.text}"
    if operation.kind == "judge":
        return _describe_decisions(operation, labels, classes)
    verb = VERBS.get(operation.kind, operation.kind.capitalize())
    elements = {row.element_id for row in _rows(operation) if isinstance(row, Observation)}
    if operation.kind in OF_SEVERAL and len(elements) > 1:
        return f"{verb} {len(elements)} elements"
    return f"{verb} {_subject(operation, labels, classes)}"


def _describe_decisions(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``P-03 and P-09 are apart``, or ``P-03 is apart from 5 others``."""
    rows = [row for row in _rows(operation) if isinstance(row, ReviewDecision)]
    decided = [set(row_elements(row)) for row in rows]
    elements, common = set().union(*decided), set.intersection(*decided)
    names = _names(elements, labels, classes)
    match rows[0].verdict:
        case "apart" if len(rows) > 1 and len(common) == 1:
            return f"{_names(common, labels, classes)} is apart from {len(elements) - 1} others"
        case "apart":
            return f"{names} are apart"
        case "keep":
            return f"{names} kept as one landmark"
        case "leave out":
            return f"{names} left out of maps"


def _names(element_ids: set[str], labels: Labels, classes: ClassSet) -> str:
    """``P-03, P-09 and P-12``, by number; deleted elements are left out."""
    elements = [labels.elements[id_] for id_ in element_ids if id_ in labels.elements]
    elements.sort(key=lambda element: element.number)
    names = [label_element_name(element, classes) for element in elements]
    return " and ".join([", ".join(names[:-1]), *names[-1:]] if len(names) > 1 else names or ["It"])


def _review_state(operation: Operation) -> str:
    after = operation.changes[0].after if operation.changes else None
    return after.state if isinstance(after, Review) else ""


def _subject(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``P-04 left``: the element that an operation changed, and the image if it is only one."""
    rows = _rows(operation)
    changed = {row.id: row for row in rows if isinstance(row, LabelElement)}
    sides = {row.side for row in rows if isinstance(row, Observation | Dismissal)}
    ids = list(changed) or [id_ for row in rows for id_ in row_elements(row)]
    element = changed.get(ids[0]) or labels.elements.get(ids[0]) if ids else None
    name = label_element_name(element, classes) if element is not None else "an element"
    return f"{name} {sides.pop()}" if len(sides) == 1 else name


def observation_view(row: Observation) -> ObservationView:
    """Return a label as the page shows it."""
    return ObservationView(
        id=row.id,
        anchor=row.anchor_px,
        end=row.end_px,
        anchor_known=row.anchor_known,
        end_known=row.end_known,
        frame=row.frame_index,
        side=row.side,
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def workspace_view(workspace: Workspace, author: str, center: TriangleCenter) -> WorkspaceView:
    """Return what does not change while the page of a workspace is open."""
    rig = workspace.source.rig
    right = rig.right or rig.left
    return WorkspaceView(
        name=workspace.name,
        key=hashlib.sha256(str(workspace.path.resolve()).encode()).hexdigest()[:16],
        source=workspace.source.map_frame.name,
        author=author,
        classes=list(workspace.classes),
        triangle_center=center,
        images={
            "left": ImageSize(width=rig.left.width, height=rig.left.height),
            "right": ImageSize(width=right.width, height=right.height),
        },
        has_right=rig.right is not None,
        cameras=list(camera_names(workspace.source)),
    )
