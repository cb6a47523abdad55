"""Declare a class of a workspace's own: what is not given is chosen unlike the other classes."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from pydantic import TypeAdapter, ValidationError

from semviz_annotation.labels import rows
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.own_classes import DeclareClass, check_name, class_keys
from semviz_core.base.classes import ClassShape, ElementClass, Kind
from semviz_core.common.errors import SemvizError

PALETTE = (("#A5C3FD", "#030363"), ("#BE93A8", "#4B3D66"), ("#E6FECD", "#246056"),
           ("#B5CF81", "#463A02"), ("#F1B1B1", "#8C7A54"), ("#9D79AF", "#66583D"))  # fmt: skip
"""Colours on dark and light for classes that are given none: unlike those of the usual classes, and
unlike the colour of an estimated pose, also for who does not see all colours."""
_KEYS = "56789"
_POINT_SHAPES: tuple[ClassShape, ...] = ("diamond", "pentagon", "square", "triangle", "circle")


@dataclass(frozen=True)
class ClassLook:
    """What is shown of a class; None: chosen so that it differs from the others."""

    shape: ClassShape | None = None
    color: str | None = None
    color_light: str | None = None
    letter: str | None = None
    key: str | None = None


def new_class(
    labels: Labels, class_id: int, name: str, kind: Kind, look: ClassLook
) -> DeclareClass:
    """Return the edit that declares a class. Raise SemvizError if its name is none."""
    others = labels.classes
    _check_class_name(name, others)
    letters = [name.upper()[:1], *"ABCDEFGHIJKLMNQSUVWXYZ"]
    letters += [first + second for first in letters for second in "123456789"]
    taken = {class_.letter for class_ in others}
    shapes: tuple[ClassShape, ...] = ("line",) if kind == "line" else _POINT_SHAPES
    colors = {class_.color for class_ in others}
    dark, light = next((pair for pair in PALETTE if pair[0] not in colors), PALETTE[0])
    keys = set(class_keys(labels).values())
    row = rows.ClassDeclaration(
        id=class_id,
        name=name,
        kind=kind,
        letter=next(letter for letter in letters if letter.isascii() and letter not in taken),
        shape=next((s for s in shapes if s not in {class_.shape for class_ in others}), shapes[0]),
        color=dark,
        color_light=light,
        key=next((key for key in _KEYS if key not in keys), ""),
    )
    return DeclareClass(_with_look(row, look))


def changed_class(labels: Labels, name: str, look: ClassLook, new_name: str) -> DeclareClass:
    """Return the edit that changes what is shown of a class, and its name unless ``new_name`` is
    empty. Raise SemvizError if there is no such class of the workspace's own."""
    row = own_class(labels, name)
    if new_name:
        _check_class_name(new_name, (other for other in labels.classes if other.id != row.id))
        row = replace(row, name=new_name)
    return DeclareClass(_with_look(row, look))


def _check_class_name(name: str, others: Iterable[ElementClass]) -> None:
    check_name(name)
    if name.lower() in {"ignore", *(class_.name.lower() for class_ in others)}:
        raise SemvizError(f"{name!r} has a meaning already; choose another name")


def own_class(labels: Labels, name: str) -> rows.ClassDeclaration:
    """Return a class of the workspace's own. Raise SemvizError if there is none of that name."""
    row = next((row for row in labels.own_classes.values() if row.name == name), None)
    if row is None:
        names = ", ".join(row.name for row in labels.own_classes.values()) or "none"
        raise SemvizError(f"{name!r} is no class of this workspace's own; these are: {names}")
    return row


def _with_look(row: rows.ClassDeclaration, look: ClassLook) -> rows.ClassDeclaration:
    """Return a declaration with what is given of a look. Raise SemvizError if it is none."""
    given = {name: value for name, value in asdict(look).items() if value is not None}
    if (row.kind == "line") != (given.get("shape", row.shape) == "line"):
        raise SemvizError("the glyph 'line' is for line-like classes, the others for point-like")
    values = asdict(row) | given
    values |= {name: values[name].upper() for name in ("color", "color_light", "letter")}
    try:
        return _DECLARATION.validate_json(json.dumps(values))
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        what = _MEANT.get(str(fault["loc"][0]), fault["msg"])
        raise SemvizError(f"{what}, not {str(values[str(fault['loc'][0])])[:40]!r}") from None


_DECLARATION = TypeAdapter(rows.ClassDeclaration)
_MEANT = {
    "color": "a colour is written #RRGGBB",
    "color_light": "a colour is written #RRGGBB",
    "letter": "a letter is A to Z, or one of these and a letter or digit",
    "key": "a key is 5 to 9; 1 to 4 are those of the usual classes",
}
