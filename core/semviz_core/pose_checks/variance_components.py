"""Tell the errors of given poses from those of measured motions, by maximum likelihood.

An innovation has the errors of two poses and of one motion. The error of a pose is in two
innovations, with opposite signs, and cancels in their sum; errors of motions add up. So the
innovations of one axis have a covariance that is tridiagonal in time, with two variance components.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.pose_checks.comparison import SIGMA_LEAST, PoseComparison

_SHARES = np.geomspace(0.02, 1.0, 12)
_SIGMAS = np.geomspace(0.1, 50.0, 25)[:, None] * SIGMA_LEAST
"""(25, 6) candidates for the errors of a pose."""
_LEAST_PAIRS = 8
"""Fewer pairs tell nothing about the errors of measured motions."""


@dataclass(frozen=True, eq=False)
class VarianceComponents:
    """Errors of given poses, and of motions."""

    pose_sigma: FloatArray
    """(6,) of one given pose in camera axes: m, then rad."""
    motion_share: float
    """Variance of measured motions over the stated one, at most 1. Their floors are those of real
    images; rendered ones, or a better camera, stay far below."""


def variance_components(comparison: PoseComparison, good: BoolArray) -> VarianceComponents:
    """Return the components that pairs of frames with good poses (n,) show.

    They are means over the likelihood: a drive that tells little about motions gets a middle share.
    """
    if good.sum() < _LEAST_PAIRS:
        return VarianceComponents(comparison.pose_sigma / np.sqrt(2.0), 1.0)
    stated = np.linalg.pinv(comparison.information, rcond=1e-10, hermitian=True)
    variances = np.diagonal(stated, axis1=1, axis2=2)
    likelihood = _log_likelihood(comparison.innovation, variances, good)
    of_share = likelihood.max(axis=1).sum(axis=1)
    share = _mean(_SHARES[:, None], of_share[:, None])
    variance = _mean(_SIGMAS**2, likelihood[of_share.argmax()])
    return VarianceComponents(np.sqrt(variance), float(share[0]))


def _mean(values: FloatArray, log_likelihood: FloatArray) -> FloatArray:
    """Return the means (k,) of candidates (n, k) over their likelihood."""
    weight = np.exp(log_likelihood - log_likelihood.max(axis=0))
    mean: FloatArray = (weight * values).sum(axis=0) / weight.sum(axis=0)
    return mean


def _log_likelihood(innovation: FloatArray, variances: FloatArray, good: BoolArray) -> FloatArray:
    """Return (shares, sigmas, 6) log-likelihoods, by factors of the tridiagonal covariance."""
    pose = _SIGMAS**2
    total = np.zeros((len(_SHARES), *pose.shape))
    left, follows = np.zeros_like(total), np.zeros_like(total)
    for row, is_good in enumerate(good):
        if not is_good:
            follows = np.zeros_like(total)
            continue
        left = innovation[row] + follows * left  # beyond what the pair before says
        variance = 2.0 * pose + _SHARES[:, None, None] * variances[row] - follows * pose
        total -= 0.5 * (np.log(variance) + left**2 / variance)
        follows = pose / variance
    return total
