"""What the log tells about the people who label: who reviewed what, who has which frames."""

import re
import sqlite3
from collections import defaultdict
from typing import NamedTuple

from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import Writer
from semviz_core.common.errors import SemvizError


class AssignedFrames(NamedTuple):
    """Frames from the first to the last, inclusive."""

    first: int
    last: int


class Tally(NamedTuple):
    """The work of one person."""

    edits: int
    last: str
    """Time of the last edit: UTC, ISO 8601."""


def review_writers(connection: sqlite3.Connection) -> dict[int, Writer]:
    """Return, for each frame that was ever reviewed, the last operation on its review."""
    rows = connection.execute(
        "SELECT writers.row_id, operations.number, author, origin, time, kind "
        "FROM writers JOIN operations ON operations.number = writers.number "
        "WHERE row_tag = 'review'"
    )
    return {int(frame): Writer(*columns) for frame, *columns in rows}


def tallies(connection: sqlite3.Connection) -> dict[str, Tally]:
    """Return the number of edits of each author, and when the last one was."""
    statements = tuple(tables.STATEMENTS)
    rows = connection.execute(
        "SELECT author, count(*), max(time) FROM operations WHERE origin = 'human' "
        f"AND kind NOT IN ({', '.join('?' * len(statements))}) GROUP BY author",
        statements,
    )
    return {author: Tally(count, last) for author, count, last in rows}


def assignment_text(name: str, frames: AssignedFrames | None) -> str:
    """Return the text of an operation that assigns frames to a person, or takes all away."""
    return f"none {name}" if frames is None else f"{frames.first}-{frames.last} {name}"


def assignments(connection: sqlite3.Connection) -> dict[str, list[AssignedFrames]]:
    """Return the ranges of frames of each person, in the order in which they were assigned."""
    ranges: dict[str, list[AssignedFrames]] = defaultdict(list)
    for (text,) in connection.execute(
        "SELECT text FROM operations WHERE kind = 'assign' ORDER BY number"
    ):
        found = re.fullmatch(r"(?:none|(\d{1,9})-(\d{1,9})) (.+)", text)
        if found is None:
            raise SemvizError(f"'{text}' assigns no frames")
        if found[1] is None:
            ranges[found[3]].clear()
        else:
            ranges[found[3]].append(AssignedFrames(int(found[1]), int(found[2])))
    return {name: of for name, of in ranges.items() if of}
