"""Copies of a label file, out and in, while others use it; nothing is ever destroyed."""

import fcntl
import os
import shutil
import sqlite3
from itertools import count
from pathlib import Path

from semviz_annotation.storing.connection import WAIT_S, in_words
from semviz_annotation.storing.integrity import Integrity, check_snapshot, open_read_only, snapshot
from semviz_annotation.storing.operations import NO_HASH
from semviz_annotation.storing.schema import make
from semviz_annotation.storing.tables import hash_of
from semviz_core.errors import SemvizError
from semviz_core.files import replacing

_LOCKED_START, _LOCKED_BYTES = 0x4000_0002, 510
"""Where SQLite's readers lock a file (https://www.sqlite.org/src/doc/trunk/src/os_unix.c)."""


def backup_labels(path: Path, target: Path) -> Integrity:
    """Copy the labels of ``path``, checked, to ``target``, whole or not at all.

    An earlier backup of the same labels is replaced. Raises SemvizError where the labels are
    damaged, or ``target`` is anything else.
    """
    copy = snapshot(path)
    try:
        found = check_snapshot(copy, path)
        _check_replaceable(target, copy)
        _write(copy, target)
    except sqlite3.Error as error:
        raise in_words(error, target, "Not backed up") from None
    finally:
        copy.close()
    return found


def restore_labels(path: Path, backup: Path) -> tuple[Integrity, Path | None]:
    """Bring back the labels of ``backup``, also while others use ``path``, who go on from there.

    What was in ``path`` is kept beside it first, in the file that is returned; None where there was
    nothing. Raises SemvizError where the backup is broken or no label file, or ``path`` is broken
    and in use; nothing is changed then.
    """
    copy = snapshot(backup)
    try:
        found = check_snapshot(copy, backup)
        if not path.exists():
            _write(copy, path)
            return found, None
        if path.samefile(backup):
            raise SemvizError(f"{backup}: these are the labels themselves, not a backup")
        try:
            return found, _restore_into(path, copy)
        except sqlite3.DatabaseError as error:
            broken = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
            if getattr(error, "sqlite_errorcode", 0) & 0xFF not in broken:
                raise
            return found, _take_the_place_of(path, copy)
    except sqlite3.Error as error:
        raise in_words(error, path, "Not restored") from None
    finally:
        copy.close()


def _check_replaceable(target: Path, labels: sqlite3.Connection) -> None:
    """SemvizError unless ``target`` is free, or a backup of an earlier state of ``labels``."""
    if not target.exists():
        return
    refusal = SemvizError(
        f"{target}: exists and is no earlier backup of these labels; choose another name"
    )
    try:
        theirs = snapshot(target)
    except SemvizError:
        raise refusal from None
    reader = open_read_only(target)
    try:
        in_use = reader.execute("PRAGMA journal_mode").fetchone()[0] == "wal"  # backups are not
        last, hash_ = _last(theirs)
        if in_use or hash_of(labels, last) != hash_:
            raise refusal
    finally:
        reader.close()
        theirs.close()


def _last(connection: sqlite3.Connection) -> tuple[int, str]:
    """Number and hash of the last operation."""
    row = connection.execute(
        "SELECT number, hash FROM operations ORDER BY number DESC LIMIT 1"
    ).fetchone()
    return (0, NO_HASH) if row is None else row


def _write(labels: sqlite3.Connection, path: Path) -> None:
    """One file without companions, readable also where nothing can be written."""
    with replacing(path) as temporary:
        file = sqlite3.connect(temporary, isolation_level=None)
        try:
            labels.backup(file)
            file.execute("PRAGMA journal_mode = DELETE")
        finally:
            file.close()


def _restore_into(path: Path, copy: sqlite3.Connection) -> Path:
    """Replace the content in one transaction: who has the file open sees it, and goes on."""
    live = sqlite3.connect(path, isolation_level=None, timeout=WAIT_S)
    try:
        live.execute("PRAGMA synchronous = FULL")
        live.execute("BEGIN IMMEDIATE")
        aside = _aside(path, _last_number(live))
        reader = open_read_only(path)
        try:
            _write(reader, aside)
        finally:
            reader.close()
        _replace_content(live, copy)
        live.execute("COMMIT")
    finally:
        live.close()
    return aside


def _last_number(live: sqlite3.Connection) -> str:
    """Of any version's log; the file may be anything."""
    if "operations" not in _tables(live):
        return "unknown"
    return str(live.execute("SELECT coalesce(max(number), 0) FROM operations").fetchone()[0])


def _replace_content(live: sqlite3.Connection, copy: sqlite3.Connection) -> None:
    for name in _tables(live):
        live.execute(f'DROP TABLE "{name}"')
    make(live)
    live.execute("DELETE FROM counters")
    for name in _tables(copy):
        rows = copy.execute(f"SELECT * FROM {name}")
        marks = ", ".join("?" * len(rows.description))
        live.executemany(f"INSERT INTO {name} VALUES ({marks})", rows)


def _tables(connection: sqlite3.Connection) -> list[str]:
    return [
        name
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    ]


def _take_the_place_of(path: Path, copy: sqlite3.Connection) -> Path:
    """Replace a file that SQLite cannot read, with its companions."""
    _check_unused(path)
    aside = _aside(path, "damaged")
    companions = [path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal")]
    for one in (path, *companions):
        if one.exists():
            with replacing(aside.with_name(aside.name + one.name.removeprefix(path.name))) as kept:
                shutil.copyfile(one, kept)
    for one in companions:  # they would be taken for those of the new file
        one.unlink(missing_ok=True)
    _write(copy, path)
    return aside


def _aside(path: Path, what: str) -> Path:
    """A name beside ``path`` that is free."""
    stem = f"{path.stem}-before-restore-{what}"
    names = (f"{stem}{'' if again == 1 else f'-{again}'}{path.suffix}" for again in count(1))
    return next(one for one in map(path.with_name, names) if not one.exists())


def _check_unused(path: Path) -> None:
    """SemvizError where a program has the file open in SQLite."""
    with path.open("rb+") as file:
        try:
            fcntl.lockf(
                file, fcntl.LOCK_EX | fcntl.LOCK_NB, _LOCKED_BYTES, _LOCKED_START, os.SEEK_SET
            )
        except OSError:
            raise SemvizError(
                f"Not restored: {path} is damaged and another program has it open; close it "
                "(semviz annotate?), try again."
            ) from None
