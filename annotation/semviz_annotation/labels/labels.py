"""The whole label state as one immutable value.

Two states are equal if their rows are. A draft is a mutable copy that shares all unchanged parts
with its origin.
"""

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from semviz_annotation.labels.draft_tables import INDICES, TABLES, DraftTables
from semviz_annotation.labels.own_classes import class_set
from semviz_annotation.labels.rows import (
    STRICT,
    Attribute,
    AttributeType,
    ClassDeclaration,
    Dismissal,
    Id,
    ImportedOutline,
    Index,
    Key,
    LabelElement,
    Note,
    Observation,
    Pixel,
    Review,
    ReviewDecision,
    Row,
    RowChange,
    new_id,
    outline_id,
    proposal_id,
    row_elements,
    row_key,
)
from semviz_annotation.labels.shared_dict import SharedDict
from semviz_core.base.classes import OLDER_CENTER, ClassSet, TriangleCenter
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

__all__ = [
    "STRICT",
    "Dismissal",
    "Draft",
    "Id",
    "Index",
    "Key",
    "LabelElement",
    "Labels",
    "Note",
    "Observation",
    "Pixel",
    "Review",
    "ReviewDecision",
    "ReviewState",
    "Row",
    "RowChange",
    "StereoPair",
    "new_id",
    "proposal_id",
    "row_key",
]

ReviewState: TypeAlias = Literal["unseen", "in work", "reviewed", "reviewed, empty"]


class StereoPair(NamedTuple):
    """One element in both images of one frame."""

    element: LabelElement
    left: Observation
    right: Observation


@dataclass(frozen=True)
class Labels:
    """The whole label state. Do not modify the mappings: ``changed`` returns a new state."""

    elements: Mapping[str, LabelElement] = field(default_factory=dict)
    observations: Mapping[str, Observation] = field(default_factory=SharedDict)
    reviews: Mapping[int, Review] = field(default_factory=SharedDict)
    dismissals: Mapping[str, Dismissal] = field(default_factory=SharedDict)
    review_decisions: Mapping[str, ReviewDecision] = field(default_factory=SharedDict)
    notes: Mapping[str, Note] = field(default_factory=SharedDict)
    own_classes: Mapping[int, ClassDeclaration] = field(default_factory=SharedDict)
    attribute_types: Mapping[str, AttributeType] = field(default_factory=SharedDict)
    attributes: Mapping[str, Attribute] = field(default_factory=SharedDict)
    outlines: Mapping[str, ImportedOutline] = field(default_factory=SharedDict)
    next_number: int = field(default=1, compare=False)
    """Number of the next new element. It never decreases, not even by undo."""
    operation: int = field(default=0, compare=False)
    """Number of the last durable operation in this state; 0 outside a store."""
    triangle_center: TriangleCenter = field(default=OLDER_CENTER, compare=False)
    """What the point of a triangular sign is."""
    _numbered: Mapping[int, str] = field(default_factory=SharedDict, compare=False)
    _in_frame: Mapping[int, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _of_element: Mapping[str, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _dismissed_in: Mapping[int, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _dismissed_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _decisions_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _notes_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)
    _attributes_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharedDict, compare=False)

    @classmethod
    def from_rows(
        cls,
        rows: Iterable[Row],
        next_number: int = 1,
        operation: int = 0,
        triangle_center: TriangleCenter = OLDER_CENTER,
    ) -> "Labels":
        """Return the state of ``rows``, in any order. Raise SemvizError if inconsistent."""
        empty = cls(next_number=next_number, operation=operation, triangle_center=triangle_center)
        draft = Draft(empty, dict)
        draft.fill(rows)
        return draft.labels()

    def with_rows(self, rows: Iterable[Row]) -> "Labels":
        """Return a state of other rows, with the same counters and definitions."""
        return Labels.from_rows(rows, self.next_number, self.operation, self.triangle_center)

    def changed(self, changes: Iterable[RowChange]) -> "Labels":
        """Return this state with ``changes`` applied.

        Raise SemvizError if a row differs from a change's ``before``, or the result would be
        inconsistent (see ``Draft.apply``).
        """
        draft = Draft(self)
        draft.apply(changes)
        return draft.labels()

    def row(self, key: Key) -> Row | None:
        """Return the row of a type and id; None if there is none."""
        kind, name = key
        table: Mapping[Any, Row] = getattr(self, TABLES[kind])
        return table.get(name)

    def rows(self) -> Iterator[Row]:
        """Iterate over all rows, table by table."""
        return (row for name in TABLES.values() for row in getattr(self, name).values())

    @property
    def classes(self) -> ClassSet:
        """The classes of every workspace, and its own."""
        return class_set(tuple(self.own_classes.values()))

    def element(self, element_id: str) -> LabelElement:
        """Return an element. Raise SemvizError if it does not exist."""
        try:
            return self.elements[element_id]
        except KeyError:
            raise SemvizError(f"no element {element_id}; it may have been deleted") from None

    def observation(self, observation_id: str) -> Observation:
        """Return an observation. Raise SemvizError if it does not exist."""
        try:
            return self.observations[observation_id]
        except KeyError:
            raise SemvizError(f"no observation {observation_id}; it may be deleted") from None

    def of_element(self, element_id: str) -> tuple[Observation, ...]:
        """Return an element's observations by frame, left first; empty if it does not exist."""
        rows = (self.observations[row_id] for row_id in self._of_element.get(element_id, ()))
        return tuple(sorted(rows, key=lambda row: (row.frame_index, row.side)))

    def in_frame(self, frame_index: int, side: Side | None = None) -> tuple[Observation, ...]:
        """Return the observations in a frame, or in one image, by element number, left first."""
        rows = (self.observations[row_id] for row_id in self._in_frame.get(frame_index, ()))
        observations = (row for row in rows if side is None or row.side == side)
        return tuple(
            sorted(observations, key=lambda row: (self.elements[row.element_id].number, row.side))
        )

    def dismissed_in(self, frame_index: int) -> tuple[Dismissal, ...]:
        """Return the dismissals in a frame, by id."""
        return tuple(
            self.dismissals[row_id] for row_id in sorted(self._dismissed_in.get(frame_index, ()))
        )

    def dismissed_of(self, element_id: str) -> tuple[Dismissal, ...]:
        """Return the dismissals of an element that was expected in an image, by id."""
        return tuple(
            self.dismissals[row_id] for row_id in sorted(self._dismissed_of.get(element_id, ()))
        )

    def decisions_of(self, element_id: str) -> tuple[ReviewDecision, ...]:
        """Return the review decisions about an element, alone or with another, by id."""
        return tuple(
            self.review_decisions[row_id]
            for row_id in sorted(self._decisions_of.get(element_id, ()))
        )

    def notes_of(self, element_id: str) -> tuple[Note, ...]:
        """Return the notes about an element, by id: oldest first."""
        return tuple(self.notes[row_id] for row_id in sorted(self._notes_of.get(element_id, ())))

    def attributes_of(self, element_id: str) -> tuple[Attribute, ...]:
        """Return the attributes of an element, by name."""
        rows = (self.attributes[row_id] for row_id in self._attributes_of.get(element_id, ()))
        return tuple(sorted(rows, key=lambda row: row.name))

    def outline_of(self, observation_id: str) -> ImportedOutline | None:
        """Return the box or polygon that a label was imported with; None if there is none."""
        return self.outlines.get(outline_id(observation_id))

    def is_left_out(self, element_id: str) -> bool:
        """Return whether a person decided that an element belongs in no map."""
        row_ids = self._decisions_of.get(element_id, ())
        return any(self.review_decisions[row_id].verdict == "leave out" for row_id in row_ids)

    def without_left_out(self) -> "Labels":
        """Return the state without the elements that belong in no map; the same if there are none.

        For what uses labels as true elements: exports, observations, training.
        """
        decisions = self.review_decisions.values()
        left_out = {row.element_id for row in decisions if row.verdict == "leave out"}
        if not left_out:
            return self
        gone = {row.id for id_ in left_out for row in self.of_element(id_)}
        kept = (
            row
            for row in self.rows()
            if left_out.isdisjoint(row_elements(row))
            and not (isinstance(row, ImportedOutline) and row.observation_id in gone)
        )
        return self.with_rows(kept)

    def find(self, element_id: str, frame_index: int, side: Side) -> Observation | None:
        """Return the observation of an element in one image; None if there is none."""
        for row in self.of_element(element_id):
            if row.frame_index == frame_index and row.side == side:
                return row
        return None

    def has_landmarks(self, frame_index: int) -> bool:
        """Return whether an element that is not left out of maps is labelled in a frame."""
        rows = (self.observations[row_id] for row_id in self._in_frame.get(frame_index, ()))
        return any(not self.is_left_out(row.element_id) for row in rows)

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of frames with observations, ascending."""
        return tuple(sorted(self._in_frame))

    def pairs(self, frame_index: int) -> Iterator[StereoPair]:
        """Iterate over the elements labelled in both images of a frame."""
        right = {row.element_id: row for row in self.in_frame(frame_index, "right")}
        for row in self.in_frame(frame_index, "left"):
            if row.element_id in right:
                yield StereoPair(self.element(row.element_id), row, right[row.element_id])

    def differing(self, before: "Labels") -> set[str]:
        """Return the ids of elements whose labels, decisions, notes or attributes differ, and more.

        Rows are compared by identity: fast if one state comes from the other by ``changed``.
        """
        return set().union(
            SharedDict.of(self._of_element).differing(SharedDict.of(before._of_element)),
            SharedDict.of(self._decisions_of).differing(SharedDict.of(before._decisions_of)),
            SharedDict.of(self._notes_of).differing(SharedDict.of(before._notes_of)),
            SharedDict.of(self._attributes_of).differing(SharedDict.of(before._attributes_of)),
        )

    def review(self, frame_index: int) -> ReviewState:
        """Return the review state of a frame; "in work" if its labels contradict its review.

        Labels of elements that are left out of maps do not count: they show no landmark.
        """
        has_labels = self.has_landmarks(frame_index)
        review = self.reviews.get(frame_index)
        if review is None:
            return "in work" if has_labels else "unseen"
        contradicted = has_labels == (review.state == "reviewed, empty")
        return "in work" if contradicted else review.state


Table: TypeAlias = type[SharedDict[Any, Any]] | type[dict[Any, Any]]


class Draft(DraftTables):
    """A mutable copy of a state, which shares all unchanged parts with it.

    ``table`` is the mapping type of the copies: ``dict`` is faster if nearly all rows change.
    """

    def __init__(self, labels: Labels, table: Table = SharedDict) -> None:
        tables: dict[type[Row], MutableMapping[Any, Any]] = {
            kind: (dict if kind is LabelElement else table)(getattr(labels, name))
            for kind, name in TABLES.items()
        }
        super().__init__(
            tables,
            {name: table(getattr(labels, name)) for of in INDICES.values() for name in of},
            table(labels._numbered),
            labels.next_number,
        )
        self._operation = labels.operation
        self._triangle_center = labels.triangle_center

    def labels(self) -> Labels:
        """Return the present state, which is valid until the draft changes again."""
        tables: dict[str, Any] = {
            TABLES[kind]: rows if kind is LabelElement else SharedDict.of(rows)
            for kind, rows in self._tables.items()
        }
        indices: dict[str, Any] = {
            name: SharedDict.of(index) for name, index in self._indices.items()
        }
        return Labels(
            **tables,
            next_number=self.next_number,
            operation=self._operation,
            triangle_center=self._triangle_center,
            _numbered=SharedDict.of(self._numbered),
            **indices,
        )
