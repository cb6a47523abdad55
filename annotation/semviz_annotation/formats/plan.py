"""What a file adds to labels: which things in it are one element, and which are there already."""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from semviz_annotation.formats.numbers import quoted
from semviz_annotation.formats.reading import Seen, at
from semviz_annotation.labels import Labels
from semviz_annotation.rows import (
    Change,
    LabelElement,
    Observation,
    Pixel,
    derived_id,
    is_id,
    proposal_id,
)
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

MOST_NUMBER = 1_000_000
"""Larger element numbers of a file are given anew."""
_Content: TypeAlias = tuple[int, Side, int, Pixel, Pixel | None]


@dataclass(frozen=True)
class ImportLabels:
    """Elements and observations of a file, as one edit.

    ``elements`` are new; their numbers are kept where no element ever had them.
    """

    elements: tuple[LabelElement, ...]
    observations: tuple[Observation, ...]
    kind: Literal["import"] = "import"

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        classes = {one.id: one.class_id for one in labels.elements.values()}
        for element in _numbered(self.elements, labels.next_number):
            classes[element.id] = rules.check_class(element).class_id
            yield Change(None, element)
        for row in self.observations:
            yield Change(None, rules.check(row, classes[row.element_id]))
            dismissal = labels.dismissals.get(
                proposal_id(row.element_id, row.frame_index, row.side)
            )
            if dismissal is not None:  # it is seen there after all
                yield Change(dismissal, None)


def _numbered(elements: Sequence[LabelElement], first: int) -> Iterator[LabelElement]:
    wanted = Counter(one.number for one in elements)
    free = {n for n, count in wanted.items() if count == 1 and first <= n < MOST_NUMBER}
    following = max(free, default=first - 1)
    for one in elements:
        if one.number in free:
            yield one
        else:
            following += 1
            yield replace(one, number=following)


@dataclass
class Plan:
    """What to do, and what there is nothing to do about."""

    elements: list[LabelElement] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    kept: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """By observation, what only the file's format understands."""
    already: int = 0
    repeated: int = 0
    """The same label twice in the file."""


def plan_import(seen: Sequence[Seen], labels: Labels) -> Plan:
    """Which elements and observations ``seen`` adds to ``labels``.

    Things of one name are one element, and so are those of one number and class. An element that
    has no id of ours in the file is the one of ``labels`` that has an equal observation, if any.
    Raises SemvizError, naming the item, where an element is twice in one image, of two classes,
    or elsewhere in ``labels``.
    """
    plan, present = Plan(), _contents(labels)
    digest = hashlib.sha256(repr([(_content(one), one.number) for one in seen]).encode())
    for key, group in _groups(seen).items():
        with at(group[0].where):
            element_id = _element_id(key, group, present, digest.hexdigest())
        _add(plan, element_id, group, labels)
    return plan


_Key: TypeAlias = tuple[str, object]


def _groups(seen: Sequence[Seen]) -> dict[_Key, list[Seen]]:
    """What belongs to one element, in the order of the file."""
    names = {(one.class_id, one.number): one.name for one in seen if one.name is not None}
    groups: dict[_Key, list[Seen]] = {}
    for one in seen:
        number = (one.class_id, one.number)
        name = one.name
        if name is None and one.number is not None:
            name = names.get(number)  # drawn later, and given only the number of a named one
        key: _Key = ("alone", _content(one))
        if name is not None:
            key = ("name", name)
        elif one.number is not None:
            key = ("number", number)
        groups.setdefault(key, []).append(one)
    return groups


def _content(one: Seen) -> _Content:
    return (one.frame_index, one.side, one.class_id, one.anchor_px, one.end_px)


def _contents(labels: Labels) -> dict[_Content, str]:
    return {
        (row.frame_index, row.side, labels.element(row.element_id).class_id, row.anchor_px,
         row.end_px): row.element_id
        for row in labels.observations.values()
    }  # fmt: skip


def _element_id(
    key: _Key, group: Sequence[Seen], present: Mapping[_Content, str], digest: str
) -> str:
    kind, value = key
    if kind == "name" and is_id(str(value)):
        return str(value)
    known = {present[content] for content in map(_content, group) if content in present}
    if len(known) > 1:
        raise SemvizError("one element here, but several in the workspace; link them there first")
    if known:
        return known.pop()
    if kind == "number":  # says nothing outside of this file
        return derived_id(f"{digest} {value!r}")
    return derived_id(f"{kind} {group[0].class_id} {value!r}")


def _add(plan: Plan, element_id: str, group: Sequence[Seen], labels: Labels) -> None:
    element = labels.elements.get(element_id)
    if element is None:
        ours = (one.number for one in group if one.name == element_id)  # of others: no meaning
        element = LabelElement(element_id, next(ours, None) or 0, group[0].class_id)
        plan.elements.append(element)
    here: dict[tuple[int, Side], Seen] = {}
    for one in group:
        with at(one.where):
            if one.class_id != element.class_id:
                raise SemvizError(f"element {_name(one)} is of another class elsewhere")
            twin = here.setdefault((one.frame_index, one.side), one)
            if twin is one:
                _add_observation(plan, element, one, labels)
            elif _content(twin) == _content(one):
                plan.repeated += 1
            else:
                raise SemvizError(f"element {_name(one)} is twice in this image")


def _name(one: Seen) -> str:
    return quoted(one.name if one.name is not None else one.number)


def _add_observation(plan: Plan, element: LabelElement, one: Seen, labels: Labels) -> None:
    row = Observation(
        id=proposal_id(element.id, one.frame_index, one.side),
        element_id=element.id,
        frame_index=one.frame_index,
        side=one.side,
        anchor_px=one.anchor_px,
        end_px=one.end_px,
        anchor_known=one.anchor_known,
        end_known=one.end_known and one.end_px is not None,
    )
    there = labels.find(element.id, one.frame_index, one.side)
    if there is None and row.id in labels.observations:
        raise SemvizError("its label was given to another element since; delete that one first")
    if there is None:
        plan.observations.append(row)
    elif replace(there, id=row.id) == row:
        plan.already += 1
    else:
        raise SemvizError(
            f"element {element.number} is labelled differently in this {one.side} image of frame "
            f"{one.frame_index}; delete that label first, or import into a new workspace"
        )
    if one.kept:
        plan.kept[row.id if there is None else there.id] = one.kept
