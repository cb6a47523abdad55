"""Apply, undo and redo edits in a label file: an edit is durable when the call returns.

Log and state are written in one transaction, in WAL mode with ``synchronous=FULL``. There is
one writer at a time; other threads and processes wait, then read its result. An edit that would
overwrite what its author had not seen is refused, and the error names who wrote it. A machine's
edit is refused if it touches a row that a human has written.
"""

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from types import TracebackType

from semviz_annotation.labels import rows
from semviz_annotation.labels.edits import AnyEdit
from semviz_annotation.labels.labels import Draft, Labels
from semviz_annotation.labels.own_classes import check_classes
from semviz_annotation.storage import closed_frames, placement, tables, teamwork
from semviz_annotation.storage.conflicts import ConflictChecker
from semviz_annotation.storage.declarations import free_class_id
from semviz_annotation.storage.label_file import BackgroundCheck, Health, LabelFile, LabelFileError
from semviz_annotation.storage.operations import (
    BrokenOperationError,
    ConflictError,
    EditBase,
    LogEnd,
    Operation,
    Origin,
    ReplacedLogError,
    Writer,
    sealed,
)
from semviz_core.base.camera import Rig
from semviz_core.base.classes import NEW_CENTER, TriangleCenter, describe_center
from semviz_core.common.errors import SemvizError

__all__ = [
    "BrokenOperationError",
    "ConflictError",
    "EditBase",
    "LabelStore",
    "LogEnd",
    "Operation",
    "Origin",
    "ReplacedLogError",
    "Writer",
]

MAX_UNDO_CANDIDATES = 200
"""Undo tries so many earlier edits if the last one conflicts with later changes."""
MAX_NAME_LENGTH = 100


class LabelStore:
    """An open label file. Threads may share it; several processes may open the file at once."""

    def __init__(self, file: LabelFile, rig: Rig | None) -> None:
        self.path = file.path
        self.rig = rig
        self.closed: closed_frames.WhyClosed = closed_frames.open_to_all
        """Says why a frame takes no edit of a kind; see ``WhyClosed``."""
        self._file = file
        self._check: BackgroundCheck | None = None

    @classmethod
    def open(
        cls,
        path: Path,
        rig: Rig | None = None,
        triangle_center: TriangleCenter = NEW_CENTER,
    ) -> "LabelStore":
        """Open or create ``path``; points must be inside the images of ``rig``.

        A new file follows ``triangle_center``; one that exists keeps its own.

        Raise SemvizError if the file is no label file, of a newer version, or not writable.
        """
        if not path.parent.is_dir():
            raise SemvizError(f"{path}: there is no such folder; create it with 'semviz new'")
        return cls(LabelFile(path, triangle_center), rig)

    def close(self) -> None:
        if self._check is not None:
            self._check.close()
        self._file.close()

    def check_in_background(self) -> None:
        """Check the whole file in a thread; ``health`` tells the result."""
        self._check = BackgroundCheck(self._file)

    def health(self) -> Health:
        """Return what is known about the file; see ``check_in_background``."""
        return Health("checking", "") if self._check is None else self._check.health()

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
        """The newest state, including what other processes have written."""
        with self._file.reading():
            return self._file.labels

    @property
    def rules(self) -> rows.Rules:
        """The present classes, and the image sizes, that labels are checked against."""
        return rows.Rules(self.labels.classes, self.rig)

    @property
    def last_operation(self) -> int:
        """Number of the last durable operation; 0 if there is none.

        It decreases only if someone restores a backup.
        """
        with self._file.reading():
            return self._file.labels.operation

    @property
    def end(self) -> LogEnd:
        """The last durable operation with its hash."""
        return self.labels_and_end[1]

    @property
    def labels_and_end(self) -> tuple[Labels, LogEnd]:
        """The newest state, and the operation that led to it."""
        with self._file.reading():
            return self._file.labels, LogEnd(self._file.labels.operation, self._file.hash)

    def holds(self, end: LogEnd) -> bool:
        """Whether ``end`` is an operation of this log: not if a backup has replaced it."""
        return self._file.contains(*end)

    def check_triangles(self, center: TriangleCenter) -> None:
        """Raise LabelFileError if triangular signs are no longer marked at ``center``.

        A restored backup or an imported log may mark them otherwise.
        """
        if self.labels.triangle_center != center:
            raise LabelFileError(
                f"{self.path.name} no longer marks triangular signs at {describe_center(center)}; "
                "close it and reopen it"
            )

    def operations(
        self, after: int = 0, limit: int | None = None, before: int | None = None
    ) -> tuple[Operation, ...]:
        """Return the operations between two numbers (exclusive), oldest first; up to ``limit``,
        closest to ``before``, or to ``after`` if ``before`` is None."""
        with self._file.reading():
            return tuple(tables.read_operations(self._file.connection, after, limit, before))

    def labels_at(self, number: int) -> Labels:
        """Return the state after operation ``number``; 0 is the empty start.

        Raise SemvizError if there is no such operation.
        """
        with self._file.reading():
            return self._file.labels_at(number)

    def named(self) -> tuple[Operation, ...]:
        """Return the operations of kind ``name``; their ``text`` names the state before them."""
        with self._file.reading():
            return tuple(tables.named_operations(self._file.connection))

    def last_writers(self, observation_ids: Iterable[str]) -> dict[str, Writer]:
        """Return the last writer of each observation, without unknown ids."""
        with self._file.reading():
            writers = {
                id_: tables.last_writer(self._file.connection, [(rows.Observation, id_)])
                for id_ in observation_ids
            }
        return {id_: writer for id_, writer in writers.items() if writer is not None}

    def placing_operations(self, observation_ids: Iterable[str]) -> dict[str, Writer]:
        """Return the operation that placed the ends of each observation, without unknown ids."""
        with self._file.reading():
            return placement.placing_operations(self._file.connection, observation_ids)

    def team(self) -> teamwork.Teamwork:
        """Return what the log tells about the people who label."""
        with self._file.reading():
            return teamwork.read_teamwork(self._file.connection)

    def earlier_version(self, frame_index: int) -> Writer | None:
        """Return the operation that left the version of a frame before the present one."""
        with self._file.reading():
            return teamwork.earlier_version(self._file.connection, frame_index)

    def number_of(self, request_id: str) -> int:
        """Return the number of a request's operation. Raise SemvizError if it has none."""
        with self._file.reading():
            if operation := tables.operation_of_request(self._file.connection, request_id):
                return operation.number
        raise SemvizError("this edit was not saved")

    def free_class_id(self) -> int:
        """Return an id that no class ever had."""
        with self._file.reading():
            return free_class_id(self._file.connection)

    def undoable(self, author: str) -> int | None:
        """Return the number of the author's last edit that is not undone; None if there is none."""
        with self._file.reading():
            return next(self._file.history.done(author), None)

    def redoable(self, author: str) -> int | None:
        """Return the number of the author's last undone edit; None if there is none."""
        with self._file.reading():
            return next(self._file.history.undone(author), None)

    # -- writing

    def apply(
        self,
        edit: AnyEdit,
        author: str,
        request_id: str | None = None,
        origin: Origin = "human",
        base: EditBase | None = None,
    ) -> Operation:
        """Apply ``edit`` and return its operation once it is on disk.

        A repeated request id returns the operation of the first request. ``base`` is what the
        author had seen; None: the present state. A machine may add rows, and change or delete rows
        that no human has ever written.

        Raise ConflictError if the edit writes a field that others wrote after ``base``,
        ReplacedLogError if ``base`` is of another log, as undo, redo and restore do, too, and
        SemvizError if it is invalid or cannot be saved. Nothing is changed then.
        """

        def operation(number: int, request_id: str) -> Operation:
            rules = rows.Rules(self._file.labels.classes, self.rig)
            changes = self._conflicts().changes_of(edit, rules, base)
            return Operation(number, request_id, author, origin, _now(), edit.kind, changes)

        return self._commit(operation, edit.kind, author, request_id, base)

    def undo(
        self,
        author: str,
        request_id: str | None = None,
        number: int | None = None,
        base: EditBase | None = None,
    ) -> Operation:
        """Undo the author's last edit that still can be undone, or edit ``number``.

        The undo is itself an operation. If the author's last edit conflicts with later changes, an
        earlier one is undone, and the operation's ``text`` says which was skipped and why. Edits
        that the author made on another page after ``base`` are skipped, too.

        Raise SemvizError if there is none; the message says who changed what since.
        """

        def operation(new: int, request_id: str) -> Operation:
            if number is not None and not self._file.history.stands(author, number):
                raise SemvizError(f"Cannot undo operation {number}: it is no edit of yours.")
            numbers = self._file.history.done(author) if number is None else iter([number])
            undone, text = self._first_applicable("undo", numbers, base)
            changes = tuple(change.inverse() for change in undone.changes)
            return Operation(
                number=new,
                request_id=request_id,
                author=author,
                origin=undone.origin,
                time=_now(),
                kind="undo",
                changes=changes,
                undoes=undone.number,
                text=text,
            )

        return self._commit(operation, "undo", author, request_id, base)

    def redo(
        self, author: str, request_id: str | None = None, base: EditBase | None = None
    ) -> Operation:
        """Redo the author's last undone edit; otherwise like ``undo``."""

        def operation(new: int, request_id: str) -> Operation:
            redone, text = self._first_applicable("redo", self._file.history.undone(author), base)
            return Operation(
                number=new,
                request_id=request_id,
                author=author,
                origin=redone.origin,
                time=_now(),
                kind="redo",
                changes=redone.changes,
                redoes=redone.number,
                text=text,
            )

        return self._commit(operation, "redo", author, request_id, base)

    def restore(
        self,
        number: int,
        author: str,
        request_id: str | None = None,
        base: EditBase | None = None,
    ) -> Operation:
        """Restore the state after operation ``number`` by a new operation, which can be undone.

        Raise SemvizError if there is no such operation, or nothing has changed since, and
        ConflictError if it takes back what others wrote after ``base``.
        """

        def operation(new: int, request_id: str) -> Operation:
            changes = tuple(tables.difference(self._file.labels, self._file.labels_at(number)))
            if not changes:
                raise SemvizError(f"the labels are already those after operation {number}")
            self._conflicts().check_seen(changes, base)
            names = {
                operation.number: operation.text
                for operation in tables.named_operations(self._file.connection)
            }
            text = f"operation {number}" + (f", '{names[number]}'" if number in names else "")
            return Operation(
                new, request_id, author, "human", _now(), "restore", changes, text=text
            )

        return self._commit(operation, "restore", author, request_id, base)

    def name_state(self, name: str, author: str, request_id: str | None = None) -> Operation:
        """Name the present state; see ``named``.

        Raise SemvizError if the name is empty, too long, or in use.
        """
        name = " ".join(name.split())
        if not 0 < len(name) <= MAX_NAME_LENGTH:
            raise SemvizError(f"a name has 1 to {MAX_NAME_LENGTH} characters")

        def operation(new: int, request_id: str) -> Operation:
            for operation in tables.named_operations(self._file.connection):
                if operation.text == name:
                    raise SemvizError(f"operation {operation.number} is already named '{name}'")
            return Operation(new, request_id, author, "human", _now(), "name", (), text=name)

        return self._commit(operation, "name", author, request_id)

    def state(self, kind: teamwork.Statement, text: str, author: str) -> Operation:
        """Write down what was done about people; it changes no row, and is not undone."""

        def operation(new: int, request_id: str) -> Operation:
            return Operation(new, request_id, author, "human", _now(), kind, (), text=text)

        return self._commit(operation, kind, author, None)

    def extend(
        self, operations: Iterable[Operation], triangle_center: TriangleCenter = NEW_CENTER
    ) -> None:
        """Append operations of another log, which follows ``triangle_center``, all or none.

        Raise BrokenOperationError for the first that does not follow from those before it, and
        SemvizError if the labels here mark triangular signs otherwise.
        """
        with self._file.writing():
            labels, hash_before = self._file.with_triangles_at(triangle_center), self._file.hash
            draft = Draft(labels)
            history = tables.read_history(self._file.connection)
            for number, operation in enumerate(operations, self._file.labels.operation + 1):
                try:
                    self._check_follows(operation, number, hash_before)
                    draft.apply(operation.changes)
                    self._check_rows(operation, draft)
                    history.add(operation)
                    self._file.append(operation, draft.labels())
                except (SemvizError, sqlite3.IntegrityError) as error:
                    raise BrokenOperationError(operation.number, error) from None
                hash_before = operation.hash

    # -- inside

    def _commit(
        self,
        make: Callable[[int, str], Operation],
        kind: str,
        author: str,
        request_id: str | None,
        base: EditBase | None = None,
    ) -> Operation:
        with self._file.writing():
            labels, connection = self._file.labels, self._file.connection
            earlier = tables.operation_of_request(connection, request_id or "")
            if earlier is not None:
                if (earlier.author, earlier.kind) != (author, kind):
                    raise SemvizError("this request id was used for another edit; take a new one")
                return earlier
            if base and base.hash and tables.hash_of(connection, base.operation) != base.hash:
                raise ReplacedLogError
            operation = make(labels.operation + 1, request_id or rows.new_id())
            operation = sealed(operation, self._file.hash)
            closed_frames.check_open(operation, self.closed, labels, connection)
            if operation.origin == "machine":
                self._conflicts().check_machine(operation.changes)
            changed = labels.changed(operation.changes)
            check_classes(operation.changes, changed.classes)  # an undo may need a removed one
            self._file.append(operation, changed)
            return operation

    @staticmethod
    def _check_follows(operation: Operation, number: int, hash_before: str) -> None:
        if operation.number != number:
            raise SemvizError(f"expected number {number}")
        if operation != sealed(operation, hash_before):
            raise SemvizError("its hash is wrong; it was altered after it was written")

    def _check_rows(self, operation: Operation, draft: Draft) -> None:
        rules = rows.Rules(draft.classes, self.rig)
        for change in operation.changes:
            if isinstance(change.after, rows.LabelElement):
                rules.check_class(change.after)
            elif isinstance(change.after, rows.Observation):
                rules.check(change.after, draft.class_of(change.after))

    def _first_applicable(
        self, what: str, numbers: Iterator[int], base: EditBase | None
    ) -> tuple[Operation, str]:
        """Return the first of the edits that still applies, and which one was skipped and why."""
        skipped = ""
        for number in islice(numbers, MAX_UNDO_CANDIDATES):
            (operation,) = tables.read_operations(self._file.connection, number - 1, limit=1)
            changes = operation.changes
            if what == "undo":
                changes = tuple(change.inverse() for change in changes)
            why = self._conflicts().undo_conflict(changes, operation, base)
            if why is None:
                return operation, skipped
            skipped = skipped or f"operation {number} ({operation.kind}): {why}"
        raise SemvizError(f"Cannot {what} {skipped}." if skipped else f"Nothing to {what}.")

    def _conflicts(self) -> ConflictChecker:
        return ConflictChecker(self._file.connection, self._file.labels)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
