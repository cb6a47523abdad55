"""The learned matcher on one frame: P with dustbins, and the poses that couples of its pairs imply.

With gravity known, the azimuths of two pairs leave the camera an arc on the ground, and their
slopes choose the place on it. These poses are ordered by the consensus of P: the log-likelihood
of the observed elements if P is their prior. Each is the mapped element j with probability P_ij,
at the gain that its azimuth and slopes then have under the pose, or none.

Without torch: geometry and network are NumPy and compiled loops.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Match
from semviz_core.base.weights import NetworkWeights, load_trained, version_error
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.association import SURELY_REAL_NATS
from semviz_core.localization.correspondences import network
from semviz_core.localization.correspondences.candidate_pairs import (
    Compass,
    Sample,
    candidate_pairs,
)
from semviz_core.localization.correspondences.couples import FrameGeometry
from semviz_core.localization.heading_votes import (
    GATE_SIGMAS,
    GATE_WIDER_M,
    Effort,
    heading_allowed,
)
from semviz_core.localization.match_probabilities import sinkhorn_with_dustbin
from semviz_core.localization.prior_residuals import MOST_ROADS, road_heights
from semviz_core.localization.problem import PoseProblem, PriorRecord, RecordArray
from semviz_core.localization.rating import (
    VOTED_SIGMAS,
    PoseSigmas,
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
MOST_COUPLES = 1500
"""Couples that propose poses: those of the surest pairs."""
NEAREST_M, FARTHEST_M, ARC_STEP_M = 3.0, 50.0, 2.0
"""Distances of the first element of a couple that are tried, and limits of the second's."""
LEAST_APART_M, MOST_APART_M = 1.0, 85.0
"""Of the mapped elements of a couple; two on one post give no heading."""
ARC_SIGMAS = PoseSigmas(1.0, 0.15, float(np.deg2rad(1.0)), 1.0)
"""Of the poses that are tried on an arc."""
ROAD_CELLS = 15
"""Cells of equal road height along each side of the square around the fix."""
LEAST_P = 1e-4
"""Less likely pairs do not count."""
LEAST_LIKELIHOOD = 1e-3
"""Of an observed element that surely has a pair, under a pose that no pair of it fits."""
MOST_GAIN = 12.0
"""Nats of a single pair."""


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
    ) -> Match:
        """Return P of a frame with at least one observed and one mapped element.

        ``possible`` (m, n) are the pairs that may be, by default those of one class; ``forced``
        (k, 2) those that surely are.
        """
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        if possible is None:
            possible = observed.class_id[:, None] == submap.class_id
        frame = FrameGeometry.of(candidate_pairs(sample, possible), Compass.of(sample))
        log_odds = network.pair_log_odds(
            self.weights, frame, sample.seen_class, len(sample.mapped_class)
        )
        log_odds = np.where(possible, log_odds, -np.inf)
        log_odds[tuple(forced.T)] = SURELY_REAL_NATS
        probability = sinkhorn_with_dustbin(log_odds)
        return Match(-log_odds, probability, prioritized_pairs(probability))


def prioritized_pairs(probability: FloatArray) -> IntArray:
    """Return (k, 2) the surest pairs of P (m + 1, n + 1), surest first: SUREST_PER_SEEN an observed
    element, fewer if others are impossible."""
    P = probability[:-1, :-1]
    order = np.argsort(-P, axis=None, kind="stable")[: SUREST_PER_SEEN * len(P)]
    pairs = np.column_stack(np.divmod(order, max(P.shape[1], 1)))
    return np.asarray(pairs[P[tuple(pairs.T)] > 0.0])


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

    match: Match

    def __call__(
        self, problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
    ) -> ProposedCandidates:
        probability = self.match.probability
        pose, tried = couple_poses(problem, view, prior, self.match.order, probability)
        nats = consensus(problem, view, pose, probability)
        best = np.argsort(-nats, kind="stable")[: effort.polished]
        return ProposedCandidates(pose[best], tried, len(pose))


@compiled
def couple_poses(
    problem: PoseProblem,
    view: UprightView,
    prior: PriorRecord,
    pairs: IntArray,
    probability: FloatArray,
) -> tuple[FloatArray, int]:
    """Return the poses (h, 6) that couples of ``pairs`` (k, 2) imply, and how many were tried."""
    elements, _ = upright_elements(problem)
    couples = _surest_couples(pairs, probability)
    road = _road_grid(prior)
    poses = np.zeros((2 * len(couples), 6))
    found = tried = 0
    for row in range(len(couples)):
        first, second = pairs[couples[row, 0]], pairs[couples[row, 1]]
        for branch in (-1.0, 1.0):
            fits, count = _best_on_arc(
                problem, view, prior, elements, road, first, second, branch, poses[found]
            )
            found, tried = found + fits, tried + count
    return poses[:found], tried


@compiled
def _surest_couples(pairs: IntArray, probability: FloatArray) -> IntArray:
    """Return the couples (c, 2) of different elements, rows of ``pairs``, surest first."""
    k = len(pairs)
    couples, sure, count = np.empty((k * k // 2, 2), np.int64), np.empty(k * k // 2), 0
    for first in range(k):
        i, j = pairs[first]
        for second in range(first):
            if pairs[second, 0] != i and pairs[second, 1] != j:
                couples[count, 0], couples[count, 1] = first, second
                sure[count] = probability[i, j] * probability[pairs[second, 0], pairs[second, 1]]
                count += 1
    return couples[np.argsort(-sure[:count], kind="mergesort")[:MOST_COUPLES]]


class _RoadGrid(NamedTuple):
    """Heights that a camera can have, by cells around the fix."""

    corner_m: complex
    cell_m: float
    height_m: FloatArray
    """(ROAD_CELLS, ROAD_CELLS, MOST_ROADS), NaN for none"""


@compiled
def _road_grid(prior: PriorRecord) -> _RoadGrid:
    gate = GATE_SIGMAS * prior.value.position_sigma_m[0] + GATE_WIDER_M
    cell = 2.0 * gate / ROAD_CELLS
    corner = complex(prior.value.position_m[0] - gate, prior.value.position_m[1] - gate)
    height = np.full((ROAD_CELLS, ROAD_CELLS, MOST_ROADS), np.nan)
    for column in range(ROAD_CELLS):
        for row in range(ROAD_CELLS):
            x, y = corner.real + (column + 0.5) * cell, corner.imag + (row + 0.5) * cell
            of_cell = road_heights(prior, x, y)
            height[column, row, : len(of_cell)] = of_cell
    return _RoadGrid(corner, cell, height)


@compiled
def _best_on_arc(
    problem: PoseProblem,
    view: UprightView,
    prior: PriorRecord,
    elements: RecordArray,
    road: _RoadGrid,
    first: IntArray,
    second: IntArray,
    branch: float,
    best: FloatArray,
) -> tuple[int, int]:
    """Fill ``best`` (6,) with the pose at which the slopes of two pairs fit best, on one of the two
    branches of the arc; return 1, or 0 if they fit nowhere, and how many poses were tried.

    Gravity known, two azimuths leave the camera an arc through both mapped elements. It is
    tried by the distance of the first; the angle between them then gives that of the second.
    """
    a, b = elements[first[1]].position_m, elements[second[1]].position_m
    place, apart = complex(a[0], a[1]), complex(b[0] - a[0], b[1] - a[1])
    square = apart.real**2 + apart.imag**2
    if not LEAST_APART_M**2 < square < MOST_APART_M**2:
        return 0, 0
    u, v = _azimuth(view, first[0]), _azimuth(view, second[0])
    between = v * np.conj(u)
    pose, most, tried = np.zeros(6), 0.0, 0
    for distance in np.arange(NEAREST_M, FARTHEST_M, ARC_STEP_M):
        root = square - (distance * between.imag) ** 2
        if root < 0.0:
            break
        other = distance * between.real + branch * np.sqrt(root)
        if not NEAREST_M < other < FARTHEST_M:
            continue
        turn = apart * np.conj(other * v - distance * u) / square
        camera = place - distance * u * turn
        column = int((camera.real - road.corner_m.real) // road.cell_m)
        row = int((camera.imag - road.corner_m.imag) // road.cell_m)
        tried += 1
        if not (0 <= column < ROAD_CELLS and 0 <= row < ROAD_CELLS):
            continue
        pose[0], pose[1], pose[3], pose[4] = camera.real, camera.imag, turn.real, turn.imag
        for height in road.height_m[column, row]:
            if np.isnan(height):
                break
            pose[2] = height
            nats = _nats_of_couple(problem, view, elements, pose, first, second)
            if nats > most and heading_allowed(prior, np.arctan2(pose[4], pose[3])):
                best[:], most = pose, nats
    return int(most > 0.0), tried


@compiled
def _azimuth(view: UprightView, row: int) -> complex:
    return complex(view.seen[row].azimuth[0], view.seen[row].azimuth[1])


@compiled
def _nats_of_couple(
    problem: PoseProblem,
    view: UprightView,
    elements: RecordArray,
    pose: FloatArray,
    first: IntArray,
    second: IntArray,
) -> float:
    """Return the gain of both pairs in nats, 0 if one does not fit."""
    total = 0.0
    for pair in (first, second):
        ahead, left = ahead_and_left(pose, elements[pair[1]])
        gain = approximate_gain(
            problem.setting, view, view.seen[pair[0]], elements[pair[1]],
            direction_to(ahead, left, ARC_SIGMAS), pose, ARC_SIGMAS,
        )  # fmt: skip
        if gain == 0.0:
            return 0.0
        total += gain
    return total


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
