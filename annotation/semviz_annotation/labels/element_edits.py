"""Edits that draw observations and link them to elements.

Observations are added, moved and corrected. Linking states that label elements are one landmark:
the element with the smallest number keeps all observations. Unlinking separates observations and
keeps the elements apart.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from semviz_annotation.labels.delete_edits import deletions, in_turn
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import (
    STRICT,
    Id,
    Index,
    LabelElement,
    Observation,
    Pixel,
    RowChange,
    Rules,
    attribute_id,
    different_elements,
    proposal_id,
    review_decision,
    review_decision_id,
    row_elements,
)
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True)
class Link:
    """State that label elements are one landmark: the smallest number keeps all observations.

    Notes on the others pass to the element that is kept. So do attributes and decisions, unless it
    has its own. A decision that two of them are apart is revoked.
    """

    element_ids: Annotated[tuple[Id, ...], Field(min_length=2)]
    kind: Literal["link"] = "link"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        kept, *merged = sorted(
            map(labels.element, self.element_ids), key=lambda element: element.number
        )
        self._check([kept, *merged], labels, rules)
        for element in merged:
            yield RowChange(element, None)
            for row in labels.of_element(element.id):
                yield RowChange(row, replace(row, element_id=kept.id))
                proposal = proposal_id(kept.id, row.frame_index, row.side)
                yield from deletions([labels.dismissals.get(proposal)])
            yield from deletions(labels.dismissed_of(element.id))
            for note in labels.notes_of(element.id):
                yield RowChange(note, replace(note, element_id=kept.id))
        yield from _transferred_attributes(kept.id, [element.id for element in merged], labels)
        yield from _transferred_decisions(kept.id, {element.id for element in merged}, labels)

    @staticmethod
    def _check(elements: list[LabelElement], labels: Labels, rules: Rules) -> None:
        images: dict[tuple[int, Side], str] = {}
        first = rules.classes.element_name(elements[0].class_id, elements[0].number)
        for index, element in enumerate(elements):
            name = rules.classes.element_name(element.class_id, element.number)
            if element in elements[:index]:
                raise SemvizError(f"{name} cannot be linked with itself")
            if element.class_id != elements[0].class_id:
                raise SemvizError(f"{first} and {name} differ in class; set one class first")
            for row in labels.of_element(element.id):
                earlier = images.setdefault((row.frame_index, row.side), name)
                if earlier != name:
                    raise SemvizError(
                        f"{earlier} and {name} are both in the {row.side} image of "
                        f"frame {row.frame_index}, so they are two landmarks"
                    )


def _transferred_attributes(
    kept_id: str, merged_ids: Iterable[str], labels: Labels
) -> Iterator[RowChange]:
    """Replace the attributes of merged elements by those of ``kept_id`` that it lacks."""
    present = {row.name for row in labels.attributes_of(kept_id)}
    for row in (row for id_ in merged_ids for row in labels.attributes_of(id_)):
        yield RowChange(row, None)
        if row.name not in present:
            present.add(row.name)
            id_ = attribute_id(kept_id, row.name)
            yield RowChange(None, replace(row, id=id_, element_id=kept_id))


def _transferred_decisions(
    kept_id: str, merged_ids: set[str], labels: Labels
) -> Iterator[RowChange]:
    """Replace the decisions about merged elements by decisions about ``kept_id``."""
    rows = {row.id: row for id_ in sorted(merged_ids) for row in labels.decisions_of(id_)}
    present = {row.id for row in labels.decisions_of(kept_id)}
    for row in rows.values():
        yield RowChange(row, None)
        elements = sorted(
            {kept_id if element in merged_ids else element for element in row_elements(row)}
        )
        if row.verdict != "apart":
            decision = review_decision(kept_id, row.verdict)
        elif len(elements) == 2:
            decision = different_elements(elements[0], elements[1])
        else:
            continue
        if decision.id not in present:
            present.add(decision.id)
            yield RowChange(None, decision)


@dataclass(frozen=True)
class Unlink:
    """State that observations of an element show another landmark: a new element, kept apart.

    Notes on frames that only the new element is labelled in go along.
    """

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    new_element_id: Id
    kind: Literal["unlink"] = "unlink"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        rows = [labels.observation(id_) for id_ in self.observation_ids]
        element = labels.element(rows[0].element_id)
        self._check(rows, element, labels, rules)
        yield RowChange(
            None, LabelElement(self.new_element_id, labels.next_number, element.class_id)
        )
        for row in rows:
            yield RowChange(row, replace(row, element_id=self.new_element_id))
        kept_as_one = labels.review_decisions.get(review_decision_id(element.id))
        if kept_as_one is not None and kept_as_one.verdict == "keep":
            yield RowChange(kept_as_one, None)
        yield RowChange(None, different_elements(element.id, self.new_element_id))
        moved, kept = set(rows), labels.of_element(element.id)
        frames = {row.frame_index for row in rows}
        frames -= {row.frame_index for row in kept if row not in moved}
        for note in labels.notes_of(element.id):
            if note.frame_index in frames:
                yield RowChange(note, replace(note, element_id=self.new_element_id))

    def _check(
        self, rows: list[Observation], element: LabelElement, labels: Labels, rules: Rules
    ) -> None:
        name = rules.classes.element_name(element.class_id, element.number)
        if self.new_element_id in labels.elements:
            raise SemvizError("the new element already exists; link them instead")
        if any(row.element_id != element.id for row in rows):
            raise SemvizError(f"not all observations are of {name}; unlink one by one")
        if len(labels.of_element(element.id)) == len(rows):
            which = "this is the only observation" if len(rows) == 1 else "these are all"
            raise SemvizError(f"{which} of {name}; nothing to unlink")


@dataclass(frozen=True)
class SetClass:
    """Change the class of an element, within its kind: a sign stays a sign."""

    element_id: Id
    class_id: Index
    kind: Literal["set class"] = "set class"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        element = labels.element(self.element_id)
        old, new = rules.classes[element.class_id], rules.classes[self.class_id]
        if old.kind != new.kind:
            raise SemvizError(f"a {old.name} cannot become a {new.name}; delete and draw it anew")
        yield RowChange(element, replace(element, class_id=self.class_id))


@dataclass(frozen=True)
class SetClassOfMany:
    """Change the class of several elements, all or none, each like ``SetClass``."""

    element_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    class_id: Index
    kind: Literal["set class of many"] = "set class of many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        for element_id in dict.fromkeys(self.element_ids):
            yield from SetClass(element_id, self.class_id).changes(labels, rules)


@dataclass(frozen=True)
class SetClassOfViews:
    """Change the class of some observations of an element, within its kind.

    If they are not all of its observations, they become a new element, kept apart from it.
    """

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    class_id: Index
    new_element_id: Id
    kind: Literal["set class of views"] = "set class of views"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        rows = {labels.observation(id_) for id_ in self.observation_ids}
        element = labels.element(labels.observation(self.observation_ids[0]).element_id)
        whole = SetClass(element.id, self.class_id).changes(labels, rules)
        if rows == set(labels.of_element(element.id)):
            yield from whole
            return
        tuple(whole)  # raises if the kinds differ
        for change in Unlink(self.observation_ids, self.new_element_id).changes(labels, rules):
            if isinstance(change.after, LabelElement):
                change = RowChange(None, replace(change.after, class_id=self.class_id))
            yield change


@dataclass(frozen=True)
class AddObservation:
    """Add an observation of an existing element or, if ``class_id`` is set, of a new one."""

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

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        if self.observation_id in labels.observations:
            raise SemvizError("this observation already exists")
        if self.class_id is None:
            element = labels.element(self.element_id)
            if labels.find(element.id, self.frame_index, self.side):
                name = rules.classes.element_name(element.class_id, element.number)
                raise SemvizError(f"{name} is already labelled in this {self.side} image")
        elif self.element_id in labels.elements:
            raise SemvizError("this element already exists; omit its class")
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
            yield RowChange(None, element)
        yield RowChange(None, row)
        here, accepted = labels.dismissed_in(self.frame_index), self.observation_id
        yield from deletions(one for one in here if one.id == accepted or one.is_refuted_by(row))


@dataclass(frozen=True)
class AddMany:
    """Add several observations, all or none.

    An observation of an element that an earlier one creates has ``class_id`` None.
    """

    observations: Annotated[tuple[AddObservation, ...], Field(min_length=1)]
    kind: Literal["add many"] = "add many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        yield from in_turn(self.observations, labels, rules)


@dataclass(frozen=True)
class NewElement:
    """An element to be added, with its observations in any order."""

    id: Id
    class_id: Index
    observations: tuple[Observation, ...]


@dataclass(frozen=True)
class AddElements:
    """Add new elements with their observations, all or none, whatever was rejected before.

    With ``left_out`` they come with the decision that no map has them: what a detector proposed is
    known then, and rejected in every image.
    """

    elements: tuple[NewElement, ...]
    left_out: bool = False

    @property
    def kind(self) -> Literal["accept tracks", "reject tracks"]:
        return "reject tracks" if self.left_out else "accept tracks"

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        for number, new in enumerate(self.elements, labels.next_number):
            if new.id in labels.elements:
                name = rules.classes.element_name(new.class_id, labels.elements[new.id].number)
                raise SemvizError(f"this is {name} already")
            yield RowChange(None, rules.check_class(LabelElement(new.id, number, new.class_id)))
            for row in new.observations:
                if row.id in labels.observations:
                    raise SemvizError("one of these observations already exists")
                yield RowChange(None, rules.check(replace(row, element_id=new.id), new.class_id))
                yield from deletions([labels.dismissals.get(row.id)])
            if self.left_out:
                yield RowChange(None, review_decision(new.id, "leave out"))


@dataclass(frozen=True)
class MoveObservation:
    """Move the anchor, the end or both; None leaves a point unchanged."""

    observation_id: Id
    anchor_px: Pixel | None = None
    end_px: Pixel | None = None
    kind: Literal["move"] = "move"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        row = labels.observation(self.observation_id)
        moved = replace(
            row,
            anchor_px=row.anchor_px if self.anchor_px is None else self.anchor_px,
            end_px=row.end_px if self.end_px is None else self.end_px,
        )
        yield RowChange(row, rules.check(moved, labels.element(row.element_id).class_id))


@dataclass(frozen=True)
class ReSnap:
    """Move observations to the edges that the images show, all or none."""

    moves: Annotated[tuple[MoveObservation, ...], Field(min_length=1)]
    kind: Literal["re-snap"] = "re-snap"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        for move in self.moves:
            yield from move.changes(labels, rules)


@dataclass(frozen=True)
class SetKnown:
    """Set whether the ends of a pole are visible, not cut off or hidden; None: unchanged."""

    observation_id: Id
    anchor_known: bool | None = None
    end_known: bool | None = None
    kind: Literal["set known"] = "set known"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        row = labels.observation(self.observation_id)
        if row.end_px is None:
            raise SemvizError("only a pole's ends can be hidden or cut off; delete the sign")
        yield RowChange(
            row,
            replace(
                row,
                anchor_known=row.anchor_known if self.anchor_known is None else self.anchor_known,
                end_known=row.end_known if self.end_known is None else self.end_known,
            ),
        )


@dataclass(frozen=True)
class SetKnownOfMany:
    """Set whether the ends of several poles are visible, all or none, each like ``SetKnown``."""

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    anchor_known: bool | None = None
    end_known: bool | None = None
    kind: Literal["set known of many"] = "set known of many"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        for id_ in dict.fromkeys(self.observation_ids):
            one = SetKnown(id_, self.anchor_known, self.end_known)
            yield from one.changes(labels, rules)


@dataclass(frozen=True)
class SwapEnds:
    """Swap the peak and the bottom of a pole."""

    observation_id: Id
    kind: Literal["swap ends"] = "swap ends"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        row = labels.observation(self.observation_id)
        if row.end_px is None:
            raise SemvizError("a sign has one point; there is nothing to swap")
        yield RowChange(
            row,
            replace(
                row,
                anchor_px=row.end_px,
                end_px=row.anchor_px,
                anchor_known=row.end_known,
                end_known=row.anchor_known,
            ),
        )
