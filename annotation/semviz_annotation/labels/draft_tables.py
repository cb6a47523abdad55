"""The rows of a label state that changes: tables, their indices, and what must hold of them."""

from collections.abc import Callable, Iterable, Mapping, MutableMapping
from typing import Any

from semviz_annotation.labels.own_classes import class_set
from semviz_annotation.labels.rows import (
    Attribute,
    AttributeType,
    ClassDeclaration,
    Dismissal,
    ImportedOutline,
    LabelElement,
    Note,
    Observation,
    Review,
    ReviewDecision,
    Row,
    RowChange,
    check_decision,
    outline_id,
    row_elements,
    row_key,
)
from semviz_core.base.classes import ClassSet
from semviz_core.common.errors import SemvizError

TABLES: Mapping[type[Row], str] = {
    LabelElement: "elements",
    Observation: "observations",
    Review: "reviews",
    Dismissal: "dismissals",
    ReviewDecision: "review_decisions",
    Note: "notes",
    ClassDeclaration: "own_classes",
    AttributeType: "attribute_types",
    Attribute: "attributes",
    ImportedOutline: "outlines",
}
"""The mapping of ``Labels`` that holds the rows of a type."""


def _frame(row: Any) -> tuple[int]:
    return (row.frame_index,)


INDICES: Mapping[type[Row], Mapping[str, Callable[[Any], tuple[Any, ...]]]] = {
    Observation: {"_in_frame": _frame, "_of_element": row_elements},
    Dismissal: {"_dismissed_in": _frame, "_dismissed_of": row_elements},
    ReviewDecision: {"_decisions_of": row_elements},
    Note: {"_notes_of": row_elements},
    Attribute: {"_attributes_of": row_elements},
}
"""The indices of ``Labels`` over the rows of a type, and under which keys a row is in them."""
_OF_ELEMENTS = {
    "_of_element": "some observations",
    "_dismissed_of": "a dismissal",
    "_decisions_of": "a decision for the map",
    "_notes_of": "a note",
    "_attributes_of": "an attribute",
}
"""The indices by element, and what is in them."""


class DraftTables:
    """Tables by type of row, which change together."""

    def __init__(
        self,
        tables: dict[type[Row], MutableMapping[Any, Any]],
        indices: dict[str, MutableMapping[Any, tuple[str, ...]]],
        numbered: MutableMapping[int, str],
        next_number: int,
    ) -> None:
        self._tables = tables
        self._indices = indices
        self._numbered = numbered
        """Ids of elements, by number."""
        self.next_number = next_number

    @property
    def _elements(self) -> MutableMapping[str, LabelElement]:
        return self._tables[LabelElement]

    def apply(self, changes: Iterable[RowChange]) -> None:
        """Apply ``changes`` together. Discard the draft if this raises.

        Raise SemvizError if a row differs from a change's ``before``, an element would have no
        observation or two in one image, a row would refer to no element, or a number is taken.
        """
        changes = tuple(changes)
        if len({change.key for change in changes}) < len(changes):
            raise SemvizError("one operation changes the same row twice")
        for change in changes:
            kind, name = change.key
            if self._tables[kind].get(name) != change.before:
                raise SemvizError(f"{self._name(change)} was changed by someone else meanwhile")
        for change in changes:
            if change.before is not None:
                self._remove(change.before)
        for change in changes:
            if change.after is not None:
                self._add(change.after)
        rows = [row for change in changes for row in (change.before, change.after)]
        for element_id in {element for row in rows for element in row_elements(row)}:
            self._check(element_id)
        for row in rows:
            if isinstance(row, Observation | ImportedOutline):
                self._check_outline(row)
        if any(isinstance(row, ClassDeclaration) for row in rows):
            self._check_own_classes(changes)

    def fill(self, rows: Iterable[Row]) -> None:
        """Add new rows, in any order; same result as ``apply``, but faster."""
        for row in rows:
            self._add(row)
        for element_id in self._elements.keys() | {
            element_id for name in _OF_ELEMENTS for element_id in self._indices[name]
        }:
            self._check(element_id)
        for outline in self._tables[ImportedOutline].values():
            self._check_outline(outline)

    def class_of(self, row: Observation) -> int:
        """Return the class id of an observation's element."""
        return self._elements[row.element_id].class_id

    @property
    def classes(self) -> ClassSet:
        return class_set(tuple(self._tables[ClassDeclaration].values()))

    def _remove(self, row: Row) -> None:
        kind, name = row_key(row)
        del self._tables[kind][name]
        if isinstance(row, LabelElement):
            del self._numbered[row.number]
        for index, keys in INDICES.get(kind, {}).items():
            for key in keys(row):
                _discard(self._indices[index], key, row_key(row)[1])

    def _add(self, row: Row) -> None:
        match row:
            case LabelElement():
                if row.number in self._numbered:
                    raise SemvizError(f"element number {row.number} is taken")
                self._numbered[row.number] = row.id
                self.next_number = max(self.next_number, row.number + 1)
            case Observation() if row.end_px is None and row.end_known:
                raise SemvizError("an observation without an end has it marked as known")
            case ReviewDecision():
                check_decision(row)
            case Note() if not row.text and not row.unsure:
                raise SemvizError("a note has a text, or says that its element is unsure")
        kind, name = row_key(row)
        self._tables[kind][name] = row
        for index, keys in INDICES.get(kind, {}).items():
            for key in keys(row):
                _include(self._indices[index], key, name)

    def _check(self, element_id: str) -> None:
        if element_id not in self._elements:
            for name, what in _OF_ELEMENTS.items():
                if element_id in self._indices[name]:
                    raise SemvizError(f"{what} would be left without the element")
            return
        row_ids = self._indices["_of_element"].get(element_id, ())
        rows = [self._tables[Observation][row_id] for row_id in row_ids]
        number = self._elements[element_id].number
        if not rows:
            raise SemvizError(f"element {number} would be left without observations")
        if len({(row.frame_index, row.side) for row in rows}) < len(rows):
            raise SemvizError(f"element {number} would have two observations in one image")

    def _check_outline(self, row: Observation | ImportedOutline) -> None:
        """Raise SemvizError if an outline would be left without its observation."""
        observation_id = row.observation_id if isinstance(row, ImportedOutline) else row.id
        if observation_id not in self._tables[Observation] and (
            outline_id(observation_id) in self._tables[ImportedOutline]
        ):
            raise SemvizError("an outline would be left without its label")

    def _check_own_classes(self, changes: Iterable[RowChange]) -> None:
        """Raise SemvizError if two classes would have one name, or a removed one has elements."""
        known = self.classes
        for change in changes:
            row = change.before
            if isinstance(row, ClassDeclaration) and row.id not in known:
                used = sum(element.class_id == row.id for element in self._elements.values())
                if used:
                    raise SemvizError(f"{used} elements are of the class {row.name}")

    def _name(self, change: RowChange) -> str:
        row = change.before or change.after
        match row:
            case Review():
                return f"the review of frame {row.frame_index}"
            case Dismissal():
                return f"a dismissal in frame {row.frame_index}"
            case ClassDeclaration() | AttributeType():
                return f"the declaration of {row.name}"
        names = [
            f"element {self._elements[element].number}"
            for element in row_elements(row)
            if element in self._elements
        ]
        match row:
            case ReviewDecision():
                return f"the decision about {' and '.join(names) or 'deleted elements'}"
            case Note():
                return f"a note on {' and '.join(names) or 'a deleted element'}"
            case Attribute():
                return f"{row.name} of {' and '.join(names) or 'a deleted element'}"
        return names[0] if names else "a deleted element"


def _include(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: Any) -> None:
    index[key] = (*index.get(key, ()), row_id)


def _discard(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: object) -> None:
    remaining = tuple(existing_id for existing_id in index[key] if existing_id != row_id)
    if remaining:
        index[key] = remaining
    else:
        del index[key]
