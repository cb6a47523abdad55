"""Edits of observations: drawn, moved, corrected, deleted."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from semviz_annotation.editing.identity import fall_with, without
from semviz_annotation.labels import Draft, Labels
from semviz_annotation.rows import (
    STRICT,
    Change,
    Id,
    Index,
    LabelElement,
    Observation,
    Pixel,
    proposal_id,
)
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side


@dataclass(frozen=True)
class AddObservation:
    """A new observation, of an element there is or, where ``class_id`` is given, of a new one."""

    observation_id: Id
    element_id: Id
    frame_index: Index
    side: Side
    anchor_px: Pixel
    end_px: Pixel | None = None
    anchor_known: bool = True
    end_known: bool = True
    """Ignored for signs, which have no end."""
    class_id: Index | None = None
    kind: Literal["add"] = "add"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        if self.observation_id in labels.observations:
            raise SemvizError("this observation exists already")
        if self.class_id is None:
            element = labels.element(self.element_id)
            if labels.find(element.id, self.frame_index, self.side):
                name = rules.classes.element_name(element.class_id, element.number)
                raise SemvizError(f"{name} is labelled already in this {self.side} image")
        elif self.element_id in labels.elements:
            raise SemvizError("this element exists already; leave its class out")
        else:
            element = LabelElement(self.element_id, labels.next_number, self.class_id)
        row = Observation(
            id=self.observation_id,
            element_id=element.id,
            frame_index=self.frame_index,
            side=self.side,
            anchor_px=self.anchor_px,
            end_px=self.end_px,
            anchor_known=self.anchor_known,
            end_known=self.end_known and self.end_px is not None,
        )
        rules.check(row, element.class_id)
        if self.class_id is not None:
            yield Change(None, element)
        yield Change(None, row)
        proposals = (proposal_id(element.id, self.frame_index, self.side), self.observation_id)
        yield from without(labels.dismissals.get(one) for one in proposals)


@dataclass(frozen=True)
class AddMany:
    """Several observations, all or none.

    One may be of an element that an earlier one makes; its ``class_id`` is None then.
    """

    observations: Annotated[tuple[AddObservation, ...], Field(min_length=1)]
    kind: Literal["add many"] = "add many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        yield from _in_turn(self.observations, labels, rules)


@dataclass(frozen=True)
class MoveObservation:
    """Another anchor or end; None leaves it where it is."""

    observation_id: Id
    anchor_px: Pixel | None = None
    end_px: Pixel | None = None
    kind: Literal["move"] = "move"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        moved = replace(
            row,
            anchor_px=row.anchor_px if self.anchor_px is None else self.anchor_px,
            end_px=row.end_px if self.end_px is None else self.end_px,
        )
        yield Change(row, rules.check(moved, labels.element(row.element_id).class_id))


@dataclass(frozen=True)
class SetKnown:
    """Whether the ends of a pole are seen, or cut off or hidden; None leaves it as it is."""

    observation_id: Id
    anchor_known: bool | None = None
    end_known: bool | None = None
    kind: Literal["set known"] = "set known"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        if row.end_px is None:
            raise SemvizError("only a pole's ends can be hidden or cut off; delete the sign")
        yield Change(
            row,
            replace(
                row,
                anchor_known=row.anchor_known if self.anchor_known is None else self.anchor_known,
                end_known=row.end_known if self.end_known is None else self.end_known,
            ),
        )


@dataclass(frozen=True)
class SwapEnds:
    """Make the peak the bottom and the bottom the peak."""

    observation_id: Id
    kind: Literal["swap ends"] = "swap ends"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        if row.end_px is None:
            raise SemvizError("a sign has one point; there is nothing to swap")
        yield Change(
            row,
            replace(
                row,
                anchor_px=row.end_px,
                end_px=row.anchor_px,
                anchor_known=row.end_known,
                end_known=row.anchor_known,
            ),
        )


@dataclass(frozen=True)
class DeleteObservation:
    """Delete one observation; the last one takes its element along, and what falls with that."""

    observation_id: Id
    kind: Literal["delete"] = "delete"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        yield Change(row, None)
        if len(labels.of_element(row.element_id)) == 1:
            yield Change(labels.element(row.element_id), None)
            yield from fall_with(labels, row.element_id)


@dataclass(frozen=True)
class DeleteMany:
    """Delete several observations, all or none, each as ``DeleteObservation`` does."""

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    kind: Literal["delete many"] = "delete many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        yield from _in_turn(map(DeleteObservation, self.observation_ids), labels, rules)


def _in_turn(
    edits: Iterable[AddObservation | DeleteObservation], labels: Labels, rules: Rules
) -> Iterator[Change]:
    """Changes of edits of which each finds what those before it have left."""
    draft = Draft(labels)
    for one in edits:
        changes = tuple(one.changes(draft.labels(), rules))
        draft.apply(changes)
        yield from changes
