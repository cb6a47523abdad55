"""Describe labels, elements, frames and operations for the page."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict

from semviz.annotator.drawing.association import NearbyElement
from semviz.annotator.frame_quality import FrameFacts
from semviz.annotator.map_review import MapSummary
from semviz.annotator.panes import Pane, Panes
from semviz.annotator.proposals.detector_proposals import Disagreement
from semviz.web.protocol import ImageSize, Part
from semviz.workspace.blind import BlindWorkspace
from semviz.workspace.maps.map_decisions import asked_by_frame, decisions_path
from semviz.workspace.people import Role
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import (
    LabelElement,
    Labels,
    Observation,
    Pixel,
    ReviewState,
)
from semviz_annotation.labels.own_classes import attribute_types, class_keys
from semviz_annotation.labels.rows import AttributeType, Note, row_elements
from semviz_core.base.classes import ClassSet, ClassShape, Kind, TriangleCenter
from semviz_core.base.frame import Side
from semviz_core.datasets.rig_cameras import camera_names


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


class NoteView(Part):
    """A note on an element."""

    id: str
    frame: int | None
    unsure: bool
    text: str
    author: str
    time: str
    """UTC, ISO 8601."""


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
    attributes: dict[str, str]
    notes: list[NoteView]
    """Those on this frame."""


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
    asked: tuple[str, ...] = ()
    """Map elements whose labels are asked for in the inspector."""


class OperationView(Part):
    """One line of the history, and the frame it changed."""

    number: int
    text: str
    author: str
    time: str
    """UTC, ISO 8601."""
    kind: str
    frame: int | None


class TeamSummary(Part):
    """What the page of everybody knows of the work of all."""

    sent_back: list[int]
    """Frames that a reviewer sent back and nobody reviewed since."""
    assigned: dict[str, list[tuple[int, int]]]
    """The ranges of frames of each person, first and last."""


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
    team: TeamSummary


class KeyedClass(Part):
    """A class, and the key that chooses it; empty for none."""

    id: int
    name: str
    kind: Kind
    letter: str
    shape: ClassShape
    color: str
    color_light: str
    key: str


class WorkspaceView(Part):
    """What does not change while the page is open."""

    name: str
    key: str
    """Prefix of this workspace's entries in the browser's storage."""
    source: str
    author: str
    """Whose page it is."""
    role: Role
    classes: list[KeyedClass]
    attribute_types: list[AttributeType]
    """What is declared of attributes; others are texts."""
    triangle_center: TriangleCenter
    """What the point of a triangular sign is."""
    images: dict[Side, ImageSize]
    has_right: bool
    cameras: list[str]
    """Of a rig."""
    is_blind: bool
    """Whether these are frames that its person labels without seeing another's labels."""


def label_element_name(element: LabelElement, classes: ClassSet) -> str:
    """Return an element's name, for example ``P-04``; ``?-04`` if its class was removed since."""
    if element.class_id not in classes:
        return f"?-{element.number:02d}"
    return classes.element_name(element.class_id, element.number)


def attribute_values(labels: Labels, element_id: str) -> dict[str, str]:
    """Return the attributes of an element, by name."""
    return {row.name: row.value for row in labels.attributes_of(element_id)}


def element_ref(element: LabelElement, classes: ClassSet) -> ElementRef:
    """Return name and class of an element."""
    name = label_element_name(element, classes)
    return ElementRef(id=element.id, name=name, class_id=element.class_id)


def note_view(note: Note) -> NoteView:
    """Return a note as the page shows it."""
    return NoteView(
        id=note.id,
        frame=note.frame_index,
        unsure=note.unsure,
        text=note.text,
        author=note.author,
        time=note.time,
    )


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
            attributes=attribute_values(labels, element.id),
            notes=[
                note_view(note)
                for note in labels.notes_of(element.id)
                if note.frame_index == panes["left"].frame_index
            ],
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


def frame_summaries(
    labels: Labels,
    indices: Iterable[int],
    facts_of: Callable[[int], FrameFacts | None],
    workspace: Workspace,
) -> list[FrameSummary]:
    """Return the review states of frames, their quality if known, and what is asked for in them."""
    asked = asked_by_frame(decisions_path(workspace))
    return [_frame_summary(labels, i, facts_of(i), asked.get(i, ())) for i in indices]


def _frame_summary(
    labels: Labels, index: int, facts: FrameFacts | None, asked: tuple[str, ...]
) -> FrameSummary:
    here = {row.element_id for row in labels.in_frame(index)}
    elements = sum(not labels.is_left_out(element_id) for element_id in here)
    state = labels.review(index)
    if facts is None:
        return FrameSummary(index=index, state=state, elements=elements, asked=asked)
    return FrameSummary(
        index=index,
        state=state,
        elements=elements,
        worst=WorstLabel(px=facts.worst_px, element=facts.worst_id),
        proposed=facts.proposed,
        disagreement=facts.disagreement,
        asked=asked,
    )


def class_counts(labels: Labels) -> dict[int, int]:
    """Return the number of elements by class, without those that are left out of maps."""
    rows = labels.elements.values()
    return dict(Counter(row.class_id for row in rows if not labels.is_left_out(row.id)))


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


def workspace_view(workspace: Workspace, author: str, role: Role, labels: Labels) -> WorkspaceView:
    """Return what does not change while the page of a workspace is open."""
    rig = workspace.source.rig
    right = rig.right or rig.left
    keys = class_keys(labels)
    return WorkspaceView(
        name=workspace.name,
        key=hashlib.sha256(str(workspace.path.resolve()).encode()).hexdigest()[:16],
        source=workspace.source.map_frame.name,
        author=author,
        role=role,
        classes=[
            KeyedClass(**asdict(class_), key=keys.get(class_.id, "")) for class_ in labels.classes
        ],
        attribute_types=list(attribute_types(labels).values()),
        triangle_center=labels.triangle_center,
        images={
            "left": ImageSize(width=rig.left.width, height=rig.left.height),
            "right": ImageSize(width=right.width, height=right.height),
        },
        has_right=rig.right is not None,
        cameras=list(camera_names(workspace.source)),
        is_blind=isinstance(workspace, BlindWorkspace),
    )
