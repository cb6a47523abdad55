"""The learned matcher on one frame: P with dustbins, the couples it rests on, and their poses.

The poses that couples of the surest pairs imply are ordered by the consensus of P: the
log-likelihood of the observed elements if P is their prior. Each is the mapped element j with
probability P_ij, at the gain that its azimuth and slopes then have under the pose, or none.

Without torch: geometry and network are NumPy and compiled loops.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Match
from semviz_core.base.weights import NetworkWeights, load_trained, version_error
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.association import SURELY_REAL_NATS, sinkhorn_with_dustbin
from semviz_core.localization.correspondences import network
from semviz_core.localization.correspondences.candidate_pairs import (
    Compass,
    Sample,
    candidate_pairs,
)
from semviz_core.localization.correspondences.couples import FrameGeometry
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

TASK = "matcher"
NO_PAIRS: IntArray = np.empty((0, 2), dtype=np.int64)
SUREST_PER_SEEN = 12
"""Prioritized pairs, per observed element."""
LEAST_P = 1e-4
"""Less likely pairs do not count."""
LEAST_LIKELIHOOD = 1e-3
"""Of an observed element that surely has a pair, under a pose that no pair of it fits."""
MOST_GAIN = 12.0
"""Nats of a single pair."""


@dataclass(frozen=True, eq=False)
class LearnedCorrespondences:
    """P of a frame, and the poses that couples of its pairs imply."""

    match: Match
    couple: IntArray
    """(E, 2, 2) rows (observed, mapped) of the two pairs of each couple."""
    pose: FloatArray
    """(E, 6) of upright cameras in the map, as in ``heading_votes.PoseCandidates``, at the height
    of the road."""


@dataclass(frozen=True, eq=False)
class PairMatcher:
    """The trained network: its weights and its classes."""

    weights: network.Weights
    classes: ClassSet

    def match(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        possible: BoolArray | None = None,
        forced: IntArray = NO_PAIRS,
    ) -> LearnedCorrespondences:
        """Return the correspondences of a frame with at least one observed and one mapped element.

        ``possible`` (m, n) are the pairs that may be, by default those of one class; ``forced``
        (k, 2) those that surely are.
        """
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        if possible is None:
            possible = sample.seen_class[:, None] == sample.mapped_class
        frame = FrameGeometry.of(candidate_pairs(sample, possible), Compass.of(sample))
        log_odds = network.pair_log_odds(
            self.weights, frame, sample.seen_class, len(sample.mapped_class)
        )
        log_odds = np.where(possible, log_odds, -np.inf)
        log_odds[tuple(forced.T)] = SURELY_REAL_NATS
        probability = sinkhorn_with_dustbin(log_odds)
        match = Match(-log_odds, probability, prioritized_pairs(probability))
        rows = np.column_stack([frame.pairs.seen, frame.pairs.mapped])
        couple = np.stack([rows[frame.couples.first], rows[frame.couples.second]], axis=1)
        return LearnedCorrespondences(match, couple, _in_map(frame, sample))


def prioritized_pairs(probability: FloatArray) -> IntArray:
    """Return (k, 2) the surest pairs of P (m + 1, n + 1), surest first: SUREST_PER_SEEN an observed
    element, fewer if others are impossible."""
    P = probability[:-1, :-1]
    order = np.argsort(-P, axis=None, kind="stable")[: SUREST_PER_SEEN * len(P)]
    pairs = np.column_stack(np.divmod(order, max(P.shape[1], 1)))
    return np.asarray(pairs[P[tuple(pairs.T)] > 0.0])


def couple_poses(sample: Sample) -> FloatArray:
    """Return the poses (E, 6) of all couples of candidate pairs of one class."""
    possible = sample.seen_class[:, None] == sample.mapped_class
    frame = FrameGeometry.of(candidate_pairs(sample, possible), Compass.of(sample))
    return _in_map(frame, sample)


def _in_map(frame: FrameGeometry, sample: Sample) -> FloatArray:
    """Return the couples' poses (E, 6)."""
    camera, turn = frame.couples.camera_m, frame.couples.turn
    place = np.column_stack([camera.real, camera.imag])
    height = sample.road[0] + place @ sample.road[1:]
    position_m = np.column_stack([place, height]) + sample.origin_m
    return np.column_stack([position_m, turn.real, turn.imag, np.zeros(len(turn))])


def load_pair_matcher(path: Path | None, classes: ClassSet) -> PairMatcher:
    """Return the matcher with the weights at ``path`` (default: the shipped ones).

    Raise SemvizError if the file is missing or holds another network.
    """
    return load_trained(TASK, path, classes, _built)


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> PairMatcher:
    shapes = {name: tensor.shape for name, tensor in weights.tensors.items()}
    if shapes != network.tensor_shapes(len(classes)):
        raise version_error(TASK, path)
    return PairMatcher(weights.tensors, classes)


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
