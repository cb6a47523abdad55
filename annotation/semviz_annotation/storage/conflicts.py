"""Conflicts of an edit with the present state, explained from the log."""

import sqlite3
from collections.abc import Iterable

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import (
    Key,
    LabelElement,
    Observation,
    Review,
    ReviewDecision,
    Row,
    RowChange,
    row_elements,
    row_key,
)
from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import ConflictError, Operation, Writer
from semviz_core.base.classes import ClassSet
from semviz_core.common.errors import SemvizError


class ConflictChecker:
    """Explains conflicts of an edit with the present state, from the log."""

    def __init__(self, connection: sqlite3.Connection, labels: Labels, classes: ClassSet) -> None:
        self._connection = connection
        self._labels = labels
        self._classes = classes

    def check_unchanged(self, expected: Observation) -> None:
        """Raise ConflictError if an observation differs from ``expected``."""
        current = self._labels.observations.get(expected.id)
        if current == expected:
            return
        writer = tables.last_writer(self._connection, [(Observation, expected.id)])
        raise ConflictError(
            f"{self._describe_change(expected, writer)}; keep yours or theirs", current
        )

    def check_machine(self, changes: Iterable[RowChange]) -> None:
        """Raise SemvizError if a human has ever written one of the rows."""
        touched = {change.key: change.before or change.after for change in changes}
        key = tables.first_written_by_human(self._connection, touched)
        row = None if key is None else touched[key]
        if row is not None:
            raise SemvizError(f"{self._name(row)} is a person's work; no machine may change it")

    def undo_conflict(self, changes: tuple[RowChange, ...], since: Operation) -> str | None:
        """Return why ``changes``, which undo or redo ``since``, do not apply; None if they do."""
        changed = {
            change.key: change.before or change.after
            for change in changes
            if self._labels.row(change.key) != change.before
        }
        if not changed:
            try:
                self._labels.changed(changes)
            except SemvizError as error:
                changed = self._newer_rows(changes, since)
                if not changed:
                    return str(error)
            else:
                return None
        writer = tables.last_writer(self._connection, changed)
        last = [key for key in changed if tables.last_writer(self._connection, [key]) == writer]
        row = changed[last[0]]
        return "it was never done" if row is None else self._describe_change(row, writer)

    def _newer_rows(
        self, changes: tuple[RowChange, ...], since: Operation
    ) -> dict[Key, Row | None]:
        """Return other rows of the same elements that were written after ``since``."""
        result: dict[Key, Row | None] = {}
        changed = {change.key for change in changes}
        element_ids = (row_elements(change.before or change.after) for change in changes)
        for element_id in sorted({id_ for ids in element_ids for id_ in ids}):
            rows: list[Row] = [*self._labels.of_element(element_id)]
            rows += self._labels.dismissed_of(element_id)
            rows += self._labels.decisions_of(element_id)
            for row in rows:
                key = row_key(row)
                writer = tables.last_writer(self._connection, [key])
                if key not in changed and writer and writer.number > since.number:
                    result[key] = row
        return result

    def _describe_change(self, row: Row, writer: Writer | None) -> str:
        if writer is None:
            return f"{self._name(row)} is not in the log"
        return (
            f"{writer.author} changed {self._name(row)} since "
            f"(operation {writer.number}, {writer.kind})"
        )

    def _name(self, row: Row) -> str:
        if isinstance(row, Review):
            return f"the review of frame {row.frame_index}"
        elements = [
            element for element in map(self._element, row_elements(row)) if element is not None
        ]
        names = [
            self._classes.element_name(element.class_id, element.number) for element in elements
        ]
        if not names:
            return "a proposal"
        match row:
            case LabelElement():
                return names[0]
            case ReviewDecision():
                return f"the decision about {' and '.join(names)}"
        return f"{names[0]} in the {row.side} image of frame {row.frame_index}"

    def _element(self, element_id: str) -> LabelElement | None:
        """Return an element as it is, or as it was before it was deleted."""
        if element_id in self._labels.elements:
            return self._labels.elements[element_id]
        writer = tables.last_writer(self._connection, [(LabelElement, element_id)])
        if writer is None:
            return None
        (operation,) = tables.read_operations(self._connection, writer.number - 1, limit=1)
        rows = (row for change in operation.changes for row in (change.before, change.after))
        return next(row for row in rows if isinstance(row, LabelElement) and row.id == element_id)
