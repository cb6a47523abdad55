"""RANSAC over minimal samples of poles and signs, drawn by score, with local optimization.

Fischler and Bolles 1981; truncated residuals after Torr and Zisserman 2000; local optimization
after Chum, Matas and Kittler 2003, on scenes blurred less and less.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.solving.matched.consensus import (
    Consensus,
    Scenes,
    estimate_of,
    polish,
    rate,
    settle,
)
from semviz_core.solving.matched.matches import Estimate, Matches
from semviz_core.solving.matched.samples import Constraints, sample_poses
from semviz_core.solving.refine import Failure
from semviz_core.solving.scene import Known

BATCH = 100
"""Samples drawn and scored at once."""
MOST_SAMPLES = 3000
OPTIMIZED = 12
"""Poses of each batch that are optimized locally."""
MISS_PROBABILITY = 1e-3
"""Accepted chance that no sample of only the best pose's inliers was drawn."""
NOISE_FACTOR = 3.0
"""Samples of inliers needed until one is good: noise spoils some."""
TWO_MATCH_SHARE = 0.5
"""Of samples that are of two matches, where both kinds are possible."""
LEAST_WEIGHT = 1e-3
"""Matches of score 0 are drawn too, seldom."""
GPS_SIGMAS = 5.0
"""Poses further from the prior's position are not tried."""
CONTRADICTION = 12.0
"""A prior that takes more than this from the agreement of matches (nats) is itself wrong."""


def ransac_minimal(matches: Matches, prior: Prior | None, seed: int) -> Estimate | Failure:
    """The pose that the most matches agree with, one-to-one, or why there is none."""
    rng = np.random.default_rng(seed)
    sampler = _Sampler.of(matches, prior)
    scenes, known = Scenes.of(matches), Known.of(prior)
    best: Consensus | None = None
    drawn = tried = 0
    while drawn < sampler.enough(matches, best):
        rotation, translation = sampler.poses(rng)
        drawn, tried = drawn + BATCH, tried + len(rotation)
        rating = rate(scenes.far, rotation, translation)
        for row in np.argsort(-rating, kind="stable")[:OPTIMIZED]:
            found = settle(scenes, known, rotation[row], translation[row])
            if found.gain > (0.0 if best is None else best.gain):
                best = found
    if best is not None:
        best, prior = _polished(scenes, prior, best)
    return estimate_of(matches, scenes.sharp, prior, best, tried)


def _polished(
    scenes: Scenes, prior: Prior | None, found: Consensus
) -> tuple[Consensus, Prior | None]:
    """The best consensus near ``found``, and the prior unless the matches contradict it: a road's
    height, say, is off by many sigmas where another road crosses."""
    best = polish(scenes, Known.of(prior), found)
    if prior is None:
        return best, None
    nothing = Known.of(None)
    alone = polish(scenes, nothing, settle(scenes, nothing, best.rotation, best.translation))
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
        """Rotations (b, 3, 3) and translations (b, 3) that fit the samples of one batch."""
        twos = round(BATCH * TWO_MATCH_SHARE) if self.two_suffice.sum() > 1 else 0
        up = None if self.prior is None else self.prior.up_camera
        samples = self._draw(rng, twos, 2), self._draw(rng, BATCH - twos, 3)
        found = [sample_poses(self.constraints, one, up) for one in samples]
        rotation = np.concatenate([one[0] for one in found])
        translation = np.concatenate([one[1] for one in found])
        near = self._near_prior(rotation, translation)
        return rotation[near], translation[near]

    def enough(self, matches: Matches, best: Consensus | None) -> float:
        """Samples after which one of only inliers was very likely among them."""
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
        """``count`` samples of ``size`` matches by weight, no element twice; fewer where none is.

        Adding Gumbel noise to log weights and taking the largest draws by weight.
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
