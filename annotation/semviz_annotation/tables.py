"""The tables of a label file, and rows in and out of them. SQL lives here only."""

import sqlite3
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from semviz_annotation.labels import Change, LabelElement, Labels, Observation, Review, Row
from semviz_core.errors import SemvizError

APPLICATION_ID = 0x53564C42
"""Marks a SQLite file as ours ("SVLB")."""
VERSION = 1
WAIT_S = 10.0
"""How long to wait for another program that is writing."""

_SCHEMA = f"""
CREATE TABLE operations (
    number INTEGER PRIMARY KEY,
    request_id TEXT NOT NULL UNIQUE,
    author TEXT NOT NULL,
    origin TEXT NOT NULL CHECK (origin IN ('human', 'machine')),
    time TEXT NOT NULL,
    kind TEXT NOT NULL,
    changes TEXT NOT NULL,
    undoes INTEGER REFERENCES operations,
    redoes INTEGER REFERENCES operations
);
CREATE TRIGGER operations_stay BEFORE UPDATE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TRIGGER operations_last BEFORE DELETE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TABLE elements (
    id TEXT PRIMARY KEY,
    number INTEGER NOT NULL UNIQUE,
    class_id INTEGER NOT NULL
);
CREATE TABLE observations (
    id TEXT PRIMARY KEY,
    element_id TEXT NOT NULL REFERENCES elements DEFERRABLE INITIALLY DEFERRED,
    frame_index INTEGER NOT NULL,
    side TEXT NOT NULL CHECK (side IN ('left', 'right')),
    anchor_u REAL NOT NULL,
    anchor_v REAL NOT NULL,
    end_u REAL,
    end_v REAL,
    anchor_known INTEGER NOT NULL,
    end_known INTEGER NOT NULL,
    UNIQUE (element_id, frame_index, side)
);
CREATE TABLE reviews (frame_index INTEGER PRIMARY KEY, state TEXT NOT NULL);
CREATE TABLE counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
INSERT INTO counters VALUES ('next element number', 1);
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {VERSION};
"""


def connect(path: Path) -> sqlite3.Connection:
    """Open or make a label file; SemvizError where ``path`` is another file or a newer version."""
    connection = sqlite3.connect(
        path, isolation_level=None, check_same_thread=False, timeout=WAIT_S
    )
    try:
        connection.execute("BEGIN IMMEDIATE")  # looking and making are one: others may come too
        try:
            _make_or_check(connection, path)
            connection.execute("COMMIT")
        except BaseException:
            connection.execute("ROLLBACK")
            raise
        _use_wal(connection)
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
    except BaseException:
        connection.close()
        raise
    return connection


def _make_or_check(connection: sqlite3.Connection, path: Path) -> None:
    if connection.execute("PRAGMA application_id").fetchone()[0] == APPLICATION_ID:
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version > VERSION:
            raise SemvizError(
                f"{path}: labels of version {version}, this semviz reads up to {VERSION}; update"
            )
    elif connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        raise SemvizError(f"{path}: a SQLite file, but not labels of semviz")
    else:
        for statement in _statements(_SCHEMA):
            connection.execute(statement)


def _use_wal(connection: sqlite3.Connection) -> None:
    """SQLite does not wait for others when it changes the mode, so this does."""
    deadline = time.monotonic() + WAIT_S
    while connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _statements(script: str) -> Iterator[str]:
    """One by one: ``executescript`` would commit the transaction it runs in."""
    pending = ""
    for line in script.splitlines(keepends=True):
        pending += line
        if sqlite3.complete_statement(pending):
            yield pending
            pending = ""


def read_labels(connection: sqlite3.Connection) -> Labels:
    """The current state."""
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
    if isinstance(row, LabelElement):
        connection.execute("DELETE FROM elements WHERE id = ?", (row.id,))
    elif isinstance(row, Observation):
        connection.execute("DELETE FROM observations WHERE id = ?", (row.id,))
    else:
        connection.execute("DELETE FROM reviews WHERE frame_index = ?", (row.frame_index,))


def _insert(connection: sqlite3.Connection, row: Row) -> None:
    if isinstance(row, LabelElement):
        connection.execute(
            "INSERT INTO elements VALUES (?, ?, ?)", (row.id, row.number, row.class_id)
        )
    elif isinstance(row, Observation):
        connection.execute(
            "INSERT INTO observations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                row.id,
                row.element_id,
                row.frame_index,
                row.side,
                *row.anchor_px,
                *(row.end_px or (None, None)),
                row.anchor_known,
                row.end_known,
            ),
        )
    else:
        connection.execute("INSERT INTO reviews VALUES (?, ?)", (row.frame_index, row.state))
