"""Frames of a label file that take no edits for a while: two people label them for themselves."""

import sqlite3
from collections.abc import Callable, Iterable
from typing import TypeAlias

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Dismissal, Observation, Review
from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import Operation
from semviz_annotation.storage.teamwork import BlindShare
from semviz_core.common.errors import SemvizError

WhyClosed: TypeAlias = Callable[[int, str, Labels], str]
"""Why a frame takes no edit of a kind, with the labels before it; empty if it does. Called while
the file is locked for writing, so it must not read that file."""


def open_to_all(frame_index: int, kind: str, labels: Labels) -> str:
    """A ``WhyClosed`` of files without such frames."""
    return ""


def until_merged(shares: Iterable[BlindShare]) -> WhyClosed:
    """Return why frames take no edits while two people label them blind."""
    by_frame = {frame: share for share in shares for frame in share.frames}

    def why_closed(frame_index: int, kind: str, labels: Labels) -> str:
        return why_until_merged(frame_index, by_frame.get(frame_index), labels)

    return why_closed


def why_until_merged(frame_index: int, share: BlindShare | None, labels: Labels) -> str:
    """Return why a frame takes no edits; empty if nobody labels it blind, or it is merged."""
    if share is None or not is_untouched(frame_index, labels):
        return ""
    first, second = share.people
    return f"{first} and {second} label frame {frame_index} blind, until it is merged"


def is_untouched(frame_index: int, labels: Labels) -> bool:
    """Return whether a frame has neither labels nor a review."""
    return frame_index not in labels.reviews and not labels.in_frame(frame_index)


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
