"""The paper's pipeline with the costs of a perfect network, a reference that uses the truth.

The costs are the least and the largest that features of length 1 allow. P follows from them as in
the paper (eq. 3-4), so no network of the paper's can match better.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.common.arrays import IntArray
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.methods import Method, MethodResult
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem
from semviz_core.research.paper.matcher import SoftMatches, uniform_transport
from semviz_core.research.paper.method import PaperPipeline

LARGEST_COST = 2.0
"""Between opposite features."""


@dataclass(frozen=True, eq=False)
class TrueCosts:
    """A matcher that knows the true pairs (k, 2), rows of observed and submap."""

    pairs: IntArray

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> SoftMatches:
        sample = Sample.of(observed, submap, camera, prior)
        cost = np.full((len(observed), len(submap)), LARGEST_COST)
        cost[tuple(self.pairs.T)] = 0.0
        possible = sample.seen_class[:, None] == sample.mapped_class
        return SoftMatches(sample, cost, possible, uniform_transport(cost, possible))


@dataclass(frozen=True)
class _WithTrueCosts(Localizer):
    true_costs: TrueCosts = field(kw_only=True)

    def _external_method(self) -> PaperPipeline:
        return PaperPipeline(self.true_costs, self.seed)


@dataclass(frozen=True)
class PaperWithTrueCosts:
    """A reference, not a method: it uses the ground truth."""

    name: str = "paper with true costs"
    seed: int = 0

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        costs = TrueCosts(problem.pairs)
        localizer = _WithTrueCosts("paper", self.seed, detector=DETECTOR, true_costs=costs)
        frame = problem.observed, problem.submap, problem.camera, problem.prior
        return MethodResult.of(localizer.localize(*frame))


METHODS: dict[str, Callable[[], Method]] = {"paper with true costs": PaperWithTrueCosts}
