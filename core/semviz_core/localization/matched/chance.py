"""Tell whether wrong matches may agree on a pose by chance, a contrario (Moisan and Stival 2004).

Either so many agree that chance does not explain it, wherever the pose is; or so closely, near what
the prior says, that sets of wrong matches are not expected to. Three or four matches need the
second.
"""

from dataclasses import dataclass
from math import comb, log

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.localization.least_squares import fit
from semviz_core.localization.matched.matches import NEEDED_PAIRS, Matches
from semviz_core.localization.problem import PoseProblem, PriorRecord

MOST_CHANCE = 0.01
"""Largest expected number of wrong poses accepted per frame without a single true match."""
CHANCE_FIT = 3e-4
"""Chance that a wrong match agrees with a wrong pose, measured on matches that were all wrong."""
ANY_HEADING, ANY_ROTATION = 1.0 / (2.0 * np.pi), 2.0 * np.pi / (8.0 * np.pi**2) ** (2.0 / 3.0)
"""Information (1/rad^2) of a Gaussian that in its middle is as dense as headings, or rotations,
that may be any: 1/(2 pi), or 1/(8 pi^2)."""
LEAST_SPREAD_M = 1.0
_NO_STEPS = np.int64(0)


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


def agrees_by_chance(
    matches: Matches, problem: PoseProblem, prior: PriorRecord, best: Consensus
) -> bool:
    """Return whether wrong matches may agree as well as those of a pose, or none agree on it."""
    if not best.gain > 0.0:
        return True
    if (best.mapped >= 0).sum() >= needed_inliers(len(matches)):
        return False
    return log_false_alarms(matches, problem, prior, best) > log(MOST_CHANCE)


def needed_inliers(matches: int) -> int:
    """Return the fewest of ``matches`` whose agreement, by their number, is not due to chance.

    Two matches give up to four poses, and others may agree with each of these by chance.
    """
    poses = 4 * comb(matches, 2)
    for inliers in range(NEEDED_PAIRS, matches):
        others = inliers - 2
        if poses * comb(matches - 2, others) * CHANCE_FIT**others < MOST_CHANCE:
            return inliers
    return max(matches, NEEDED_PAIRS)


def log_false_alarms(
    matches: Matches, problem: PoseProblem, prior: PriorRecord, best: Consensus
) -> float:
    """Return the logarithm of how many sets of wrong matches are expected to agree as well.

    A set's likelihood, averaged over the poses that were possible before (Laplace), over that of
    wrong matches is 1 in the mean over wrong matches. It exceeds x for fewer than 1/x of the sets
    (Markov's inequality).
    """
    inliers = int((best.mapped >= 0).sum())
    nats = best.gain + inliers * float(problem.setting["log_false_detections"])
    even = _information_of_even(matches, prior, best.rotation)
    pose, none = (best.rotation, best.translation), np.full_like(best.mapped, -1)
    after, before = (
        np.linalg.slogdet(fit(problem, prior, *pose, mapped, _NO_STEPS)[2] + even)[1]
        for mapped in (best.mapped, none)
    )
    return float(log(comb(len(matches), inliers)) - nats - 0.5 * (before - after))


def _information_of_even(matches: Matches, prior: PriorRecord, R: FloatArray) -> FloatArray:
    """Return the information (6, 6) of Gaussians as dense as what is even where ``prior`` is open:
    turns may be any, and a camera without a fix is among the mapped elements."""
    even = np.zeros((6, 6))
    if not prior.value["has_position"]:
        spread_m = max(float(matches.points_m()[0].std(axis=0).max()), LEAST_SPREAD_M)
        even[:3, :3] = np.eye(3) / spread_m**2
    if not prior.value["has_up"]:
        even[3:, 3:] = ANY_ROTATION * np.eye(3)
    elif not prior.value["has_heading"]:
        even[3:, 3:] = ANY_HEADING * np.outer(R[:, 2], R[:, 2])
    return even
