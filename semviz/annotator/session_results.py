"""What a labelling session returns: an edit on disk."""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from semviz.annotator import operation_texts
from semviz_annotation.labels.edits import AnyEdit, SetAttribute
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.rows import Note
from semviz_annotation.storage.store import Operation

Write: TypeAlias = Callable[[AnyEdit], Operation]
"""Writes an edit in the name of whose page sent it, against what that page had shown."""

BesideBlind: TypeAlias = Callable[
    [int, Mapping[str, str], frozenset[str]], tuple[tuple[SetAttribute, ...], tuple[Note, ...]]
]
"""Returns attributes and notes of elements of a frame that two people labelled blind: by the ids
that they get, and whose second person's attributes count. See ``BlindShares.beside``."""


@dataclass(frozen=True)
class SavedEdit:
    """An edit that is on disk."""

    operation: Operation
    element_id: str | None
    """The element to which a drawing, link or unlinked view now belongs; None for other edits."""
    frame: int | None
    """The frame it changed, if in this sequence; the page goes there after an undo."""
    added: int = 0
    """Number of observations added; negative for removed ones."""
    note: str = ""
    """Message for the user."""

    @classmethod
    def of(cls, operation: Operation, labels: Labels, frames: Container[int]) -> "SavedEdit":
        """Describe ``operation`` on ``labels``, for a page of a sequence with ``frames``."""
        rows = [change.after for change in operation.changes]
        element_ids = [row.element_id for row in rows if isinstance(row, Observation)]
        has_element = element_ids and operation.kind in ("add", "link", "unlink")
        frame = operation_texts.frame_of(operation, labels)
        return cls(
            operation=operation,
            element_id=element_ids[0] if has_element else None,
            frame=frame if frame in frames else None,
            added=operation_texts.observations_added(operation),
            note=operation_texts.note_on(operation, labels),
        )
