"""Edits of elements: which views show one thing, and of what class it is."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from semviz_annotation.labels import Labels
from semviz_annotation.rows import (
    STRICT,
    Change,
    Id,
    Index,
    LabelElement,
    Observation,
    Row,
    apart,
    elements_of,
    judged,
    judgement_id,
    proposal_id,
)
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side


@dataclass(frozen=True)
class DeleteElement:
    """Delete an element with all its observations, and what falls with it."""

    element_id: Id
    kind: Literal["delete element"] = "delete element"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        yield Change(labels.element(self.element_id), None)
        for row in labels.of_element(self.element_id):
            yield Change(row, None)
        yield from fall_with(labels, self.element_id)


@dataclass(frozen=True)
class Link:
    """Say that label elements are one thing: the smallest number keeps all observations.

    What was decided about the others is then about the one that is kept, where that is not judged
    itself; that two of them are apart is taken back.
    """

    element_ids: Annotated[tuple[Id, ...], Field(min_length=2)]
    kind: Literal["link"] = "link"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        kept, *gone = sorted(map(labels.element, self.element_ids), key=lambda one: one.number)
        self._check([kept, *gone], labels, rules)
        for element in gone:
            yield Change(element, None)
            for row in labels.of_element(element.id):
                yield Change(row, replace(row, element_id=kept.id))
                proposal = proposal_id(kept.id, row.frame_index, row.side)
                yield from without([labels.dismissals.get(proposal)])
            yield from without(labels.dismissed_of(element.id))
        yield from _judgements_moved(kept.id, {one.id for one in gone}, labels)

    @staticmethod
    def _check(elements: list[LabelElement], labels: Labels, rules: Rules) -> None:
        images: dict[tuple[int, Side], str] = {}
        first = rules.classes.element_name(elements[0].class_id, elements[0].number)
        for place, element in enumerate(elements):
            name = rules.classes.element_name(element.class_id, element.number)
            if element in elements[:place]:
                raise SemvizError(f"{name} cannot be linked with itself")
            if element.class_id != elements[0].class_id:
                raise SemvizError(f"{first} and {name} differ in class; set one class first")
            for row in labels.of_element(element.id):
                other = images.setdefault((row.frame_index, row.side), name)
                if other != name:
                    raise SemvizError(
                        f"{other} and {name} are both in the {row.side} image of "
                        f"frame {row.frame_index}, so they are two things"
                    )


def _judgements_moved(kept_id: str, gone_ids: set[str], labels: Labels) -> Iterator[Change]:
    """Judgements of elements that are linked with ``kept_id``."""
    rows = {row.id: row for one in sorted(gone_ids) for row in labels.judgements_of(one)}
    taken = {row.id for row in labels.judgements_of(kept_id)}
    for row in rows.values():
        yield Change(row, None)
        about = sorted({kept_id if one in gone_ids else one for one in elements_of(row)})
        if row.verdict != "apart":
            moved = judged(kept_id, row.verdict)
        elif len(about) == 2:
            moved = apart(about[0], about[1])
        else:
            continue
        if moved.id not in taken:
            taken.add(moved.id)
            yield Change(None, moved)


@dataclass(frozen=True)
class Unlink:
    """Say that observations of one element show another thing: a new element, apart from it."""

    observation_ids: Annotated[tuple[Id, ...], Field(min_length=1)]
    new_element_id: Id
    kind: Literal["unlink"] = "unlink"

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        rows = [labels.observation(one) for one in self.observation_ids]
        element = labels.element(rows[0].element_id)
        self._check(rows, element, labels, rules)
        yield Change(None, LabelElement(self.new_element_id, labels.next_number, element.class_id))
        for row in rows:
            yield Change(row, replace(row, element_id=self.new_element_id))
        kept_as_one = labels.judgements.get(judgement_id(element.id))
        if kept_as_one is not None and kept_as_one.verdict == "keep":
            yield Change(kept_as_one, None)
        yield Change(None, apart(element.id, self.new_element_id))

    def _check(
        self, rows: list[Observation], element: LabelElement, labels: Labels, rules: Rules
    ) -> None:
        name = rules.classes.element_name(element.class_id, element.number)
        if self.new_element_id in labels.elements:
            raise SemvizError("the new element exists already; link them instead")
        if any(row.element_id != element.id for row in rows):
            raise SemvizError(f"not all of them are observations of {name}; unlink one by one")
        if len(labels.of_element(element.id)) == len(rows):
            which = "this is the only observation" if len(rows) == 1 else "these are all"
            raise SemvizError(f"{which} of {name}; nothing to unlink")


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


def fall_with(labels: Labels, element_id: str) -> Iterator[Change]:
    """What was turned down of an element and decided about it, which falls with it."""
    yield from without([*labels.dismissed_of(element_id), *labels.judgements_of(element_id)])


def without(rows: Iterable[Row | None]) -> Iterator[Change]:
    """Rows deleted, where there are any."""
    return (Change(row, None) for row in rows if row is not None)
