"""Integrity check of a label file that may be in use.

A file is intact if its log is unbroken and its tables follow from the log.

A digest of all rows is stored with them, so that opening a file finds altered rows. It is the sum
of the hashes of all rows: an edit updates it without reading other rows. An earlier version of
semviz writes rows without it. The number of its operation shows that it is out of date.
"""

import hashlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from semviz_annotation.labels.labels import Draft, Labels
from semviz_annotation.labels.rows import Key, Row, RowChange, row_key
from semviz_annotation.storage import database, tables
from semviz_annotation.storage.operations import NO_HASH, Operation, sealed
from semviz_core.common.errors import SemvizError

_MODULUS = 2**62
"""SQLite's integers have 63 bits."""
_DIGEST, _NUMBER = "digest of all rows", "operation of the digest"

ALTERED = "its hash is wrong; it was altered after it was written"
Pace: TypeAlias = Callable[[], None]
"""Called often during a check: it may sleep to slow it down, or raise to end it."""
TAIL = 200
"""How many of the last operations are checked when a file is opened: 0.2 ms each."""


def digest_of(rows: Iterable[Row]) -> int:
    """Return the digest of ``rows``, in any order."""
    return sum(map(_row_digest, rows)) % _MODULUS


def digest_after(digest: int, changes: Iterable[RowChange]) -> int:
    """Return the digest after ``changes`` to the rows of ``digest``."""
    for change in changes:
        if change.before is not None:
            digest -= _row_digest(change.before)
        if change.after is not None:
            digest += _row_digest(change.after)
    return digest % _MODULUS


def _row_digest(row: Row) -> int:
    text = f"{type(row).__name__} {tables.row_values(row)!r}"
    return int.from_bytes(hashlib.blake2b(text.encode(errors="replace"), digest_size=8).digest())


def write_digest(connection: sqlite3.Connection, digest: int, number: int) -> None:
    """Store the digest after operation ``number``, within the open transaction."""
    connection.executemany(
        "INSERT INTO counters VALUES (?, ?) ON CONFLICT DO UPDATE SET value = excluded.value",
        [(_DIGEST, digest), (_NUMBER, number)],
    )


def read_digest(connection: sqlite3.Connection, number: int) -> int | None:
    """Return the stored digest after operation ``number``; None if there is none."""
    stored = dict(
        connection.execute(
            "SELECT name, value FROM counters WHERE name IN (?, ?)", (_DIGEST, _NUMBER)
        )
    )
    return stored.get(_DIGEST) if stored.get(_NUMBER) == number else None


@dataclass(frozen=True)
class Integrity:
    """The content of an intact label file."""

    operations: int
    hash: str
    """Hash of the last operation: equal hashes mean equal logs."""
    elements: int
    observations: int


def no_pace() -> None:
    """Check as fast as possible."""


def check_labels(path: Path, pace: Pace = no_pace) -> Integrity:
    """Check a label file without writing to it, also while others do.

    Raise SemvizError, naming the first faulty operation: altered, missing, in conflict with those
    before it, or with the rows in the tables.
    """
    connection = snapshot(path)
    try:
        return check_snapshot(connection, path, pace)
    finally:
        connection.close()


def snapshot(path: Path) -> sqlite3.Connection:
    """Return a copy of a label file in memory, upgraded if it is of an older version.

    Raise SemvizError if ``path`` is missing, another file, of a newer version or unreadable.
    """
    if not path.is_file():
        raise SemvizError(
            f"{path}: there is no such file; the first label makes it: semviz annotate"
        )
    database.check_not_empty(path)
    memory = sqlite3.connect(":memory:", isolation_level=None)
    try:
        source = open_read_only(path)
        try:
            source.backup(memory)
        finally:
            source.close()
        memory.execute("BEGIN")
        database.check_and_upgrade(memory, path)
        memory.execute("COMMIT")
    except database.UNREADABLE as error:
        memory.close()
        raise database.database_error(error, path, "Not read") from None
    except BaseException:
        memory.close()
        raise
    return memory


def open_read_only(path: Path, mode: str = "mode=ro") -> sqlite3.Connection:
    """Open a label file without the right to write; ``mode`` is a parameter of SQLite's URI."""
    uri = f"{path.resolve().as_uri()}?{mode}"
    return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)


def check_snapshot(connection: sqlite3.Connection, path: Path, pace: Pace = no_pace) -> Integrity:
    """Check a ``snapshot`` like ``check_labels``; ``path`` is for messages."""
    replay = _LogReplay(pace)
    try:
        _check_schema(connection)
        replay.follow(tables.read_operations(connection))
        replay.compare(connection)
        _check_pages(connection)
    except (SemvizError, *database.UNREADABLE) as error:
        raise database.damaged(path, f"{replay.where}{database.fault(error)}") from None
    labels = replay.labels
    return Integrity(replay.number, replay.hash, len(labels.elements), len(labels.observations))


class _LogReplay:
    """Replays the log from the first operation, and checks it."""

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self.where = ""
        """Prefix of an error message: the operation that is being checked."""
        self.number = 0
        self.hash = NO_HASH
        self.labels = Labels()
        self._writers: dict[Key, tuple[int, bool]] = {}

    def follow(self, operations: Iterator[Operation]) -> None:
        draft, history = Draft(Labels(), dict), tables.UndoHistory()
        self.where = "operation 1: "
        for operation in operations:
            self._pace()
            if operation.number != self.number + 1:
                raise SemvizError(f"missing; number {operation.number} follows")
            if operation != sealed(operation, self.hash):
                raise SemvizError(ALTERED)
            draft.apply(operation.changes)
            history.add(operation)
            for change in operation.changes:
                _, by_human = self._writers.get(change.key, (0, False))
                self._writers[change.key] = (
                    operation.number,
                    by_human or operation.origin == "human",
                )
            self.number, self.hash = operation.number, operation.hash
            self.where = f"operation {operation.number + 1}: "
        self.labels = draft.labels()
        self.where = ""

    def compare(self, connection: sqlite3.Connection) -> None:
        """Raise SemvizError if the tables differ from the replayed state."""
        stored = tables.read_labels(connection)
        for row in (*self.labels.rows(), *stored.rows()):
            self._pace()
            key = row_key(row)
            if stored.row(key) != self.labels.row(key):
                number, _ = self._writers.get(key, (0, False))
                self.where = f"operation {number}: " if number else ""
                raise SemvizError(f"the tables hold another {type(row).__name__} than the log")
        if stored.next_number != self.labels.next_number:
            raise SemvizError("the next element number does not follow from the log")
        if tables.read_writers(connection) != {
            (tables.writer_key(key), number, by_human)
            for key, (number, by_human) in self._writers.items()
        }:
            raise SemvizError("the last writers of rows do not follow from the log")
        check_digest(connection, stored.operation, digest_of(stored.rows()))


def check_opened(connection: sqlite3.Connection, labels: Labels, digest: int) -> None:
    """Check what is quick to check when a file is opened: ``labels`` and the end of the log.

    ``digest`` is that of the rows of ``labels``.

    Raise SemvizError if rows differ from those that were written, operations are missing, or one of
    the last was altered.
    """
    check_digest(connection, labels.operation, digest)
    (count,) = connection.execute("SELECT count(*) FROM operations").fetchone()
    if count != labels.operation:
        raise SemvizError(f"{labels.operation} operations were written, {count} are there")
    first = max(0, count - TAIL)
    hash_before = tables.hash_of(connection, first) or NO_HASH
    check_following(tables.read_operations(connection, first), hash_before, labels)


def check_following(operations: Iterable[Operation], hash_before: str, labels: Labels) -> None:
    """Check that ``operations`` are unaltered and lead to ``labels``; raise SemvizError if not."""
    rows: dict[Key, Row | None] = {}
    for operation in operations:
        if operation != sealed(operation, hash_before):
            raise SemvizError(f"operation {operation.number}: {ALTERED}")
        hash_before = operation.hash
        rows.update((change.key, change.after) for change in operation.changes)
    for key, row in rows.items():
        if labels.row(key) != row:
            raise SemvizError(f"the tables hold another {key[0].__name__} than the log")


def check_digest(connection: sqlite3.Connection, number: int, digest: int) -> None:
    """Raise SemvizError if rows with ``digest`` are not those written by operation ``number``."""
    if read_digest(connection, number) not in (None, digest):
        raise SemvizError("its rows are not those that were written")


def check_again(path: Path, number: int, hash_: str) -> None:
    """Read ``path`` afresh; raise SemvizError if its log is another one, or a page is broken.

    It takes 0.9 s at 100,000 operations.
    """
    with closing(open_read_only(path)) as connection:
        connection.execute("BEGIN")
        count, last = connection.execute("SELECT count(*), max(number) FROM operations").fetchone()
        if count != (last or 0) or tables.hash_of(connection, number) != hash_:
            raise SemvizError("its log is another one")
        _check_pages(connection)


def last_in_file(path: Path) -> tuple[int, str]:
    """Return number and hash of the last operation in the file alone, without its journal."""
    with closing(open_read_only(path, "immutable=1")) as connection:
        return tables.last_operation(connection)


def last_hash(path: Path) -> str:
    """Return the hash of the last operation without reading the labels. Raise SemvizError if the
    file is none of this version."""
    try:
        with closing(open_read_only(path)) as connection:
            return tables.last_operation(connection)[1]
    except sqlite3.Error as error:
        raise SemvizError(f"{path}: cannot be read ({error})") from None


def _check_schema(connection: sqlite3.Connection) -> None:
    fresh = sqlite3.connect(":memory:", isolation_level=None)
    database.make(fresh)
    missing = _schema_objects(fresh) ^ _schema_objects(connection)
    fresh.close()
    if missing:
        raise SemvizError(f"its tables were altered: {min(missing)[0]}")


def _schema_objects(connection: sqlite3.Connection) -> set[tuple[str, str]]:
    return set(connection.execute("SELECT name, coalesce(sql, '') FROM sqlite_master"))


def _check_pages(connection: sqlite3.Connection) -> None:
    (result,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if result != "ok":
        raise SemvizError(" ".join(result.split()))
    if connection.execute("PRAGMA foreign_key_check").fetchone() is not None:
        raise SemvizError("a row refers to a missing row")
