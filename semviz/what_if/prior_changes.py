"""Changes to the prior and to the submap around it.

A prior moves along the axes of the true camera pose, or else of the estimate.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.what_if.change import FrameRequest, Stage, WhatIfChange
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.assumptions import GRAVITY, HEADING, PriorPart, raised

LEFT_OUT: dict[str, PriorPart] = {"heading": HEADING, "gravity": GRAVITY}
"""The parts of a prior that can be left out; position and height are changed instead."""


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


@dataclass(frozen=True)
class WithoutPriorPart(WhatIfChange):
    """Leave out the heading or the gravity of the prior."""

    stage: ClassVar[Stage] = Stage.PRIOR
    part: str
    """A key of ``LEFT_OUT``."""

    def __post_init__(self) -> None:
        if self.part not in LEFT_OUT:
            raise SemvizError(f"prior part '{self.part}': give {' or '.join(LEFT_OUT)}")

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"without the {LEFT_OUT[self.part].name}"

    def affects(self, request: FrameRequest) -> bool:
        return LEFT_OUT[self.part].is_given(request.prior)

    def applied(self, request: FrameRequest) -> FrameRequest:
        without, *_ = LEFT_OUT[self.part].without(request.prior)
        return replace(request, prior=without)


@dataclass(frozen=True)
class RaisePrior(WhatIfChange):
    """Raise the height that the prior gives, and the road with it."""

    stage: ClassVar[Stage] = Stage.PRIOR
    up_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with the prior {abs(self.up_m):.2g} m {'higher' if self.up_m > 0.0 else 'lower'}"

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, prior=raised(request.prior, self.up_m))
