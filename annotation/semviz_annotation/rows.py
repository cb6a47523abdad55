"""The rows that labels are made of, and a change of one row.

A label element is the physical thing; an observation is that thing in one image. Left and right
image, and all frames, are paired by belonging to one element.
"""

import hashlib
import os
import re
import time
import uuid
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Discriminator, Field, Tag

from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

_ID = r"^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$"
Id: TypeAlias = Annotated[str, Field(pattern=_ID)]
Index: TypeAlias = Annotated[int, Field(ge=0, lt=2**31)]
Pixel: TypeAlias = tuple[float, float]
"""(u, v); (0, 0) is the centre of the top-left pixel."""
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)
"""How pydantic reads these values from JSON: nothing missing, nothing more, no conversions."""


def new_id() -> str:
    """A UUID of version 7: sortable by the millisecond of its making (RFC 9562, 5.7)."""
    milliseconds = time.time_ns() // 1_000_000
    value = (milliseconds & (2**48 - 1)) << 80 | int.from_bytes(os.urandom(10))
    return _uuid(value, 7)


def proposal_id(element_id: str, frame_index: int, side: Side) -> str:
    """Id of the proposal "this element is seen in this image": always the same."""
    return derived_id(f"{element_id} {frame_index} {side}")


def derived_id(text: str) -> str:
    """A UUID of version 8 (RFC 9562, 5.8), from the SHA-256 of ``text``."""
    digest = hashlib.sha256(text.encode()).digest()
    return _uuid(int.from_bytes(digest[:16]), 8)


def is_id(text: str) -> bool:
    """Whether ``text`` is an id as ours are written."""
    return re.fullmatch(_ID, text) is not None


def _uuid(value: int, version: int) -> str:
    value = value & ~(0xF << 76) | version << 76
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


@dataclass(frozen=True)
class Dismissal:
    """A proposal that a person turned down in one image."""

    id: Id
    """Of the proposal; ``proposal_id`` where an element was expected."""
    frame_index: Index
    side: Side
    why: Literal["rejected", "occluded", "absent"]
    element_id: Id | None
    """The element that was expected; None for a detector's proposal."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Judgement:
    """What a person decided about one label element or two; every map that is built honours it."""

    id: Id
    """``judgement_id`` of the elements: there is one judgement about them, or none."""
    verdict: Literal["apart", "keep", "leave out"]
    """``apart``: they are two things; ``keep``: it is one thing, with all its observations;
    ``leave out``: it does not belong in a map."""
    element_id: Id
    other_id: Id | None
    """The second element where they are ``apart``, None otherwise; ``element_id < other_id``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


def apart(element_id: str, other_id: str) -> Judgement:
    """The judgement that two elements are two things."""
    first, second = sorted((element_id, other_id))
    return Judgement(judgement_id(first, second), "apart", first, second)


def judged(element_id: str, verdict: Literal["keep", "leave out"]) -> Judgement:
    """A judgement about one element."""
    return Judgement(judgement_id(element_id), verdict, element_id, None)


def judgement_id(element_id: str, other_id: str | None = None) -> str:
    """Id of the judgement about one element or two: always the same."""
    ids = sorted(one for one in (element_id, other_id) if one is not None)
    return derived_id(" ".join(["judgement", *ids]))


Row: TypeAlias = LabelElement | Observation | Review | Dismissal | Judgement
Key: TypeAlias = tuple[type[Row], str | int]
TAGS: dict[type[Row], str] = {
    LabelElement: "element",
    Observation: "observation",
    Review: "review",
    Dismissal: "dismissal",
    Judgement: "judgement",
}


def _row_tag(row: object) -> str:
    """Which row it is, parsed or not, so that what is wrong in it is reported as of that row."""
    names = row if isinstance(row, dict) else vars(row) if isinstance(row, Row) else {}
    marks = {"state": "review", "number": "element", "why": "dismissal", "verdict": "judgement"}
    return next((tag for name, tag in marks.items() if name in names), "observation")


_Tagged: TypeAlias = Annotated[
    Annotated[LabelElement, Tag("element")]
    | Annotated[Observation, Tag("observation")]
    | Annotated[Review, Tag("review")]
    | Annotated[Dismissal, Tag("dismissal")]
    | Annotated[Judgement, Tag("judgement")],
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


def elements_of(row: Row | None) -> tuple[str, ...]:
    """Ids of the elements that a row is about."""
    match row:
        case LabelElement():
            return (row.id,)
        case Observation():
            return (row.element_id,)
        case Judgement():
            return (row.element_id,) if row.other_id is None else (row.element_id, row.other_id)
        case Dismissal() if row.element_id is not None:
            return (row.element_id,)
    return ()
