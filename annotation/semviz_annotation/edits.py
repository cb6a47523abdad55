"""What people can do to labels, as values.

Every edit computes its row changes from the state alone; nothing here touches a file or a clock.
An edit that makes no sense raises SemvizError and changes nothing.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.labels import Draft, Labels, ReviewState
from semviz_annotation.rows import (
    STRICT,
    Change,
    Dismissal,
    Id,
    Index,
    LabelElement,
    Observation,
    Pixel,
    Review,
    proposal_id,
)
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side


class AnyEdit(Protocol):
    """What a store can apply: an ``Edit``, or one that no page sends, such as an import."""

    @property
    def kind(self) -> str:
        """What the log calls it."""
        ...

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        """The rows that change; SemvizError where it makes no sense in ``labels``."""
        ...


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
        yield from _forget(labels.dismissals.get(one) for one in proposals)


@dataclass(frozen=True)
class AddMany:
    """Several observations, all or none.

    One may be of an element that an earlier one makes; its ``class_id`` is None then.
    """

    observations: Annotated[tuple[AddObservation, ...], Field(min_length=1)]
    kind: Literal["add many"] = "add many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        draft = Draft(labels)
        for one in self.observations:
            changes = tuple(one.changes(draft.labels(), rules))
            draft.apply(changes)
            yield from changes


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
    """Delete one observation; with the last one of its element go element and dismissals."""

    observation_id: Id
    kind: Literal["delete"] = "delete"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        yield Change(row, None)
        if len(labels.of_element(row.element_id)) == 1:
            yield Change(labels.element(row.element_id), None)
            yield from _forget(labels.dismissed_of(row.element_id))


@dataclass(frozen=True)
class DeleteElement:
    """Delete an element with all its observations and dismissals."""

    element_id: Id
    kind: Literal["delete element"] = "delete element"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        yield Change(labels.element(self.element_id), None)
        for row in labels.of_element(self.element_id):
            yield Change(row, None)
        yield from _forget(labels.dismissed_of(self.element_id))


@dataclass(frozen=True)
class Link:
    """Say that two label elements are one thing: the smaller number keeps all observations."""

    element_id: Id
    other_id: Id
    kind: Literal["link"] = "link"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        both = labels.element(self.element_id), labels.element(self.other_id)
        kept, gone = sorted(both, key=lambda one: one.number)
        self._check(kept, gone, labels, rules)
        yield Change(gone, None)
        for row in labels.of_element(gone.id):
            yield Change(row, replace(row, element_id=kept.id))
            proposal = proposal_id(kept.id, row.frame_index, row.side)
            yield from _forget([labels.dismissals.get(proposal)])
        yield from _forget(labels.dismissed_of(gone.id))

    @staticmethod
    def _check(kept: LabelElement, gone: LabelElement, labels: Labels, rules: Rules) -> None:
        names = [rules.classes.element_name(one.class_id, one.number) for one in (kept, gone)]
        if kept.id == gone.id:
            raise SemvizError(f"{names[0]} cannot be linked with itself")
        if kept.class_id != gone.class_id:
            raise SemvizError(f"{names[0]} and {names[1]} differ in class; set one class first")
        for row in labels.of_element(gone.id):
            if labels.find(kept.id, row.frame_index, row.side):
                raise SemvizError(
                    f"{names[0]} and {names[1]} are both in the {row.side} image of "
                    f"frame {row.frame_index}, so they are two things"
                )


@dataclass(frozen=True)
class Unlink:
    """Say that an observation shows another thing: it becomes the first of a new element."""

    observation_id: Id
    new_element_id: Id
    kind: Literal["unlink"] = "unlink"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        row = labels.observation(self.observation_id)
        element = labels.element(row.element_id)
        if self.new_element_id in labels.elements:
            raise SemvizError("the new element exists already; link them instead")
        if len(labels.of_element(element.id)) == 1:
            name = rules.classes.element_name(element.class_id, element.number)
            raise SemvizError(f"this is the only observation of {name}; nothing to unlink")
        yield Change(None, LabelElement(self.new_element_id, labels.next_number, element.class_id))
        yield Change(row, replace(row, element_id=self.new_element_id))


@dataclass(frozen=True)
class SetClass:
    """Another class of the same kind: a sign stays a sign."""

    element_id: Id
    class_id: Index
    kind: Literal["set class"] = "set class"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        element = labels.element(self.element_id)
        old, new = rules.classes[element.class_id], rules.classes[self.class_id]
        if old.kind != new.kind:
            raise SemvizError(f"a {old.name} cannot become a {new.name}; delete and draw it anew")
        yield Change(element, replace(element, class_id=self.class_id))


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


def _forget(dismissals: Iterable[Dismissal | None]) -> Iterator[Change]:
    return (Change(row, None) for row in dismissals if row is not None)


Edit: TypeAlias = (
    AddObservation
    | AddMany
    | Dismiss
    | MoveObservation
    | SetKnown
    | SwapEnds
    | DeleteObservation
    | DeleteElement
    | Link
    | Unlink
    | SetClass
    | ReviewFrame
)

_EDIT: TypeAdapter[Edit] = TypeAdapter(Annotated[Edit, Field(discriminator="kind")])


def edit_from_json(data: object) -> Edit:
    """An edit from parsed JSON, such as ``{"kind": "delete", "observation_id": "..."}``.

    Raises SemvizError naming the field that is wrong.
    """
    try:
        return _EDIT.validate_json(json.dumps(data))
    except (ValidationError, TypeError, ValueError) as error:
        raise SemvizError(f"not an edit: {first_fault(error)}") from None


def edit_to_json(edit: Edit) -> dict[str, Any]:
    """What ``edit_from_json`` reads."""
    result: dict[str, Any] = _EDIT.dump_python(edit, mode="json")
    return result


def first_fault(error: Exception) -> str:
    """The first thing that pydantic found wrong, on one line."""
    if not isinstance(error, ValidationError):
        return str(error)
    fault = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in fault["loc"])
    return f"{where}: {fault['msg']}" if where else fault["msg"]
