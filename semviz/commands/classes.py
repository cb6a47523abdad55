"""The commands classes list, add, change, remove and attribute."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands import parsing

if TYPE_CHECKING:
    from semviz_annotation.labels.class_looks import ClassLook
    from semviz_annotation.storage.store import LabelStore

Glyph: TypeAlias = Annotated[
    Literal["line", "triangle", "square", "circle", "diamond", "pentagon"] | None,
    arg(metavar="{line,triangle,square,circle,diamond,pentagon}", help_behavior_hint=""),
]


@dataclass(frozen=True)
class ClassesListCommand:
    """List the classes of a workspace and the types of its attributes.

    Example: 'semviz classes list town'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    json: bool = False
    """Print one JSON object instead of lines."""

    def run(self) -> int:
        from collections import Counter

        from semviz_annotation.labels.own_classes import attribute_types, class_keys

        labels = parsing.open_workspace(self.workspace).read_labels()
        counts, keys = Counter(row.class_id for row in labels.elements.values()), class_keys(labels)
        classes = [
            asdict(class_) | {"key": keys.get(class_.id, ""), "elements": counts[class_.id]}
            for class_ in labels.classes
        ]
        types = [asdict(type_) for type_ in attribute_types(labels).values()]
        if self.json:
            print(json.dumps({"classes": classes, "attributes": types}))
            return 0
        for row in classes:
            key = f"key {row['key']}" if row["key"] else "no key"
            print(
                f"{row['letter']:<2} {row['name']:<18} {row['kind']:<5} {row['shape']:<8} "
                f"{row['color']} {key}, {row['elements']} elements"
            )
        for type_ in types:
            choices = f": {', '.join(type_['choices'])}" if type_["choices"] else ""
            print(f"attribute {type_['name']}: {type_['type']}{choices}")
        return 0


@dataclass(frozen=True)
class _Look:
    glyph: Glyph = None
    """Shape that shows the class without colour; 'line' for line-like classes."""
    color: parsing.OptionalText = None
    """Colour #RRGGBB on images and dark backgrounds."""
    color_light: parsing.OptionalText = None
    """Colour #RRGGBB on light backgrounds."""
    letter: parsing.OptionalText = None
    """Start of the names of elements, such as G for G-04: one or two characters."""
    key: parsing.OptionalText = None
    """Key of the class on the page, 5 to 9; empty for none."""
    author: parsing.OptionalText = None
    """Author in the history; default: your login name."""
    json: parsing.Json = False

    def look(self) -> "ClassLook":
        from semviz_annotation.labels.class_looks import ClassLook

        return ClassLook(self.glyph, self.color, self.color_light, self.letter, self.key)


@dataclass(frozen=True)
class _Named:
    workspace: Positional[Path]
    """Folder of the workspace; others may label in it meanwhile."""
    name: Positional[str]
    """Name of the class or attribute."""


@dataclass(frozen=True)
class ClassesAddCommand(_Look, _Named):
    """Add a class of your own. What is not given is chosen so that it differs from the others.

    Examples: 'semviz classes add town gantry'; 'semviz classes add town beacon --kind point'."""

    kind: Literal["line", "point"] = "line"
    """line: two ends, as a pole; point: one middle, as a sign. It stays so."""

    def run(self) -> int:
        from semviz.workspace.settings import login_name
        from semviz_annotation.labels.class_looks import new_class

        with parsing.open_workspace(self.workspace).open_labels() as store:
            edit = new_class(store.labels, store.free_class_id(), self.name, self.kind, self.look())
            store.apply(edit, self.author or login_name())
            _print_class(store, edit.declaration.id, self.json)
        return 0


@dataclass(frozen=True)
class ClassesChangeCommand(_Look, _Named):
    """Change what is shown of a class of your own, or its name; its elements follow.

    Example: 'semviz classes change town gantry --color "#FF8800" --new-name portal'."""

    new_name: str = ""
    """Another name."""

    def run(self) -> int:
        from semviz.workspace.settings import login_name
        from semviz_annotation.labels.class_looks import changed_class

        with parsing.open_workspace(self.workspace).open_labels() as store:
            edit = changed_class(store.labels, self.name, self.look(), self.new_name)
            store.apply(edit, self.author or login_name())
            _print_class(store, edit.declaration.id, self.json)
        return 0


@dataclass(frozen=True)
class ClassesRemoveCommand(_Named):
    """Remove a class of your own that no element has.

    Example: 'semviz classes remove town gantry'."""

    author: parsing.OptionalText = None
    """Author in the history; default: your login name."""
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.workspace.settings import login_name
        from semviz_annotation.labels.class_looks import own_class
        from semviz_annotation.labels.own_classes import RemoveClass

        with parsing.open_workspace(self.workspace).open_labels() as store:
            row = own_class(store.labels, self.name)
            store.apply(RemoveClass(row.id), self.author or login_name())
        print(json.dumps({"removed": self.name}) if self.json else f"{self.name} removed")
        return 0


@dataclass(frozen=True)
class ClassesAttributeCommand(_Named):
    """Declare an attribute of elements, so that its values are of one type.

    Example: 'semviz classes attribute town material --choice steel --choice wood'."""

    type: Literal["text", "number", "flag", "choice"] = "text"
    """Type of the values; a flag is yes or no."""
    choice: UseAppendAction[tuple[str, ...]] = ()
    """A value of the type choice; one option per value."""
    author: parsing.OptionalText = None
    """Author in the history; default: your login name."""
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.workspace.settings import login_name
        from semviz_annotation.labels.own_classes import DeclareAttribute
        from semviz_annotation.labels.rows import AttributeType

        type_ = "choice" if self.choice and self.type == "text" else self.type
        declared = AttributeType(self.name, type_, self.choice)
        with parsing.open_workspace(self.workspace).open_labels() as store:
            store.apply(DeclareAttribute(declared), self.author or login_name())
        print(json.dumps(asdict(declared)) if self.json else f"attribute {self.name}: {type_}")
        return 0


def _print_class(store: "LabelStore", class_id: int, as_json: bool) -> None:
    row = store.labels.own_classes[class_id]
    if as_json:
        print(json.dumps(asdict(row)))
        return
    shown = f"{row.letter}-01, {row.kind}-like, {row.shape}, {row.color}"
    print(f"{row.name}: {shown}, " + (f"key {row.key}" if row.key else "no key"))
