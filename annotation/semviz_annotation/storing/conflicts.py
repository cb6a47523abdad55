"""Who wrote what since: the words for edits that others have overtaken."""

import sqlite3
from collections.abc import Iterable

from semviz_annotation.labels import Labels
from semviz_annotation.rows import (
    Change,
    Judgement,
    Key,
    LabelElement,
    Observation,
    Review,
    Row,
    elements_of,
    row_key,
)
from semviz_annotation.storing.operations import ConflictError, Operation, Writer
from semviz_annotation.storing.tables import first_of_human, last_writer, read_operations
from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError


class Witness:
    """Looks at the state and the log of one moment."""

    def __init__(self, connection: sqlite3.Connection, labels: Labels, classes: ClassSet) -> None:
        self._connection = connection
        self._labels = labels
        self._classes = classes

    def check_seen(self, seen: Observation) -> None:
        """Raises ConflictError where an observation is no longer as ``seen``."""
        current = self._labels.observations.get(seen.id)
        if current == seen:
            return
        writer = last_writer(self._connection, [(Observation, seen.id)])
        raise ConflictError(f"{self._what_happened(seen, writer)}; keep yours or theirs", current)

    def check_machine(self, changes: Iterable[Change]) -> None:
        """Raises SemvizError where one of the rows was ever written by a human."""
        touched = {change.key: change.before or change.after for change in changes}
        key = first_of_human(self._connection, touched)
        row = None if key is None else touched[key]
        if row is not None:
            raise SemvizError(f"{self._name(row)} is a person's work; no machine may change it")

    def misfit(self, changes: tuple[Change, ...], since: Operation) -> str | None:
        """Why ``changes``, which take ``since`` back or do it once more, no longer fit."""
        overtaken = {
            change.key: change.before or change.after
            for change in changes
            if self._labels.row(change.key) != change.before
        }
        if not overtaken:
            try:
                self._labels.changed(changes)
            except SemvizError as error:
                overtaken = self._beside(changes, since)
                if not overtaken:
                    return str(error)
            else:
                return None
        writer = last_writer(self._connection, overtaken)
        last = [key for key in overtaken if last_writer(self._connection, [key]) == writer]
        row = overtaken[last[0]]
        return "it was never done" if row is None else self._what_happened(row, writer)

    def _beside(self, changes: tuple[Change, ...], since: Operation) -> dict[Key, Row | None]:
        """What was written since beside the rows of ``changes``, of the same elements."""
        found: dict[Key, Row | None] = {}
        changed = {change.key for change in changes}
        about = (elements_of(change.before or change.after) for change in changes)
        for element_id in sorted({one for ids in about for one in ids}):
            rows: list[Row] = [*self._labels.of_element(element_id)]
            rows += self._labels.dismissed_of(element_id)
            rows += self._labels.judgements_of(element_id)
            for row in rows:
                key = row_key(row)
                writer = last_writer(self._connection, [key])
                if key not in changed and writer and writer.number > since.number:
                    found[key] = row
        return found

    def _what_happened(self, row: Row, writer: Writer | None) -> str:
        if writer is None:
            return f"{self._name(row)} is not in the log"
        return (
            f"{writer.author} changed {self._name(row)} since "
            f"(operation {writer.number}, {writer.kind})"
        )

    def _name(self, row: Row) -> str:
        if isinstance(row, Review):
            return f"the review of frame {row.frame_index}"
        elements = [one for one in map(self._element, elements_of(row)) if one is not None]
        names = [self._classes.element_name(one.class_id, one.number) for one in elements]
        if not names:
            return "a proposal"
        match row:
            case LabelElement():
                return names[0]
            case Judgement():
                return f"what was decided about {' and '.join(names)}"
        return f"{names[0]} in the {row.side} image of frame {row.frame_index}"

    def _element(self, element_id: str) -> LabelElement | None:
        """An element as it is, or was before it was deleted."""
        if element_id in self._labels.elements:
            return self._labels.elements[element_id]
        writer = last_writer(self._connection, [(LabelElement, element_id)])
        if writer is None:
            return None
        (operation,) = read_operations(self._connection, writer.number - 1, limit=1)
        rows = (row for one in operation.changes for row in (one.before, one.after))
        return next(row for row in rows if isinstance(row, LabelElement) and row.id == element_id)
