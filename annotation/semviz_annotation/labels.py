"""Labels: what people said is where, as one immutable state.

A label element is the physical thing; an observation is that thing in one image. Left and right
image, and all frames, are paired by belonging to one element.
"""

import os
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias

from pydantic import ConfigDict, Discriminator, Field, Tag

from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

Id: TypeAlias = Annotated[
    str, Field(pattern=r"^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$")
]
Index: TypeAlias = Annotated[int, Field(ge=0, lt=2**31)]
Pixel: TypeAlias = tuple[float, float]
"""(u, v); (0, 0) is the centre of the top-left pixel."""
ReviewState: TypeAlias = Literal["unseen", "in work", "reviewed", "reviewed, empty"]

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)
"""How pydantic reads these values from JSON: nothing missing, nothing more, no conversions."""


def new_id() -> str:
    """A UUID of version 7: sortable by the millisecond of its making (RFC 9562, 5.7)."""
    milliseconds = time.time_ns() // 1_000_000
    value = (milliseconds & (2**48 - 1)) << 80 | int.from_bytes(os.urandom(10))
    value = value & ~(0xF << 76) | 7 << 76  # version
    value = value & ~(0b11 << 62) | 0b10 << 62  # variant
    return str(uuid.UUID(int=value))


@dataclass(frozen=True)
class LabelElement:
    """One physical pole or sign."""

    id: Id
    number: Annotated[int, Field(ge=1, lt=2**31)]
    """For people; unique in the workspace and never used again."""
    class_id: Index

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Observation:
    """An element in one image. An element has at most one in each image."""

    id: Id
    element_id: Id
    frame_index: Index
    side: Side
    anchor_px: Pixel
    """Peak of a pole, middle of a sign."""
    end_px: Pixel | None
    """Bottom of a pole; None for signs."""
    anchor_known: bool
    """False where the peak is cut off or hidden: ``anchor_px`` is then only on the line."""
    end_known: bool
    """False where the bottom is cut off or hidden, and for signs."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Review:
    """What a person said about a frame as a whole."""

    frame_index: Index
    state: Literal["in work", "reviewed", "reviewed, empty"]

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


Row: TypeAlias = LabelElement | Observation | Review
Key: TypeAlias = tuple[type[Row], str | int]


def _row_tag(row: object) -> str:
    """Which row it is, parsed or not, so that what is wrong in it is reported as of that row."""
    names = row if isinstance(row, dict) else vars(row) if isinstance(row, Row) else {}
    return "review" if "state" in names else "element" if "number" in names else "observation"


_Tagged: TypeAlias = Annotated[
    Annotated[LabelElement, Tag("element")]
    | Annotated[Observation, Tag("observation")]
    | Annotated[Review, Tag("review")],
    Discriminator(_row_tag),
]


@dataclass(frozen=True)
class Change:
    """One row before and after; None where it did not exist. Its inverse swaps the two."""

    before: _Tagged | None
    after: _Tagged | None

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def inverse(self) -> "Change":
        return Change(self.after, self.before)

    @property
    def key(self) -> Key:
        """The row's type and id."""
        row = self.before if self.after is None else self.after
        if row is None:
            raise SemvizError("a change has neither a row before nor one after")
        return row_key(row)


def row_key(row: Row) -> Key:
    """Type and id of a row."""
    return (Review, row.frame_index) if isinstance(row, Review) else (type(row), row.id)


class StereoPair(NamedTuple):
    """One element in both images of one frame."""

    element: LabelElement
    left: Observation
    right: Observation


@dataclass(frozen=True)
class Labels:
    """The whole current state. Equal where elements, observations and reviews are.

    Change it with ``changed``; the mappings are for reading.
    """

    elements: Mapping[str, LabelElement] = field(default_factory=dict)
    observations: Mapping[str, Observation] = field(default_factory=dict)
    reviews: Mapping[int, Review] = field(default_factory=dict)
    next_number: int = field(default=1, compare=False)
    """What the next new element is called. Only grows, also over undo."""
    operation: int = field(default=0, compare=False)
    """Number of the last durable operation in this state; 0 outside a store."""
    _in_frame: Mapping[int, tuple[str, ...]] = field(default_factory=dict, compare=False)
    _of_element: Mapping[str, tuple[str, ...]] = field(default_factory=dict, compare=False)

    @classmethod
    def from_rows(cls, rows: Iterable[Row], next_number: int = 1, operation: int = 0) -> "Labels":
        """From all rows, in any order; SemvizError where they do not hold together."""
        draft = Draft(cls(next_number=next_number, operation=operation))
        draft.fill(rows)
        return draft.labels()

    def changed(self, changes: Iterable[Change]) -> "Labels":
        """This state with ``changes`` applied.

        Raises SemvizError where a row is not as a change found it, or the result would not hold
        together (see ``Draft.apply``).
        """
        draft = Draft(self)
        draft.apply(changes)
        return draft.labels()

    def element(self, element_id: str) -> LabelElement:
        """Raises SemvizError where there is none."""
        try:
            return self.elements[element_id]
        except KeyError:
            raise SemvizError(f"no element {element_id}; it may have been deleted") from None

    def observation(self, observation_id: str) -> Observation:
        """Raises SemvizError where there is none."""
        try:
            return self.observations[observation_id]
        except KeyError:
            raise SemvizError(f"no observation {observation_id}; it may be deleted") from None

    def of_element(self, element_id: str) -> tuple[Observation, ...]:
        """An element's observations, oldest first; empty where there is no such element."""
        return tuple(self.observations[one] for one in sorted(self._of_element.get(element_id, ())))

    def in_frame(self, frame_index: int, side: Side | None = None) -> tuple[Observation, ...]:
        """What is labelled in a frame (in one image of it), oldest first."""
        rows = (self.observations[one] for one in sorted(self._in_frame.get(frame_index, ())))
        return tuple(row for row in rows if side is None or row.side == side)

    def find(self, element_id: str, frame_index: int, side: Side) -> Observation | None:
        """The observation of an element in one image, if there is one."""
        for row in self.of_element(element_id):
            if row.frame_index == frame_index and row.side == side:
                return row
        return None

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of frames with observations, ascending."""
        return tuple(sorted(self._in_frame))

    def pairs(self, frame_index: int) -> Iterator[StereoPair]:
        """The elements labelled in both images of a frame."""
        right = {row.element_id: row for row in self.in_frame(frame_index, "right")}
        for row in self.in_frame(frame_index, "left"):
            if row.element_id in right:
                yield StereoPair(self.element(row.element_id), row, right[row.element_id])

    def review(self, frame_index: int) -> ReviewState:
        """How far a frame is. A verdict that its labels have overtaken counts as in work."""
        has_labels = frame_index in self._in_frame
        said = self.reviews.get(frame_index)
        if said is None:
            return "in work" if has_labels else "unseen"
        overtaken = has_labels == (said.state == "reviewed, empty")
        return "in work" if overtaken else said.state


class Draft:
    """A state under change, copied once however many changes follow."""

    def __init__(self, labels: Labels) -> None:
        self._elements = dict(labels.elements)
        self._observations = dict(labels.observations)
        self._reviews = dict(labels.reviews)
        self.next_number = labels.next_number
        self._operation = labels.operation
        self._numbers = {row.number for row in labels.elements.values()}
        self._in_frame = dict(labels._in_frame)
        self._of_element = dict(labels._of_element)

    def apply(self, changes: Iterable[Change]) -> None:
        """Apply ``changes`` together; the draft must be thrown away where this raises.

        Raises SemvizError where a row is not as a change found it, or afterwards an element has
        no observation or two in one image, an observation no element, or a number is taken twice.
        """
        changes = tuple(changes)
        if len({change.key for change in changes}) < len(changes):
            raise SemvizError("one operation changes the same row twice")
        for change in changes:
            if self._row(change.key) != change.before:
                raise SemvizError(f"{self._name(change)} was changed by someone else meanwhile")
        for change in changes:
            self._remove(change)
        for change in changes:
            if change.after is not None:
                self._add(change.after)
        for element_id in {one for change in changes for one in _elements_of(change)}:
            self._check(element_id)

    def fill(self, rows: Iterable[Row]) -> None:
        """Add rows that are not there yet, in any order; as ``apply``, but faster."""
        for row in rows:
            self._add(row)
        for element_id in self._elements.keys() | self._of_element.keys():
            self._check(element_id)

    def labels(self) -> Labels:
        """The state as it is now; the draft is used up."""
        return Labels(
            self._elements,
            self._observations,
            self._reviews,
            self.next_number,
            self._operation,
            self._in_frame,
            self._of_element,
        )

    def class_of(self, row: Observation) -> int:
        """Class of an observation's element."""
        return self._elements[row.element_id].class_id

    def _row(self, key: Key) -> Row | None:
        kind, name = key
        if kind is Review:
            return self._reviews.get(int(name))
        if kind is Observation:
            return self._observations.get(str(name))
        return self._elements.get(str(name))

    def _remove(self, change: Change) -> None:
        row = change.before
        if isinstance(row, LabelElement):
            del self._elements[row.id]
            self._numbers.discard(row.number)
        elif isinstance(row, Observation):
            del self._observations[row.id]
            _discard(self._in_frame, row.frame_index, row.id)
            _discard(self._of_element, row.element_id, row.id)
        elif isinstance(row, Review):
            del self._reviews[row.frame_index]

    def _add(self, row: Row) -> None:
        if isinstance(row, LabelElement):
            if row.number in self._numbers:
                raise SemvizError(f"element number {row.number} is taken")
            self._numbers.add(row.number)
            self.next_number = max(self.next_number, row.number + 1)
            self._elements[row.id] = row
        elif isinstance(row, Observation):
            if row.end_px is None and row.end_known:
                raise SemvizError("an observation without an end has it marked as known")
            self._observations[row.id] = row
            self._in_frame[row.frame_index] = (*self._in_frame.get(row.frame_index, ()), row.id)
            self._of_element[row.element_id] = (*self._of_element.get(row.element_id, ()), row.id)
        else:
            self._reviews[row.frame_index] = row

    def _check(self, element_id: str) -> None:
        rows = [self._observations[one] for one in self._of_element.get(element_id, ())]
        if element_id not in self._elements:
            if rows:
                raise SemvizError("observations of others would be left without their element")
            return
        number = self._elements[element_id].number
        if not rows:
            raise SemvizError(f"element {number} would be left without observations")
        if len({(row.frame_index, row.side) for row in rows}) < len(rows):
            raise SemvizError(f"element {number} would have two observations in one image")

    def _name(self, change: Change) -> str:
        row = change.before or change.after
        if isinstance(row, Review):
            return f"the review of frame {row.frame_index}"
        element_id = row.element_id if isinstance(row, Observation) else str(change.key[1])
        element = self._elements.get(element_id)
        return f"element {element.number}" if element else "an element that is no longer there"


def _elements_of(change: Change) -> Iterator[str]:
    for row in (change.before, change.after):
        if isinstance(row, LabelElement):
            yield row.id
        elif isinstance(row, Observation):
            yield row.element_id


def _discard(index: dict[Any, tuple[str, ...]], key: object, row_id: str) -> None:
    rest = tuple(one for one in index[key] if one != row_id)
    if rest:
        index[key] = rest
    else:
        del index[key]
