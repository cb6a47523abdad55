"""Reading and writing of the rows, operations and undo history of a label file.

Former states are computed from the log: forwards from its start, or backwards from the present
state.
"""

import json
import sqlite3
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import TypeAdapter

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import (
    TAGS,
    Attribute,
    AttributeType,
    ClassDeclaration,
    Dismissal,
    ImportedOutline,
    Key,
    LabelElement,
    Note,
    Observation,
    Pixel,
    Review,
    ReviewDecision,
    Row,
    RowChange,
    row_key,
)
from semviz_annotation.storage.declarations import read_declarations
from semviz_annotation.storage.operations import CHANGES, NO_HASH, Operation, Writer
from semviz_core.base.classes import OLDER_CENTER, TriangleCenter
from semviz_core.common.errors import SemvizError

STATEMENTS = frozenset({"name", "invite", "revoke", "assign", "label twice", "label once"})
"""Kinds of operations that are no edits: they change no row, and are not undone."""


class UndoHistory:
    """Numbers of each author's done and undone edits; latest last.

    Authors undo only their own edits. A new edit clears the author's undone edits.
    """

    def __init__(self) -> None:
        self._done: dict[str, dict[int, None]] = {}
        self._undone: dict[str, dict[int, None]] = {}

    def add(self, operation: Operation) -> None:
        """Raise SemvizError if ``operation`` undoes an edit that is not done, or the reverse."""
        self.add_numbers(
            operation.number, operation.author, operation.kind, operation.undoes, operation.redoes
        )

    def add_numbers(
        self, number: int, author: str, kind: str, undoes: int | None, redoes: int | None
    ) -> None:
        """Add an operation by its columns, without its changes; see ``add``."""
        done = self._done.setdefault(author, {})
        undone = self._undone.setdefault(author, {})
        if undoes is not None:
            _move(undoes, done, undone)
        elif redoes is not None:
            _move(redoes, undone, done)
        elif kind not in STATEMENTS:
            done[number] = None
            undone.clear()

    def done(self, author: str) -> Iterator[int]:
        """Iterate over the author's edits that are not undone, latest first."""
        return reversed(self._done.get(author, {}))

    def undone(self, author: str) -> Iterator[int]:
        """Iterate over the author's edits that can be redone, last undone first."""
        return reversed(self._undone.get(author, {}))

    def stands(self, author: str, number: int) -> bool:
        return number in self._done.get(author, {})


def _move(number: int, source: dict[int, None], target: dict[int, None]) -> None:
    if number not in source:
        raise SemvizError(f"operation {number} is not an edit of this author to undo or redo")
    del source[number]
    target[number] = None


def replayed(operations: Iterable[Operation], labels: Labels) -> Labels:
    """Return the state after ``operations``, the first of the log that led to ``labels``."""
    rows: dict[Key, Row | None] = {}
    for change in _changes(operations):
        rows[change.key] = change.after
    return labels.with_rows(row for row in rows.values() if row is not None)


def rewound(labels: Labels, operations: Iterable[Operation]) -> Labels:
    """Return the state before ``operations`` (oldest first), which led to ``labels``."""
    rows: dict[Key, Row | None] = {}
    for change in _changes(operations):
        rows.setdefault(change.key, change.before)
    return labels.changed(
        RowChange(now, then) for key, then in rows.items() if (now := labels.row(key)) != then
    )


def difference(before: Labels, after: Labels) -> Iterator[RowChange]:
    """Return the changes from one state to another."""
    for row in before.rows():
        then = after.row(row_key(row))
        if then != row:
            yield RowChange(row, then)
    for row in after.rows():
        if before.row(row_key(row)) is None:
            yield RowChange(None, row)


def _changes(operations: Iterable[Operation]) -> Iterator[RowChange]:
    return (change for operation in operations for change in operation.changes)


_OPERATION = "number, request_id, author, origin, time, kind, changes, undoes, redoes, text, hash"
_WRITER = "number, author, origin, time, kind"


def read_labels(connection: sqlite3.Connection) -> Labels:
    """Return the present state. Raise SemvizError if its rows are inconsistent."""
    _check_types(connection)
    next_number = connection.execute(
        "SELECT coalesce(max(value), 1) FROM counters WHERE name = 'next element number'"
    ).fetchone()[0]
    last = connection.execute("SELECT coalesce(max(number), 0) FROM operations").fetchone()[0]
    return Labels.from_rows(_rows(connection), next_number, last, read_triangle_center(connection))


VERSION, OLDER_VERSION = 8, 7
"""Versions of files whose triangular signs are labelled at their centroid, and of others."""
CENTROID_VERSIONS = frozenset({4, 6, VERSION})
"""The same of all times; 5 and 6 had no classes of their own, versions before these no notes."""
_CENTROID = "triangle centroid"
"""Name of the counter that is 1 if triangular signs are labelled at their centroid."""


def read_triangle_center(connection: sqlite3.Connection) -> TriangleCenter:
    """Return what the labels of triangular signs mark; older files do not say it.

    Raise SemvizError if the version of the file says otherwise.
    """
    row = connection.execute("SELECT value FROM counters WHERE name = ?", (_CENTROID,)).fetchone()
    is_centroid = row is not None and bool(row[0])
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if is_centroid != (version == VERSION):
        raise SemvizError("what its labels of triangular signs mark contradicts its version")
    return "centroid" if is_centroid else OLDER_CENTER


def write_triangle_center(connection: sqlite3.Connection, center: TriangleCenter) -> None:
    """Store what the labels of triangular signs mark."""
    connection.execute("DELETE FROM counters WHERE name = ?", (_CENTROID,))
    if center != OLDER_CENTER:
        connection.execute("INSERT INTO counters VALUES (?, 1)", (_CENTROID,))


_TYPES = {
    "elements": "tii",
    "observations": "ttitrrRRii",
    "reviews": "it",
    "dismissals": "tittT",
    "judgements": "tttT",
    "notes": "ttIittt",
    "declarations": "ittttttt",
    "attribute_types": "ttt",
    "attributes": "tttt",
    "outlines": "tttt",
    "counters": "ti",
}
"""The type of each column, by the letters of ``_TYPE_NAMES``."""
_TYPE_NAMES = {
    "t": "'text'",
    "T": "'text', 'null'",
    "i": "'integer'",
    "I": "'integer', 'null'",
    "r": "'real'",
    "R": "'real', 'null'",
}


def _check_types(connection: sqlite3.Connection) -> None:
    """Raise SemvizError if a column has a value of another type, as in a damaged file."""
    for table, types in _TYPES.items():
        columns = connection.execute(f"PRAGMA table_info({table})").fetchall()
        if len(columns) != len(types):
            raise SemvizError(f"the columns of the table of {table} were altered")
        wrong = " OR ".join(
            f"typeof({name}) NOT IN ({_TYPE_NAMES[type_]})"
            for (_, name, *_), type_ in zip(columns, types, strict=True)
        )
        if connection.execute(f"SELECT 1 FROM {table} WHERE {wrong} LIMIT 1").fetchone():
            raise SemvizError(f"a value in the table of {table} has another type")


_CHOICES: TypeAdapter[tuple[str, ...]] = TypeAdapter(tuple[str, ...])
_POINTS: TypeAdapter[tuple[Pixel, ...]] = TypeAdapter(tuple[Pixel, ...])


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
        yield ReviewDecision(*row)
    for id_, element, frame, unsure, *written in connection.execute(
        "SELECT id, element_id, frame_index, unsure, text, author, time FROM notes"
    ):
        yield Note(id_, element, frame, bool(unsure), *written)
    yield from read_declarations(connection)
    for name, type_, choices in connection.execute("SELECT * FROM attribute_types"):
        yield AttributeType(name, type_, _CHOICES.validate_json(choices))
    for row in connection.execute("SELECT * FROM attributes"):
        yield Attribute(*row)
    for id_, observation, form, points in connection.execute("SELECT * FROM outlines"):
        yield ImportedOutline(id_, observation, form, _POINTS.validate_json(points))


def write_changes(
    connection: sqlite3.Connection, changes: Iterable[RowChange], next_number: int
) -> None:
    """Bring the tables to the state after ``changes`` (at most one a row)."""
    changes = tuple(changes)
    for change in changes:  # delete first: an element has one observation per image at any time
        if change.before is not None:
            _delete(connection, change.before)
    for change in changes:
        if change.after is not None:
            _insert(connection, change.after)
    connection.execute(
        "UPDATE counters SET value = ? WHERE name = 'next element number'", (next_number,)
    )


def _delete(connection: sqlite3.Connection, row: Row) -> None:
    kind, name = row_key(row)
    column = {Review: "frame_index", AttributeType: "name"}.get(kind, "id")
    connection.execute(f"DELETE FROM {TAGS[kind]}s WHERE {column} = ?", (name,))


def _insert(connection: sqlite3.Connection, row: Row) -> None:
    values = row_values(row)
    marks = ", ".join("?" * len(values))
    connection.execute(f"INSERT INTO {TAGS[type(row)]}s VALUES ({marks})", values)


def row_values(row: Row) -> tuple[object, ...]:
    """Return a row as the values of its table's columns: as they are read back, so that whole
    numbers of a caller's pixels become floats."""
    match row:
        case LabelElement():
            return row.id, row.number, row.class_id
        case Observation():
            end_px = (None, None) if row.end_px is None else map(float, row.end_px)
            known = (row.anchor_known, row.end_known)
            place = (row.id, row.element_id, row.frame_index, row.side)
            return *place, *map(float, row.anchor_px), *end_px, *known
        case Review():
            return row.frame_index, row.state
        case Dismissal():
            return row.id, row.frame_index, row.side, row.why, row.element_id
        case ReviewDecision():
            return row.id, row.verdict, row.element_id, row.other_id
        case Note():
            about = (row.id, row.element_id, row.frame_index, row.unsure)
            return *about, row.text, row.author, row.time
        case ClassDeclaration():
            shown = (row.letter, row.shape, row.color, row.color_light, row.key)
            return row.id, row.name, row.kind, *shown
        case AttributeType():
            return row.name, row.type, json.dumps(row.choices)
        case Attribute():
            return row.id, row.element_id, row.name, row.value
        case ImportedOutline():
            points_px = [tuple(map(float, point)) for point in row.points_px]
            return row.id, row.observation_id, row.form, json.dumps(points_px)


def write_operation(connection: sqlite3.Connection, operation: Operation) -> None:
    """Append an operation to the log, and record it as the last writer of its rows."""
    connection.execute(
        f"INSERT INTO operations ({_OPERATION}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            operation.number,
            operation.request_id,
            operation.author,
            operation.origin,
            operation.time,
            operation.kind,
            CHANGES.dump_json(operation.changes).decode(),
            operation.undoes,
            operation.redoes,
            operation.text,
            operation.hash,
        ),
    )
    by_human = operation.origin == "human"
    connection.executemany(
        "INSERT INTO writers VALUES (?, ?, ?, ?) ON CONFLICT DO UPDATE "
        "SET number = excluded.number, by_human = max(by_human, excluded.by_human)",
        [(*writer_key(change.key), operation.number, by_human) for change in operation.changes],
    )


def writer_key(key: Key) -> tuple[str, str]:
    """Return a row's key as the table of writers stores it."""
    return TAGS[key[0]], str(key[1])


def read_operations(
    connection: sqlite3.Connection,
    after: int = 0,
    limit: int | None = None,
    before: int | None = None,
) -> Iterator[Operation]:
    """Return the operations between two numbers, ascending; see ``LabelStore.operations``.

    Raise pydantic's ValidationError if an operation cannot be read.
    """
    end, order = (2**53, "ASC") if before is None else (before, "DESC")
    rows = connection.execute(
        f"SELECT {_OPERATION} FROM operations WHERE number > ? AND number < ? "
        f"ORDER BY number {order} LIMIT ?",
        (after, end, -1 if limit is None else limit),
    )
    return map(operation_of_row, rows if before is None else reversed(rows.fetchall()))


def operation_of_request(connection: sqlite3.Connection, request_id: str) -> Operation | None:
    """Return the operation of a request; None if there is none."""
    row = connection.execute(
        f"SELECT {_OPERATION} FROM operations WHERE request_id = ?", (request_id,)
    ).fetchone()
    return None if row is None else operation_of_row(row)


def named_operations(connection: sqlite3.Connection) -> Iterator[Operation]:
    """Return the operations that named a state, oldest first."""
    return map(
        operation_of_row,
        connection.execute(
            f"SELECT {_OPERATION} FROM operations WHERE kind = 'name' ORDER BY number"
        ),
    )


def operation_of_row(row: tuple[Any, ...]) -> Operation:
    """Return the operation in a log row. Raise pydantic's ValidationError if it is invalid."""
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


def read_history(connection: sqlite3.Connection) -> UndoHistory:
    """Return the undo history of all authors."""
    history = UndoHistory()
    for row in connection.execute(
        "SELECT number, author, kind, undoes, redoes FROM operations ORDER BY number"
    ):
        history.add_numbers(*row)
    return history


def hash_of(connection: sqlite3.Connection, number: int) -> str | None:
    """Return the hash of an operation; None if there is no such number."""
    if number == 0:
        return NO_HASH
    row = connection.execute("SELECT hash FROM operations WHERE number = ?", (number,)).fetchone()
    return None if row is None else str(row[0])


def last_operation(connection: sqlite3.Connection) -> tuple[int, str]:
    """Return number and hash of the last operation."""
    row = connection.execute(
        "SELECT number, hash FROM operations ORDER BY number DESC LIMIT 1"
    ).fetchone()
    return (0, NO_HASH) if row is None else row


def last_writer(connection: sqlite3.Connection, keys: Iterable[Key]) -> Writer | None:
    """Return the newest operation that wrote one of the rows; None if there is none."""
    numbers = [
        number
        for key in keys
        for (number,) in connection.execute(
            "SELECT number FROM writers WHERE row_tag = ? AND row_id = ?", writer_key(key)
        )
    ]
    if not numbers:
        return None
    row = connection.execute(
        f"SELECT {_WRITER} FROM operations WHERE number = ?", (max(numbers),)
    ).fetchone()
    return Writer(*row)


def read_writers(connection: sqlite3.Connection) -> set[tuple[tuple[str, str], int, bool]]:
    """Return, for every row that ever existed, its last operation and whether a human wrote it.

    A row is given by its stored tag and id; see ``writer_key``.
    """
    return {
        ((tag, name), number, bool(by_human))
        for tag, name, number, by_human in connection.execute("SELECT * FROM writers")
    }


def first_written_by_human(connection: sqlite3.Connection, keys: Iterable[Key]) -> Key | None:
    """Return the first of the rows that a human has ever written; None if there is none."""
    for key in keys:
        if connection.execute(
            "SELECT 1 FROM writers WHERE row_tag = ? AND row_id = ? AND by_human", writer_key(key)
        ).fetchone():
            return key
    return None
