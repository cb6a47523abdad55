"""Changes to the prior, the submap radius, and the method.

A prior moves along the axes of the true camera pose, or else of the estimate.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.what_if.change import FrameRequest, Stage, WhatIfChange
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.localization.matched import METHODS, MatchedMethodName


@dataclass(frozen=True)
class MovePrior(WhatIfChange):
    """Move the prior, in the horizontal axes of the true camera pose, or else of the estimate."""

    stage: ClassVar[Stage] = Stage.PRIOR
    ahead_m: float
    left_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        moves = [(self.ahead_m, "ahead", "back"), (self.left_m, "to the left", "to the right")]
        texts = [
            f"{abs(m):g} m {positive if m > 0 else negative}"
            for m, positive, negative in moves
            if m
        ]
        return f"with the prior {' and '.join(texts) or '0 m'}"

    def applied(self, request: FrameRequest) -> FrameRequest:
        if request.reference_pose is None:
            raise SemvizError(
                "without a true pose or an estimate, 'ahead' is unknown; choose another change"
            )
        ahead = request.reference_pose.rotation[:2, 2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        by_m = self.ahead_m * ahead + self.left_m * np.array([-ahead[1], ahead[0]])
        position_m = request.prior.position_m + np.append(by_m, 0.0)
        return request.with_prior(replace(request.prior, position_m=position_m), request.radius_m)


@dataclass(frozen=True)
class PriorAtTruth(WhatIfChange):
    """Move the prior to the true position."""

    stage: ClassVar[Stage] = Stage.PRIOR

    def describe(self, semantic_map: SemanticMap) -> str:
        return "with the prior at the true position"

    def affects(self, request: FrameRequest) -> bool:
        return request.truth is not None

    def applied(self, request: FrameRequest) -> FrameRequest:
        assert request.truth is not None
        prior = replace(request.prior, position_m=request.truth.translation)
        return request.with_prior(prior, request.radius_m)


@dataclass(frozen=True)
class PriorSigma(WhatIfChange):
    """Change the horizontal sigma of the prior."""

    stage: ClassVar[Stage] = Stage.PRIOR
    sigma_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with the prior ± {self.sigma_m:g} m"

    def affects(self, request: FrameRequest) -> bool:
        return request.prior.horizontal_sigma_m != self.sigma_m

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, prior=replace(request.prior, horizontal_sigma_m=self.sigma_m))


@dataclass(frozen=True)
class CropRadius(WhatIfChange):
    """Change the radius of the submap."""

    stage: ClassVar[Stage] = Stage.PRIOR
    radius_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_m < np.inf:
            raise SemvizError(f"submap radius {self.radius_m:g} m: give a positive number")

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with a submap of {self.radius_m:g} m"

    def affects(self, request: FrameRequest) -> bool:
        return request.radius_m != self.radius_m

    def applied(self, request: FrameRequest) -> FrameRequest:
        return request.with_prior(request.prior, self.radius_m)


MATCHED: dict[str, MatchedMethodName] = {name: name for name in METHODS}


@dataclass(frozen=True)
class UseMethod(WhatIfChange):
    """Use another method of ``Localizer``; or ``minimal`` or ``p3p`` on the recorded matches."""

    stage: ClassVar[Stage] = Stage.SOLVER
    method: str

    def describe(self, semantic_map: SemanticMap) -> str:
        matched = " on the recorded matches" if self.method in MATCHED else ""
        return f"with method {self.method}{matched}"

    def affects(self, request: FrameRequest) -> bool:
        return request.method != self.method

    def applied(self, request: FrameRequest) -> FrameRequest:
        if self.method in MATCHED:
            return replace(request, matched=MATCHED[self.method])
        localizer = replace(request.localizer, method=self.method, weights=None)
        return replace(request, localizer=localizer, matched=None)


@dataclass(frozen=True)
class StartAtTruth(WhatIfChange):
    """Refine from the true pose, without a search."""

    stage: ClassVar[Stage] = Stage.SOLVER

    def describe(self, semantic_map: SemanticMap) -> str:
        return "from the true pose"

    def affects(self, request: FrameRequest) -> bool:
        return request.truth is not None

    def applied(self, request: FrameRequest) -> FrameRequest:
        assert request.truth is not None
        return replace(request, start=request.truth.inverse())
