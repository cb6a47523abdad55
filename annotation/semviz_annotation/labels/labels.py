"""The whole label state as one immutable value.

Two states are equal if their rows are. A draft is a mutable copy that shares all unchanged parts
with its origin.
"""

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from semviz_annotation.labels.rows import (
    STRICT,
    Dismissal,
    Id,
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
    SharedDict,
    check_decision,
    new_id,
    proposal_id,
    row_elements,
    row_key,
)
from semviz_core.base.classes import OLDER_CENTER, TriangleCenter
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
        return self._tables()[kind].get(name)

    def rows(self) -> Iterator[Row]:
        """Iterate over all rows, table by table."""
        return (row for table in self._tables().values() for row in table.values())

    def _tables(self) -> dict[type[Row], Mapping[Any, Row]]:
        return {
            LabelElement: self.elements,
            Observation: self.observations,
            Review: self.reviews,
            Dismissal: self.dismissals,
            ReviewDecision: self.review_decisions,
            Note: self.notes,
        }

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
        kept = (row for row in self.rows() if left_out.isdisjoint(row_elements(row)))
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
        """Return the ids of elements whose observations, decisions or notes differ, perhaps more.

        Rows are compared by identity: fast if one state comes from the other by ``changed``.
        """
        return set().union(
            SharedDict.of(self._of_element).differing(SharedDict.of(before._of_element)),
            SharedDict.of(self._decisions_of).differing(SharedDict.of(before._decisions_of)),
            SharedDict.of(self._notes_of).differing(SharedDict.of(before._notes_of)),
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


class Draft:
    """A mutable copy of a state, which shares all unchanged parts with it.

    ``table`` is the mapping type of the copies: ``dict`` is faster if nearly all rows change.
    """

    def __init__(self, labels: Labels, table: Table = SharedDict) -> None:
        self._elements = dict(labels.elements)
        self._observations = table(labels.observations)
        self._reviews = table(labels.reviews)
        self._dismissals = table(labels.dismissals)
        self._review_decisions = table(labels.review_decisions)
        self._notes = table(labels.notes)
        self.next_number = labels.next_number
        self._operation = labels.operation
        self._triangle_center = labels.triangle_center
        self._numbered = table(labels._numbered)
        self._in_frame = table(labels._in_frame)
        self._of_element = table(labels._of_element)
        self._dismissed_in = table(labels._dismissed_in)
        self._dismissed_of = table(labels._dismissed_of)
        self._decisions_of = table(labels._decisions_of)
        self._notes_of = table(labels._notes_of)

    def apply(self, changes: Iterable[RowChange]) -> None:
        """Apply ``changes`` together. Discard the draft if this raises.

        Raise SemvizError if a row differs from a change's ``before``, an element would have no
        observation or two in one image, a row would refer to no element, or a number is taken.
        """
        changes = tuple(changes)
        if len({change.key for change in changes}) < len(changes):
            raise SemvizError("one operation changes the same row twice")
        tables: dict[type[Row], Mapping[Any, Row]] = {
            LabelElement: self._elements,
            Observation: self._observations,
            Review: self._reviews,
            Dismissal: self._dismissals,
            ReviewDecision: self._review_decisions,
            Note: self._notes,
        }
        for change in changes:
            kind, name = change.key
            if tables[kind].get(name) != change.before:
                raise SemvizError(f"{self._name(change)} was changed by someone else meanwhile")
        for change in changes:
            self._remove(change)
        for change in changes:
            if change.after is not None:
                self._add(change.after)
        rows = (row for change in changes for row in (change.before, change.after))
        for element_id in {element for row in rows for element in row_elements(row)}:
            self._check(element_id)

    def fill(self, rows: Iterable[Row]) -> None:
        """Add new rows, in any order; same result as ``apply``, but faster."""
        for row in rows:
            self._add(row)
        indices = (self._of_element, self._dismissed_of, self._decisions_of, self._notes_of)
        for element_id in self._elements.keys() | {
            element_id for index in indices for element_id in index
        }:
            self._check(element_id)

    def labels(self) -> Labels:
        """Return the present state, which is valid until the draft changes again."""
        return Labels(
            self._elements,
            SharedDict.of(self._observations),
            SharedDict.of(self._reviews),
            SharedDict.of(self._dismissals),
            SharedDict.of(self._review_decisions),
            SharedDict.of(self._notes),
            self.next_number,
            self._operation,
            self._triangle_center,
            SharedDict.of(self._numbered),
            SharedDict.of(self._in_frame),
            SharedDict.of(self._of_element),
            SharedDict.of(self._dismissed_in),
            SharedDict.of(self._dismissed_of),
            SharedDict.of(self._decisions_of),
            SharedDict.of(self._notes_of),
        )

    def class_of(self, row: Observation) -> int:
        """Return the class id of an observation's element."""
        return self._elements[row.element_id].class_id

    def _remove(self, change: RowChange) -> None:
        row = change.before
        if isinstance(row, LabelElement):
            del self._elements[row.id]
            del self._numbered[row.number]
        elif isinstance(row, Observation):
            del self._observations[row.id]
            _discard(self._in_frame, row.frame_index, row.id)
            _discard(self._of_element, row.element_id, row.id)
        elif isinstance(row, Review):
            del self._reviews[row.frame_index]
        elif isinstance(row, Dismissal):
            del self._dismissals[row.id]
            _discard(self._dismissed_in, row.frame_index, row.id)
            if row.element_id is not None:
                _discard(self._dismissed_of, row.element_id, row.id)
        elif isinstance(row, ReviewDecision):
            del self._review_decisions[row.id]
            for element_id in row_elements(row):
                _discard(self._decisions_of, element_id, row.id)
        elif isinstance(row, Note):
            del self._notes[row.id]
            _discard(self._notes_of, row.element_id, row.id)

    def _add(self, row: Row) -> None:
        if isinstance(row, LabelElement):
            if row.number in self._numbered:
                raise SemvizError(f"element number {row.number} is taken")
            self._numbered[row.number] = row.id
            self.next_number = max(self.next_number, row.number + 1)
            self._elements[row.id] = row
        elif isinstance(row, Observation):
            if row.end_px is None and row.end_known:
                raise SemvizError("an observation without an end has it marked as known")
            self._observations[row.id] = row
            _include(self._in_frame, row.frame_index, row.id)
            _include(self._of_element, row.element_id, row.id)
        elif isinstance(row, Dismissal):
            self._dismissals[row.id] = row
            _include(self._dismissed_in, row.frame_index, row.id)
            if row.element_id is not None:
                _include(self._dismissed_of, row.element_id, row.id)
        elif isinstance(row, ReviewDecision):
            check_decision(row)
            self._review_decisions[row.id] = row
            for element_id in row_elements(row):
                _include(self._decisions_of, element_id, row.id)
        elif isinstance(row, Note):
            if not row.text and not row.unsure:
                raise SemvizError("a note has a text, or says that its element is unsure")
            self._notes[row.id] = row
            _include(self._notes_of, row.element_id, row.id)
        else:
            self._reviews[row.frame_index] = row

    def _check(self, element_id: str) -> None:
        rows = [self._observations[row_id] for row_id in self._of_element.get(element_id, ())]
        if element_id not in self._elements:
            if rows:
                raise SemvizError("some observations would be left without their element")
            if element_id in self._dismissed_of:
                raise SemvizError("a dismissal would be left without its element")
            if element_id in self._decisions_of:
                raise SemvizError("a decision for the map would be left without its element")
            if element_id in self._notes_of:
                raise SemvizError("a note would be left without its element")
            return
        number = self._elements[element_id].number
        if not rows:
            raise SemvizError(f"element {number} would be left without observations")
        if len({(row.frame_index, row.side) for row in rows}) < len(rows):
            raise SemvizError(f"element {number} would have two observations in one image")

    def _name(self, change: RowChange) -> str:
        row = change.before or change.after
        if isinstance(row, Review):
            return f"the review of frame {row.frame_index}"
        if isinstance(row, Dismissal):
            return f"a dismissal in frame {row.frame_index}"
        names = [
            f"element {self._elements[element].number}"
            for element in row_elements(row)
            if element in self._elements
        ]
        if isinstance(row, ReviewDecision):
            return f"the decision about {' and '.join(names) or 'deleted elements'}"
        if isinstance(row, Note):
            return f"a note on {' and '.join(names) or 'a deleted element'}"
        return names[0] if names else "a deleted element"


def _include(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: str) -> None:
    index[key] = (*index.get(key, ()), row_id)


def _discard(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: str) -> None:
    remaining = tuple(existing_id for existing_id in index[key] if existing_id != row_id)
    if remaining:
        index[key] = remaining
    else:
        del index[key]
