"""Edits that delete observations and elements, with the rows that refer to them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Protocol

from pydantic import ConfigDict, Field

from semviz_annotation.labels.labels import Draft, Labels
from semviz_annotation.labels.rows import STRICT, Id, Row, RowChange, Rules


@dataclass(frozen=True)
class DeleteElement:
    """Delete an element with its observations and all that refers to it."""

    element_id: Id
    kind: Literal["delete element"] = "delete element"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        yield RowChange(labels.element(self.element_id), None)
        for row in labels.of_element(self.element_id):
            yield from deletions([row, labels.outline_of(row.id)])
        yield from _with_element(labels, self.element_id)


@dataclass(frozen=True)
class DeleteObservation:
    """Delete one observation; deleting the last one deletes its element."""

    observation_id: Id
    kind: Literal["delete"] = "delete"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        row = labels.observation(self.observation_id)
        yield from deletions([row, labels.outline_of(row.id)])
        if len(labels.of_element(row.element_id)) == 1:
            yield RowChange(labels.element(row.element_id), None)
            yield from _with_element(labels, row.element_id)


@dataclass(frozen=True)
class DeleteMany:
    """Delete several observations, all or none, each like ``DeleteObservation``."""

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    kind: Literal["delete many"] = "delete many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        yield from in_turn(map(DeleteObservation, self.observation_ids), labels, rules)


def _with_element(labels: Labels, element_id: str) -> Iterator[RowChange]:
    """Delete the dismissals, decisions, notes and attributes that refer to an element."""
    yield from deletions([*labels.dismissed_of(element_id), *labels.decisions_of(element_id)])
    yield from deletions([*labels.notes_of(element_id), *labels.attributes_of(element_id)])


def deletions(rows: Iterable[Row | None]) -> Iterator[RowChange]:
    """Delete those of ``rows`` that exist."""
    return (RowChange(row, None) for row in rows if row is not None)


class _OneEdit(Protocol):
    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]: ...


def in_turn(edits: Iterable[_OneEdit], labels: Labels, rules: Rules) -> Iterator[RowChange]:
    """Return the changes of ``edits``, each applied to the result of those before it."""
    draft = Draft(labels)
    for edit in edits:
        changes = tuple(edit.changes(draft.labels(), rules))
        draft.apply(changes)
        yield from changes
