"""Backup, restore, export and import of a label file that may be in use.

Nothing is ever destroyed: a restore keeps the former labels in a second file. The log is exported
as JSON lines: a header, then one operation a line, oldest first.
"""

import fcntl
import json
import os
import shutil
import sqlite3
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.labels.edits import first_fault
from semviz_annotation.labels.rows import Observation
from semviz_annotation.storage import database, tables
from semviz_annotation.storage.integrity import (
    Integrity,
    check_labels,
    check_snapshot,
    open_read_only,
    snapshot,
)
from semviz_annotation.storage.label_file import LabelFileError
from semviz_annotation.storage.operations import NO_HASH, BrokenOperationError, Operation, sealed
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.classes import NEW_CENTER, OLDER_CENTER, TriangleCenter
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import read_limited

__all__ = [
    "Integrity",
    "backup_labels",
    "check_labels",
    "export_operations",
    "import_operations",
    "restore_labels",
    "tells_its_length",
]

_LOCKED_START, _LOCKED_BYTES = 0x4000_0002, 510
"""The bytes that SQLite locks for readers (https://www.sqlite.org/src/doc/trunk/src/os_unix.c)."""


def backup_labels(path: Path, target: Path) -> Integrity:
    """Check the labels of ``path`` and copy them to ``target``, completely or not at all.

    An earlier backup of the same labels is replaced. Raise SemvizError if the labels are damaged,
    or ``target`` exists and is anything else.
    """
    copy = snapshot(path)
    try:
        integrity = check_snapshot(copy, path)
        _check_replaceable(target, copy)
        _write(copy, target)
    except sqlite3.Error as error:
        raise database.database_error(error, target, "Not backed up") from None
    finally:
        copy.close()
    return integrity


def restore_labels(path: Path, backup: Path) -> tuple[Integrity, Path | None]:
    """Restore the labels of ``backup`` into ``path``, also while other processes use it.

    The former content of ``path`` is first copied to the returned file; None if there was none.
    Raise SemvizError if the backup is damaged or no label file, or ``path`` is damaged and in use.
    Nothing is changed then.
    """
    copy = snapshot(backup)
    try:
        integrity = check_snapshot(copy, backup)
        if not path.exists():
            _write(copy, path)
            return integrity, None
        if path.samefile(backup):
            raise SemvizError(f"{backup}: these are the labels themselves, not a backup")
        try:
            return integrity, _restore_into(path, copy)
        except sqlite3.DatabaseError as error:
            broken = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
            if getattr(error, "sqlite_errorcode", 0) & 0xFF not in broken:
                raise
            return integrity, _replace_damaged_file(path, copy)
    except sqlite3.Error as error:
        raise database.database_error(error, path, "Not restored") from None
    finally:
        copy.close()


def _check_replaceable(target: Path, labels: sqlite3.Connection) -> None:
    """Raise SemvizError if ``target`` is neither free nor an earlier backup of ``labels``."""
    if not target.exists():
        return
    refusal = SemvizError(
        f"{target}: exists and is no earlier backup of these labels; choose another name"
    )
    try:
        earlier = snapshot(target)
    except SemvizError:
        raise refusal from None
    reader = open_read_only(target)
    try:
        in_use = reader.execute("PRAGMA journal_mode").fetchone()[0] == "wal"  # backups are not
        last, hash_ = tables.last_operation(earlier)
        if in_use or tables.hash_of(labels, last) != hash_:
            raise refusal
    finally:
        reader.close()
        earlier.close()


def _write(labels: sqlite3.Connection, path: Path) -> None:
    """Write a single file without WAL companions, which also opens on read-only media."""
    with replacing(path) as temporary:
        file = sqlite3.connect(temporary, isolation_level=None)
        try:
            labels.backup(file)
            file.execute("PRAGMA journal_mode = DELETE")
        finally:
            file.close()


def _restore_into(path: Path, copy: sqlite3.Connection) -> Path:
    """Replace the content in one transaction, so that processes with the file open follow it."""
    live = sqlite3.connect(path, isolation_level=None, timeout=database.WAIT_S)
    try:
        live.execute("PRAGMA synchronous = FULL")
        live.execute("BEGIN IMMEDIATE")
        aside = _free_path(path, _last_number(live))
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
    """Return the last operation's number, for any version of the file; "unknown" without a log."""
    if "operations" not in _tables(live):
        return "unknown"
    return str(live.execute("SELECT coalesce(max(number), 0) FROM operations").fetchone()[0])


def _replace_content(live: sqlite3.Connection, copy: sqlite3.Connection) -> None:
    for name in _tables(live):
        live.execute(f'DROP TABLE "{name}"')
    database.make(live, tables.read_triangle_center(copy))
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


def _replace_damaged_file(path: Path, copy: sqlite3.Connection) -> Path:
    """Replace a file that SQLite cannot read, and its companions."""
    _check_unused(path)
    aside = _free_path(path, "damaged")
    companions = [path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal")]
    for companion in (path, *companions):
        if companion.exists():
            with replacing(
                aside.with_name(aside.name + companion.name.removeprefix(path.name))
            ) as kept:
                shutil.copyfile(companion, kept)
    for companion in companions:  # SQLite would apply them to the new file
        companion.unlink(missing_ok=True)
    _write(copy, path)
    return aside


def _free_path(path: Path, what: str) -> Path:
    """Return a free path next to ``path``."""
    stem = f"{path.stem}-before-restore-{what}"
    names = (f"{stem}{'' if again == 1 else f'-{again}'}{path.suffix}" for again in count(1))
    return next(candidate for candidate in map(path.with_name, names) if not candidate.exists())


def _check_unused(path: Path) -> None:
    """Raise SemvizError if another program has the file open in SQLite."""
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


FORMAT = "semviz-operations"
MOST_LOG_BYTES = 2**30
"""An operation has about 500 bytes.

Logs have the versions of files. Version 1 had neither hashes nor texts, version 2 no review
decisions, versions up to 4 no notes, versions up to 6 no classes of their own.

Later logs also tell their number of operations and the hash of the last one.
"""
_OPERATION = TypeAdapter(Operation)


def export_operations(store: LabelStore, path: Path) -> None:
    """Write the log of ``store`` to ``path``, completely or not at all."""
    operations, center = store.operations(), store.labels.triangle_center
    header = {
        "format": FORMAT,
        "version": tables.OLDER_VERSION if center == OLDER_CENTER else tables.VERSION,
        "triangle_center": center,
        "operations": len(operations),
        "hash": operations[-1].hash if operations else NO_HASH,
    }
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(header) + "\n")
        for operation in operations:
            file.write(_OPERATION.dump_json(operation).decode() + "\n")


def import_operations(path: Path, store: LabelStore, frames: Collection[int] | None = None) -> int:
    """Append the operations of ``path`` that ``store`` lacks; return their count.

    The store's log must be the beginning of the file's log, as in a new store. Raise SemvizError,
    naming the line, if it is not, or a line is invalid or missing, or labels are in others than
    ``frames``. Nothing is imported then.
    """
    imported, center = _read(path)
    if frames is not None:
        _check_frames(path, imported, frames)
    present = store.operations()
    for number, operation in enumerate(present, 1):
        if number > len(imported) or imported[number - 1] != operation:
            raise SemvizError(
                f"{path}, line {number + 1}: not operation {number} of {store.path}, which has "
                "labels of its own; import into a new workspace"
            )
    newer = imported[len(present) :]
    try:
        if newer:
            store.extend(newer, center)
    except BrokenOperationError as error:
        raise SemvizError(f"{path}, line {error.number + 1}: {error}; nothing imported") from None
    except LabelFileError:
        raise
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}; nothing imported") from None
    return len(newer)


def _check_frames(path: Path, operations: list[Operation], frames: Collection[int]) -> None:
    labelled: dict[str, int] = {}
    for change in (change for operation in operations for change in operation.changes):
        if isinstance(change.before, Observation):
            labelled.pop(change.before.id, None)
        if isinstance(change.after, Observation):
            labelled[change.after.id] = change.after.frame_index
    others = sorted(set(labelled.values()) - set(frames))
    if others:
        raise SemvizError(
            f"{path}: labels of another sequence: {len(others)} of its labelled frames are not in "
            f"this one, the first is {others[0]}; nothing imported"
        )


def tells_its_length(path: Path) -> bool:
    """Whether a log would be refused if lines at its end were missing; older ones are not.

    Raise SemvizError if it cannot be read.
    """
    return _read_header(path, next(_lines(path), b"")).operations is not None


def _lines(path: Path) -> Iterator[bytes]:
    return iter(BytesIO(read_limited(path, MOST_LOG_BYTES)))


def _read(path: Path) -> tuple[list[Operation], TriangleCenter]:
    lines = _lines(path)
    header = _read_header(path, next(lines, b""))
    operations: list[Operation] = []
    for number, line in enumerate(lines, 1):
        try:
            operation = _OPERATION.validate_json(line)
            if operation.number != number:
                raise SemvizError(f"number {operation.number} where {number} follows")
        except (ValidationError, SemvizError) as error:
            raise SemvizError(
                f"{path}, line {number + 1}: {first_fault(error)}; nothing imported"
            ) from None
        if header.version == 1:
            operation = sealed(operation, operations[-1].hash if operations else NO_HASH)
        operations.append(operation)
    _check_complete(path, header, operations)
    return operations, header.center


def _check_complete(path: Path, header: "_Header", operations: list[Operation]) -> None:
    if header.operations is None:
        return
    if header.operations != len(operations):
        raise SemvizError(
            f"{path}: cut short: {len(operations)} of {header.operations} operations are there; "
            "nothing imported"
        )
    if header.hash != (operations[-1].hash if operations else NO_HASH):
        raise SemvizError(f"{path}: its last operation is not the one exported; nothing imported")


@dataclass(frozen=True)
class _Header:
    """The first line of a log."""

    format: Literal["semviz-operations"]
    version: Annotated[int, Field(ge=1, lt=2**31)]
    operations: Annotated[int, Field(ge=0, lt=2**53)] | None = None
    hash: str | None = None
    triangle_center: TriangleCenter | None = None

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(strict=True)

    @property
    def center(self) -> TriangleCenter:
        """What the labels of triangular signs mark, by the version."""
        return NEW_CENTER if self.version in tables.CENTROID_VERSIONS else OLDER_CENTER


_HEADER = TypeAdapter(_Header)


def _read_header(path: Path, line: bytes) -> _Header:
    try:
        header = _HEADER.validate_json(line)
    except ValidationError:
        raise SemvizError(f"{path}, line 1: not a log of label operations of semviz") from None
    if header.version > tables.VERSION:
        raise SemvizError(
            f"{path}: log version {header.version}, this semviz reads up to {tables.VERSION}; "
            "update"
        )
    if header.triangle_center not in (None, header.center):
        raise SemvizError(
            f"{path}, line 1: a log of version {header.version} has triangle_center "
            f"'{header.center}', not '{header.triangle_center}'; export it again"
        )
    return header
