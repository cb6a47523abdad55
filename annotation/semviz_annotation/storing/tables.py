"""Rows and operations in and out of the tables of a label file (see ``schema``)."""

import sqlite3
from collections.abc import Iterable, Iterator
from typing import Any

from semviz_annotation.labels import Labels
from semviz_annotation.rows import (
    TAGS,
    Change,
    Dismissal,
    Judgement,
    Key,
    LabelElement,
    Observation,
    Review,
    Row,
)
from semviz_annotation.storing.history import History
from semviz_annotation.storing.operations import CHANGES, NO_HASH, Operation, Writer

_OPERATION = "number, request_id, author, origin, time, kind, changes, undoes, redoes, text, hash"
_WRITER = "number, author, origin, time, kind"


def read_labels(connection: sqlite3.Connection) -> Labels:
    """The current state; SemvizError where its rows do not hold together."""
    next_number = connection.execute(
        "SELECT coalesce(max(value), 1) FROM counters WHERE name = 'next element number'"
    ).fetchone()[0]
    last = connection.execute("SELECT coalesce(max(number), 0) FROM operations").fetchone()[0]
    return Labels.from_rows(_rows(connection), next_number, last)


def _rows(connection: sqlite3.Connection) -> Iterator[Row]:
    for row in connection.execute("SELECT id, number, class_id FROM elements"):
        yield LabelElement(*row)
    for id_, element, frame, side, u, v, end_u, end_v, anchor, end in connection.execute(
        "SELECT id, element_id, frame_index, side, anchor_u, anchor_v, end_u, end_v, "
        "anchor_known, end_known FROM observations"
    ):
        end_px = None if end_u is None else (end_u, end_v)
        yield Observation(id_, element, frame, side, (u, v), end_px, bool(anchor), bool(end))
    for row in connection.execute("SELECT frame_index, state FROM reviews"):
        yield Review(*row)
    for row in connection.execute("SELECT id, frame_index, side, why, element_id FROM dismissals"):
        yield Dismissal(*row)
    for row in connection.execute("SELECT id, verdict, element_id, other_id FROM judgements"):
        yield Judgement(*row)


def write_changes(
    connection: sqlite3.Connection, changes: Iterable[Change], next_number: int
) -> None:
    """Bring the tables to the state after ``changes`` (at most one a row)."""
    changes = tuple(changes)
    for change in changes:  # all removals first: a row may take another's place in an image
        if change.before is not None:
            _delete(connection, change.before)
    for change in changes:
        if change.after is not None:
            _insert(connection, change.after)
    connection.execute(
        "UPDATE counters SET value = ? WHERE name = 'next element number'", (next_number,)
    )


def _delete(connection: sqlite3.Connection, row: Row) -> None:
    if isinstance(row, Review):
        connection.execute("DELETE FROM reviews WHERE frame_index = ?", (row.frame_index,))
    else:
        connection.execute(f"DELETE FROM {TAGS[type(row)]}s WHERE id = ?", (row.id,))


def _insert(connection: sqlite3.Connection, row: Row) -> None:
    values: tuple[object, ...]
    match row:
        case LabelElement():
            values = (row.id, row.number, row.class_id)
        case Observation():
            end_px = row.end_px or (None, None)
            known = (row.anchor_known, row.end_known)
            place = (row.id, row.element_id, row.frame_index, row.side)
            values = (*place, *row.anchor_px, *end_px, *known)
        case Review():
            values = (row.frame_index, row.state)
        case Dismissal():
            values = (row.id, row.frame_index, row.side, row.why, row.element_id)
        case Judgement():
            values = (row.id, row.verdict, row.element_id, row.other_id)
    marks = ", ".join("?" * len(values))
    connection.execute(f"INSERT INTO {TAGS[type(row)]}s VALUES ({marks})", values)


def write_operation(connection: sqlite3.Connection, one: Operation) -> None:
    """Append to the log, and note who wrote which rows."""
    connection.execute(
        f"INSERT INTO operations ({_OPERATION}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            one.number,
            one.request_id,
            one.author,
            one.origin,
            one.time,
            one.kind,
            CHANGES.dump_json(one.changes).decode(),
            one.undoes,
            one.redoes,
            one.text,
            one.hash,
        ),
    )
    by_human = one.origin == "human"
    connection.executemany(
        "INSERT INTO writers VALUES (?, ?, ?, ?) ON CONFLICT DO UPDATE "
        "SET number = excluded.number, by_human = max(by_human, excluded.by_human)",
        [(*_writer_key(change.key), one.number, by_human) for change in one.changes],
    )


def _writer_key(key: Key) -> tuple[str, str]:
    return TAGS[key[0]], str(key[1])


def read_operations(
    connection: sqlite3.Connection,
    after: int = 0,
    limit: int | None = None,
    before: int | None = None,
) -> Iterator[Operation]:
    """Operations between two numbers, ascending; see ``LabelStore.operations``.

    Raises pydantic's ValidationError where one cannot be read.
    """
    end, order = (2**53, "ASC") if before is None else (before, "DESC")
    rows = connection.execute(
        f"SELECT {_OPERATION} FROM operations WHERE number > ? AND number < ? "
        f"ORDER BY number {order} LIMIT ?",
        (after, end, -1 if limit is None else limit),
    )
    return map(operation_of_row, rows if before is None else reversed(rows.fetchall()))


def operation_of_request(connection: sqlite3.Connection, request_id: str) -> Operation | None:
    """The operation that a request led to, if it was done."""
    row = connection.execute(
        f"SELECT {_OPERATION} FROM operations WHERE request_id = ?", (request_id,)
    ).fetchone()
    return None if row is None else operation_of_row(row)


def named_operations(connection: sqlite3.Connection) -> Iterator[Operation]:
    """The operations that gave a name to a state, oldest first."""
    return map(
        operation_of_row,
        connection.execute(
            f"SELECT {_OPERATION} FROM operations WHERE kind = 'name' ORDER BY number"
        ),
    )


def operation_of_row(row: tuple[Any, ...]) -> Operation:
    """An operation from the values of its columns; pydantic's ValidationError where it is none."""
    number, request_id, author, origin, time, kind, changes, undoes, redoes, text, hash_ = row
    return Operation(
        number=number,
        request_id=request_id,
        author=author,
        origin=origin,
        time=time,
        kind=kind,
        changes=CHANGES.validate_json(changes),
        undoes=undoes,
        redoes=redoes,
        text=text,
        hash=hash_,
    )


def read_history(connection: sqlite3.Connection) -> History:
    """What each author can undo and redo."""
    history = History()
    for row in connection.execute(
        "SELECT number, author, kind, undoes, redoes FROM operations ORDER BY number"
    ):
        history.add_numbers(*row)
    return history


def hash_of(connection: sqlite3.Connection, number: int) -> str | None:
    """Hash of an operation; None where there is none of that number."""
    if number == 0:
        return NO_HASH
    row = connection.execute("SELECT hash FROM operations WHERE number = ?", (number,)).fetchone()
    return None if row is None else str(row[0])


def last_writer(connection: sqlite3.Connection, keys: Iterable[Key]) -> Writer | None:
    """The newest operation that wrote one of some rows."""
    numbers = [
        number
        for key in keys
        for (number,) in connection.execute(
            "SELECT number FROM writers WHERE row_tag = ? AND row_id = ?", _writer_key(key)
        )
    ]
    if not numbers:
        return None
    row = connection.execute(
        f"SELECT {_WRITER} FROM operations WHERE number = ?", (max(numbers),)
    ).fetchone()
    return Writer(*row)


def read_writers(connection: sqlite3.Connection) -> set[tuple[Key, int, bool]]:
    """Of every row that ever was: the operation that wrote it last, and whether a human did."""
    kinds = {tag: kind for kind, tag in TAGS.items()}
    return {
        ((kinds[tag], int(name) if tag == TAGS[Review] else name), number, bool(by_human))
        for tag, name, number, by_human in connection.execute("SELECT * FROM writers")
    }


def first_of_human(connection: sqlite3.Connection, keys: Iterable[Key]) -> Key | None:
    """The first of some rows that a human has ever written."""
    for key in keys:
        if connection.execute(
            "SELECT 1 FROM writers WHERE row_tag = ? AND row_id = ? AND by_human", _writer_key(key)
        ).fetchone():
            return key
    return None
