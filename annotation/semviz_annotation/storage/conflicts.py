"""Find conflicts of an edit with what others wrote meanwhile, and explain them from the log.

Edits of several people are merged by field: an end, its flag, a class, a review. An edit may write
a field unless others wrote it after what the author had seen.
"""

import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import fields
from typing import TypeAlias

from semviz_annotation.labels.edits import AnyEdit
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import (
    Attribute,
    AttributeType,
    ClassDeclaration,
    ImportedOutline,
    Key,
    LabelElement,
    Note,
    Observation,
    Review,
    ReviewDecision,
    Row,
    RowChange,
    Rules,
    row_elements,
    row_key,
)
from semviz_annotation.storage import tables
from semviz_annotation.storage.operations import ConflictError, EditBase, Operation, Writer
from semviz_core.common.errors import SemvizError

Changes: TypeAlias = tuple[RowChange, ...]


def written_fields(change: RowChange) -> set[str]:
    """Return the names of the fields that a change writes; all of a new or deleted row.

    Flags belong to ends, so a pole both of whose ends change is written as a whole: they may have
    been swapped, and one of them moved, in an undo or a restored state.
    """
    before, after = change.before, change.after
    names = {field.name for row in (before, after) if row is not None for field in fields(row)}
    if before is None or after is None or _moves_both_ends(before, after):
        return names
    return {name for name in names if getattr(before, name) != getattr(after, name)}


def _moves_both_ends(before: Row, after: Row) -> bool:
    if not isinstance(before, Observation) or not isinstance(after, Observation):
        return False
    return before.anchor_px != after.anchor_px and before.end_px != after.end_px


class ConflictChecker:
    """Explains conflicts of an edit with the present state, from the log."""

    def __init__(self, connection: sqlite3.Connection, labels: Labels) -> None:
        self._connection = connection
        self._labels = labels

    def changes_of(self, edit: AnyEdit, rules: Rules, base: EditBase | None) -> Changes:
        """Return the row changes of ``edit``.

        Raise ConflictError if it writes a field that others wrote after ``base``, SemvizError if it
        is invalid.
        """
        try:
            changes = tuple(edit.changes(self._labels, rules))
        except SemvizError:
            self._check_row_unseen(edit, base)
            raise
        self.check_seen(changes, base)
        return changes

    def check_seen(self, changes: Changes, base: EditBase | None) -> None:
        """Raise ConflictError if ``changes`` write a field that others wrote after ``base``."""
        overwritten = [
            (operation, change)
            for operation in self._unseen(base)
            for change in self._overlap(changes, operation)
        ]
        if overwritten:
            raise self._conflict(overwritten, is_deleted=False)

    def _check_row_unseen(self, edit: AnyEdit, base: EditBase | None) -> None:
        """Raise ConflictError if others wrote the observation of ``edit`` after ``base``.

        An invalid edit may have been valid on the observation that its author saw.
        """
        key = (Observation, getattr(edit, "observation_id", ""))
        written = [
            (operation, change)
            for operation in self._unseen(base)
            for change in operation.changes
            if change.key == key
        ]
        if written:
            raise self._conflict(written, is_deleted=self._labels.row(key) is None)

    def _unseen(self, base: EditBase | None) -> Iterator[Operation]:
        """Iterate over the operations that the author of an edit has not seen.

        A base after the last operation is of a log that a restored backup has replaced: its
        numbers say nothing about this one, so nothing of it was seen.
        """
        if base is not None:
            seen = base.operation if base.operation <= self._labels.operation else 0
            for operation in tables.read_operations(self._connection, seen):
                if operation.request_id not in base.known:
                    yield operation

    @staticmethod
    def _overlap(changes: Changes, operation: Operation) -> list[RowChange]:
        """Return those of ``changes`` that write a field that ``operation`` wrote."""
        written = {change.key: written_fields(change) for change in operation.changes}
        return [
            change for change in changes if written_fields(change) & written.get(change.key, set())
        ]

    def _conflict(
        self, overwritten: list[tuple[Operation, RowChange]], is_deleted: bool
    ) -> ConflictError:
        last, change = overwritten[-1]
        row = change.before or change.after
        why = "" if row is None else self._describe_change(row, last)
        requests = dict.fromkeys(operation.request_id for operation, _ in overwritten)
        return ConflictError(f"{why}; keep yours or theirs", tuple(requests), is_deleted, last)

    def check_machine(self, changes: Iterable[RowChange]) -> None:
        """Raise SemvizError if a human has ever written one of the rows."""
        touched = {change.key: change.before or change.after for change in changes}
        key = tables.first_written_by_human(self._connection, touched)
        row = None if key is None else touched[key]
        if row is not None:
            raise SemvizError(f"{self._name(row)} is a person's work; no machine may change it")

    def undo_conflict(
        self, changes: Changes, since: Operation, base: EditBase | None
    ) -> str | None:
        """Return why ``changes``, which undo or redo ``since``, do not apply; None if they do."""
        try:
            self.check_seen(changes, base)
        except ConflictError:
            return "it is newer than what you see; once more undoes it"
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

    def _newer_rows(self, changes: Changes, since: Operation) -> dict[Key, Row | None]:
        """Return other rows of the same elements that were written after ``since``."""
        result: dict[Key, Row | None] = {}
        changed = {change.key for change in changes}
        element_ids = (row_elements(change.before or change.after) for change in changes)
        for element_id in sorted({id_ for ids in element_ids for id_ in ids}):
            rows: list[Row] = [*self._labels.of_element(element_id)]
            rows += self._labels.dismissed_of(element_id)
            rows += self._labels.decisions_of(element_id)
            rows += self._labels.notes_of(element_id)
            rows += self._labels.attributes_of(element_id)
            for row in rows:
                key = row_key(row)
                writer = tables.last_writer(self._connection, [key])
                if key not in changed and writer and writer.number > since.number:
                    result[key] = row
        return result

    def _describe_change(self, row: Row, writer: Writer | Operation | None) -> str:
        if writer is None:
            return f"{self._name(row)} is not in the log"
        return (
            f"{writer.author} changed {self._name(row)} since "
            f"(operation {writer.number}, {writer.kind})"
        )

    def _name(self, row: Row) -> str:
        match row:
            case Review():
                return f"the review of frame {row.frame_index}"
            case ClassDeclaration() | AttributeType():
                return f"the declaration of {row.name}"
            case ImportedOutline():
                return "an imported outline"
        elements = [
            element for element in map(self._element, row_elements(row)) if element is not None
        ]
        names = [
            self._labels.classes.element_name(element.class_id, element.number)
            for element in elements
            if element.class_id in self._labels.classes
        ]
        if not names:
            return "a proposal"
        match row:
            case LabelElement():
                return names[0]
            case ReviewDecision():
                return f"the decision about {' and '.join(names)}"
            case Note():
                return f"a note on {names[0]}"
            case Attribute():
                return f"{row.name} of {names[0]}"
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
