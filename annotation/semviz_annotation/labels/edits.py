"""Edits of the label state as JSON, and the edits that draw nothing.

An edit computes its row changes from the state alone, without file or clock. An invalid edit
raises SemvizError and changes nothing. Reviews of frames, dismissals of proposals, and review
decisions for map building, and notes are defined here.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.labels import rows
from semviz_annotation.labels.delete_edits import DeleteElement, DeleteMany, DeleteObservation
from semviz_annotation.labels.element_edits import (
    AddElements,
    AddMany,
    AddObservation,
    Link,
    MoveObservation,
    NewElement,
    ReSnap,
    SetClass,
    SetClassOfMany,
    SetClassOfViews,
    SetKnown,
    SetKnownOfMany,
    SwapEnds,
    Unlink,
)
from semviz_annotation.labels.labels import Labels, ReviewState
from semviz_annotation.labels.own_classes import SetAttribute, attribute_types, checked_value
from semviz_core.common.errors import SemvizError

__all__ = [
    "AcceptFrame",
    "AddElements",
    "AddMany",
    "AddObservation",
    "AnyEdit",
    "DecideElements",
    "DeleteElement",
    "DeleteMany",
    "DeleteNote",
    "DeleteObservation",
    "Dismiss",
    "Edit",
    "Link",
    "MergeFrame",
    "MoveObservation",
    "NewElement",
    "ReSnap",
    "ReviewFrame",
    "RevokeDecision",
    "SendBackFrame",
    "SetAttribute",
    "SetClass",
    "SetClassOfMany",
    "SetClassOfViews",
    "SetKnown",
    "SetKnownOfMany",
    "SwapEnds",
    "Unlink",
    "WriteNote",
    "edit_from_json",
    "edit_to_json",
    "first_fault",
]


@dataclass(frozen=True)
class ReviewFrame:
    """Set a frame's review state; ``unseen`` removes the review."""

    frame_index: rows.Index
    state: ReviewState
    kind: Literal["review"] = "review"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        here = labels.in_frame(self.frame_index)
        count = sum(not labels.is_left_out(row.element_id) for row in here)
        if self.state == "reviewed, empty" and count:
            raise SemvizError(f"frame {self.frame_index} has {count} labels; it is not empty")
        if self.state == "reviewed" and not count:
            raise SemvizError(f"frame {self.frame_index} has no labels; say 'reviewed, empty'")
        after = None if self.state == "unseen" else rows.Review(self.frame_index, self.state)
        before = labels.reviews.get(self.frame_index)
        if before is not None or after is not None:
            yield rows.RowChange(before, after)


@dataclass(frozen=True)
class AcceptFrame:
    """Accept the review of a frame as it is.

    The row stays as it is, and the operation becomes its last writer: whoever reviews the frame
    anew takes the acceptance away.
    """

    frame_index: rows.Index
    kind: Literal["accept frame"] = "accept frame"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        yield rows.RowChange(*(_reviewed(self.frame_index, labels),) * 2)


@dataclass(frozen=True)
class SendBackFrame:
    """Send a reviewed frame back to who labelled it: it is in work again."""

    frame_index: rows.Index
    kind: Literal["send back"] = "send back"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        before = _reviewed(self.frame_index, labels)
        yield rows.RowChange(before, rows.Review(self.frame_index, "in work"))


@dataclass(frozen=True)
class MergeFrame:
    """Take labels for a frame that two people labelled each for themselves, and review it."""

    frame_index: rows.Index
    observations: tuple[AddObservation, ...]
    attributes: tuple[SetAttribute, ...] = ()
    """Of their elements; what an element has already stays."""
    notes: tuple[rows.Note, ...] = ()
    kind: Literal["merge frame"] = "merge frame"

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        if labels.in_frame(self.frame_index):
            raise SemvizError(f"frame {self.frame_index} has labels already; delete them first")
        if any(row.frame_index != self.frame_index for row in self.observations):
            raise SemvizError(f"not all of these labels are in frame {self.frame_index}")
        if self.observations:
            yield from AddMany(self.observations).changes(labels, rules)
        review = rows.Review(
            self.frame_index, "reviewed" if self.observations else "reviewed, empty"
        )
        yield rows.RowChange(labels.reviews.get(self.frame_index), review)
        types = attribute_types(labels)
        for each in self.attributes:
            id_ = rows.attribute_id(each.element_id, each.name)
            if each.value is not None and id_ not in labels.attributes:
                value = checked_value(each.value, types.get(each.name))
                yield rows.RowChange(None, rows.Attribute(id_, each.element_id, each.name, value))
        yield from (rows.RowChange(labels.notes.get(note.id), note) for note in self.notes)


def _reviewed(frame_index: int, labels: Labels) -> rows.Review:
    review = labels.reviews.get(frame_index)
    if review is None or labels.review(frame_index) not in rows.REVIEWED:
        raise SemvizError(f"frame {frame_index} is not marked as reviewed")
    return review


@dataclass(frozen=True)
class Dismiss:
    """Dismiss proposals, all or none."""

    dismissals: Annotated[tuple[rows.Dismissal, ...], Field(min_length=1)]
    kind: Literal["dismiss"] = "dismiss"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        for row in self.dismissals:
            rules.camera(row.side)
            self._check(row, labels, rules)
            before = labels.dismissals.get(row.id)
            if before != row:
                yield rows.RowChange(before, row)

    @staticmethod
    def _check(row: rows.Dismissal, labels: Labels, rules: rows.Rules) -> None:
        if row.id in labels.observations:
            raise SemvizError("this proposal was accepted; delete its observation instead")
        if row.element_id is None:
            return
        element = labels.element(row.element_id)
        if row.id != rows.proposal_id(element.id, row.frame_index, row.side):
            raise SemvizError("this is not the id of a proposal of this element in this image")
        if labels.find(element.id, row.frame_index, row.side):
            name = rules.classes.element_name(element.class_id, element.number)
            raise SemvizError(f"{name} is labelled in this {row.side} image; delete it there first")


@dataclass(frozen=True)
class DecideElements:
    """Add review decisions, all or none; every later map build follows them."""

    judgements: Annotated[tuple[rows.ReviewDecision, ...], Field(min_length=1)]
    kind: Literal["judge"] = "judge"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        for row in self.judgements:
            for element_id in rows.row_elements(row):
                labels.element(element_id)
            before = labels.review_decisions.get(row.id)
            if before != row:
                yield rows.RowChange(before, row)


@dataclass(frozen=True)
class RevokeDecision:
    """Remove a review decision, so that map building decides again."""

    judgement_id: rows.Id
    kind: Literal["take back"] = "take back"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        row = labels.review_decisions.get(self.judgement_id)
        if row is None:
            raise SemvizError("there is no such decision; it may be revoked already")
        yield rows.RowChange(row, None)


@dataclass(frozen=True)
class WriteNote:
    """Write a note on an element, or write it anew.

    Author and time are whoever's the caller knows: no page sends this edit.
    """

    note: rows.Note
    kind: Literal["note"] = "note"

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        labels.element(self.note.element_id)
        before = labels.notes.get(self.note.id)
        if before != self.note:
            yield rows.RowChange(before, self.note)


@dataclass(frozen=True)
class DeleteNote:
    """Delete a note: the question is answered."""

    note_id: rows.Id
    kind: Literal["delete note"] = "delete note"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        row = labels.notes.get(self.note_id)
        if row is None:
            raise SemvizError("there is no such note; it may be deleted already")
        yield rows.RowChange(row, None)


class AnyEdit(Protocol):
    """An edit that a store can apply: an ``Edit``, or one that no page sends, such as an import."""

    @property
    def kind(self) -> str:
        """The name of the edit in the operation log."""
        ...

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        """Compute the row changes. Raise SemvizError if the edit is invalid in ``labels``."""
        ...


Edit: TypeAlias = (
    AddObservation
    | AddMany
    | Dismiss
    | MoveObservation
    | ReSnap
    | SetKnown
    | SetKnownOfMany
    | SwapEnds
    | DeleteObservation
    | DeleteMany
    | DeleteElement
    | Link
    | Unlink
    | SetClass
    | SetClassOfMany
    | SetClassOfViews
    | SetAttribute
    | ReviewFrame
    | AcceptFrame
    | SendBackFrame
    | DecideElements
    | RevokeDecision
    | DeleteNote
)

_EDIT: TypeAdapter[Edit] = TypeAdapter(Annotated[Edit, Field(discriminator="kind")])


def edit_from_json(data: object) -> Edit:
    """Return an edit from parsed JSON, for example ``{"kind": "delete", "observation_id": "..."}``.

    Raise SemvizError, naming the invalid field.
    """
    try:
        return _EDIT.validate_json(json.dumps(data))
    except (ValidationError, TypeError, ValueError) as error:
        raise SemvizError(f"not an edit: {first_fault(error)}") from None


def edit_to_json(edit: Edit) -> dict[str, Any]:
    """Return the JSON value that ``edit_from_json`` reads."""
    result: dict[str, Any] = _EDIT.dump_python(edit, mode="json")
    return result


def first_fault(error: Exception) -> str:
    """Return the first error that pydantic reports, on one line."""
    if not isinstance(error, ValidationError):
        return str(error)
    fault = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in fault["loc"])
    return f"{where}: {fault['msg']}" if where else fault["msg"]
