"""What the log tells about the people who label: who reviewed what, who has which frames."""

import re
import sqlite3
from collections import defaultdict
from collections.abc import Iterable
from typing import Literal, NamedTuple, TypeAlias

from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import Writer
from semviz_core.common.errors import SemvizError

Statement: TypeAlias = Literal["invite", "revoke", "assign", "label twice", "label once"]
"""Kinds of operations about people: they change no row."""


class AssignedFrames(NamedTuple):
    """Frames from the first to the last, inclusive."""

    first: int
    last: int


class Tally(NamedTuple):
    """The work of one person."""

    edits: int
    last: str
    """Time of the last edit: UTC, ISO 8601."""


class BlindShare(NamedTuple):
    """Frames that two people label, neither seeing the other's labels."""

    number: int
    """Of the operation that assigned them."""
    people: tuple[str, str]
    frames: tuple[int, ...]


class Teamwork(NamedTuple):
    """What the log tells about the people who label."""

    reviews: dict[int, Writer]
    """The last operation on the review of each frame that was ever reviewed."""
    tallies: dict[str, Tally]
    """The work of each author."""
    assigned: dict[str, list[AssignedFrames]]
    """The ranges of each person, in the order in which they were assigned."""
    shares: list[BlindShare]
    """Those that were not ended."""


def read_teamwork(connection: sqlite3.Connection) -> Teamwork:
    """Read all of it."""
    reviews, work = review_writers(connection), tallies(connection)
    return Teamwork(reviews, work, assignments(connection), read_shares(connection))


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


def share_text(people: tuple[str, str], frames: Iterable[int]) -> str:
    """Return the text of an operation that lets two people label frames."""
    return f"{','.join(map(str, sorted(frames)))} by {' | '.join(people)}"


def read_shares(connection: sqlite3.Connection) -> list[BlindShare]:
    """Return the shares that were not ended, in the order in which they were assigned."""
    found: dict[int, BlindShare] = {}
    for number, kind, text in connection.execute(
        "SELECT number, kind, text FROM operations WHERE kind IN ('label twice', 'label once') "
        "ORDER BY number"
    ):
        if kind == "label once":
            found.pop(int(text), None)
            continue
        frames, first, second = _parsed_share(text)
        found[number] = BlindShare(number, (first, second), frames)
    return list(found.values())


def _parsed_share(text: str) -> tuple[tuple[int, ...], str, str]:
    found = re.fullmatch(r"(\d{1,9}(?:,\d{1,9})*) by (.+) \| (.+)", text)
    if found is None:
        raise SemvizError(f"'{text[:60]}' assigns no frames to two people")
    return tuple(map(int, found[1].split(","))), found[2], found[3]


LOOKED_BACK = 50_000
"""The earlier version of a frame is searched for in so many operations."""


def earlier_version(connection: sqlite3.Connection, frame_index: int) -> Writer | None:
    """Return the operation that left the version of a frame before the present one.

    It is the last that sent the frame back, if nobody accepted it since; otherwise the last of
    another author than who wrote last. None if one person alone wrote it.
    """
    (last,) = connection.execute("SELECT coalesce(max(number), 0) FROM operations").fetchone()
    rows = connection.execute(
        "SELECT number, author, origin, time, kind FROM operations "
        "WHERE number > ? AND changes LIKE ? ORDER BY number DESC",
        (last - LOOKED_BACK, f'%"frame_index":{frame_index},%'),
    )
    newest: Writer | None = None
    other: Writer | None = None
    for writer in map(Writer._make, rows):
        if writer.kind == "send back":
            return writer
        if newest is None:
            newest = writer
        elif other is None and writer.author != newest.author:
            other = writer
        if writer.kind == "accept frame" and other is not None:
            break
    return other
