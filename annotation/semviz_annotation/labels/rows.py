"""The rows of the label state, changes and rules of a row.

A label element is one physical pole or sign; an observation is that element in one image. Left
and right image, and all frames, are paired by belonging to one element. Ids are UUIDs of
version 7 (RFC 9562, 5.7), or of version 8 where they are derived from content (SHA-256). An
observation must be of a known class, have that class's shape, and lie inside its image.

Fields are hashed with each operation of the log, so they never change: what is new is a row of a
new type.
"""

import hashlib
import os
import re
import time
import uuid
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, Tag

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, ClassShape
from semviz_core.base.classes import Kind as ClassKind
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

_ID = r"^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$"
Id: TypeAlias = Annotated[str, Field(pattern=_ID)]
Index: TypeAlias = Annotated[int, Field(ge=0, lt=2**31)]
MAX_NOTE_LENGTH = 500
"""Characters of a note."""
Pixel: TypeAlias = tuple[float, float]
"""(u, v); (0, 0) is the centre of the top-left pixel."""
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)
"""Pydantic settings for reading JSON: no missing or extra fields, no conversions."""


def new_id() -> str:
    """Return a new UUID of version 7: ids sort by creation time in ms (RFC 9562, 5.7)."""
    milliseconds = time.time_ns() // 1_000_000
    value = (milliseconds & (2**48 - 1)) << 80 | int.from_bytes(os.urandom(10))
    return _uuid(value, 7)


def proposal_id(element_id: str, frame_index: int, side: Side) -> str:
    """Return the id of the proposal that an element is visible in an image; deterministic."""
    return derived_id(f"{element_id} {frame_index} {side}")


def derived_id(text: str) -> str:
    """Return a UUID of version 8 (RFC 9562, 5.8), from the SHA-256 of ``text``."""
    digest = hashlib.sha256(text.encode()).digest()
    return _uuid(int.from_bytes(digest[:16]), 8)


def is_id(text: str) -> bool:
    """Return whether ``text`` has the form of an id."""
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
    """Shown to people; unique in the workspace and never reused."""
    class_id: Index

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Observation:
    """An element in one image. An element has at most one observation per image."""

    id: Id
    element_id: Id
    frame_index: Index
    side: Side
    anchor_px: Pixel
    """Peak of a pole, centre of a sign."""
    end_px: Pixel | None
    """Bottom of a pole; None for signs."""
    anchor_known: bool
    """False if the peak is cut off or hidden: ``anchor_px`` is then only a point on the line."""
    end_known: bool
    """False if the bottom is cut off or hidden, and for signs."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


REVIEWED = frozenset({"reviewed", "reviewed, empty"})
"""States of a frame that a person is done with."""


@dataclass(frozen=True)
class Review:
    """A person's review of a frame as a whole."""

    frame_index: Index
    state: Literal["in work", "reviewed", "reviewed, empty"]

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Dismissal:
    """A proposal that a person rejected in one image."""

    id: Id
    """Id of the proposal; ``proposal_id`` if an element was expected."""
    frame_index: Index
    side: Side
    why: Literal["rejected", "occluded", "absent"]
    element_id: Id | None
    """The element that was expected; None for a detector's proposal."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def is_refuted_by(self, row: Observation) -> bool:
        """Return whether a label takes this back: in its image whatever was said of the element; in
        the other image of the frame "not here", as the element can be proposed there anew."""
        if (self.element_id, self.frame_index) != (row.element_id, row.frame_index):
            return False
        return self.side == row.side or self.why == "rejected"


@dataclass(frozen=True)
class ReviewDecision:
    """A person's decision about one or two label elements; every map build follows it."""

    id: Id
    """``review_decision_id`` of the elements, so there is at most one decision about them."""
    verdict: Literal["apart", "keep", "leave out"]
    """``apart``: two landmarks; ``keep``: one landmark, with all its observations;
    ``leave out``: it does not belong in a map."""
    element_id: Id
    other_id: Id | None
    """The second element if they are ``apart``, else None; ``element_id < other_id``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


def different_elements(element_id: str, other_id: str) -> ReviewDecision:
    """Return the decision that two elements are different landmarks."""
    first, second = sorted((element_id, other_id))
    return ReviewDecision(review_decision_id(first, second), "apart", first, second)


def review_decision(element_id: str, verdict: Literal["keep", "leave out"]) -> ReviewDecision:
    """Return a decision about one element."""
    return ReviewDecision(review_decision_id(element_id), verdict, element_id, None)


def review_decision_id(element_id: str, other_id: str | None = None) -> str:
    """Return the id of the decision about one or two elements; deterministic."""
    ids = sorted(id_ for id_ in (element_id, other_id) if id_ is not None)
    return derived_id(" ".join(["judgement", *ids]))


@dataclass(frozen=True)
class Note:
    """What a person wrote about an element; it may say that the element is doubtful."""

    id: Id
    element_id: Id
    frame_index: Index | None
    """The frame that it is about; None: all of the element."""
    unsure: bool
    """Whether somebody else should look at the element."""
    text: Annotated[str, Field(max_length=MAX_NOTE_LENGTH)]
    """May be empty if ``unsure``."""
    author: str
    time: str
    """UTC, ISO 8601, when it was written."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


NAME_PATTERN = r"^[^\s=,;:]([^=,;:\t\n\r]{0,38}[^\s=,;:])?$"
"""Names of classes and attributes, as filters, options and columns of files can have them."""
FIRST_OWN_CLASS = len(DEFAULT_CLASSES)
"""Class ids from here on are a workspace's own."""
_Color: TypeAlias = Annotated[str, Field(pattern=r"^#[0-9A-F]{6}$")]


@dataclass(frozen=True)
class ClassDeclaration:
    """A class of the workspace's own; see ``ElementClass``."""

    id: Annotated[int, Field(ge=FIRST_OWN_CLASS, lt=2**15)]
    """Never reused, not even if the class was removed."""
    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    kind: ClassKind
    letter: Annotated[str, Field(pattern=r"^[A-Z][A-Z0-9]?$")]
    shape: ClassShape
    color: _Color
    color_light: _Color
    key: Annotated[str, Field(pattern=r"^[5-9]?$")]
    """The key that chooses the class on the page; empty: none. The classes of every workspace have
    1 to 4."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


ValueType: TypeAlias = Literal["text", "number", "flag", "choice"]
AttributeName: TypeAlias = Annotated[str, Field(pattern=NAME_PATTERN)]
MAX_VALUE_LENGTH = 200
"""Characters of the value of an attribute."""


@dataclass(frozen=True)
class AttributeType:
    """What the values of an attribute are; those of attributes without one are texts."""

    name: AttributeName
    type: ValueType
    choices: tuple[Annotated[str, Field(min_length=1, max_length=MAX_VALUE_LENGTH)], ...]
    """Of the type ``choice``, else empty."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


@dataclass(frozen=True)
class Attribute:
    """What is known of an element besides its class; an element has one value of a name."""

    id: Id
    """``attribute_id`` of element and name."""
    element_id: Id
    name: AttributeName
    value: Annotated[str, Field(min_length=1, max_length=MAX_VALUE_LENGTH)]
    """As the type writes it: a number as in Python, a flag as ``yes`` or ``no``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


def attribute_id(element_id: str, name: str) -> str:
    """Return the id of an element's attribute; deterministic."""
    return derived_id(f"attribute {element_id} {name}")


OutlineForm: TypeAlias = Literal["box", "polygon"]


@dataclass(frozen=True)
class ImportedOutline:
    """The box or polygon that a label was imported with; it stays as it was drawn."""

    id: Id
    """``outline_id`` of the observation, so it has at most one."""
    observation_id: Id
    form: OutlineForm
    points_px: Annotated[tuple[Pixel, ...], Field(min_length=2, max_length=10_000)]
    """Of a box its top left and bottom right corner, of a polygon all corners."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


def outline_id(observation_id: str) -> str:
    """Return the id of an observation's outline; deterministic."""
    return derived_id(f"outline {observation_id}")


Row: TypeAlias = (
    LabelElement
    | Observation
    | Review
    | Dismissal
    | ReviewDecision
    | Note
    | ClassDeclaration
    | AttributeType
    | Attribute
    | ImportedOutline
)
Key: TypeAlias = tuple[type[Row], str | int]
TAGS: dict[type[Row], str] = {
    LabelElement: "element",
    Observation: "observation",
    Review: "review",
    Dismissal: "dismissal",
    ReviewDecision: "judgement",
    Note: "note",
    ClassDeclaration: "declaration",
    AttributeType: "attribute_type",
    Attribute: "attribute",
    ImportedOutline: "outline",
}


def _row_tag(row: object) -> str:
    """Return the tag of a row, parsed or not, so that pydantic reports errors for that row type."""
    fields = row if isinstance(row, dict) else vars(row) if isinstance(row, Row) else {}
    return next((tag for field, tag in _TAG_OF_FIELD.items() if field in fields), "observation")


_TAG_OF_FIELD = {
    "state": "review",
    "number": "element",
    "why": "dismissal",
    "verdict": "judgement",
    "unsure": "note",
    "letter": "declaration",
    "choices": "attribute_type",
    "value": "attribute",
    "points_px": "outline",
}
"""A field of each type of row that no other type has."""


_Tagged: TypeAlias = Annotated[
    Annotated[LabelElement, Tag("element")]
    | Annotated[Observation, Tag("observation")]
    | Annotated[Review, Tag("review")]
    | Annotated[Dismissal, Tag("dismissal")]
    | Annotated[ReviewDecision, Tag("judgement")]
    | Annotated[Note, Tag("note")]
    | Annotated[ClassDeclaration, Tag("declaration")]
    | Annotated[AttributeType, Tag("attribute_type")]
    | Annotated[Attribute, Tag("attribute")]
    | Annotated[ImportedOutline, Tag("outline")],
    Discriminator(_row_tag),
]


@dataclass(frozen=True)
class RowChange:
    """One row before and after a change; None where the row does not exist."""

    before: _Tagged | None
    after: _Tagged | None

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def inverse(self) -> "RowChange":
        """Return the change that takes this one back."""
        return RowChange(self.after, self.before)

    @property
    def key(self) -> Key:
        """The type and id of the row."""
        row = self.before if self.after is None else self.after
        if row is None:
            raise SemvizError("a change has neither a row before nor one after")
        return row_key(row)


def row_key(row: Row) -> Key:
    """Return the type and id of a row."""
    match row:
        case Review():
            return Review, row.frame_index
        case AttributeType():
            return AttributeType, row.name
    return type(row), row.id


def row_elements(row: Row | None) -> tuple[str, ...]:
    """Return the ids of the elements that a row refers to."""
    match row:
        case LabelElement():
            return (row.id,)
        case Observation() | Note() | Attribute():
            return (row.element_id,)
        case ReviewDecision():
            return (row.element_id,) if row.other_id is None else (row.element_id, row.other_id)
        case Dismissal() if row.element_id is not None:
            return (row.element_id,)
    return ()


def check_decision(row: ReviewDecision) -> None:
    """Raise SemvizError if a decision is not of the form that the fields of its row describe."""
    first, *others = row_elements(row)
    if bool(others) != (row.verdict == "apart") or any(first >= other_id for other_id in others):
        raise SemvizError(
            "only a decision 'apart' is about two elements, the one with the smaller id first"
        )
    if row.id != review_decision_id(row.element_id, row.other_id):
        raise SemvizError("this is not the id of a decision about these elements")


MIN_LENGTH_PX = 0.5
"""A pole whose ends are closer than this has no direction."""


@dataclass(frozen=True, eq=False)
class Rules:
    """The classes and image sizes that observations are checked against."""

    classes: ClassSet = DEFAULT_CLASSES
    rig: Rig | None = None
    """Camera models with the image sizes; None accepts every pixel."""

    def check_class(self, element: LabelElement) -> LabelElement:
        """Return ``element``. Raise SemvizError if its class is unknown."""
        self.classes[element.class_id]
        return element

    def check(self, row: Observation, class_id: int) -> Observation:
        """Return ``row``. Raise SemvizError if it is no valid observation of this class."""
        element_class = self.classes[class_id]
        if element_class.kind == "line" and row.end_px is None:
            raise SemvizError(f"a {element_class.name} needs two points: peak and bottom")
        if element_class.kind == "point" and row.end_px is not None:
            raise SemvizError(f"a {element_class.name} has one point, its middle, not two")
        for point in (row.anchor_px, row.end_px):
            if point is not None:
                self._check_inside(point, row.side)
        if row.end_px is not None and np.hypot(*np.subtract(row.anchor_px, row.end_px)) < (
            MIN_LENGTH_PX
        ):
            raise SemvizError("peak and bottom are the same point; click them apart")
        return row

    def camera(self, side: Side) -> Camera | None:
        """Return the camera of a side; None if there is no rig.

        Raise SemvizError if the sequence has no camera on this side.
        """
        if self.rig is None:
            return None
        camera = self.rig.left if side == "left" else self.rig.right
        if camera is None:
            raise SemvizError("this sequence has no right camera")
        return camera

    def _check_inside(self, point: Pixel, side: Side) -> None:
        if not np.isfinite(point).all():
            raise SemvizError("a point is not a number; nothing was changed")
        camera = self.camera(side)
        if camera is not None and not camera.contains(np.array([point]))[0]:
            raise SemvizError(
                f"point ({point[0]:.1f}, {point[1]:.1f}) is outside the {side} image "
                f"({camera.width}x{camera.height})"
            )
