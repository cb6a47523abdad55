"""RANSAC over minimal samples of poles and signs, with one-to-one consensus and refinement.

Samples are drawn by score (Fischler and Bolles 1981), and residuals are truncated (Torr and
Zisserman 2000). Local optimization (Chum, Matas and Kittler 2003) of poses that are rated higher
than all before pairs again within the covariance of each fit. Samples are drawn until the best
pose is more than chance (`chance`) and one of inliers alone was very likely among them. A pose
whose covariance is too large is no result.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import inverse
from semviz_core.localization.association import associate
from semviz_core.localization.least_squares import fit, fit_record
from semviz_core.localization.matched.chance import (
    Consensus,
    agrees_by_chance,
    needed_inliers,
)
from semviz_core.localization.matched.matches import NEEDED_PAIRS, Estimate, Matches
from semviz_core.localization.matched.minimal_solvers import Constraints, sample_poses
from semviz_core.localization.prior_residuals import prior_chi2
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.refinement import MOST_SIGMA_M, MOST_SIGMA_RAD, Failure
from semviz_core.localization.residuals import EXACT_POSE

SAMPLE_SIGMA_PX = 6.0
"""Typical residual of true matches under a pose from a minimal sample of others."""
LEAST_INFORMATION = 1e-3
"""Least information of the pose's weakest direction (sigma 30 m or rad) that is inverted."""
LEAST_GAIN = 0.1
"""Smaller improvements (nats) are not worth another round."""
_ROUNDS = 4
_STEPS, _STEPS_WITHOUT = np.int64(6), np.int64(4)
"""Most steps of a fit, and of one without one of the pairs. Plain integers would have the fit
compiled once for each of them."""


def blurred(problem: PoseProblem, sigma_px: float) -> PoseProblem:
    """Return ``problem`` with detections that are less certain by ``sigma_px``."""
    seen = problem.seen.copy()
    seen["variance_px2"] += sigma_px**2
    return problem._replace(seen=seen)


class Leading(NamedTuple):
    """The best consensus so far."""

    consensus: tuple[FloatArray, FloatArray, IntArray, float]
    """Fields of ``Consensus``."""
    rating: float
    """The highest gain (nats) of a pose from a sample."""


@compiled
def optimize_best(
    problem: PoseProblem,
    rough: PoseProblem,
    prior: PriorRecord,
    rotation: FloatArray,
    translation: FloatArray,
    leading: Leading,
) -> Leading:
    """Return what leads after poses (b, 3, 3) and (b, 3) from minimal samples.

    They are rated in the ``rough`` problem, whose detections are blurred by SAMPLE_SIGMA_PX. Those
    that are rated higher than all before are optimized locally.
    """
    gains = np.zeros(len(rotation))
    for row in range(len(rotation)):
        _, gain = associate(rough, rotation[row], translation[row], EXACT_POSE.copy())
        gains[row] = gain.sum()
    best, most = leading.consensus, leading.rating
    for row in np.argsort(-gains, kind="mergesort")[:OPTIMIZED]:
        if gains[row] <= leading.rating:
            break
        R, t = rotation[row], translation[row]
        mapped, _ = associate(rough, R, t, EXACT_POSE.copy())
        found = _find_consensus(problem, prior, R, t, mapped)
        if found[3] > best[3]:
            best = found
        most = max(most, gains[row])
    return Leading(best, most)


def find_consensus(
    problem: PoseProblem, prior: PriorRecord, R: FloatArray, t: FloatArray, mapped: IntArray
) -> Consensus:
    """Return the consensus near a pose with its pairs."""
    return Consensus(*_find_consensus(problem, prior, R, t, mapped))


def improve_consensus(problem: PoseProblem, prior: PriorRecord, consensus: Consensus) -> Consensus:
    """Return the best consensus near a given one, leaving out each match in turn: a wrong match, or
    a bottom wrongly taken for visible or hidden, can hold the pose away from it."""
    start = consensus.rotation, consensus.translation, consensus.mapped, consensus.gain
    return Consensus(*_improve_consensus(problem, prior, *start))


@compiled
def _find_consensus(
    problem: PoseProblem, prior: PriorRecord, R: FloatArray, t: FloatArray, mapped: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Fit the pose to its pairs, and pair again within its covariance, until they stay the same."""
    for _ in range(_ROUNDS):
        if (mapped >= 0).sum() < NEEDED_PAIRS:
            return R, t, mapped, -np.inf
        R, t, information, _ = fit(problem, prior, R, t, mapped, _STEPS)
        before = mapped
        mapped, _ = associate(problem, R, t, _covariance(information))
        if (mapped == before).all():
            break
    mapped, gain = associate(problem, R, t, EXACT_POSE.copy())
    return R, t, mapped, gain.sum() - 0.5 * prior_chi2(prior, R, t)


@compiled
def _covariance(information: FloatArray) -> FloatArray:
    """Return the inverse (6, 6), finite even if the pairs do not fix the pose."""
    return inverse(information + LEAST_INFORMATION * np.eye(6))


@compiled
def _improve_consensus(
    problem: PoseProblem,
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    mapped: IntArray,
    gain: float,
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    best, before = (R, t, mapped, gain), -np.inf
    while best[3] > before + LEAST_GAIN:
        R, t, mapped, before = best
        for i in np.flatnonzero(mapped >= 0):
            others = mapped.copy()
            others[i] = -1
            free_R, free_t, information, _ = fit(problem, prior, R, t, others, _STEPS_WITHOUT)
            again, _ = associate(problem, free_R, free_t, _covariance(information))
            if (again == mapped).all():
                continue  # the other pairs confirm this one
            candidate = _find_consensus(problem, prior, free_R, free_t, again)
            if candidate[3] > best[3]:
                best = candidate
    return best


def estimate_of(
    matches: Matches,
    problem: PoseProblem,
    prior: PriorRecord,
    best: Consensus,
    hypotheses: int,
) -> Estimate | Failure:
    """Return the pose of a consensus, or why there is none."""
    inlier = best.inlier(matches.pairs)
    if agrees_by_chance(matches, problem, prior, best):
        return too_few_agree(matches, max(int(inlier.sum()), NEEDED_PAIRS - 1), hypotheses)
    start = Pose(nearest_rotation(best.rotation), best.translation)
    fitted = fit_record(problem, prior, start, matches.pairs[inlier])
    return confident_estimate(matches, fitted.T_camera_map, fitted.information, inlier, hypotheses)


def too_few_agree(matches: Matches, agreeing: int, hypotheses: int) -> Failure:
    """Return the failure of a search without a pose that explains enough matches."""
    needed = needed_inliers(len(matches))
    return Failure(
        f"At most {agreeing} of {len(matches)} matches agree on one of {hypotheses} poses; "
        f"fewer than {needed} may do so by chance."
    )


def confident_estimate(
    matches: Matches,
    T_camera_map: Pose,
    information: FloatArray,
    inlier: BoolArray,
    hypotheses: int,
) -> Estimate | Failure:
    """Return the pose with its covariance, or a Failure if the covariance is too large."""
    weakest = np.linalg.eigvalsh(information)[0]
    if weakest > LEAST_INFORMATION:
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
        sigma_rad = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
        if sigma_m <= MOST_SIGMA_M and sigma_rad <= MOST_SIGMA_RAD:
            return Estimate(T_camera_map, covariance, matches.pairs, inlier, hypotheses)
    return Failure(
        f"The {int(inlier.sum())} matches that agree do not fix the pose "
        f"to {MOST_SIGMA_M:.0f} m and {np.rad2deg(MOST_SIGMA_RAD):.0f} deg."
    )


FIRST_BATCH, BATCH = 40, 100
"""Samples drawn and scored at once."""
MOST_SAMPLES = 3000
OPTIMIZED = 4
"""Poses of each batch that are optimized locally."""
MISS_PROBABILITY = 1e-3
"""Accepted chance that no sample consisting of inliers only was drawn."""
NOISE_FACTORS = 4.0, 1.5
"""Samples of inliers drawn until one gives a good pose in spite of noise: without gravity, and
with it."""
TWO_MATCH_SHARES = 0.5, 0.8
"""Share of samples of two matches, if samples of two and of three are possible; likewise."""
LEAST_WEIGHT = 1e-3
"""Weight of matches of score 0, so that they are drawn occasionally."""
GPS_SIGMAS = 5.0
"""Poses further from the prior's position are not evaluated."""
CONTRADICTION = 12.0
"""A prior that reduces the consensus by more than this (nats) is taken to be wrong."""


def ransac_minimal(matches: Matches, prior: Prior | None, seed: int) -> Estimate | Failure:
    """Return the pose with the largest one-to-one consensus, or why there is none."""
    rng = np.random.default_rng(seed)
    sampler, record = _Sampler.of(matches, prior), PriorRecord.of(prior)
    problem = matches.problem()
    problems = problem, blurred(problem, SAMPLE_SIGMA_PX)
    leading = Leading((np.eye(3), np.zeros(3), np.full(len(problem.seen), -1), 0.0), 0.0)
    best = Consensus(*leading.consensus)
    drawn = evaluated = 0
    while drawn < MOST_SAMPLES and (
        drawn < sampler.enough(matches, best) or agrees_by_chance(matches, problem, record, best)
    ):
        batch = BATCH if drawn else FIRST_BATCH
        poses = sampler.poses(rng, batch)
        drawn, evaluated = drawn + batch, evaluated + len(poses[0])
        leading = optimize_best(*problems, record, *poses, leading)
        best = Consensus(*leading.consensus)
    if best.gain > 0.0:
        best, record = _improve_with_prior(problem, record, best)
    return estimate_of(matches, problem, record, best, evaluated)


def _improve_with_prior(
    problem: PoseProblem, prior: PriorRecord, consensus: Consensus
) -> tuple[Consensus, PriorRecord]:
    """Return the best consensus near a given one, and the prior unless the matches contradict it.

    A road's height, for example, is off by many sigmas where another road crosses.
    """
    best = improve_consensus(problem, prior, consensus)
    if not prior.value["has_position"]:
        return best, prior
    nothing = PriorRecord.of(None)
    start = best.rotation, best.translation, best.mapped
    alone = improve_consensus(problem, nothing, find_consensus(problem, nothing, *start))
    if alone.gain > best.gain + CONTRADICTION:
        return alone, nothing
    return best, prior


@dataclass(frozen=True, eq=False)
class _Sampler:
    """Draws minimal samples by score and solves them."""

    prior: Prior | None
    constraints: Constraints
    weight: FloatArray  # (k,)
    conflicts: BoolArray  # (k, k)
    two_suffice: BoolArray  # (k,)

    @property
    def upright(self) -> bool:
        """Whether gravity is known."""
        return self.prior is not None and self.prior.up_camera is not None

    @classmethod
    def of(cls, matches: Matches, prior: Prior | None) -> "_Sampler":
        constraints = Constraints.of(matches)
        upright = prior is not None and prior.up_camera is not None
        return cls(
            prior,
            constraints,
            np.maximum(matches.score, LEAST_WEIGHT),
            matches.conflicts(),
            constraints.two_suffice(upright),
        )

    def poses(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Return rotations (b, 3, 3) and translations (b, 3) that fit ``count`` samples."""
        twos = round(count * TWO_MATCH_SHARES[self.upright]) if self.two_suffice.sum() > 1 else 0
        up = None if self.prior is None else self.prior.up_camera
        pairs = draw_samples(self.weight * self.two_suffice, self.conflicts, rng.random((twos, 2)))
        triples = draw_samples(self.weight, self.conflicts, rng.random((count - twos, 3)))
        batches = [sample_poses(self.constraints, samples, up) for samples in (pairs, triples)]
        rotation, translation = (np.concatenate(arrays) for arrays in zip(*batches, strict=True))
        near = self._near_prior(rotation, translation)
        return rotation[near], translation[near]

    def enough(self, matches: Matches, best: Consensus) -> float:
        """Return the number of samples after which one of inliers only was very likely drawn."""
        if not best.gain > 0.0:
            return MOST_SAMPLES
        weight, two, inlier = self.weight, self.two_suffice, best.inlier(matches.pairs)
        twos = TWO_MATCH_SHARES[self.upright] if two.sum() > 1 else 0.0
        chance = (1.0 - twos) * (weight[inlier].sum() / weight.sum()) ** 3
        if (inlier & two).sum() > 1:
            chance += twos * (weight[inlier & two].sum() / weight[two].sum()) ** 2
        factor = NOISE_FACTORS[self.upright]
        needed = factor * np.log(MISS_PROBABILITY) / np.log1p(-min(chance, 0.999))
        return float(min(needed, MOST_SAMPLES))

    def _near_prior(self, rotation: FloatArray, translation: FloatArray) -> BoolArray:
        if self.prior is None:
            return np.ones(len(rotation), dtype=bool)
        center = -np.einsum("bji,bj->bi", rotation, translation)
        off = np.linalg.norm((center - self.prior.position_m)[:, :2], axis=1)
        near: BoolArray = off < GPS_SIGMAS * self.prior.horizontal_sigma_m
        return near


@compiled
def draw_samples(weight: FloatArray, conflicts: BoolArray, draws: FloatArray) -> IntArray:
    """Return samples (b, s) of the k matches, drawn by weight (k,), no element twice.

    ``conflicts`` (k, k) are the pairs with a common element, ``draws`` (c, s) uniform numbers.
    Impossible samples are dropped.
    """
    samples, count = np.empty(draws.shape, dtype=np.int64), 0
    for draw in draws:
        left = weight.copy()
        possible = True
        for column in range(len(draw)):
            sums = np.cumsum(left)
            if sums[-1] <= 0.0:
                possible = False
                break
            chosen = min(
                np.searchsorted(sums, draw[column] * sums[-1], side="right"), len(left) - 1
            )
            samples[count, column] = chosen
            left[conflicts[chosen]] = 0.0
        count += possible
    return samples[:count]
