"""Describe operations for people: lines of the history, and what an edit did."""

import math
import statistics
from collections.abc import Sequence

from semviz.annotator.views import OperationView, label_element_name
from semviz_annotation.labels.labels import (
    Dismissal,
    LabelElement,
    Labels,
    Observation,
    Review,
    ReviewDecision,
    Row,
)
from semviz_annotation.labels.rows import AttributeType, ClassDeclaration, Note, row_elements
from semviz_annotation.storage.store import Operation

VERBS = {
    "add": "Draw",
    "add many": "Accept",
    "move": "Move",
    "set known": "Flag",
    "set known of many": "Flag",
    "swap ends": "Swap ends of",
    "delete": "Delete",
    "delete element": "Delete",
    "delete many": "Delete",
    "link": "Link",
    "unlink": "Unlink",
    "set class": "Class of",
    "set class of many": "Class of",
    "dismiss": "Dismiss",
    "take back": "Revoke the decision on",
    "accept tracks": "Accept",
    "reject tracks": "Reject",
    "align labels": "Align",
    "re-snap": "Re-snap",
    "set class of views": "Class of labels of",
    "delete note": "Delete a note on",
    "set attribute": "Attribute of",
}
OF_SEVERAL = (
    "add many",
    "delete many",
    "set class of many",
    "set known of many",
    "import",
    "accept tracks",
    "reject tracks",
)
"""Kinds of operations that may change several elements at once."""


def operation_view(operation: Operation, labels: Labels) -> OperationView:
    """Return one line of the history, and the frame it changed."""
    return OperationView(
        number=operation.number,
        text=_describe(operation, labels),
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


def note_on(operation: Operation, labels: Labels) -> str:
    """Return a message about an operation; empty for most.

    It tells what a deletion removed and what is left, and what an undo could not restore.
    """
    if operation.kind == "undo" and operation.text:
        return f"Undone operation {operation.undoes}; left as it is: {operation.text}."
    if operation.kind in ("accept tracks", "reject tracks"):
        return _note_on_tracks(operation, labels)
    if operation.kind == "re-snap":
        return _note_on_resnap(operation)
    if operation.kind not in ("delete", "delete element", "delete many"):
        return ""
    befores = [change.before for change in operation.changes]
    deleted = [row for row in befores if isinstance(row, Observation)]
    frames = len({row.frame_index for row in deleted})
    extent = f"{_count(len(deleted), 'view')} in {_count(frames, 'frame')}"
    elements = len({row.element_id for row in deleted})
    if elements > 1:
        return f"Deleted {extent}, of {elements} elements. Ctrl Z brings all back."
    subject = _subject(operation, labels)
    left = len(labels.of_element(deleted[0].element_id)) if deleted else 0
    if left:
        return f"Deleted {subject}. {_count(left, 'view')} left. Ctrl Z brings it back."
    return f"Deleted {subject} with {extent}. Ctrl Z brings all back."


def _note_on_tracks(operation: Operation, labels: Labels) -> str:
    """``Accepted P-26 in 9 frames. Ctrl Z undoes it.``, or how many tracks."""
    rows = [change.after for change in operation.changes]
    elements = [row for row in rows if isinstance(row, LabelElement)]
    frames = _count(len(frames_touched(operation)), "frame")
    name = label_element_name(elements[0], labels.classes)
    subject, them = (name, "it") if len(elements) == 1 else (f"{len(elements)} tracks", "them")
    if operation.kind == "accept tracks":
        return f"Accepted {subject} in {frames}. Ctrl Z undoes it."
    return f"Rejected {subject} in {frames}: no map will have {them}. Ctrl Z undoes it."


def _note_on_resnap(operation: Operation) -> str:
    """``Moved 43 views by 0.3 px (median). Ctrl Z undoes it.``"""
    moved = [
        max(
            math.dist(before, after)
            for before, after in (
                (change.before.anchor_px, change.after.anchor_px),
                (change.before.end_px or (0.0, 0.0), change.after.end_px or (0.0, 0.0)),
            )
        )
        for change in operation.changes
        if isinstance(change.before, Observation) and isinstance(change.after, Observation)
    ]
    views = _count(len(moved), "view")
    return f"Moved {views} by {statistics.median(moved):.1f} px (median). Ctrl Z undoes it."


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


def _describe(operation: Operation, labels: Labels) -> str:
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
    if operation.kind == "label once":
        return f"Label once what operation {operation.text} had labelled twice"
    if operation.kind in ("invite", "revoke", "assign", "label twice"):
        return f"{operation.kind.capitalize()} {operation.text}"
    if operation.kind in ("accept frame", "send back", "merge frame"):
        verb = operation.kind.removesuffix(" frame").capitalize()
        return f"{verb} frame {frame_of(operation, labels)}"
    if operation.kind in ("declare class", "remove class", "declare attribute"):
        declared = (ClassDeclaration, AttributeType)
        names = {row.name for row in _rows(operation) if isinstance(row, declared)}
        return f"{operation.kind.capitalize()} {', '.join(sorted(names))}"
    if operation.kind == "restore":
        return f"Restore {operation.text}"
    if operation.kind == "note":
        text = next((row.text for row in _rows(operation) if isinstance(row, Note)), "")
        return f"Note on {_subject(operation, labels)}{f': {text}' if text else ', unsure'}"
    if operation.kind == "judge":
        return _describe_decisions(operation, labels)
    verb = VERBS.get(operation.kind, operation.kind.capitalize())
    elements = _labelled_elements(_rows(operation))
    if operation.kind in OF_SEVERAL and len(elements) > 1:
        return f"{verb} {len(elements)} elements"
    return f"{verb} {_subject(operation, labels)}"


def _labelled_elements(rows: Sequence[Row]) -> set[str]:
    """Return the ids of the elements that rows are, or that rows are observations of."""
    observed = {row.element_id for row in rows if isinstance(row, Observation)}
    return observed | {row.id for row in rows if isinstance(row, LabelElement)}


def _describe_decisions(operation: Operation, labels: Labels) -> str:
    """``P-03 and P-09 are apart``, or ``P-03 is apart from 5 others``."""
    rows = [row for row in _rows(operation) if isinstance(row, ReviewDecision)]
    decided = [set(row_elements(row)) for row in rows]
    elements, common = set().union(*decided), set.intersection(*decided)
    names = _names(elements, labels)
    match rows[0].verdict:
        case "apart" if len(rows) > 1 and len(common) == 1:
            return f"{_names(common, labels)} is apart from {len(elements) - 1} others"
        case "apart":
            return f"{names} are apart"
        case "keep":
            return f"{names} kept as one landmark"
        case "leave out":
            return f"{names} left out of maps"


def _names(element_ids: set[str], labels: Labels) -> str:
    """``P-03, P-09 and P-12``, by number; deleted elements are left out."""
    elements = [labels.elements[id_] for id_ in element_ids if id_ in labels.elements]
    elements.sort(key=lambda element: element.number)
    names = [label_element_name(element, labels.classes) for element in elements]
    return " and ".join([", ".join(names[:-1]), *names[-1:]] if len(names) > 1 else names or ["It"])


def _review_state(operation: Operation) -> str:
    after = operation.changes[0].after if operation.changes else None
    return after.state if isinstance(after, Review) else ""


def _subject(operation: Operation, labels: Labels) -> str:
    """``P-04 left``: the element that an operation changed, and the image if it is only one."""
    rows = _rows(operation)
    changed = {row.id: row for row in rows if isinstance(row, LabelElement)}
    sides = {row.side for row in rows if isinstance(row, Observation | Dismissal)}
    ids = list(changed) or [id_ for row in rows for id_ in row_elements(row)]
    element = changed.get(ids[0]) or labels.elements.get(ids[0]) if ids else None
    name = label_element_name(element, labels.classes) if element is not None else "an element"
    return f"{name} {sides.pop()}" if len(sides) == 1 else name


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
