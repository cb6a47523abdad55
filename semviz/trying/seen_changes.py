"""Changes of what is seen: a detection less, or of another class; scores, noise and classes."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage
from semviz.trying.map_changes import check_kind
from semviz_core.arrays import IntArray
from semviz_core.classes import ClassSet
from semviz_core.elements import SIGMA_PX_RANGE, Elements
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap


@dataclass(frozen=True)
class DropDetection(Change):
    """A frame without one of its detections."""

    stage: ClassVar[Stage] = Stage.SEEN
    frame: int
    observed: int

    def words(self, semantic_map: SemanticMap) -> str:
        return f"without detection #{self.observed}"

    def concerns(self, asked: Asked) -> bool:
        return is_there(asked, self.frame, self.observed)

    def applied(self, asked: Asked) -> Asked:
        return asked.keeping(np.flatnonzero(asked.row != self.observed))


@dataclass(frozen=True)
class DetectionClass(Change):
    """A frame with one detection of another class."""

    stage: ClassVar[Stage] = Stage.SEEN
    frame: int
    observed: int
    class_id: int

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with detection #{self.observed} as {semantic_map.classes[self.class_id].name}"

    def concerns(self, asked: Asked) -> bool:
        mine = asked.row == self.observed
        differs = (asked.observed.class_id[mine] != self.class_id).any()
        return is_there(asked, self.frame, self.observed) and bool(differs)

    def applied(self, asked: Asked) -> Asked:
        mine = asked.row == self.observed
        check_kind(asked, asked.observed, self.class_id, np.flatnonzero(mine))
        named = np.where(mine, self.class_id, asked.observed.class_id)
        return replace(asked, observed=replace(asked.observed, class_id=named))


@dataclass(frozen=True)
class LeastScore(Change):
    """Detections with a lower score are left out."""

    stage: ClassVar[Stage] = Stage.SEEN
    score: float

    def words(self, semantic_map: SemanticMap) -> str:
        return f"without detections of a score below {self.score:g}"

    def concerns(self, asked: Asked) -> bool:
        return bool((asked.observed.score < self.score).any())

    def applied(self, asked: Asked) -> Asked:
        return asked.keeping(np.flatnonzero(asked.observed.score >= self.score))


@dataclass(frozen=True)
class NoiseFactor(Change):
    """Detections that are said to be so many times as far off."""

    stage: ClassVar[Stage] = Stage.SEEN
    factor: float

    def __post_init__(self) -> None:
        if not 0.0 < self.factor < np.inf:
            raise SemvizError(f"noise times {self.factor:g}: give a positive number")

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with {self.factor:g} times the detections' noise"

    def applied(self, asked: Asked) -> Asked:
        sigma_px = np.clip(asked.observed.sigma_px * self.factor, *SIGMA_PX_RANGE)
        return replace(asked, observed=replace(asked.observed, sigma_px=sigma_px))


@dataclass(frozen=True)
class IgnoreClasses(Change):
    """Poles and signs, whatever their classes: what is left without semantics."""

    stage: ClassVar[Stage] = Stage.SEEN

    def words(self, semantic_map: SemanticMap) -> str:
        return "without classes"

    def applied(self, asked: Asked) -> Asked:
        classes = asked.localizer.classes
        return replace(
            asked,
            observed=replace(asked.observed, class_id=_alike(asked.observed, classes)),
            submap=replace(asked.submap, class_id=_alike(asked.submap, classes)),
        )


def is_there(asked: Asked, frame: int, observed: int) -> bool:
    """Whether the question is of this frame, and has this detection."""
    return asked.record.frame.index == frame and observed in asked.row.tolist()


def _alike(elements: Elements, classes: ClassSet) -> IntArray:
    """(n,) the first class of each kind."""
    first = {one.kind: one.id for one in reversed(tuple(classes))}
    return np.where(elements.is_line, first.get("line", -1), first.get("point", -1))
