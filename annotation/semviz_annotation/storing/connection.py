"""A label file opened, made or brought up to date; what SQLite says about it, for people."""

import sqlite3
import time
from pathlib import Path

from pydantic import ValidationError

from semviz_annotation.edits import first_fault
from semviz_annotation.storing.schema import APPLICATION_ID, VERSION, make, upgrade
from semviz_core.errors import SemvizError

WAIT_S = 10.0
"""How long to wait for another program that is writing."""


def connect(path: Path) -> sqlite3.Connection:
    """Open or make a label file; one of an older version is upgraded, or left as it was.

    Raises SemvizError where ``path`` is another file, damaged, of a newer version, locked or not
    writable.
    """
    try:
        connection = sqlite3.connect(
            path, isolation_level=None, check_same_thread=False, timeout=WAIT_S
        )
        try:
            _prepare(connection, path)
        except BaseException:
            connection.close()
            raise
    except sqlite3.Error as error:
        raise in_words(error, path, "Not opened") from None
    return connection


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    connection.execute("BEGIN IMMEDIATE")  # looking and making are one: others may come too
    try:
        make_or_upgrade(connection, path)
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise
    _use_wal(connection)
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")


def make_or_upgrade(connection: sqlite3.Connection, path: Path) -> None:
    """Give the file its tables, in the transaction that is open; ``path`` is for messages."""
    if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        make(connection)
        return
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise SemvizError(f"{path}: a SQLite file, but not labels of semviz")
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > VERSION:
        raise SemvizError(
            f"{path}: labels of version {version}, this semviz reads up to {VERSION}; update"
        )
    if version < VERSION:
        try:
            upgrade(connection, version)
        except ValidationError as error:
            raise damaged(path, first_fault(error)) from None


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


def damaged(path: Path, why: str) -> SemvizError:
    """The error of a file that cannot be what it should be."""
    return SemvizError(f"{path}: the label file is damaged ({why}); restore a copy")


def in_words(error: sqlite3.Error, path: Path, what: str) -> SemvizError:
    """The line for people to read; ``what`` says what was not done."""
    match getattr(error, "sqlite_errorcode", 0) & 0xFF:
        case sqlite3.SQLITE_FULL:
            return SemvizError(f"{what}: disk full.")
        case sqlite3.SQLITE_BUSY | sqlite3.SQLITE_LOCKED:
            return SemvizError(f"{what}: another program keeps {path} locked; close it, try again.")
        case sqlite3.SQLITE_READONLY | sqlite3.SQLITE_CANTOPEN | sqlite3.SQLITE_PERM:
            return SemvizError(f"{what}: {path} or its folder cannot be written; make it writable.")
        case sqlite3.SQLITE_NOTADB:
            return SemvizError(f"{path}: not a label file")
        case sqlite3.SQLITE_CORRUPT:
            return damaged(path, str(error))
    return SemvizError(f"{what}: {path}: {error}")
