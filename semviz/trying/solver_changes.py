"""Changes of how the frame is solved."""

from dataclasses import dataclass, replace
from typing import ClassVar

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.matched import METHODS, MatchedMethodName

MATCHED: dict[str, MatchedMethodName] = {one: one for one in METHODS}


@dataclass(frozen=True)
class UseMethod(Change):
    """Another method of ``Localizer``; ``minimal`` or ``p3p`` on the frame's matches."""

    stage: ClassVar[Stage] = Stage.SOLVER
    method: str

    def words(self, semantic_map: SemanticMap) -> str:
        own = " on the frame's matches" if self.method in MATCHED else ""
        return f"with method {self.method}{own}"

    def concerns(self, asked: Asked) -> bool:
        return asked.method != self.method

    def applied(self, asked: Asked) -> Asked:
        if self.method in MATCHED:
            return replace(asked, matched=MATCHED[self.method])
        localizer = replace(asked.localizer, method=self.method, weights=None)
        return replace(asked, localizer=localizer, matched=None)


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
