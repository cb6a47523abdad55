"""A change: one thing that is otherwise than in the run."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

from semviz.trying.asked import Asked
from semviz_core.elements import Elements3D
from semviz_core.semantic_map import SemanticMap


class Stage(IntEnum):
    """Changes are made in this order, whatever order they are named in."""

    MAP = 0
    PRIOR = 1
    SUBMAP = 2
    SEEN = 3
    PAIRS = 4
    SOLVER = 5


@dataclass(frozen=True)
class Change(ABC):
    """Made of JSON values; those that are about a row of one frame name the frame's number."""

    stage: ClassVar[Stage]

    @abstractmethod
    def words(self, semantic_map: SemanticMap) -> str:
        """As it follows 'Trying', such as ``without R-052``."""

    def concerns(self, asked: Asked) -> bool:
        """Whether anything is otherwise in this frame."""
        return True

    @abstractmethod
    def applied(self, asked: Asked) -> Asked:
        """The question with this change, of a frame that it concerns."""

    def mended(self, elements: Elements3D) -> Elements3D:
        """Elements of the map with this change; most change none."""
        return elements


def element_name(semantic_map: SemanticMap, element: int) -> str:
    """Such as R-052; the id alone where the map has no such element."""
    elements = semantic_map.elements
    for class_id in elements.class_id[elements.id == element].tolist():
        return semantic_map.classes.element_name(class_id, element)
    return f"element {element}"
