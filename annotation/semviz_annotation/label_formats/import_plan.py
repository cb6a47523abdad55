"""What an import adds to the labels of a workspace.

The plan says which shapes form one element, and which are already labelled. Labels that already
exist, equal to the last digit, are skipped, so an extended file can be imported again. Elements
keep their numbers where these are free. An attribute is an element's, so its labels must agree.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from semviz_annotation.label_formats.reading import ParsedObservation, at, quoted
from semviz_annotation.labels import rows
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.own_classes import attribute_types, check_name, checked_value
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

MOST_NUMBER = 1_000_000
"""Larger element numbers of a file are replaced."""
_Content: TypeAlias = tuple[int, Side, int, rows.Pixel, rows.Pixel | None]


@dataclass(frozen=True)
class ImportLabels:
    """Add the elements and observations of a file, as one edit.

    New elements keep their numbers if no element ever had them.
    """

    elements: tuple[rows.LabelElement, ...]
    observations: tuple[rows.Observation, ...]
    attributes: tuple[rows.Attribute, ...] = ()
    outlines: tuple[rows.ImportedOutline, ...] = ()
    kind: Literal["import"] = "import"

    @classmethod
    def of(cls, plan: "ImportPlan") -> "ImportLabels":
        """Return the edit that adds what an import adds."""
        return cls(
            tuple(plan.elements),
            tuple(plan.observations),
            tuple(plan.attributes),
            tuple(plan.outlines),
        )

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        classes = {element.id: element.class_id for element in labels.elements.values()}
        for element in _numbered(self.elements, labels.next_number):
            classes[element.id] = rules.check_class(element).class_id
            yield rows.RowChange(None, element)
        for row in self.observations:
            yield rows.RowChange(None, rules.check(row, classes[row.element_id]))
            dismissal = labels.dismissals.get(
                rows.proposal_id(row.element_id, row.frame_index, row.side)
            )
            if dismissal is not None:  # the element is visible there after all
                yield rows.RowChange(dismissal, None)
        yield from (rows.RowChange(None, attribute) for attribute in self.attributes)
        yield from (rows.RowChange(None, outline) for outline in self.outlines)


def _numbered(elements: Sequence[rows.LabelElement], first: int) -> Iterator[rows.LabelElement]:
    wanted = Counter(element.number for element in elements)
    free = {n for n, count in wanted.items() if count == 1 and first <= n < MOST_NUMBER}
    following = max(free, default=first - 1)
    for element in elements:
        if element.number in free:
            yield element
        else:
            following += 1
            yield replace(element, number=following)


@dataclass
class ImportPlan:
    """What an import adds, and how many labels it skips."""

    elements: list[rows.LabelElement] = field(default_factory=list)
    observations: list[rows.Observation] = field(default_factory=list)
    kept: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """Keys that only the file's format understands, by observation id."""
    attributes: list[rows.Attribute] = field(default_factory=list)
    outlines: list[rows.ImportedOutline] = field(default_factory=list)
    dropped: "Counter[str]" = field(default_factory=Counter)
    """Count of attributes that cannot be kept, by why."""
    already: int = 0
    repeated: int = 0
    """Number of labels that the file has twice."""

    @property
    def adds(self) -> bool:
        """Whether there is anything new."""
        return bool(self.observations or self.attributes or self.outlines)


def plan_import(observations: Sequence[ParsedObservation], labels: Labels) -> ImportPlan:
    """Return which elements and observations a file adds to ``labels``.

    Observations with the same name, or with the same number and class, are one element. An element
    without a semviz id is the one in ``labels`` with an equal observation, if there is one. Raise
    SemvizError, naming the item, if an element is twice in one image, has two classes, or
    contradicts ``labels``.
    """
    plan, present = ImportPlan(), _contents(labels)
    digest = hashlib.sha256(
        repr([(_content(observation), observation.number) for observation in observations]).encode()
    )
    for key, group in _groups(observations).items():
        with at(group[0].where):
            element_id = _element_id(key, group, present, digest.hexdigest())
        _add(plan, element_id, group, labels)
        _add_attributes(plan, element_id, group, labels)
    return plan


_Key: TypeAlias = tuple[str, object]


def _groups(observations: Sequence[ParsedObservation]) -> dict[_Key, list[ParsedObservation]]:
    """Group the observations by element, in the order of the file."""
    names = {
        (observation.class_id, observation.number): observation.name
        for observation in observations
        if observation.name is not None
    }
    groups: dict[_Key, list[ParsedObservation]] = {}
    for observation in observations:
        number = (observation.class_id, observation.number)
        name = observation.name
        if name is None and observation.number is not None:
            name = names.get(number)  # drawn later, and given only the number of a named one
        key: _Key = ("alone", _content(observation))
        if name is not None:
            key = ("name", name)
        elif observation.number is not None:
            key = ("number", number)
        groups.setdefault(key, []).append(observation)
    return groups


def _content(observation: ParsedObservation) -> _Content:
    return (
        observation.frame_index,
        observation.side,
        observation.class_id,
        observation.anchor_px,
        observation.end_px,
    )


def _contents(labels: Labels) -> dict[_Content, str]:
    return {
        (row.frame_index, row.side, labels.element(row.element_id).class_id, row.anchor_px,
         row.end_px): row.element_id
        for row in labels.observations.values()
    }  # fmt: skip


def _element_id(
    key: _Key, group: Sequence[ParsedObservation], present: Mapping[_Content, str], digest: str
) -> str:
    kind, value = key
    if kind == "name" and rows.is_id(str(value)):
        return str(value)
    present_ids = {present[content] for content in map(_content, group) if content in present}
    if len(present_ids) > 1:
        raise SemvizError("one element here, but several in the workspace; link them there first")
    if present_ids:
        return present_ids.pop()
    if kind == "number":  # says nothing outside of this file
        return rows.derived_id(f"{digest} {value!r}")
    return rows.derived_id(f"{kind} {group[0].class_id} {value!r}")


def _add(
    plan: ImportPlan, element_id: str, group: Sequence[ParsedObservation], labels: Labels
) -> None:
    element = labels.elements.get(element_id)
    if element is None:
        ours = (
            observation.number for observation in group if observation.name == element_id
        )  # of others: no meaning
        element = rows.LabelElement(element_id, next(ours, None) or 0, group[0].class_id)
        plan.elements.append(element)
    by_image: dict[tuple[int, Side], ParsedObservation] = {}
    for observation in group:
        with at(observation.where):
            if observation.class_id != element.class_id:
                raise SemvizError(f"element {_name(observation)} is of another class elsewhere")
            twin = by_image.setdefault((observation.frame_index, observation.side), observation)
            if twin is observation:
                _add_observation(plan, element, observation, labels)
            elif _content(twin) == _content(observation):
                plan.repeated += 1
            else:
                raise SemvizError(f"element {_name(observation)} is twice in this image")


def _add_attributes(
    plan: ImportPlan, element_id: str, group: Sequence[ParsedObservation], labels: Labels
) -> None:
    """Add what the labels of an element agree on, and the workspace does not know otherwise."""
    values: dict[str, set[str]] = {}
    for observation in group:
        for name, value in observation.attributes.items():
            values.setdefault(name, set()).add(value)
    present = {row.name: row.value for row in labels.attributes_of(element_id)}
    types = attribute_types(labels)
    for name, found in values.items():
        shown = f"attribute {quoted(name)}"
        if len(found) > 1:
            plan.dropped[f"{shown}: it differs between labels of one element"] += 1
        elif name not in present:
            try:
                check_name(name)
                value = checked_value(next(iter(found)), types.get(name))
            except SemvizError as error:
                plan.dropped[f"{shown}: {error}"] += 1
            else:
                id_ = rows.attribute_id(element_id, name)
                plan.attributes.append(rows.Attribute(id_, element_id, name, value))
        elif found != {present[name]}:
            plan.dropped[f"{shown}: the workspace has another value"] += 1


def _name(observation: ParsedObservation) -> str:
    return quoted(observation.name if observation.name is not None else observation.number)


def _add_observation(
    plan: ImportPlan, element: rows.LabelElement, parsed: ParsedObservation, labels: Labels
) -> None:
    row = rows.Observation(
        id=rows.proposal_id(element.id, parsed.frame_index, parsed.side),
        element_id=element.id,
        frame_index=parsed.frame_index,
        side=parsed.side,
        anchor_px=parsed.anchor_px,
        end_px=parsed.end_px,
        anchor_known=parsed.anchor_known,
        end_known=parsed.end_known and parsed.end_px is not None,
    )
    existing = labels.find(element.id, parsed.frame_index, parsed.side)
    if existing is None and row.id in labels.observations:
        raise SemvizError("its label was given to another element since; delete that one first")
    if existing is None:
        plan.observations.append(row)
    elif replace(existing, id=row.id) == row:
        plan.already += 1
    else:
        raise SemvizError(
            f"element {element.number} is labelled differently in this {parsed.side} image of "
            f"frame {parsed.frame_index}; delete that label first, or import into a new workspace"
        )
    id_ = row.id if existing is None else existing.id
    outline_id = rows.outline_id(id_)
    if parsed.outline is not None and outline_id not in labels.outlines:
        plan.outlines.append(rows.ImportedOutline(outline_id, id_, *parsed.outline))
    if parsed.kept:
        plan.kept[id_] = parsed.kept
