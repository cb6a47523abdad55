"""Create, open and upgrade the SQLite database of a label file, and word its errors.

An upgrade is one transaction: it happens completely or not at all.
"""

import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from semviz_annotation.labels.edits import first_fault
from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import NO_HASH, sealed
from semviz_core.base.classes import NEW_CENTER, OLDER_CENTER, TriangleCenter
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import new_file

APPLICATION_ID = 0x53564C42
"""Identifies a SQLite file as a label file ("SVLB")."""

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
_SINCE_5 = """
CREATE TABLE notes (
    id TEXT PRIMARY KEY,
    element_id TEXT NOT NULL REFERENCES elements DEFERRABLE INITIALLY DEFERRED,
    frame_index INTEGER,
    unsure INTEGER NOT NULL,
    text TEXT NOT NULL,
    author TEXT NOT NULL,
    time TEXT NOT NULL
);
CREATE INDEX notes_of_element ON notes (element_id);
"""
_SINCE_7 = """
CREATE TABLE declarations (
    id INTEGER PRIMARY KEY,
    name TEXT NOT NULL UNIQUE,
    kind TEXT NOT NULL CHECK (kind IN ('line', 'point')),
    letter TEXT NOT NULL UNIQUE,
    shape TEXT NOT NULL,
    color TEXT NOT NULL,
    color_light TEXT NOT NULL,
    key TEXT NOT NULL
);
CREATE TABLE attribute_types (name TEXT PRIMARY KEY, type TEXT NOT NULL, choices TEXT NOT NULL);
CREATE TABLE attributes (
    id TEXT PRIMARY KEY,
    element_id TEXT NOT NULL REFERENCES elements DEFERRABLE INITIALLY DEFERRED,
    name TEXT NOT NULL,
    value TEXT NOT NULL,
    UNIQUE (element_id, name)
);
CREATE TABLE outlines (
    id TEXT PRIMARY KEY,
    observation_id TEXT NOT NULL UNIQUE REFERENCES observations DEFERRABLE INITIALLY DEFERRED,
    form TEXT NOT NULL CHECK (form IN ('box', 'polygon')),
    points TEXT NOT NULL
);
"""


def make(connection: sqlite3.Connection, center: TriangleCenter = NEW_CENTER) -> None:
    """Create the tables in an empty file, within the open transaction."""
    _run(connection, _STATE + _SINCE_2 + _SINCE_3 + _SINCE_5 + _SINCE_7)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    define_triangles(connection, center)


def define_triangles(connection: sqlite3.Connection, center: TriangleCenter) -> None:
    """Store what the labels of triangular signs mark, within the open transaction."""
    tables.write_triangle_center(connection, center)
    version = tables.OLDER_VERSION if center == OLDER_CENTER else tables.VERSION
    connection.execute(f"PRAGMA user_version = {version}")


def upgrade(connection: sqlite3.Connection, version: int) -> None:
    """Upgrade a file of an older ``version``, within the open transaction.

    Raise pydantic's ValidationError if an operation cannot be read.
    """
    if version < 2:
        _seal_operations(connection)
    if version < 3:
        _run(connection, _SINCE_3)
    if version < 5:
        _run(connection, _SINCE_5)
    _run(connection, _SINCE_7)
    new = tables.VERSION if version in tables.CENTROID_VERSIONS else tables.OLDER_VERSION
    connection.execute(f"PRAGMA user_version = {new}")


def _seal_operations(connection: sqlite3.Connection) -> None:
    """Upgrade from version 1: add the hashes of operations and the writers of rows."""
    _run(connection, "DROP TRIGGER operations_stay;\nDROP TRIGGER operations_last;\n")
    connection.execute("ALTER TABLE operations RENAME TO operations_1")
    _run(connection, _SINCE_2)
    hash_before = NO_HASH
    for row in connection.execute(
        "SELECT number, request_id, author, origin, time, kind, changes, undoes, redoes "
        "FROM operations_1 ORDER BY number"
    ):
        operation = sealed(tables.operation_of_row((*row, "", NO_HASH)), hash_before)
        hash_before = operation.hash
        tables.write_operation(connection, operation)
    connection.execute("DROP TABLE operations_1")


def _run(connection: sqlite3.Connection, script: str) -> None:
    """Run statements one by one; ``executescript`` would commit the open transaction."""
    for statement in _statements(script):
        connection.execute(statement)


def _statements(script: str) -> Iterator[str]:
    pending = ""
    for line in script.splitlines(keepends=True):
        pending += line
        if sqlite3.complete_statement(pending):
            yield pending
            pending = ""


WAIT_S = 10.0
"""How long to wait while another program writes."""


def connect(path: Path, center: TriangleCenter = NEW_CENTER) -> sqlite3.Connection:
    """Open or create a label file; upgrade an older version. ``center`` is for a new file.

    Raise SemvizError if ``path`` is another file, empty, damaged, of a newer version, locked or not
    writable.
    """
    try:
        if not path.exists():
            _create(path, center)
        check_not_empty(path)
        connection = sqlite3.connect(
            path, isolation_level=None, check_same_thread=False, timeout=WAIT_S
        )
        try:
            _prepare(connection, path)
        except BaseException:
            connection.close()
            raise
    except UNREADABLE as error:
        raise database_error(error, path, "Not opened") from None
    return connection


def _create(path: Path, center: TriangleCenter) -> None:
    """Create a label file, complete or not at all; another process may do so at the same time.

    Raise SemvizError if there is a journal of a label file that was removed.
    """
    journal = path.with_name(f"{path.name}-wal")
    if journal.exists() and journal.stat().st_size:
        raise SemvizError(
            f"{path} is missing, but its journal {journal.name} is there: restore the file, or "
            "remove the journal to begin anew"
        )
    try:
        with new_file(path) as temporary:
            connection = sqlite3.connect(temporary, isolation_level=None)
            try:
                connection.execute("BEGIN")
                make(connection, center)
                connection.execute("COMMIT")
            finally:
                connection.close()
    except OSError:
        raise SemvizError(
            f"Not opened: {path} or its folder cannot be written; make it writable."
        ) from None


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    connection.execute("BEGIN IMMEDIATE")  # another process may upgrade the file at the same time
    try:
        check_and_upgrade(connection, path)
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise
    _use_wal(connection)
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")


def check_not_empty(path: Path) -> None:
    """Raise SemvizError if ``path`` has no content, which SQLite takes for a new database."""
    try:
        is_empty = path.is_file() and not path.stat().st_size
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    if is_empty:
        raise SemvizError(
            f"{path}: an empty file, not labels of semviz; restore a backup, or remove it to begin "
            "anew"
        )


def check_and_upgrade(connection: sqlite3.Connection, path: Path) -> None:
    """Upgrade older tables within the open transaction; ``path`` is for messages.

    Raise SemvizError if the file is no label file, or of a newer version.
    """
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise SemvizError(f"{path}: a SQLite file, but not labels of semviz")
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > tables.VERSION:
        raise SemvizError(
            f"{path}: labels of version {version}, this semviz reads up to {tables.VERSION}; update"
        )
    if version < tables.OLDER_VERSION:
        try:
            upgrade(connection, version)
        except ValidationError as error:
            raise damaged(path, first_fault(error)) from None


def _use_wal(connection: sqlite3.Connection) -> None:
    """Switch to WAL mode, waiting for other programs, as SQLite itself does not wait here."""
    deadline = time.monotonic() + WAIT_S
    while connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


class DamagedError(SemvizError):
    """The content of a label file is not what was written."""


UNREADABLE = (sqlite3.Error, ValidationError, UnicodeDecodeError)
"""What reading a damaged file raises; the sqlite3 module decodes SQLite's texts as UTF-8."""


def damaged(path: Path, why: str) -> DamagedError:
    """Return the error for a damaged label file."""
    return DamagedError(f"{path}: the label file is damaged ({why}); restore a copy")


def fault(error: Exception) -> str:
    """Return what an error of ``UNREADABLE`` says, on one line."""
    if isinstance(error, UnicodeDecodeError):
        return "a text is not UTF-8"
    return " ".join(first_fault(error).split())


def database_error(error: Exception, path: Path, what: str) -> SemvizError:
    """Return the message for an error of ``UNREADABLE``; ``what`` begins it: ``Not saved``."""
    if not isinstance(error, sqlite3.Error) or "Could not decode to UTF-8" in str(error):
        return damaged(path, fault(error))
    match getattr(error, "sqlite_errorcode", 0) & 0xFF:
        case sqlite3.SQLITE_FULL:
            return SemvizError(f"{what}: disk full.")
        case sqlite3.SQLITE_BUSY | sqlite3.SQLITE_LOCKED:
            return SemvizError(f"{what}: another program keeps {path} locked; close it, try again.")
        case sqlite3.SQLITE_READONLY | sqlite3.SQLITE_CANTOPEN | sqlite3.SQLITE_PERM:
            return SemvizError(f"{what}: {path} or its folder cannot be written; make it writable.")
        case sqlite3.SQLITE_IOERR:
            return SemvizError(f"{what}: {path}: {fault(error)}; is the disk full?")
        case sqlite3.SQLITE_NOTADB:
            return DamagedError(f"{path}: not a label file")
        case sqlite3.SQLITE_CORRUPT:
            return damaged(path, fault(error))
    return SemvizError(f"{what}: {path}: {fault(error)}")
