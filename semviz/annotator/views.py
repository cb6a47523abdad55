"""Labels as the page gets them: plain JSON values."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from semviz.annotator.ghosts import Ghost
from semviz.annotator.nearby import Nearby
from semviz_annotation.labels import LabelElement, Labels, Observation, Review, Row
from semviz_annotation.store import Operation
from semviz_core.classes import ClassSet

Json = dict[str, Any]

VERBS = {
    "add": "Draw",
    "move": "Move",
    "set known": "Flag",
    "swap ends": "Swap ends of",
    "delete": "Delete",
    "delete element": "Delete",
    "link": "Link",
    "unlink": "Unlink",
    "set class": "Class of",
}


def element_name(element: LabelElement, classes: ClassSet) -> str:
    """``P-04``."""
    return classes.element_name(element.class_id, element.number)


def elements_json(labels: Labels, frame_index: int, classes: ClassSet) -> list[Json]:
    """The elements labelled in a frame by number, with what was drawn in each image."""
    observations: dict[str, dict[str, Json]] = {}
    for row in labels.in_frame(frame_index):
        observations.setdefault(row.element_id, {})[row.side] = _observation_json(row)
    elements = sorted(map(labels.element, observations), key=lambda one: one.number)
    return [
        _element_json(one, classes)
        | {"observations": observations[one.id], "views": len(labels.of_element(one.id))}
        for one in elements
    ]


def ghosts_json(ghosts: Iterable[Ghost], labels: Labels, classes: ClassSet) -> list[Json]:
    """Expected elements, with their place in each image in which they should be."""
    found: dict[str, Json] = {}
    for one in ghosts:
        fresh = _element_json(labels.element(one.element_id), classes) | {"depth_m": one.depth_m}
        found.setdefault(one.element_id, fresh).update(_ghost_json(one))
    return list(found.values())


def nearby_json(nearby: Iterable[Nearby], labels: Labels, classes: ClassSet) -> list[Json]:
    """Elements to continue, like ghosts, but with the frame they are known from, not a depth."""
    return [
        _element_json(labels.element(one.element_id), classes)
        | {"labelled_in": one.labelled_in}
        | {side: place for ghost in one.ghosts for side, place in _ghost_json(ghost).items()}
        for one in nearby
    ]


def frames_json(labels: Labels, indices: Iterable[int]) -> list[Json]:
    """State of review and number of elements of some frames."""
    return [
        {
            "index": index,
            "state": labels.review(index),
            "elements": len({row.element_id for row in labels.in_frame(index)}),
        }
        for index in indices
    ]


def class_counts(labels: Labels) -> dict[int, int]:
    """Number of elements by class."""
    return dict(Counter(element.class_id for element in labels.elements.values()))


def operation_json(operation: Operation, labels: Labels, classes: ClassSet) -> Json:
    """One line of the history, and the frame that it is about."""
    return {
        "number": operation.number,
        "text": _describe(operation, labels, classes),
        "author": operation.author,
        "frame": frame_of(operation, labels),
    }


def frame_of(operation: Operation, labels: Labels) -> int | None:
    """The frame that an operation changed (the first, if several); None where it has none."""
    frames = frames_touched(operation)
    if frames:
        return frames[0]
    elements = [row for row in _rows(operation) if isinstance(row, LabelElement)]
    seen = labels.of_element(elements[0].id) if elements else ()
    return seen[0].frame_index if seen else None


def what_fell(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """What a deletion took away and what is left, for people; empty for other operations."""
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


def frames_touched(operation: Operation) -> list[int]:
    """All frames whose labels or review an operation changed, ascending."""
    rows = _rows(operation)
    return sorted({row.frame_index for row in rows if isinstance(row, Observation | Review)})


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
    verb = VERBS.get(operation.kind, operation.kind.capitalize())
    return f"{verb} {_subject(operation, labels, classes)}".strip()


def _said(operation: Operation) -> str:
    after = operation.changes[0].after if operation.changes else None
    return after.state if isinstance(after, Review) else ""


def _subject(operation: Operation, labels: Labels, classes: ClassSet) -> str:
    """``P-04 left``: the element that an operation is about, and the image if it is only one."""
    rows = _rows(operation)
    known = {row.id: row for row in rows if isinstance(row, LabelElement)}
    seen = [row for row in rows if isinstance(row, Observation)]
    ids = list(known) or [row.element_id for row in seen]
    element = known.get(ids[0]) or labels.elements.get(ids[0]) if ids else None
    name = element_name(element, classes) if element is not None else "an element"
    sides = {row.side for row in seen}
    return f"{name} {sides.pop()}" if len(sides) == 1 else name


def _element_json(element: LabelElement, classes: ClassSet) -> Json:
    return {
        "id": element.id,
        "name": element_name(element, classes),
        "class": element.class_id,
    }


def _ghost_json(ghost: Ghost) -> Json:
    return {ghost.side: {"anchor": ghost.anchor_px, "end": ghost.end_px}}


def _observation_json(row: Observation) -> Json:
    return {
        "id": row.id,
        "anchor": row.anchor_px,
        "end": row.end_px,
        "anchor_known": row.anchor_known,
        "end_known": row.end_known,
    }


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
