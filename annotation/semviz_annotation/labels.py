"""Labels: what people said is where, as one immutable state."""

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from semviz_annotation.rows import (
    STRICT,
    Change,
    Dismissal,
    Id,
    Index,
    Judgement,
    Key,
    LabelElement,
    Observation,
    Pixel,
    Review,
    Row,
    elements_of,
    judgement_id,
    new_id,
    proposal_id,
    row_key,
)
from semviz_annotation.sharing import SharingDict
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

__all__ = [
    "STRICT",
    "Change",
    "Dismissal",
    "Draft",
    "Id",
    "Index",
    "Judgement",
    "Key",
    "LabelElement",
    "Labels",
    "Observation",
    "Pixel",
    "Review",
    "ReviewState",
    "Row",
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
    """The whole current state. Equal where its rows are.

    Change it with ``changed``; the mappings are for reading.
    """

    elements: Mapping[str, LabelElement] = field(default_factory=dict)
    observations: Mapping[str, Observation] = field(default_factory=SharingDict)
    reviews: Mapping[int, Review] = field(default_factory=SharingDict)
    dismissals: Mapping[str, Dismissal] = field(default_factory=SharingDict)
    judgements: Mapping[str, Judgement] = field(default_factory=SharingDict)
    next_number: int = field(default=1, compare=False)
    """What the next new element is called. Only grows, also over undo."""
    operation: int = field(default=0, compare=False)
    """Number of the last durable operation in this state; 0 outside a store."""
    _numbered: Mapping[int, str] = field(default_factory=SharingDict, compare=False)
    _in_frame: Mapping[int, tuple[str, ...]] = field(default_factory=SharingDict, compare=False)
    _of_element: Mapping[str, tuple[str, ...]] = field(default_factory=SharingDict, compare=False)
    _dismissed_in: Mapping[int, tuple[str, ...]] = field(default_factory=SharingDict, compare=False)
    _dismissed_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharingDict, compare=False)
    _judged_of: Mapping[str, tuple[str, ...]] = field(default_factory=SharingDict, compare=False)

    @classmethod
    def from_rows(cls, rows: Iterable[Row], next_number: int = 1, operation: int = 0) -> "Labels":
        """From all rows, in any order; SemvizError where they do not hold together."""
        draft = Draft(cls(next_number=next_number, operation=operation), dict)
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

    def row(self, key: Key) -> Row | None:
        """The row of a type and id, if there is one."""
        kind, name = key
        return self._tables()[kind].get(name)

    def rows(self) -> Iterator[Row]:
        """All rows."""
        return (row for table in self._tables().values() for row in table.values())

    def _tables(self) -> dict[type[Row], Mapping[Any, Row]]:
        return {
            LabelElement: self.elements,
            Observation: self.observations,
            Review: self.reviews,
            Dismissal: self.dismissals,
            Judgement: self.judgements,
        }

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
        """An element's observations by frame, left first; empty where it does not exist."""
        rows = (self.observations[one] for one in self._of_element.get(element_id, ()))
        return tuple(sorted(rows, key=lambda row: (row.frame_index, row.side)))

    def in_frame(self, frame_index: int, side: Side | None = None) -> tuple[Observation, ...]:
        """What is labelled in a frame (in one image of it), by element number, left first."""
        rows = (self.observations[one] for one in self._in_frame.get(frame_index, ()))
        seen = (row for row in rows if side is None or row.side == side)
        return tuple(sorted(seen, key=lambda row: (self.elements[row.element_id].number, row.side)))

    def dismissed_in(self, frame_index: int) -> tuple[Dismissal, ...]:
        """What was turned down in a frame, by id."""
        return tuple(
            self.dismissals[one] for one in sorted(self._dismissed_in.get(frame_index, ()))
        )

    def dismissed_of(self, element_id: str) -> tuple[Dismissal, ...]:
        """Where an element was expected and turned down, by id."""
        return tuple(self.dismissals[one] for one in sorted(self._dismissed_of.get(element_id, ())))

    def judgements_of(self, element_id: str) -> tuple[Judgement, ...]:
        """What was decided about an element, alone or with another, by id."""
        return tuple(self.judgements[one] for one in sorted(self._judged_of.get(element_id, ())))

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

    def differing(self, before: "Labels") -> set[str]:
        """Ids of all elements, here or there, whose observations or judgements differ; perhaps of a
        few more.

        Quick where one state comes from the other by ``changed``: nothing is compared by value.
        """
        return set().union(
            SharingDict.of(self._of_element).differing(SharingDict.of(before._of_element)),
            SharingDict.of(self._judged_of).differing(SharingDict.of(before._judged_of)),
        )

    def review(self, frame_index: int) -> ReviewState:
        """How far a frame is. A verdict that its labels have overtaken counts as in work."""
        has_labels = frame_index in self._in_frame
        said = self.reviews.get(frame_index)
        if said is None:
            return "in work" if has_labels else "unseen"
        overtaken = has_labels == (said.state == "reviewed, empty")
        return "in work" if overtaken else said.state


Table: TypeAlias = type[SharingDict[Any, Any]] | type[dict[Any, Any]]


class Draft:
    """A state under change, which shares with the one it comes from what stays as it was.

    Where nearly all will change, ``dict`` as its ``table`` is quicker.
    """

    def __init__(self, labels: Labels, table: Table = SharingDict) -> None:
        self._elements = dict(labels.elements)
        self._observations = table(labels.observations)
        self._reviews = table(labels.reviews)
        self._dismissals = table(labels.dismissals)
        self._judgements = table(labels.judgements)
        self.next_number = labels.next_number
        self._operation = labels.operation
        self._numbered = table(labels._numbered)
        self._in_frame = table(labels._in_frame)
        self._of_element = table(labels._of_element)
        self._dismissed_in = table(labels._dismissed_in)
        self._dismissed_of = table(labels._dismissed_of)
        self._judged_of = table(labels._judged_of)

    def apply(self, changes: Iterable[Change]) -> None:
        """Apply ``changes`` together; the draft must be thrown away where this raises.

        Raises SemvizError where a row is not as a change found it, or afterwards an element has
        no observation or two in one image, another row no element, or a number is taken twice.
        """
        changes = tuple(changes)
        if len({change.key for change in changes}) < len(changes):
            raise SemvizError("one operation changes the same row twice")
        tables: dict[type[Row], Mapping[Any, Row]] = {
            LabelElement: self._elements,
            Observation: self._observations,
            Review: self._reviews,
            Dismissal: self._dismissals,
            Judgement: self._judgements,
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
        for element_id in {one for row in rows for one in elements_of(row)}:
            self._check(element_id)

    def fill(self, rows: Iterable[Row]) -> None:
        """Add rows that are not there yet, in any order; as ``apply``, but faster."""
        for row in rows:
            self._add(row)
        indices = (self._of_element, self._dismissed_of, self._judged_of)
        for element_id in self._elements.keys() | {one for index in indices for one in index}:
            self._check(element_id)

    def labels(self) -> Labels:
        """The state as it is now; it holds until the draft is changed again."""
        return Labels(
            self._elements,
            SharingDict.of(self._observations),
            SharingDict.of(self._reviews),
            SharingDict.of(self._dismissals),
            SharingDict.of(self._judgements),
            self.next_number,
            self._operation,
            SharingDict.of(self._numbered),
            SharingDict.of(self._in_frame),
            SharingDict.of(self._of_element),
            SharingDict.of(self._dismissed_in),
            SharingDict.of(self._dismissed_of),
            SharingDict.of(self._judged_of),
        )

    def class_of(self, row: Observation) -> int:
        """Class of an observation's element."""
        return self._elements[row.element_id].class_id

    def _remove(self, change: Change) -> None:
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
        elif isinstance(row, Judgement):
            del self._judgements[row.id]
            for element_id in elements_of(row):
                _discard(self._judged_of, element_id, row.id)

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
        elif isinstance(row, Judgement):
            _check_judgement(row)
            self._judgements[row.id] = row
            for element_id in elements_of(row):
                _include(self._judged_of, element_id, row.id)
        else:
            self._reviews[row.frame_index] = row

    def _check(self, element_id: str) -> None:
        rows = [self._observations[one] for one in self._of_element.get(element_id, ())]
        if element_id not in self._elements:
            if rows:
                raise SemvizError("observations of others would be left without their element")
            if element_id in self._dismissed_of:
                raise SemvizError("something turned down would be left without its element")
            if element_id in self._judged_of:
                raise SemvizError("what was decided for the map would be left without its element")
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
        if isinstance(row, Dismissal):
            return f"what was turned down in frame {row.frame_index}"
        names = [
            f"element {self._elements[one].number}"
            for one in elements_of(row)
            if one in self._elements
        ]
        if isinstance(row, Judgement):
            return f"what was decided about {' and '.join(names) or 'elements that are gone'}"
        return names[0] if names else "an element that is no longer there"


def _check_judgement(row: Judgement) -> None:
    first, *more = elements_of(row)
    if bool(more) != (row.verdict == "apart") or any(first >= one for one in more):
        raise SemvizError("two elements are apart, smaller id first; other verdicts are about one")
    if row.id != judgement_id(row.element_id, row.other_id):
        raise SemvizError("this is not the id of a judgement about these elements")


def _include(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: str) -> None:
    index[key] = (*index.get(key, ()), row_id)


def _discard(index: MutableMapping[Any, tuple[str, ...]], key: object, row_id: str) -> None:
    rest = tuple(one for one in index[key] if one != row_id)
    if rest:
        index[key] = rest
    else:
        del index[key]
