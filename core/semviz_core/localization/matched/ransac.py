"""RANSAC over minimal samples of poles and signs, with one-to-one consensus and refinement.

Samples are drawn by score (Fischler and Bolles 1981), and residuals are truncated (Torr and
Zisserman 2000). Local optimization (Chum, Matas and Kittler 2003) runs on problems whose
detection noise is annealed. The number of inliers needed follows a contrario from chance
agreement (Moisan and Stival 2004). A pose whose covariance is too large is no result.
"""

from dataclasses import dataclass
from math import comb
from typing import NamedTuple

import numpy as np

from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.association import associate
from semviz_core.localization.least_squares import fit, fit_pairs
from semviz_core.localization.matched.matches import NEEDED_PAIRS, Estimate, Matches
from semviz_core.localization.matched.minimal_solvers import Constraints, sample_poses
from semviz_core.localization.prior_residuals import prior_chi2
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.refinement import MOST_SIGMA_M, MOST_SIGMA_RAD, Failure
from semviz_core.localization.residuals import EXACT_POSE

SIGMAS_PX = (6.0, 2.0, 0.0)
"""Blur of ``AnnealedProblems``. The first is the typical residual of true matches under a pose
from a minimal sample of others."""
CHANCE_FIT = 3e-4
"""Chance that a wrong match agrees with a wrong pose, measured on matches that were all wrong."""
MOST_CHANCE = 0.01
"""Largest expected number of wrong poses accepted per frame without a single true match."""
LEAST_INFORMATION = 1e-3
"""Least information of the pose's weakest direction (sigma 30 m or rad) that is inverted."""
LEAST_GAIN = 0.1
"""Smaller improvements (nats) are not worth another round."""
_ROUNDS = 6
_ITERATIONS = np.int64(20)  # a plain integer would have the fit compiled once more


@dataclass(frozen=True, eq=False)
class Consensus:
    """A pose fitted to the matches that agree with it."""

    rotation: FloatArray  # (3, 3) T_camera_map
    translation: FloatArray  # (3,)
    mapped: IntArray  # (m,) mapped row of each observed element, -1 for none
    gain: float
    """Log-likelihood (nats) of its matches over false positives, and of the prior."""

    def inlier(self, pairs: IntArray) -> BoolArray:
        """Return (k,) which of ``pairs`` agree."""
        return np.asarray(self.mapped[pairs[:, 0]] == pairs[:, 1])


class AnnealedProblems(NamedTuple):
    """The problem of the given matches, with detections blurred less and less.

    Under a pose from a minimal sample, the other true matches are off by many sigmas: their
    residuals are truncated, and bottoms pass for hidden. Without blur, the optimization would
    converge to whatever fits by chance.
    """

    far: PoseProblem
    near: PoseProblem
    sharp: PoseProblem

    @classmethod
    def of(cls, matches: Matches) -> "AnnealedProblems":
        return cls(*(matches.problem(sigma_px) for sigma_px in SIGMAS_PX))


@compiled
def rate_samples(far: PoseProblem, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the gains (b,) in nats of poses (b, 3, 3) and (b, 3) from minimal samples."""
    gains = np.zeros(len(rotation))
    for pose in range(len(rotation)):
        _, gain = associate(far, rotation[pose], translation[pose], EXACT_POSE)
        gains[pose] = gain.sum()
    return gains


def find_consensus(
    problems: AnnealedProblems, prior: PriorRecord, R: FloatArray, t: FloatArray
) -> Consensus:
    """Return the consensus near a pose."""
    return Consensus(*_find_consensus(problems, prior, R, t))


def improve_consensus(
    problems: AnnealedProblems, prior: PriorRecord, consensus: Consensus
) -> Consensus:
    """Return the best consensus near a given one, leaving out each match in turn: a wrong match, or
    a bottom wrongly taken for visible or hidden, can hold the pose away from it."""
    start = consensus.rotation, consensus.translation, consensus.mapped, consensus.gain
    return Consensus(*_improve_consensus(problems, prior, *start))


@compiled
def _find_consensus(
    problems: AnnealedProblems, prior: PriorRecord, R: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    mapped = np.zeros(0, np.int64)
    total = -np.inf
    for problem in (problems.far, problems.near, problems.sharp):
        mapped, gain = associate(problem, R, t, EXACT_POSE)
        for _ in range(_ROUNDS):
            if (mapped >= 0).sum() < NEEDED_PAIRS:
                return R, t, mapped, -np.inf
            R, t, _, _ = fit(problem, prior, R, t, mapped, _ITERATIONS)
            before = mapped
            mapped, gain = associate(problem, R, t, EXACT_POSE)
            if (mapped == before).all():
                break
        total = gain.sum()
    return R, t, mapped, total - 0.5 * prior_chi2(prior, R, t)


@compiled
def _improve_consensus(
    problems: AnnealedProblems,
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
            free_R, free_t, _, _ = fit(problems.near, prior, R, t, others, _ITERATIONS)
            candidate = _find_consensus(problems, prior, free_R, free_t)
            if candidate[3] > best[3]:
                best = candidate
    return best


def estimate_of(
    matches: Matches,
    problem: PoseProblem,
    prior: Prior | None,
    best: Consensus | None,
    hypotheses: int,
) -> Estimate | Failure:
    """Return the pose of a consensus, or why there is none."""
    if best is None:
        return too_few_agree(matches, NEEDED_PAIRS - 1, hypotheses)
    inlier = best.inlier(matches.pairs)
    if (inliers := int(inlier.sum())) < needed_inliers(len(matches)):
        return too_few_agree(matches, inliers, hypotheses)
    start = Pose(nearest_rotation(best.rotation), best.translation)
    fitted = fit_pairs(problem, prior, start, matches.pairs[inlier])
    return confident_estimate(matches, fitted.T_camera_map, fitted.information, inlier, hypotheses)


def needed_inliers(matches: int) -> int:
    """Return the fewest of ``matches`` whose agreement is not due to chance.

    A contrario (Moisan and Stival 2004): two matches give up to four poses, and others may agree
    with each of these by chance.
    """
    poses = 4 * comb(matches, 2)
    for inliers in range(NEEDED_PAIRS, matches):
        others = inliers - 2
        if poses * comb(matches - 2, others) * CHANCE_FIT**others < MOST_CHANCE:
            return inliers
    return max(matches, NEEDED_PAIRS)


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


BATCH = 100
"""Samples drawn and scored at once."""
MOST_SAMPLES = 3000
OPTIMIZED = 12
"""Poses of each batch that are optimized locally."""
MISS_PROBABILITY = 1e-3
"""Accepted chance that no sample consisting of inliers only was drawn."""
NOISE_FACTOR = 3.0
"""Samples of inliers drawn until one gives a good pose in spite of noise."""
TWO_MATCH_SHARE = 0.5
"""Share of samples of two matches, if samples of two and of three are possible."""
LEAST_WEIGHT = 1e-3
"""Weight of matches of score 0, so that they are drawn occasionally."""
GPS_SIGMAS = 5.0
"""Poses further from the prior's position are not evaluated."""
CONTRADICTION = 12.0
"""A prior that reduces the consensus by more than this (nats) is taken to be wrong."""


def ransac_minimal(matches: Matches, prior: Prior | None, seed: int) -> Estimate | Failure:
    """Return the pose with the largest one-to-one consensus, or why there is none."""
    rng = np.random.default_rng(seed)
    sampler = _Sampler.of(matches, prior)
    problems, record = AnnealedProblems.of(matches), PriorRecord.of(prior)
    best: Consensus | None = None
    drawn = evaluated = 0
    while drawn < sampler.enough(matches, best):
        rotation, translation = sampler.poses(rng)
        drawn, evaluated = drawn + BATCH, evaluated + len(rotation)
        rating = rate_samples(problems.far, rotation, translation)
        for row in np.argsort(-rating, kind="stable")[:OPTIMIZED]:
            consensus = find_consensus(problems, record, rotation[row], translation[row])
            if consensus.gain > (0.0 if best is None else best.gain):
                best = consensus
    if best is not None:
        best, prior = _improve_with_prior(problems, prior, best)
    return estimate_of(matches, problems.sharp, prior, best, evaluated)


def _improve_with_prior(
    problems: AnnealedProblems, prior: Prior | None, consensus: Consensus
) -> tuple[Consensus, Prior | None]:
    """Return the best consensus near a given one, and the prior unless the matches contradict it.

    A road's height, for example, is off by many sigmas where another road crosses.
    """
    best = improve_consensus(problems, PriorRecord.of(prior), consensus)
    if prior is None:
        return best, None
    nothing = PriorRecord.of(None)
    alone = improve_consensus(
        problems, nothing, find_consensus(problems, nothing, best.rotation, best.translation)
    )
    if alone.gain > best.gain + CONTRADICTION:
        return alone, None
    return best, prior


@dataclass(frozen=True, eq=False)
class _Sampler:
    """Draws minimal samples by score and solves them."""

    prior: Prior | None
    constraints: Constraints
    log_weight: FloatArray  # (k,)
    conflicts: BoolArray  # (k, k)
    two_suffice: BoolArray  # (k,)

    @classmethod
    def of(cls, matches: Matches, prior: Prior | None) -> "_Sampler":
        constraints = Constraints.of(matches)
        upright = prior is not None and prior.up_camera is not None
        weight = np.maximum(matches.score, LEAST_WEIGHT)
        return cls(
            prior,
            constraints,
            np.log(weight),
            matches.conflicts(),
            constraints.two_suffice(upright),
        )

    def poses(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return rotations (b, 3, 3) and translations (b, 3) that fit the samples of a batch."""
        twos = round(BATCH * TWO_MATCH_SHARE) if self.two_suffice.sum() > 1 else 0
        up = None if self.prior is None else self.prior.up_camera
        samples = self._draw(rng, twos, 2), self._draw(rng, BATCH - twos, 3)
        batches = [sample_poses(self.constraints, sample, up) for sample in samples]
        rotation, translation = (np.concatenate(arrays) for arrays in zip(*batches, strict=True))
        near = self._near_prior(rotation, translation)
        return rotation[near], translation[near]

    def enough(self, matches: Matches, best: Consensus | None) -> float:
        """Return the number of samples after which one of inliers only was very likely drawn."""
        if best is None:
            return MOST_SAMPLES
        weight, two, inlier = np.exp(self.log_weight), self.two_suffice, best.inlier(matches.pairs)
        chance = (1.0 - TWO_MATCH_SHARE) * (weight[inlier].sum() / weight.sum()) ** 3
        if (inlier & two).sum() > 1:
            share = weight[inlier & two].sum() / weight[two].sum()
            chance += TWO_MATCH_SHARE * share**2
        needed = NOISE_FACTOR * np.log(MISS_PROBABILITY) / np.log1p(-min(chance, 0.999))
        return float(min(needed, MOST_SAMPLES))

    def _draw(self, rng: np.random.Generator, count: int, size: int) -> IntArray:
        """Draw ``count`` samples of ``size`` matches by weight, no element twice.

        Adding Gumbel noise to log weights and taking the largest draws by weight. Impossible
        samples are dropped.
        """
        allowed = self.two_suffice if size == 2 else np.ones(len(self.log_weight), dtype=bool)
        noise = rng.gumbel(size=(count, len(self.log_weight)))
        key = np.where(allowed, self.log_weight + noise, -np.inf)
        chosen = np.empty((count, size), dtype=np.int64)
        possible = np.ones(count, dtype=bool)
        for column in range(size):
            chosen[:, column] = key.argmax(axis=1)
            possible &= np.isfinite(key.max(axis=1))
            key = np.where(self.conflicts[chosen[:, column]], -np.inf, key)
        return chosen[possible]

    def _near_prior(self, rotation: FloatArray, translation: FloatArray) -> BoolArray:
        if self.prior is None:
            return np.ones(len(rotation), dtype=bool)
        center = -np.einsum("bji,bj->bi", rotation, translation)
        off = np.linalg.norm((center - self.prior.position_m)[:, :2], axis=1)
        near: BoolArray = off < GPS_SIGMAS * self.prior.horizontal_sigma_m
        return near
