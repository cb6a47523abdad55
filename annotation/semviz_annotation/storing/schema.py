"""The tables of a label file, and older files brought up to them."""

import sqlite3
from collections.abc import Iterator

from semviz_annotation.storing.operations import NO_HASH, sealed
from semviz_annotation.storing.tables import operation_of_row, write_operation

APPLICATION_ID = 0x53564C42
"""Marks a SQLite file as ours ("SVLB")."""
VERSION = 3

_STATE = """
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
"""
_SINCE_2 = """
CREATE TABLE operations (
    number INTEGER PRIMARY KEY,
    request_id TEXT NOT NULL UNIQUE,
    author TEXT NOT NULL,
    origin TEXT NOT NULL CHECK (origin IN ('human', 'machine')),
    time TEXT NOT NULL,
    kind TEXT NOT NULL,
    undoes INTEGER REFERENCES operations,
    redoes INTEGER REFERENCES operations,
    text TEXT NOT NULL,
    hash TEXT NOT NULL,
    changes TEXT NOT NULL
);
CREATE INDEX named ON operations (number) WHERE kind = 'name';
CREATE TRIGGER operations_stay BEFORE UPDATE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TRIGGER operations_last BEFORE DELETE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TABLE writers (
    row_tag TEXT NOT NULL,
    row_id TEXT NOT NULL,
    number INTEGER NOT NULL REFERENCES operations,
    by_human INTEGER NOT NULL,
    PRIMARY KEY (row_tag, row_id)
) WITHOUT ROWID;
CREATE TABLE dismissals (
    id TEXT PRIMARY KEY,
    frame_index INTEGER NOT NULL,
    side TEXT NOT NULL CHECK (side IN ('left', 'right')),
    why TEXT NOT NULL CHECK (why IN ('rejected', 'occluded', 'absent')),
    element_id TEXT REFERENCES elements DEFERRABLE INITIALLY DEFERRED
);
CREATE INDEX dismissals_of_element ON dismissals (element_id);
"""
_SINCE_3 = """
CREATE TABLE judgements (
    id TEXT PRIMARY KEY,
    verdict TEXT NOT NULL CHECK (verdict IN ('apart', 'keep', 'leave out')),
    element_id TEXT NOT NULL REFERENCES elements DEFERRABLE INITIALLY DEFERRED,
    other_id TEXT REFERENCES elements DEFERRABLE INITIALLY DEFERRED
);
CREATE INDEX judgements_of_element ON judgements (element_id);
CREATE INDEX judgements_of_other ON judgements (other_id);
"""


def make(connection: sqlite3.Connection) -> None:
    """Make the tables in an empty file, in the transaction that is open."""
    _run(connection, _STATE + _SINCE_2 + _SINCE_3)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {VERSION}")


def upgrade(connection: sqlite3.Connection, version: int) -> None:
    """Bring a file of an older ``version`` to this one, in the transaction that is open.

    Raises pydantic's ValidationError where an operation cannot be read.
    """
    if version < 2:
        _seal_operations(connection)
    _run(connection, _SINCE_3)
    connection.execute(f"PRAGMA user_version = {VERSION}")


def _seal_operations(connection: sqlite3.Connection) -> None:
    """From version 1: operations get their hashes and the writers of rows are noted."""
    _run(connection, "DROP TRIGGER operations_stay;\nDROP TRIGGER operations_last;\n")
    connection.execute("ALTER TABLE operations RENAME TO operations_1")
    _run(connection, _SINCE_2)
    hash_before = NO_HASH
    for row in connection.execute(
        "SELECT number, request_id, author, origin, time, kind, changes, undoes, redoes "
        "FROM operations_1 ORDER BY number"
    ):
        one = sealed(operation_of_row((*row, "", NO_HASH)), hash_before)
        hash_before = one.hash
        write_operation(connection, one)
    connection.execute("DROP TABLE operations_1")


def _run(connection: sqlite3.Connection, script: str) -> None:
    """One by one: ``executescript`` would commit the transaction it runs in."""
    for statement in _statements(script):
        connection.execute(statement)


def _statements(script: str) -> Iterator[str]:
    pending = ""
    for line in script.splitlines(keepends=True):
        pending += line
        if sqlite3.complete_statement(pending):
            yield pending
            pending = ""
