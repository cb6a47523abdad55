"""Which matches agree with a pose, one-to-one, and the pose that fits those best."""

from dataclasses import dataclass
from math import comb
from typing import NamedTuple

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.frame import Prior
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.association import associate
from semviz_core.solving.known import known_chi2
from semviz_core.solving.least_squares import fit, fit_pairs
from semviz_core.solving.matched.matches import NEEDED_PAIRS, Estimate, Matches
from semviz_core.solving.refine import MOST_SIGMA_M, MOST_SIGMA_RAD, Failure
from semviz_core.solving.residuals import SURE
from semviz_core.solving.scene import Known, Scene

SIGMAS_PX = (6.0, 2.0, 0.0)
"""Blur of ``Scenes``. The first is how far off in the image the rest is under a pose from a
minimal sample of true matches."""
CHANCE_FIT = 3e-4
"""Chance that a wrong match agrees with a wrong pose, counted on matches that were all wrong."""
MOST_CHANCE = 0.01
"""Most wrong poses that are accepted per frame without a single true match."""
LEAST_INFORMATION = 1e-3
"""Of the pose's weakest direction, whose sigma is then 30 m or rad: inverting stays exact."""
LEAST_GAIN = 0.1
"""Smaller improvements (nats) are not worth another round."""
_ROUNDS = 6
_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Consensus:
    """A pose fitted to the matches that agree with it."""

    rotation: FloatArray  # (3, 3) T_camera_map
    translation: FloatArray  # (3,)
    mapped: IntArray  # (m,) mapped row of each observed element, -1 for none
    gain: float
    """How much better (nats) its matches explain what is seen than false detections do, and how
    well the pose fits what is known beforehand."""

    def inlier(self, pairs: IntArray) -> BoolArray:
        """(k,) which of ``pairs`` agree."""
        return np.asarray(self.mapped[pairs[:, 0]] == pairs[:, 1])


class Scenes(NamedTuple):
    """One scene of the given matches with detections blurred less and less.

    Under a pose from a minimal sample everything else is off by many sigmas, where it is cut off
    and bottoms pass for hidden: sharp eyes would settle on whatever fits by chance.
    """

    far: Scene
    near: Scene
    sharp: Scene

    @classmethod
    def of(cls, matches: Matches) -> "Scenes":
        return cls(*(matches.scene(sigma_px) for sigma_px in SIGMAS_PX))


@compiled
def rate(far: Scene, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """(b,) gains (nats) of poses (b, 3, 3) and (b, 3) from minimal samples."""
    gains = np.zeros(len(rotation))
    for pose in range(len(rotation)):
        mapped, gain = associate(far, rotation[pose], translation[pose], SURE)
        gains[pose] = _sum_of(mapped, gain)
    return gains


def settle(scenes: Scenes, known: Known, R: FloatArray, t: FloatArray) -> Consensus:
    """The consensus near a pose."""
    return Consensus(*_settle(scenes, known, R, t))


def polish(scenes: Scenes, known: Known, found: Consensus) -> Consensus:
    """The best consensus near ``found``: one wrong match, or one bottom wrongly taken for seen or
    hidden, can hold a pose away from it, so each match is left out in turn."""
    return Consensus(
        *_polish(scenes, known, found.rotation, found.translation, found.mapped, found.gain)
    )


@compiled
def _settle(
    scenes: Scenes, known: Known, R: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    mapped = np.zeros(0, np.int64)
    total = -np.inf
    for scene in (scenes.far, scenes.near, scenes.sharp):
        mapped, gain = associate(scene, R, t, SURE)
        for _ in range(_ROUNDS):
            if (mapped >= 0).sum() < NEEDED_PAIRS:
                return R, t, mapped, -np.inf
            R, t, _, _ = fit(scene, known, R, t, mapped, _ITERATIONS)
            before = mapped
            mapped, gain = associate(scene, R, t, SURE)
            if (mapped == before).all():
                break
        total = _sum_of(mapped, gain)
    return R, t, mapped, total - 0.5 * known_chi2(known, R, t)


@compiled
def _polish(
    scenes: Scenes, known: Known, R: FloatArray, t: FloatArray, mapped: IntArray, gain: float
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    best, before = (R, t, mapped, gain), -np.inf
    while best[3] > before + LEAST_GAIN:
        R, t, mapped, before = best
        for i in np.flatnonzero(mapped >= 0):
            others = mapped.copy()
            others[i] = -1
            away_R, away_t, _, _ = fit(scenes.near, known, R, t, others, _ITERATIONS)
            found = _settle(scenes, known, away_R, away_t)
            if found[3] > best[3]:
                best = found
    return best


def estimate_of(
    matches: Matches, scene: Scene, prior: Prior | None, best: Consensus | None, hypotheses: int
) -> Estimate | Failure:
    """The answer that a consensus gives, or why it gives none."""
    if best is None:
        return too_few_agree(matches, NEEDED_PAIRS - 1, hypotheses)
    inlier = best.inlier(matches.pairs)
    if (found := int(inlier.sum())) < needed_inliers(len(matches)):
        return too_few_agree(matches, found, hypotheses)
    start = Pose(nearest_rotation(best.rotation), best.translation)
    fitted = fit_pairs(scene, prior, start, matches.pairs[inlier])
    return sure_estimate(matches, fitted.T_camera_map, fitted.information, inlier, hypotheses)


def needed_inliers(matches: int) -> int:
    """Fewest of so many matches whose agreement is no chance (a contrario, Moisan, Stival 2004).

    Two of them make up to four poses, with each of which others may agree by chance.
    """
    poses = 4 * comb(matches, 2)
    for inliers in range(NEEDED_PAIRS, matches):
        others = inliers - 2
        if poses * comb(matches - 2, others) * CHANCE_FIT**others < MOST_CHANCE:
            return inliers
    return max(matches, NEEDED_PAIRS)


def too_few_agree(matches: Matches, found: int, hypotheses: int) -> Failure:
    """The failure of a search none of whose poses explains enough matches."""
    needed = needed_inliers(len(matches))
    return Failure(
        f"At most {found} of {len(matches)} matches agree on one of {hypotheses} poses; "
        f"fewer than {needed} may do so by chance."
    )


def sure_estimate(
    matches: Matches,
    T_camera_map: Pose,
    information: FloatArray,
    inlier: BoolArray,
    hypotheses: int,
) -> Estimate | Failure:
    """The pose with its covariance, unless that is too large to be an answer."""
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


@compiled
def _sum_of(mapped: IntArray, gain: FloatArray) -> float:
    total = 0.0
    for i in range(len(mapped)):
        if mapped[i] >= 0:
            total += gain[i, mapped[i]]
    return total
