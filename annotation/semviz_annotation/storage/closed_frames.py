"""Frames of a label file that take no edits for a while: two people label them for themselves."""

import sqlite3
from collections.abc import Callable
from typing import TypeAlias

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Dismissal, Observation, Review
from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import Operation
from semviz_core.common.errors import SemvizError

WhyClosed: TypeAlias = Callable[[int, str, Labels], str]
"""Why a frame takes no edit of a kind, with the labels before it; empty if it does. Called while
the file is locked for writing, so it must not read that file."""


def open_to_all(frame_index: int, kind: str, labels: Labels) -> str:
    """A ``WhyClosed`` of files without such frames."""
    return ""


def check_open(
    operation: Operation, closed: WhyClosed, labels: Labels, connection: sqlite3.Connection
) -> None:
    """Raise SemvizError if a frame whose rows an operation changes is closed to its kind.

    An edit that is done again is of the kind that it was.
    """
    kind = operation.kind
    if operation.redoes is not None:
        (redone,) = tables.read_operations(connection, operation.redoes - 1, limit=1)
        kind = redone.kind
    changed = (row for change in operation.changes for row in (change.before, change.after))
    frames = {
        row.frame_index for row in changed if isinstance(row, Observation | Review | Dismissal)
    }
    for frame_index in sorted(frames):
        if why := closed(frame_index, kind, labels):
            raise SemvizError(why)
