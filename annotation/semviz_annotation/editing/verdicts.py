"""Edits that say something about frames, proposals and elements, and draw nothing."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from semviz_annotation.labels import Labels, ReviewState
from semviz_annotation.rows import (
    STRICT,
    Change,
    Dismissal,
    Id,
    Index,
    Judgement,
    Review,
    elements_of,
    proposal_id,
)
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class ReviewFrame:
    """A person's verdict on a frame; ``unseen`` takes it back."""

    frame_index: Index
    state: ReviewState
    kind: Literal["review"] = "review"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        count = len(labels.in_frame(self.frame_index))
        if self.state == "reviewed, empty" and count:
            raise SemvizError(f"frame {self.frame_index} has {count} labels; it is not empty")
        if self.state == "reviewed" and not count:
            raise SemvizError(f"frame {self.frame_index} has no labels; say 'reviewed, empty'")
        after = None if self.state == "unseen" else Review(self.frame_index, self.state)
        before = labels.reviews.get(self.frame_index)
        if before is not None or after is not None:
            yield Change(before, after)


@dataclass(frozen=True)
class Dismiss:
    """Turn proposals down, all or none."""

    dismissals: Annotated[tuple[Dismissal, ...], Field(min_length=1)]
    kind: Literal["dismiss"] = "dismiss"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        for row in self.dismissals:
            rules.camera(row.side)
            self._check(row, labels, rules)
            before = labels.dismissals.get(row.id)
            if before != row:
                yield Change(before, row)

    @staticmethod
    def _check(row: Dismissal, labels: Labels, rules: Rules) -> None:
        if row.id in labels.observations:
            raise SemvizError("this proposal was accepted; delete its observation instead")
        if row.element_id is None:
            return
        element = labels.element(row.element_id)
        if row.id != proposal_id(element.id, row.frame_index, row.side):
            raise SemvizError("this is not the id of a proposal of this element in this image")
        if labels.find(element.id, row.frame_index, row.side):
            name = rules.classes.element_name(element.class_id, element.number)
            raise SemvizError(f"{name} is labelled in this {row.side} image; delete it there first")


@dataclass(frozen=True)
class Judge:
    """Decide about elements for every map that is built from now on, all or none."""

    judgements: Annotated[tuple[Judgement, ...], Field(min_length=1)]
    kind: Literal["judge"] = "judge"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        for row in self.judgements:
            for element_id in elements_of(row):
                labels.element(element_id)
            before = labels.judgements.get(row.id)
            if before != row:
                yield Change(before, row)


@dataclass(frozen=True)
class TakeBack:
    """Leave it to map building again."""

    judgement_id: Id
    kind: Literal["take back"] = "take back"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.judgements.get(self.judgement_id)
        if row is None:
            raise SemvizError("nothing was decided about this; it may be taken back already")
        yield Change(row, None)
