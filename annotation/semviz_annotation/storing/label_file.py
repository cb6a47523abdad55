"""An open label file with its newest state in memory, one transaction at a time."""

import sqlite3
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from semviz_annotation.edits import first_fault
from semviz_annotation.labels import Draft, Labels
from semviz_annotation.storing.connection import connect, damaged, in_words
from semviz_annotation.storing.history import History, replayed, rewound
from semviz_annotation.storing.operations import NO_HASH, Operation
from semviz_annotation.storing.tables import (
    hash_of,
    read_history,
    read_labels,
    read_operations,
    write_changes,
    write_operation,
)
from semviz_core.errors import SemvizError


class LabelFile:
    """Inside ``reading`` and ``writing``, ``labels``, ``hash`` and ``history`` are those on disk.

    Raises SemvizError where the file cannot be opened, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.labels = Labels()
        self.hash = NO_HASH
        """Of the last operation."""
        self.history = History()
        self.connection = connect(path)
        self._lock = threading.RLock()
        self._seen_version: int | None = None
        self._written: list[tuple[Operation, Labels]] = []
        try:
            with self.reading():
                pass
        except BaseException:
            self.connection.close()
            raise

    def close(self) -> None:
        with self._lock:
            self.connection.close()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """One look at the newest state: nobody's writing shows in between."""
        with self._transaction("BEGIN", "Not read"):
            yield

    @contextmanager
    def writing(self) -> Iterator[None]:
        """One transaction on the newest state, on disk at the end; nothing is left of a failed one.

        Waits for other writers.
        """
        with self._lock:
            self._written = []
            with self._transaction("BEGIN IMMEDIATE", "Not saved"):
                yield
            self._take_over(self._written)

    def append(self, operation: Operation, labels: Labels) -> None:
        """Write an operation that leads to ``labels``; it counts when ``writing`` is left."""
        write_operation(self.connection, operation)
        write_changes(self.connection, operation.changes, labels.next_number)
        self._written.append((operation, labels))

    def labels_at(self, number: int) -> Labels:
        """The state after an operation, from the nearer end of the log; 0 is the start.

        Raises SemvizError where there is no such operation.
        """
        last = self.labels.operation
        if not 0 <= number <= last:
            raise SemvizError(f"there is no operation {number}; the last one is {last}")
        if number > last // 2:
            labels = rewound(self.labels, read_operations(self.connection, number))
        else:
            earlier = read_operations(self.connection, before=number + 1)
            labels = replayed(earlier, self.labels.next_number)
        return replace(labels, operation=number)

    @contextmanager
    def _transaction(self, begin: str, refused: str) -> Iterator[None]:
        with self._lock:
            try:
                self.connection.execute(begin)
                try:
                    self._catch_up()
                    yield
                    self.connection.execute("COMMIT")
                except BaseException:
                    if self.connection.in_transaction:
                        self.connection.execute("ROLLBACK")
                    raise
            except sqlite3.Error as error:
                raise in_words(error, self.path, refused) from None
            except ValidationError as error:
                raise damaged(self.path, first_fault(error)) from None

    def _catch_up(self) -> None:
        """Take over what other processes have written since, or a backup they restored."""
        (version,) = self.connection.execute("PRAGMA data_version").fetchone()
        if version == self._seen_version:
            return
        known = self.labels.operation
        if known and hash_of(self.connection, known) == self.hash:
            newer = tuple(read_operations(self.connection, known))
            draft = Draft(self.labels)
            for one in newer:
                draft.apply(one.changes)
            self._take_over((one, draft.labels()) for one in newer)
        else:
            self._load()
        self._seen_version = version

    def _load(self) -> None:
        try:
            self.labels = read_labels(self.connection)
        except SemvizError as error:
            raise damaged(self.path, str(error)) from None
        self.hash = hash_of(self.connection, self.labels.operation) or NO_HASH
        self.history = read_history(self.connection)

    def _take_over(self, written: Iterable[tuple[Operation, Labels]]) -> None:
        for operation, labels in written:
            self.labels = replace(labels, operation=operation.number)
            self.hash = operation.hash
            self.history.add(operation)
