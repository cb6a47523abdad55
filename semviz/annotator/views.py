"""Labels as the page gets them: plain JSON values."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from semviz.annotator.facts import FrameFacts
from semviz.annotator.nearby import Nearby
from semviz.annotator.panes import Pane
from semviz_annotation.labels import (
    Dismissal,
    Judgement,
    LabelElement,
    Labels,
    Observation,
    Review,
    Row,
)
from semviz_annotation.rows import elements_of
from semviz_annotation.storing.store import Operation
from semviz_core.classes import ClassSet
from semviz_core.sources.source import Side

Json = dict[str, Any]

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
    "dismiss": "Turn down",
    "take back": "Leave to the map",
}
OF_SEVERAL = ("add many", "delete many", "import")
"""Kinds of operations that may be about several elements at once."""


def element_name(element: LabelElement, classes: ClassSet) -> str:
    """``P-04``."""
    return classes.element_name(element.class_id, element.number)


def element_json(element: LabelElement, classes: ClassSet) -> Json:
    """What an element is called and of which class it is."""
    return {
        "id": element.id,
        "name": element_name(element, classes),
        "class": element.class_id,
    }


def panes_json(panes: Mapping[Side, Pane]) -> Json:
    """Which images are on the page."""
    return {side: {"frame": pane.frame_index, "side": pane.side} for side, pane in panes.items()}


def elements_json(labels: Labels, panes: Mapping[Side, Pane], classes: ClassSet) -> list[Json]:
    """The elements labelled in the images on the page by number, with what was drawn in each."""
    observations: dict[str, dict[str, Json]] = {}
    for side, pane in panes.items():
        for row in labels.in_frame(pane.frame_index, pane.side):
            observations.setdefault(row.element_id, {})[side] = observation_json(row)
    elements = sorted(map(labels.element, observations), key=lambda one: one.number)
    return [
        element_json(one, classes)
        | {"observations": observations[one.id], "views": len(labels.of_element(one.id))}
        | {"judged": judged_json(one, labels, classes)}
        for one in elements
    ]


def judged_json(element: LabelElement, labels: Labels, classes: ClassSet) -> list[Json]:
    """What people decided about an element for every map."""
    texts = {"apart": "apart from ", "keep": "kept as one thing", "leave out": "left out of maps"}
    found = []
    for row in labels.judgements_of(element.id):
        others = [labels.elements[one] for one in elements_of(row) if one != element.id]
        names = [element_name(one, classes) for one in others]
        found.append({"id": row.id, "text": "".join([texts[row.verdict], *names])})
    return found


def nearby_json(nearby: Iterable[Nearby], labels: Labels, classes: ClassSet) -> list[Json]:
    """Elements to continue, with the frame they are known from."""
    return [
        element_json(labels.element(one.element_id), classes) | {"labelled_in": one.labelled_in}
        for one in nearby
    ]


def frame_json(labels: Labels, index: int, facts: FrameFacts | None) -> Json:
    """A frame in the list of all: how far it is, and what is known of its labels."""
    summary: Json = {
        "index": index,
        "state": labels.review(index),
        "elements": len({row.element_id for row in labels.in_frame(index)}),
    }
    if facts is not None:
        worst = {"px": facts.worst_px, "element": facts.worst_id}
        summary |= {"worst": worst, "proposed": facts.proposed}
        if facts.disagreement is not None:
            summary |= {"disagreement": vars(facts.disagreement)}
    return summary


def class_counts(labels: Labels) -> dict[int, int]:
    """Number of elements by class."""
    return dict(Counter(element.class_id for element in labels.elements.values()))


def operation_json(operation: Operation, labels: Labels, classes: ClassSet) -> Json:
    """One line of the history, and the frame that it is about."""
    return {
        "number": operation.number,
        "text": _describe(operation, labels, classes),
        "author": operation.author,
        "time": operation.time,
        "kind": operation.kind,
        "frame": frame_of(operation, labels),
    }


def frame_of(operation: Operation, labels: Labels) -> int | None:
    """The frame that an operation changed (the first, if several); None where it has none."""
    frames = frames_touched(operation)
    if frames:
        return frames[0]
    about = (one for row in _rows(operation) for one in elements_of(row))
    seen = next((rows for one in about if (rows := labels.of_element(one))), ())
    return seen[0].frame_index if seen else None


def note_on(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """What people should know of an operation; empty for most.

    What a deletion took away and what is left; what an undo had to pass over.
    """
    if operation.kind == "undo" and operation.text:
        return f"Undone operation {operation.undoes}; left as it is: {operation.text}."
    if operation.kind not in ("delete", "delete element"):
        return ""
    gone = [one.before for one in operation.changes if isinstance(one.before, Observation)]
    subject = _subject(operation, labels, classes)
    left = len(labels.of_element(gone[0].element_id)) if gone else 0
    if left:
        return f"Deleted {subject}. {_count(left, 'view')} left. Ctrl Z brings it back."
    frames = len({row.frame_index for row in gone})
    fell = f"{_count(len(gone), 'view')} in {_count(frames, 'frame')}"
    return f"Deleted {subject} with {fell}. Ctrl Z brings all back."


def observations_added(operation: Operation) -> int:
    """How many observations more there are after it."""
    changes = operation.changes
    after = sum(isinstance(one.after, Observation) for one in changes)
    return after - sum(isinstance(one.before, Observation) for one in changes)


def frames_touched(operation: Operation) -> list[int]:
    """All frames whose labels or review an operation changed, ascending."""
    rows = _rows(operation)
    return sorted(
        {row.frame_index for row in rows if isinstance(row, Observation | Dismissal | Review)}
    )


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
        return f"Frame {frame} {_said(operation) or state}"
    if operation.kind == "name":
        return f"Name this state “{operation.text}”"
    if operation.kind == "restore":
        return f"Restore {operation.text}"
    if operation.kind == "judge":
        return _judged(operation, labels, classes)
    verb = VERBS.get(operation.kind, operation.kind.capitalize())
    seen = {row.element_id for row in _rows(operation) if isinstance(row, Observation)}
    if operation.kind in OF_SEVERAL and len(seen) > 1:
        return f"{verb} {len(seen)} elements"
    return f"{verb} {_subject(operation, labels, classes)}"


def _judged(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``P-03 and P-09 are apart``; of more, ``P-03 is apart from 5 others`` if it alone is."""
    rows = [row for row in _rows(operation) if isinstance(row, Judgement)]
    about = [set(elements_of(row)) for row in rows]
    every, common = set().union(*about), set.intersection(*about)
    names = _names(every, labels, classes)
    match rows[0].verdict:
        case "apart" if len(rows) > 1 and len(common) == 1:
            return f"{_names(common, labels, classes)} is apart from {len(every) - 1} others"
        case "apart":
            return f"{names} are apart"
        case "keep":
            return f"{names} kept as one thing"
        case "leave out":
            return f"{names} left out of maps"


def _names(element_ids: set[str], labels: Labels, classes: ClassSet) -> str:
    """``P-03, P-09 and P-12``, by number, of those that are there still."""
    known = [labels.elements[one] for one in element_ids if one in labels.elements]
    names = [element_name(one, classes) for one in sorted(known, key=lambda one: one.number)]
    return " and ".join([", ".join(names[:-1]), *names[-1:]] if len(names) > 1 else names or ["It"])


def _said(operation: Operation) -> str:
    after = operation.changes[0].after if operation.changes else None
    return after.state if isinstance(after, Review) else ""


def _subject(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``P-04 left``: the element that an operation is about, and the image if it is only one."""
    rows = _rows(operation)
    known = {row.id: row for row in rows if isinstance(row, LabelElement)}
    seen = [row for row in rows if isinstance(row, Observation | Dismissal)]
    ids = list(known) or [one for row in rows for one in elements_of(row)]
    element = known.get(ids[0]) or labels.elements.get(ids[0]) if ids else None
    name = element_name(element, classes) if element is not None else "an element"
    sides = {row.side for row in seen}
    return f"{name} {sides.pop()}" if len(sides) == 1 else name


def observation_json(row: Observation) -> Json:
    """What is labelled in one image."""
    return {
        "id": row.id,
        "anchor": row.anchor_px,
        "end": row.end_px,
        "anchor_known": row.anchor_known,
        "end_known": row.end_known,
        "frame": row.frame_index,
        "side": row.side,
    }


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
