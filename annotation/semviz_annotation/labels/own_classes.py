"""Classes and attributes that a workspace declares beside those that every workspace has.

They are rows of the labels: logged, undone, backed up and imported with them, so that labels never
come without their classes. An attribute that nobody declared is a text.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from semviz_annotation.labels import rows
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, ElementClass
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz_annotation.labels.labels import Labels

DEFAULT_ATTRIBUTES: Mapping[str, rows.AttributeType] = {
    type_.name: type_
    for type_ in (
        rows.AttributeType("sign code", "text", ()),
        rows.AttributeType("material", "text", ()),
        rows.AttributeType("lamp", "flag", ()),
    )
}
"""The attributes that every workspace has; a declaration replaces one."""
RESERVED = frozenset(
    {"element", "outline", "anchor_known", "end_known", "track_id", "occluded", "rotation",
     "keyframe", "outside"}
)  # fmt: skip
"""What attributes of shapes are called in files of CVAT, COCO and semviz."""
YES, NO = "yes", "no"
_FLAGS = {"yes": YES, "true": YES, "1": YES, "no": NO, "false": NO, "0": NO}


@lru_cache(maxsize=256)
def class_set(declared: tuple[rows.ClassDeclaration, ...]) -> ClassSet:
    """Return the classes of every workspace and the declared ones, by id.

    Raise SemvizError if two have the same name, letter or key.
    """
    own = sorted(declared, key=lambda row: row.id)
    keys = [row.key for row in own if row.key]
    if len(set(keys)) < len(keys):
        raise SemvizError(f"two classes share a key: {', '.join(keys)}")
    return ClassSet(
        (
            *DEFAULT_CLASSES,
            *(
                ElementClass(
                    row.id, row.name, row.kind, row.letter, row.shape, row.color, row.color_light
                )
                for row in own
            ),
        )
    )


def check_classes(changes: Iterable[rows.RowChange], classes: ClassSet) -> None:
    """Raise SemvizError if the class of an element that ``changes`` write is not one of these."""
    for change in changes:
        if isinstance(change.after, rows.LabelElement):
            classes[change.after.class_id]


def class_keys(labels: "Labels") -> dict[int, str]:
    """Return the key of each class on the page, by class id; own classes may have none."""
    keys = {class_.id: str(number) for number, class_ in enumerate(DEFAULT_CLASSES, 1)}
    return keys | {row.id: row.key for row in labels.own_classes.values() if row.key}


def attribute_types(labels: "Labels") -> dict[str, rows.AttributeType]:
    """Return what is declared of attributes, by name: of every workspace, and of this one."""
    return {**DEFAULT_ATTRIBUTES, **labels.attribute_types}


def checked_value(value: str, type_: rows.AttributeType | None) -> str:
    """Return ``value`` as it is stored. Raise SemvizError if it is not of the type."""
    value = " ".join(value.split())
    if not 0 < len(value) <= rows.MAX_VALUE_LENGTH or not value.isprintable():
        raise SemvizError(f"a value has 1 to {rows.MAX_VALUE_LENGTH} characters that are printable")
    if type_ is None:
        return value
    match type_.type:
        case "flag":
            if value.lower() not in _FLAGS:
                raise SemvizError(f"{type_.name} is yes or no, not {value!r}")
            return _FLAGS[value.lower()]
        case "number":
            if not re.fullmatch(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d{1,2})?", value, re.ASCII):
                raise SemvizError(f"{type_.name} is a number, not {value!r}")
            return repr(float(value)).removesuffix(".0")
        case "choice" if value not in type_.choices:
            raise SemvizError(f"{type_.name} is {' or '.join(type_.choices)}, not {value!r}")
    return value


def check_name(name: str) -> None:
    """Raise SemvizError if no attribute can have this name: files of labels use it otherwise."""
    if not re.fullmatch(rows.NAME_PATTERN, name) or not name.isprintable():
        raise SemvizError(
            f"{ascii(name)[:60]} is no name: 1 to 40 characters without comma, colon, ; or ="
        )
    if name in RESERVED:
        raise SemvizError(f"{name!r} means something else in files of labels; choose another name")


@dataclass(frozen=True)
class DeclareClass:
    """Declare a class, or change what is shown of it; its kind stays as it is."""

    declaration: rows.ClassDeclaration
    kind: Literal["declare class"] = "declare class"

    def changes(self, labels: "Labels", rules: rows.Rules) -> Iterator[rows.RowChange]:
        row = self.declaration
        before = labels.own_classes.get(row.id)
        if before is not None and before.kind != row.kind:
            raise SemvizError(f"the class {before.name} is {before.kind}-like and stays so")
        if before != row:
            yield rows.RowChange(before, row)


@dataclass(frozen=True)
class RemoveClass:
    """Remove a class that no element has."""

    class_id: int
    kind: Literal["remove class"] = "remove class"

    def changes(self, labels: "Labels", rules: rows.Rules) -> Iterator[rows.RowChange]:
        yield rows.RowChange(labels.own_classes[self.class_id], None)


@dataclass(frozen=True)
class DeclareAttribute:
    """Declare of what type the values of an attribute are; those that exist must be of it."""

    type: rows.AttributeType
    kind: Literal["declare attribute"] = "declare attribute"

    def changes(self, labels: "Labels", rules: rows.Rules) -> Iterator[rows.RowChange]:
        check_name(self.type.name)
        if bool(self.type.choices) != (self.type.type == "choice"):
            raise SemvizError("an attribute of the type choice has choices, and no other has")
        for row in labels.attributes.values():
            if row.name == self.type.name:
                checked_value(row.value, self.type)
        before = labels.attribute_types.get(self.type.name)
        if before != self.type:
            yield rows.RowChange(before, self.type)


@dataclass(frozen=True)
class CopyDeclarations:
    """Declare classes and attributes as another label file does, with their ids."""

    declared: tuple[rows.ClassDeclaration | rows.AttributeType, ...]
    kind: Literal["copy declarations"] = "copy declarations"

    def changes(self, labels: "Labels", rules: rows.Rules) -> Iterator[rows.RowChange]:
        for row in self.declared:
            before = labels.row(rows.row_key(row))
            if before != row:
                yield rows.RowChange(before, row)


@dataclass(frozen=True)
class SetAttribute:
    """Set an attribute of an element; None removes it."""

    element_id: rows.Id
    name: rows.AttributeName
    value: Annotated[str, Field(max_length=rows.MAX_VALUE_LENGTH)] | None
    kind: Literal["set attribute"] = "set attribute"

    __pydantic_config__: ClassVar[ConfigDict] = rows.STRICT

    def changes(self, labels: "Labels", rules: rows.Rules) -> Iterator[rows.RowChange]:
        labels.element(self.element_id)
        check_name(self.name)
        id_ = rows.attribute_id(self.element_id, self.name)
        before, after = labels.attributes.get(id_), None
        if self.value is not None:
            value = checked_value(self.value, attribute_types(labels).get(self.name))
            after = rows.Attribute(id_, self.element_id, self.name, value)
        if before != after:
            yield rows.RowChange(before, after)
