"""The label file: SQLite with an append-only log of operations and the current state.

An operation is durable when ``apply``, ``undo`` or ``redo`` returns: log and state are written in
one transaction, in WAL mode with ``synchronous=FULL``. One writer at a time; other threads and
processes wait for it and then see its work.
"""

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from types import TracebackType

from semviz_annotation.edits import AnyEdit
from semviz_annotation.labels import Draft, Labels
from semviz_annotation.rows import LabelElement, Observation, new_id
from semviz_annotation.rules import Rules
from semviz_annotation.storing.conflicts import Witness
from semviz_annotation.storing.history import difference
from semviz_annotation.storing.label_file import LabelFile
from semviz_annotation.storing.operations import (
    BrokenOperationError,
    ConflictError,
    Operation,
    Origin,
    Writer,
    sealed,
)
from semviz_annotation.storing.tables import (
    last_writer,
    named_operations,
    operation_of_request,
    read_history,
    read_operations,
)
from semviz_core.camera import Rig
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError

__all__ = ["BrokenOperationError", "ConflictError", "LabelStore", "Operation", "Origin", "Writer"]

LOOK_BACK = 200
"""So many edits are tried for one that can be undone, where others have overtaken the last."""
LONGEST_NAME = 100


class LabelStore:
    """An open label file. Threads may share it; several processes may open the same file."""

    def __init__(self, file: LabelFile, rules: Rules) -> None:
        self.path = file.path
        self.rules = rules
        self._file = file

    @classmethod
    def open(
        cls, path: Path, classes: ClassSet = DEFAULT_CLASSES, rig: Rig | None = None
    ) -> "LabelStore":
        """Open or make ``path``. ``rig`` gives the image sizes that points are checked against.

        Raises SemvizError where the file is no label file, of a newer version, or not writable.
        """
        if not path.parent.is_dir():
            raise SemvizError(f"{path}: there is no such folder; make it with 'semviz new'")
        return cls(LabelFile(path), Rules(classes, rig))

    def close(self) -> None:
        self._file.close()

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
        with self._file.reading():
            return self._file.labels

    @property
    def last_operation(self) -> int:
        """Number of the last durable operation; 0 where there is none.

        It grows, but for a backup that someone restored.
        """
        with self._file.reading():
            return self._file.labels.operation

    def operations(
        self, after: int = 0, limit: int | None = None, before: int | None = None
    ) -> tuple[Operation, ...]:
        """The log between two numbers, oldest first.

        Of more than ``limit`` those next to ``before`` are given, without it those next to
        ``after``.
        """
        with self._file.reading():
            return tuple(read_operations(self._file.connection, after, limit, before))

    def labels_at(self, number: int) -> Labels:
        """The state after operation ``number``, from the nearer end of the log; 0 is the start.

        Raises SemvizError where there is no such operation.
        """
        with self._file.reading():
            return self._file.labels_at(number)

    def named(self) -> tuple[Operation, ...]:
        """The operations of kind ``name``: each gave its ``text`` to the state before it."""
        with self._file.reading():
            return tuple(named_operations(self._file.connection))

    def last_writers(self, observation_ids: Iterable[str]) -> dict[str, Writer]:
        """Who wrote each observation last; without those that never were."""
        with self._file.reading():
            found = {
                one: last_writer(self._file.connection, [(Observation, one)])
                for one in observation_ids
            }
        return {one: writer for one, writer in found.items() if writer is not None}

    def undoable(self, author: str) -> int | None:
        """Number of the author's last edit that stands."""
        with self._file.reading():
            return next(self._file.history.done(author), None)

    def redoable(self, author: str) -> int | None:
        """Number of the author's last edit that was undone."""
        with self._file.reading():
            return next(self._file.history.undone(author), None)

    # -- writing

    def apply(
        self,
        edit: AnyEdit,
        author: str,
        request_id: str | None = None,
        origin: Origin = "human",
        expects: Observation | None = None,
    ) -> Operation:
        """Do ``edit``; returns when it is on disk. The same request again returns its operation.

        ``expects`` is the observation that the edit is about, as the author saw it. A machine may
        add rows, and change and delete those that no human has ever written.

        Raises ConflictError where the observation is another one now, SemvizError where the edit is
        refused or could not be saved; nothing is changed then.
        """

        def operation(number: int, request_id: str) -> Operation:
            if expects is not None:
                self._witness().check_seen(expects)
            changes = tuple(edit.changes(self._file.labels, self.rules))
            return Operation(number, request_id, author, origin, _now(), edit.kind, changes)

        return self._commit(operation, edit.kind, author, request_id)

    def undo(
        self, author: str, request_id: str | None = None, number: int | None = None
    ) -> Operation:
        """Take back the author's last edit that still can be, or edit ``number``.

        The undo is itself an operation. Where others have overtaken the author's last edit, an
        earlier one is taken, and the operation's ``text`` says which was left and why.

        Raises SemvizError where there is none; it says who changed what since.
        """

        def operation(new: int, request_id: str) -> Operation:
            if number is not None and not self._file.history.stands(author, number):
                raise SemvizError(f"Cannot undo operation {number}: it is no edit of yours.")
            numbers = self._file.history.done(author) if number is None else iter([number])
            one, text = self._first_that_fits("undo", numbers)
            changes = tuple(change.inverse() for change in one.changes)
            return Operation(
                number=new,
                request_id=request_id,
                author=author,
                origin=one.origin,
                time=_now(),
                kind="undo",
                changes=changes,
                undoes=one.number,
                text=text,
            )

        return self._commit(operation, "undo", author, request_id)

    def redo(self, author: str, request_id: str | None = None) -> Operation:
        """Do the author's last undone edit once more; like ``undo``."""

        def operation(new: int, request_id: str) -> Operation:
            one, text = self._first_that_fits("redo", self._file.history.undone(author))
            return Operation(
                number=new,
                request_id=request_id,
                author=author,
                origin=one.origin,
                time=_now(),
                kind="redo",
                changes=one.changes,
                redoes=one.number,
                text=text,
            )

        return self._commit(operation, "redo", author, request_id)

    def restore(self, number: int, author: str, request_id: str | None = None) -> Operation:
        """Bring back the state after operation ``number``: a new operation that can be undone.

        Raises SemvizError where there is no such operation, or nothing has changed since.
        """

        def operation(new: int, request_id: str) -> Operation:
            changes = tuple(difference(self._file.labels, self._file.labels_at(number)))
            if not changes:
                raise SemvizError(f"the labels are already as after operation {number}")
            names = {one.number: one.text for one in named_operations(self._file.connection)}
            text = f"operation {number}" + (f", '{names[number]}'" if number in names else "")
            return Operation(
                new, request_id, author, "human", _now(), "restore", changes, text=text
            )

        return self._commit(operation, "restore", author, request_id)

    def name_state(self, name: str, author: str, request_id: str | None = None) -> Operation:
        """Give the current state a name; see ``named``.

        Raises SemvizError where the name is empty, too long, or in use.
        """
        name = " ".join(name.split())
        if not 0 < len(name) <= LONGEST_NAME:
            raise SemvizError(f"a name has 1 to {LONGEST_NAME} characters")

        def operation(new: int, request_id: str) -> Operation:
            for one in named_operations(self._file.connection):
                if one.text == name:
                    raise SemvizError(f"operation {one.number} is named '{name}' already")
            return Operation(new, request_id, author, "human", _now(), "name", (), text=name)

        return self._commit(operation, "name", author, request_id)

    def extend(self, operations: Iterable[Operation]) -> None:
        """Append operations of another log as they are, all or none.

        Raises BrokenOperationError for the first that does not follow from those before it.
        """
        with self._file.writing():
            draft, hash_before = Draft(self._file.labels), self._file.hash
            history = read_history(self._file.connection)
            for number, one in enumerate(operations, self._file.labels.operation + 1):
                try:
                    self._check_follows(one, number, hash_before)
                    draft.apply(one.changes)
                    self._check_rows(one, draft)
                    history.add(one)
                    self._file.append(one, draft.labels())
                except (SemvizError, sqlite3.IntegrityError) as error:
                    raise BrokenOperationError(one.number, error) from None
                hash_before = one.hash

    # -- inside

    def _commit(
        self,
        make: Callable[[int, str], Operation],
        kind: str,
        author: str,
        request_id: str | None,
    ) -> Operation:
        with self._file.writing():
            labels, connection = self._file.labels, self._file.connection
            earlier = operation_of_request(connection, request_id or "")
            if earlier is not None:
                if (earlier.author, earlier.kind) != (author, kind):
                    raise SemvizError("this request id was used for another edit; take a new one")
                return earlier
            operation = make(labels.operation + 1, request_id or new_id())
            operation = sealed(operation, self._file.hash)
            if operation.origin == "machine":
                self._witness().check_machine(operation.changes)
            self._file.append(operation, labels.changed(operation.changes))
            return operation

    @staticmethod
    def _check_follows(one: Operation, number: int, hash_before: str) -> None:
        if one.number != number:
            raise SemvizError(f"expected number {number}")
        if one != sealed(one, hash_before):
            raise SemvizError("its hash is wrong; it was altered after it was written")

    def _check_rows(self, one: Operation, draft: Draft) -> None:
        for change in one.changes:
            if isinstance(change.after, LabelElement):
                self.rules.check_class(change.after)
            elif isinstance(change.after, Observation):
                self.rules.check(change.after, draft.class_of(change.after))

    def _first_that_fits(self, what: str, numbers: Iterator[int]) -> tuple[Operation, str]:
        """The first of some edits that still fits; which one was passed over for it, and why."""
        passed = ""
        for number in islice(numbers, LOOK_BACK):
            (one,) = read_operations(self._file.connection, number - 1, limit=1)
            changes = one.changes
            if what == "undo":
                changes = tuple(change.inverse() for change in changes)
            why = self._witness().misfit(changes, one)
            if why is None:
                return one, passed
            passed = passed or f"operation {number} ({one.kind}): {why}"
        raise SemvizError(f"Cannot {what} {passed}." if passed else f"Nothing to {what}.")

    def _witness(self) -> Witness:
        return Witness(self._file.connection, self._file.labels, self.rules.classes)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
