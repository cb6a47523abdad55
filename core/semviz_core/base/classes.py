"""The element classes of a map: names, letters, colours, and what the middle of a triangle is.

A class id is stored in files and is never reused.

The middle of a triangular sign is the middle of its box, or the centroid of its corners. The
centroid projects onto the centroid under any affine view, also of a triangle upside down (give
way); the middle of the box does not. The two are a sixth of the height apart. A value or file that
does not say which it follows is older, and follows the box.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np

from semviz_core.base.elements import SIGMA_PX_RANGE, Elements2D
from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.common.errors import SemvizError

Kind = Literal["line", "point"]
ClassShape = Literal["line", "triangle", "square", "circle", "diamond", "pentagon"]


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
    shape: ClassShape
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


def as_known(class_id: IntArray, is_line: BoolArray, known: ClassSet) -> IntArray:
    """Return the classes (m,) of elements as a network of the classes ``known`` sees them.

    Another line-like class counts as the first line-like one, a pole; another point-like class as
    the first whose glyph is a square, a rectangular sign, else as the first point-like one.
    """
    ids = np.array([class_.id for class_ in known])
    other = ~np.isin(class_id, ids)
    if not other.any():
        return class_id
    lines = [class_.id for class_ in known if class_.kind == "line"]
    squares = [class_.id for class_ in known if class_.shape == "square"]
    points = squares + [class_.id for class_ in known if class_.kind == "point"]
    if ((other & is_line).any() and not lines) or ((other & ~is_line).any() and not points):
        raise SemvizError("the network knows no class like those of the elements")
    instead = np.where(is_line, lines[0] if lines else 0, points[0] if points else 0)
    return np.where(other, instead, class_id)


TriangleCenter: TypeAlias = Literal["box", "centroid"]
OLDER_CENTER: Final[TriangleCenter] = "box"
"""What values and files follow that do not say it."""
NEW_CENTER: Final[TriangleCenter] = "centroid"
"""What new workspaces and simulated streets follow."""
SIGMA_RATIO = float(np.sqrt(10.0 / 9.0))
"""Sigma of the centroid's row over that of the box's. With independent errors s of the upper and
lower edge, (top + bottom) / 2 has the variance s^2 / 2, and (top + 2 bottom) / 3 has 5 s^2 / 9."""


def parse_triangle_center(value: Any) -> TriangleCenter:
    """Return the definition in a file; None, if it says nothing, is the box.

    Raise SemvizError for any other value.
    """
    if value is None:
        return OLDER_CENTER
    if value not in get_args(TriangleCenter):
        raise SemvizError(f"triangle_center is {str(value)[:40]!r}; known are box and centroid")
    known: TriangleCenter = value
    return known


def describe_center(center: TriangleCenter) -> str:
    """Return the definition in words, for people."""
    return "the middle of its box" if center == "box" else "the centroid of its corners"


def with_center(elements: Elements2D, source: TriangleCenter, target: TriangleCenter) -> Elements2D:
    """Return observed elements (m) that follow ``source`` as they are in ``target``.

    Only triangular signs move. Raise SemvizError if the height of one is not known.
    """
    rows = np.flatnonzero(elements.class_id == TRIANGULAR)
    if source == target or not len(rows):
        return elements
    shift = elements.to_centroid_px[rows]
    if np.isnan(shift).any():
        raise SemvizError(
            f"a triangular sign is {describe_center(source)}, but {describe_center(target)} is "
            "needed and its height is not known; use labels, detections and maps of one definition"
        )
    to = 1.0 if target == "centroid" else -1.0
    anchor_px, sigma_px = elements.anchor_px.copy(), elements.sigma_px.copy()
    anchor_px[rows, 1] += to * shift
    sigma_px[rows] = np.clip(sigma_px[rows] * SIGMA_RATIO**to, *SIGMA_PX_RANGE)
    return replace(elements, anchor_px=anchor_px, sigma_px=sigma_px)
