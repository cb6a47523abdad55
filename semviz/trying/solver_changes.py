"""Changes of how the frame is solved."""

from dataclasses import dataclass, replace
from typing import ClassVar

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage
from semviz_core.semantic_map import SemanticMap


@dataclass(frozen=True)
class UseMethod(Change):
    """Another method: ``search`` or ``direct``."""

    stage: ClassVar[Stage] = Stage.SOLVER
    method: str

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with method {self.method}"

    def concerns(self, asked: Asked) -> bool:
        return asked.localizer.method != self.method

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, localizer=replace(asked.localizer, method=self.method))


@dataclass(frozen=True)
class StartAtTruth(Change):
    """Refined from the true pose, without a search."""

    stage: ClassVar[Stage] = Stage.SOLVER

    def words(self, semantic_map: SemanticMap) -> str:
        return "from the true pose"

    def concerns(self, asked: Asked) -> bool:
        return asked.truth is not None

    def applied(self, asked: Asked) -> Asked:
        assert asked.truth is not None
        return replace(asked, start=asked.truth.inverse())
