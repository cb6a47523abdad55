"""Changes of the map: an element less, one more, or one of another class."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage, element_name
from semviz_core.elements import Elements, Elements3D, joined
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap

BEYOND_M = 50.0
"""An element further outside the crop than this is seen by nobody."""


@dataclass(frozen=True)
class DropElement(Change):
    """The map without one element."""

    stage: ClassVar[Stage] = Stage.MAP
    element: int

    def words(self, semantic_map: SemanticMap) -> str:
        return f"without {element_name(semantic_map, self.element)}"

    def concerns(self, asked: Asked) -> bool:
        return bool((asked.submap.id == self.element).any())

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, submap=self.mended(asked.submap))

    def mended(self, elements: Elements3D) -> Elements3D:
        return elements[elements.id != self.element]


@dataclass(frozen=True)
class ElementClass(Change):
    """One mapped element of another class."""

    stage: ClassVar[Stage] = Stage.MAP
    element: int
    class_id: int

    def words(self, semantic_map: SemanticMap) -> str:
        name = semantic_map.classes[self.class_id].name
        return f"with {element_name(semantic_map, self.element)} as {name}"

    def concerns(self, asked: Asked) -> bool:
        rows = asked.submap.id == self.element
        return bool((asked.submap.class_id[rows] != self.class_id).any())

    def applied(self, asked: Asked) -> Asked:
        check_kind(asked, asked.submap, self.class_id, np.flatnonzero(self._mine(asked.submap)))
        return replace(asked, submap=self.mended(asked.submap))

    def mended(self, elements: Elements3D) -> Elements3D:
        named = np.where(self._mine(elements), self.class_id, elements.class_id)
        return replace(elements, class_id=named)

    def _mine(self, elements: Elements3D) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.asarray(elements.id == self.element)


@dataclass(frozen=True)
class AddElement(Change):
    """An element of the map that the submap left out."""

    stage: ClassVar[Stage] = Stage.SUBMAP
    element: int

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with {element_name(semantic_map, self.element)} in the submap"

    def concerns(self, asked: Asked) -> bool:
        if (asked.submap.id == self.element).any():
            return False
        offset_m = self._added(asked).anchor_m[:, :2] - asked.prior.position_m[:2]
        reach_m = asked.radius_m + BEYOND_M
        return bool((np.linalg.norm(offset_m, axis=1) < reach_m).any())

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, submap=joined(asked.submap, self._added(asked)))

    def _added(self, asked: Asked) -> Elements3D:
        elements = asked.semantic_map.elements
        return elements[elements.id == self.element]


def check_kind(asked: Asked, elements: Elements, class_id: int, rows: np.ndarray) -> None:
    """SemvizError where a pole would become a sign, or a sign a pole."""
    classes = asked.localizer.classes
    if class_id not in classes:
        raise SemvizError(f"there is no class {class_id}")
    if (elements.is_line[rows] != (classes[class_id].kind == "line")).any():
        raise SemvizError(f"a {classes[class_id].name} has another shape; choose a class like it")
