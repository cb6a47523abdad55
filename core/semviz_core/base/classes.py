"""The element classes of a map, with their names, letters and colours.

A class id is stored in files and is never reused.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from semviz_core.common.errors import SemvizError

Kind = Literal["line", "point"]


@dataclass(frozen=True)
class ElementClass:
    """One class of element. ``id`` is stored in files and never reused.

    ``letter`` starts the names that people read (``P-04``). ``shape`` is the glyph, which shows
    the class without colour. ``color`` is sRGB hex for dark backgrounds and images,
    ``color_light`` for light backgrounds.
    """

    id: int
    name: str
    kind: Kind
    letter: str
    shape: Literal["line", "triangle", "square", "circle", "diamond", "pentagon"]
    color: str
    color_light: str


@dataclass(frozen=True)
class ClassSet:
    """The classes of a workspace; ids, names and letters are unique."""

    classes: tuple[ElementClass, ...]

    def __post_init__(self) -> None:
        for field in ("id", "name", "letter"):
            values = [getattr(class_, field) for class_ in self.classes]
            if len(set(values)) != len(values):
                raise SemvizError(f"two classes share the same {field}: {values}")

    def __iter__(self) -> Iterator[ElementClass]:
        return iter(self.classes)

    def __len__(self) -> int:
        return len(self.classes)

    @cached_property
    def _by_id(self) -> dict[int, ElementClass]:
        return {class_.id: class_ for class_ in self.classes}

    def __contains__(self, class_id: object) -> bool:
        return class_id in self._by_id

    def __getitem__(self, class_id: int) -> ElementClass:
        try:
            return self._by_id[int(class_id)]
        except KeyError:
            known = ", ".join(f"{class_.id} ({class_.name})" for class_ in self.classes)
            raise SemvizError(f"unknown class {class_id}; known are {known}") from None

    def element_name(self, class_id: int, element_id: int) -> str:
        """Return the name that people read: ``P-04``."""
        return f"{self[class_id].letter}-{element_id:02d}"


POLE, TRIANGULAR, RECTANGULAR, ROUNDED = range(4)

DEFAULT_CLASSES = ClassSet(
    (
        ElementClass(POLE, "pole", "line", "P", "line", "#EFE154", "#946200"),
        ElementClass(TRIANGULAR, "triangular sign", "point", "T", "triangle", "#FA4888", "#6E0A34"),
        ElementClass(RECTANGULAR, "rectangular sign", "point", "R", "square", "#429CDF", "#1546C0"),
        ElementClass(ROUNDED, "rounded sign", "point", "O", "circle", "#7EF2E5", "#0A8A78"),
    )
)
"""The paper's four classes (section III-A)."""
