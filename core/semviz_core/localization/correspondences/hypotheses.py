"""Order the poses that couples of the surest pairs imply by the consensus of P.

The consensus of a pose is the log-likelihood of the observed elements if P is their prior: each
is the mapped element j with probability P_ij, at the gain that its azimuth and slopes then have
under the pose, or none.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.jit import compiled
from semviz_core.localization.correspondences.matcher import LearnedCorrespondences
from semviz_core.localization.heading_votes import Effort
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.rating import (
    VOTED_SIGMAS,
    ahead_and_left,
    approximate_gain,
    direction_to,
)
from semviz_core.localization.search import ProposedCandidates
from semviz_core.localization.upright import UprightView, upright_elements

LEAST_P = 1e-4
"""Less likely pairs do not count."""
LEAST_LIKELIHOOD = 1e-3
"""Of an observed element that surely has a pair, under a pose that no pair of it fits."""
MOST_GAIN = 12.0
"""Nats of a single pair."""


@dataclass(frozen=True, eq=False)
class CoupleHypotheses:
    """Poses for ``search``, from the couples of a frame's prioritized pairs."""

    pose: FloatArray  # (h, 6) as in ``heading_votes.PoseCandidates``
    probability: FloatArray  # (m + 1, n + 1) P

    @classmethod
    def of(cls, found: LearnedCorrespondences) -> "CoupleHypotheses":
        """Keep the couples of which both pairs are prioritized."""
        surest = np.zeros(found.match.cost.shape, dtype=bool)
        surest[tuple(found.match.order.T)] = True
        (i, j) = found.couple[..., 0], found.couple[..., 1]
        kept = surest[i, j].all(axis=1)
        return cls(np.ascontiguousarray(found.pose[kept]), found.match.probability)

    def __call__(
        self, problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
    ) -> ProposedCandidates:
        nats = consensus(problem, view, self.pose, self.probability)
        best = np.argsort(-nats, kind="stable")[: effort.polished]
        return ProposedCandidates(self.pose[best], len(self.pose), len(self.pose))


@compiled
def consensus(
    problem: PoseProblem, view: UprightView, poses: FloatArray, probability: FloatArray
) -> FloatArray:
    """Return the consensus (h,) in nats of upright poses (h, 6)."""
    elements, candidate = upright_elements(problem)
    m, n = len(problem.seen), len(elements)
    nats, likelihood = np.zeros(len(poses)), np.empty(m)
    for h in range(len(poses)):
        likelihood[:] = probability[:m, n]
        for j in range(n):
            ahead, left = ahead_and_left(poses[h], elements[j])
            if ahead <= 0.0:
                continue
            direction = direction_to(ahead, left, VOTED_SIGMAS)
            for entry in range(elements[j].first, elements[j].last):
                i = candidate[entry]
                if probability[i, j] < LEAST_P:
                    continue
                gain = approximate_gain(
                    problem.setting, view, view.seen[i], elements[j], direction, poses[h],
                    VOTED_SIGMAS,
                )  # fmt: skip
                if gain > 0.0:
                    likelihood[i] += probability[i, j] * np.exp(min(gain, MOST_GAIN))
        for i in range(m):
            nats[h] += np.log(likelihood[i] + LEAST_LIKELIHOOD)
    return nats
