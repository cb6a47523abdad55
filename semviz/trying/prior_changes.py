"""Changes of what is known beforehand, and of how much of the map is looked at."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap


@dataclass(frozen=True)
class MovePrior(Change):
    """A fix that is elsewhere, seen from the camera's true (else its found) pose."""

    stage: ClassVar[Stage] = Stage.PRIOR
    ahead_m: float
    left_m: float

    def words(self, semantic_map: SemanticMap) -> str:
        moves = [(self.ahead_m, "ahead", "back"), (self.left_m, "to the left", "to the right")]
        said = [f"{abs(m):g} m {one if m > 0 else other}" for m, one, other in moves if m]
        return f"with the prior {' and '.join(said) or '0 m'}"

    def applied(self, asked: Asked) -> Asked:
        if asked.about is None:
            raise SemvizError("neither a true pose nor an answer says which way is ahead")
        ahead = asked.about.rotation[:2, 2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        by_m = self.ahead_m * ahead + self.left_m * np.array([-ahead[1], ahead[0]])
        position_m = asked.prior.position_m + np.append(by_m, 0.0)
        return asked.around(replace(asked.prior, position_m=position_m), asked.radius_m)


@dataclass(frozen=True)
class PriorAtTruth(Change):
    """A fix at the true place."""

    stage: ClassVar[Stage] = Stage.PRIOR

    def words(self, semantic_map: SemanticMap) -> str:
        return "with the prior at the true place"

    def concerns(self, asked: Asked) -> bool:
        return asked.truth is not None

    def applied(self, asked: Asked) -> Asked:
        assert asked.truth is not None
        prior = replace(asked.prior, position_m=asked.truth.translation)
        return asked.around(prior, asked.radius_m)


@dataclass(frozen=True)
class PriorSigma(Change):
    """A fix that is said to be so uncertain."""

    stage: ClassVar[Stage] = Stage.PRIOR
    sigma_m: float

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with the prior ± {self.sigma_m:g} m"

    def concerns(self, asked: Asked) -> bool:
        return asked.prior.horizontal_sigma_m != self.sigma_m

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, prior=replace(asked.prior, horizontal_sigma_m=self.sigma_m))


@dataclass(frozen=True)
class CropRadius(Change):
    """A submap that reaches so far."""

    stage: ClassVar[Stage] = Stage.PRIOR
    radius_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_m < np.inf:
            raise SemvizError(f"crop radius {self.radius_m:g} m: give a positive number")

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with a submap of {self.radius_m:g} m"

    def concerns(self, asked: Asked) -> bool:
        return asked.radius_m != self.radius_m

    def applied(self, asked: Asked) -> Asked:
        return asked.around(asked.prior, self.radius_m)
