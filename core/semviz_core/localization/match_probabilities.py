"""Probabilities of correspondences over the modes of a pose, weighted by their likelihoods.

Matrix scaling (Sinkhorn and Knopp 1967) with dustbins makes each row and column sum to 1:
P_ij = a_i K_ij b_j. Uniform marginals without dustbins, the paper's eq. 3-4, would force mass onto
false pairs wherever n > m.
"""

import numpy as np

from semviz_core.base.localization import Match
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled

TOLERANCE = 1e-7
MOST_ITERATIONS = 200
_LARGEST_NATS = 200.0  # larger log-odds are as good as certain, and would overflow


@compiled
def sinkhorn_with_dustbin(log_kernel: FloatArray) -> FloatArray:
    """Return the probabilities (m + 1, n + 1) of pairs with log-odds ``log_kernel`` (m, n).

    Odds are against no pair; -inf excludes one. Rows i < m and columns j < n sum to 1; the corner
    is 0. Both scalings move half way at once: in turns, they converge only as 1/t where a dustbin
    is weak.
    """
    seen, mapped = np.nonzero(log_kernel > -np.inf)  # few: most pairs are impossible
    some = np.unique(mapped)  # a mapped element without a pair stays in the dustbin
    column = np.searchsorted(some, mapped)
    kernel = np.empty(len(seen))
    for k in range(len(seen)):
        kernel[k] = np.exp(min(log_kernel[seen[k], mapped[k]], _LARGEST_NATS))
    a, b = np.ones(len(log_kernel)), np.ones(len(some))
    rows, columns = np.empty(len(a)), np.empty(len(b))
    for _ in range(MOST_ITERATIONS):
        rows[:], columns[:] = a, b
        for k in range(len(seen)):
            mass = a[seen[k]] * kernel[k] * b[column[k]]
            rows[seen[k]] += mass
            columns[column[k]] += mass
        a /= np.sqrt(rows)
        b /= np.sqrt(columns)
        if not len(seen) or max(np.abs(rows - 1.0).max(), np.abs(columns - 1.0).max()) < TOLERANCE:
            break
    closed = _closed(seen, column, kernel, a, b)
    probability = np.zeros((log_kernel.shape[0] + 1, log_kernel.shape[1] + 1))
    probability[-1, :-1] = 1.0
    probability[:, -1] = closed[:, -1]
    for k in range(len(some)):
        probability[:, some[k]] = closed[:, k]
    return probability


@compiled
def _closed(
    seen: IntArray, mapped: IntArray, kernel: FloatArray, a: FloatArray, b: FloatArray
) -> FloatArray:
    """Return the scaled kernel; the dustbins take the remainder, so that sums are exactly 1."""
    m, n = len(a), len(b)
    probability = np.zeros((m + 1, n + 1))
    for k in range(len(seen)):
        probability[seen[k], mapped[k]] = a[seen[k]] * kernel[k] * b[mapped[k]]
    for i in range(m):
        probability[i, :n] /= max(probability[i, :n].sum(), 1.0)
    for j in range(n):
        probability[:m, j] /= max(probability[:m, j].sum(), 1.0)
        probability[m, j] = max(1.0 - probability[:m, j].sum(), 0.0)
    for i in range(m):
        probability[i, n] = max(1.0 - probability[i, :n].sum(), 0.0)
    return probability


LEAST_PROBABILITY = 0.01
"""Less likely pairs are left out of ``Match.order``."""
_LEAST_ODDS = -30.0  # nats; of a pair beyond every gate
NEGLIGIBLE_NATS = 20.0
"""Modes further below the best have no visible effect on the probabilities."""


def posterior_match(score: FloatArray, gain: FloatArray, compatible: BoolArray) -> Match:
    """Return the correspondence probabilities over b poses with log-likelihoods ``score`` (b,).

    ``gain`` (b, m, n) holds each pair's log-odds against no pair under each pose, -inf for
    impossible ones. The cost is minus the log of the mean odds, capped where classes agree and
    inf where they do not.
    """
    probability, log_odds = _mixed(score, gain)
    cost = np.where(compatible, -np.maximum(log_odds, _LEAST_ODDS), np.inf)
    return Match(cost, probability, _order(probability[:-1, :-1]))


@compiled
def _mixed(score: FloatArray, gain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return probabilities (m + 1, n + 1) and log-odds (m, n), averaged over the poses' weights."""
    b, m, n = gain.shape
    weight = np.exp(score - score.max())
    weight[score < score.max() - NEGLIGIBLE_NATS] = 0.0
    weight /= weight.sum()
    probability, odds = np.zeros((m + 1, n + 1)), np.zeros((m, n))
    for row in range(b):
        if weight[row] > 0.0:
            probability += weight[row] * sinkhorn_with_dustbin(gain[row])
            seen, mapped = np.nonzero(gain[row] > -np.inf)
            for k in range(len(seen)):
                odds[seen[k], mapped[k]] += weight[row] * np.exp(gain[row, seen[k], mapped[k]])
    return probability, np.log(odds)


def _order(probability: FloatArray) -> IntArray:
    """Return the likely pairs (k, 2), likeliest first."""
    pairs = np.argwhere(probability >= LEAST_PROBABILITY)
    likely = probability[pairs[:, 0], pairs[:, 1]]
    return np.asarray(pairs[np.argsort(-likely, kind="stable")], dtype=np.int64)
