"""Whether a label file is what it was written to be: the log unbroken, the state what it says."""

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from semviz_annotation.edits import first_fault
from semviz_annotation.labels import Draft, Labels
from semviz_annotation.rows import Key, row_key
from semviz_annotation.storing.connection import damaged, in_words, make_or_upgrade
from semviz_annotation.storing.history import History
from semviz_annotation.storing.operations import NO_HASH, Operation, sealed
from semviz_annotation.storing.schema import make
from semviz_annotation.storing.tables import read_labels, read_operations, read_writers
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class Integrity:
    """What a sound label file holds."""

    operations: int
    hash: str
    """Of the last operation: two files with the same have the same log."""
    elements: int
    observations: int


def check_labels(path: Path) -> Integrity:
    """Check a label file, also while others write to it; the file is only read.

    Raises SemvizError, which names the operation where the log breaks: altered, missing, not
    following from those before it, or not leading to the rows that are in the tables.
    """
    connection = snapshot(path)
    try:
        return check_snapshot(connection, path)
    finally:
        connection.close()


def snapshot(path: Path) -> sqlite3.Connection:
    """A label file as of one moment, copied into memory and, if older, upgraded there.

    Raises SemvizError where ``path`` is missing, another file, of a newer version or unreadable.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: there is no such file")
    memory = sqlite3.connect(":memory:", isolation_level=None)
    try:
        source = open_read_only(path)
        try:
            source.backup(memory)
        finally:
            source.close()
        if not memory.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            raise SemvizError(f"{path}: an empty file, not labels of semviz")
        memory.execute("BEGIN")
        make_or_upgrade(memory, path)
        memory.execute("COMMIT")
    except sqlite3.Error as error:
        memory.close()
        raise in_words(error, path, "Not read") from None
    except BaseException:
        memory.close()
        raise
    return memory


def open_read_only(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, isolation_level=None)


def check_snapshot(connection: sqlite3.Connection, path: Path) -> Integrity:
    """As ``check_labels``, of a ``snapshot``; ``path`` is for messages."""
    walk = _Walk()
    try:
        _check_schema(connection)
        walk.follow(read_operations(connection))
        walk.compare(connection)
        _check_pages(connection)
    except (SemvizError, sqlite3.Error, ValidationError) as error:
        raise damaged(path, f"{walk.where}{first_fault(error)}") from None
    labels = walk.labels
    return Integrity(walk.number, walk.hash, len(labels.elements), len(labels.observations))


class _Walk:
    """The log, followed from the first operation."""

    def __init__(self) -> None:
        self.where = ""
        """Begins the message where something is wrong."""
        self.number = 0
        self.hash = NO_HASH
        self.labels = Labels()
        self._writers: dict[Key, tuple[int, bool]] = {}

    def follow(self, operations: Iterator[Operation]) -> None:
        draft, history = Draft(Labels(), dict), History()
        self.where = "operation 1: "
        for one in operations:
            if one.number != self.number + 1:
                raise SemvizError(f"missing; number {one.number} follows")
            if one != sealed(one, self.hash):
                raise SemvizError("its hash is wrong; it was altered after it was written")
            draft.apply(one.changes)
            history.add(one)
            for change in one.changes:
                _, by_human = self._writers.get(change.key, (0, False))
                self._writers[change.key] = (one.number, by_human or one.origin == "human")
            self.number, self.hash = one.number, one.hash
            self.where = f"operation {one.number + 1}: "
        self.labels = draft.labels()
        self.where = ""

    def compare(self, connection: sqlite3.Connection) -> None:
        """Raises SemvizError where the tables are not what the log leads to."""
        stored = read_labels(connection)
        for row in (*self.labels.rows(), *stored.rows()):
            key = row_key(row)
            if stored.row(key) != self.labels.row(key):
                number, _ = self._writers.get(key, (0, False))
                self.where = f"operation {number}: " if number else ""
                raise SemvizError(f"the tables hold another {type(row).__name__} than the log")
        if stored.next_number != self.labels.next_number:
            raise SemvizError("the next element's number is not what the log leads to")
        if read_writers(connection) != {
            (key, number, by_human) for key, (number, by_human) in self._writers.items()
        }:
            raise SemvizError("who wrote which rows is not what the log says")


def _check_schema(connection: sqlite3.Connection) -> None:
    fresh = sqlite3.connect(":memory:", isolation_level=None)
    make(fresh)
    missing = _things(fresh) ^ _things(connection)
    fresh.close()
    if missing:
        raise SemvizError(f"its tables were altered: {min(missing)[0]}")


def _things(connection: sqlite3.Connection) -> set[tuple[str, str]]:
    return set(connection.execute("SELECT name, coalesce(sql, '') FROM sqlite_master"))


def _check_pages(connection: sqlite3.Connection) -> None:
    (said,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if said != "ok":
        raise SemvizError(" ".join(said.split()))
    if connection.execute("PRAGMA foreign_key_check").fetchone() is not None:
        raise SemvizError("a row refers to one that is not there")
