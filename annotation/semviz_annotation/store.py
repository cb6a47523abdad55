"""The label file: SQLite with an append-only log of operations and the current state.

An operation is durable when ``apply``, ``undo`` or ``redo`` returns: log and state are written in
one transaction, in WAL mode with ``synchronous=FULL``. One writer at a time; other threads and
processes wait for it and then see its work.
"""

import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.edits import Edit, Rules, first_fault
from semviz_annotation.labels import (
    STRICT,
    Change,
    Draft,
    Id,
    LabelElement,
    Labels,
    Observation,
    new_id,
)
from semviz_annotation.tables import connect, read_labels, write_changes
from semviz_core.camera import Rig
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError

Origin: TypeAlias = Literal["human", "machine"]
Number: TypeAlias = Annotated[int, Field(ge=1, lt=2**53)]

_CHANGES: TypeAdapter[tuple[Change, ...]] = TypeAdapter(tuple[Change, ...])
_COLUMNS = "number, request_id, author, origin, time, kind, changes, undoes, redoes"


@dataclass(frozen=True)
class Operation:
    """One durable entry of the log."""

    number: Number
    """1, 2, 3, ... without gaps."""
    request_id: Id
    author: str
    origin: Origin
    time: str
    """UTC, ISO 8601, of the writer's clock; order is by number."""
    kind: str
    """The edit's kind, or ``undo`` or ``redo``."""
    changes: tuple[Change, ...]
    undoes: Number | None = None
    """Number of the edit that this operation takes back."""
    redoes: Number | None = None
    """Number of the edit that this operation does once more."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


class BrokenOperationError(SemvizError):
    """An operation of a foreign log does not follow from those before it."""

    def __init__(self, number: int, why: object) -> None:
        super().__init__(f"operation {number}: {why}")
        self.number = number


class _History:
    """What each author can undo and redo: numbers of edits, latest last."""

    def __init__(self) -> None:
        self._done: dict[str, list[int]] = {}
        self._undone: dict[str, list[int]] = {}

    def add(self, one: Operation) -> None:
        self.add_numbers(one.number, one.author, one.undoes, one.redoes)

    def add_numbers(self, number: int, author: str, undoes: int | None, redoes: int | None) -> None:
        done = self._done.setdefault(author, [])
        undone = self._undone.setdefault(author, [])
        if undoes is not None:
            _move_last(undoes, done, undone)
        elif redoes is not None:
            _move_last(redoes, undone, done)
        else:
            done.append(number)
            undone.clear()

    def undoable(self, author: str) -> int | None:
        return next(reversed(self._done.get(author, ())), None)

    def redoable(self, author: str) -> int | None:
        return next(reversed(self._undone.get(author, ())), None)


def _move_last(number: int, source: list[int], target: list[int]) -> None:
    if not source or source[-1] != number:
        raise SemvizError(f"operation {number} is not the author's last to undo or redo")
    target.append(source.pop())


class LabelStore:
    """An open label file. Threads may share it; several processes may open the same file."""

    def __init__(self, path: Path, connection: sqlite3.Connection, rules: Rules) -> None:
        self.path = path
        self.rules = rules
        self._connection = connection
        self._lock = threading.RLock()
        self._labels = Labels()
        self._history = _History()
        self._reload()

    @classmethod
    def open(
        cls, path: Path, classes: ClassSet = DEFAULT_CLASSES, rig: Rig | None = None
    ) -> "LabelStore":
        """Open or make ``path``. ``rig`` gives the image sizes that points are checked against.

        Raises SemvizError where the file is no label file, of a newer version, or not writable.
        """
        if not path.parent.is_dir():
            raise SemvizError(f"{path}: there is no such folder; make it with 'semviz new'")
        try:
            connection = connect(path)
            try:
                return cls(path, connection, Rules(classes, rig))
            except BaseException:
                connection.close()
                raise
        except sqlite3.Error as error:
            raise _plain(error, path, "Not opened") from None

    def close(self) -> None:
        with self._lock:
            self._connection.close()

    def __enter__(self) -> "LabelStore":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -- reading

    @property
    def labels(self) -> Labels:
        """The current state, with what other processes have written."""
        with self._lock:
            self._catch_up()
            return self._labels

    @property
    def last_operation(self) -> int:
        """Number of the last durable operation; 0 where there is none."""
        with self._lock:
            self._catch_up()
            return self._labels.operation

    def operations(self, after: int = 0) -> tuple[Operation, ...]:
        """The log from number ``after`` + 1 on."""
        with self._lock:
            return self._operations(after)

    def undoable(self, author: str) -> int | None:
        """Number of the edit that ``undo`` would take back."""
        with self._lock:
            self._catch_up()
            return self._history.undoable(author)

    def redoable(self, author: str) -> int | None:
        """Number of the edit that ``redo`` would do once more."""
        with self._lock:
            self._catch_up()
            return self._history.redoable(author)

    # -- writing

    def apply(
        self, edit: Edit, author: str, request_id: str | None = None, origin: Origin = "human"
    ) -> Operation:
        """Do ``edit``; returns when it is on disk. The same request again returns its operation.

        Raises SemvizError where the edit is refused or could not be saved; nothing is changed then.
        """

        def operation(number: int, request_id: str) -> Operation:
            changes = tuple(edit.changes(self._labels, self.rules))
            return Operation(number, request_id, author, origin, _now(), edit.kind, changes)

        return self._commit(operation, edit.kind, author, request_id)

    def undo(self, author: str, request_id: str | None = None) -> Operation:
        """Take back the author's last edit that stands; the undo is itself an operation.

        Raises SemvizError where there is none, or someone else has changed its rows since.
        """

        def operation(number: int, request_id: str) -> Operation:
            target = self._history.undoable(author)
            if target is None:
                raise SemvizError("Nothing to undo.")
            changes = tuple(one.inverse() for one in self._changes_of(target))
            self._check_fit(changes, f"Cannot undo operation {target}")
            return Operation(
                number, request_id, author, "human", _now(), "undo", changes, undoes=target
            )

        return self._commit(operation, "undo", author, request_id)

    def redo(self, author: str, request_id: str | None = None) -> Operation:
        """Do the author's last undone edit once more; like ``undo``."""

        def operation(number: int, request_id: str) -> Operation:
            target = self._history.redoable(author)
            if target is None:
                raise SemvizError("Nothing to redo.")
            changes = self._changes_of(target)
            self._check_fit(changes, f"Cannot redo operation {target}")
            return Operation(
                number, request_id, author, "human", _now(), "redo", changes, redoes=target
            )

        return self._commit(operation, "redo", author, request_id)

    def extend(self, operations: Iterable[Operation]) -> None:
        """Append operations of another log as they are, all or none.

        Raises BrokenOperationError for the first that does not follow from those before it.
        """
        with self._lock:
            try:
                with self._transaction():
                    draft = Draft(self._labels)
                    for number, one in enumerate(operations, self._labels.operation + 1):
                        self._append(one, number, draft)
            finally:
                self._reload()

    # -- inside

    def _commit(
        self,
        make: Callable[[int, str], Operation],
        kind: str,
        author: str,
        request_id: str | None,
    ) -> Operation:
        with self._lock:
            with self._transaction():
                earlier = self._of_request(request_id)
                if earlier is not None:
                    if (earlier.author, earlier.kind) != (author, kind):
                        raise SemvizError(
                            "this request id was used for another edit; take a new one"
                        )
                    return earlier
                operation = make(self._labels.operation + 1, request_id or new_id())
                labels = self._labels.changed(operation.changes)
                self._write(operation, labels.next_number)
            self._labels = replace(labels, operation=operation.number)
            self._history.add(operation)
            return operation

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """One transaction on the newest state; after a failure nothing of it is left."""
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                self._catch_up()
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise _plain(error, self.path, "Not saved") from None

    def _write(self, operation: Operation, next_number: int) -> None:
        self._connection.execute(
            f"INSERT INTO operations ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                operation.number,
                operation.request_id,
                operation.author,
                operation.origin,
                operation.time,
                operation.kind,
                _CHANGES.dump_json(operation.changes).decode(),
                operation.undoes,
                operation.redoes,
            ),
        )
        write_changes(self._connection, operation.changes, next_number)

    def _append(self, operation: Operation, number: int, draft: Draft) -> None:
        try:
            if operation.number != number:
                raise SemvizError(f"expected number {number}")
            draft.apply(operation.changes)
            for change in operation.changes:
                if isinstance(change.after, LabelElement):
                    self.rules.check_class(change.after)
                elif isinstance(change.after, Observation):
                    self.rules.check(change.after, draft.class_of(change.after))
            self._write(operation, draft.next_number)
            self._history.add(operation)
        except (SemvizError, sqlite3.IntegrityError) as error:
            raise BrokenOperationError(operation.number, error) from None

    def _reload(self) -> None:
        """Read the state from the file, as of one moment."""
        self._connection.execute("BEGIN")
        try:
            self._labels = self._read_labels()
            self._history = _History()
            for row in self._connection.execute(
                "SELECT number, author, undoes, redoes FROM operations ORDER BY number"
            ):
                self._history.add_numbers(*row)
        finally:
            self._connection.execute("ROLLBACK")

    def _read_labels(self) -> Labels:
        try:
            return read_labels(self._connection)
        except SemvizError as error:
            raise _damaged(self.path, str(error)) from None

    def _catch_up(self) -> None:
        """Take over what other processes have written since."""
        newer = self._operations(self._labels.operation)
        if not newer:
            return
        draft = Draft(self._labels)
        for operation in newer:
            draft.apply(operation.changes)
            self._history.add(operation)
        self._labels = replace(draft.labels(), operation=newer[-1].number)

    def _operations(self, after: int) -> tuple[Operation, ...]:
        rows = self._connection.execute(
            f"SELECT {_COLUMNS} FROM operations WHERE number > ? ORDER BY number", (after,)
        )
        try:
            return tuple(_operation(row) for row in rows)
        except ValidationError as error:
            raise _damaged(self.path, first_fault(error)) from None

    def _of_request(self, request_id: str | None) -> Operation | None:
        row = self._connection.execute(
            f"SELECT {_COLUMNS} FROM operations WHERE request_id = ?", (request_id,)
        ).fetchone()
        return None if row is None else _operation(row)

    def _changes_of(self, number: int) -> tuple[Change, ...]:
        (text,) = self._connection.execute(
            "SELECT changes FROM operations WHERE number = ?", (number,)
        ).fetchone()
        return _CHANGES.validate_json(text)

    def _check_fit(self, changes: tuple[Change, ...], what: str) -> None:
        try:
            self._labels.changed(changes)
        except SemvizError as error:
            raise SemvizError(f"{what}: {error}") from None


def _operation(row: tuple[Any, ...]) -> Operation:
    number, request_id, author, origin, time, kind, changes, undoes, redoes = row
    return Operation(
        number=number,
        request_id=request_id,
        author=author,
        origin=origin,
        time=time,
        kind=kind,
        changes=_CHANGES.validate_json(changes),
        undoes=undoes,
        redoes=redoes,
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _damaged(path: Path, why: str) -> SemvizError:
    return SemvizError(f"{path}: the label file is damaged ({why}); restore a copy")


def _plain(error: sqlite3.Error, path: Path, what: str) -> SemvizError:
    """The line for people to read."""
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
            return _damaged(path, str(error))
    return SemvizError(f"{what}: {path}: {error}")
