"""Correspondence probabilities from the poses that explain the image, each by its likelihood."""

import numpy as np
from scipy.special import logsumexp

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.localization import Match
from semviz_core.matching.sinkhorn import sinkhorn_with_dustbin

LEAST_PROBABILITY = 0.01
"""Less likely pairs are not listed in the order."""
_WORST_COST = 30.0  # nats; of a pair beyond every gate
NEGLIGIBLE_NATS = 20.0
"""Modes further below the best add nothing that could be seen."""


def posterior_match(score: FloatArray, gain: FloatArray, compatible: BoolArray) -> Match:
    """Probabilities over b poses with log-likelihoods ``score`` (b,), best first.

    ``gain`` (b, m, n) holds each pair's log-odds against no pair under each pose, -inf for
    impossible ones. The cost is minus the log of the mean odds, capped where classes agree and
    inf where they don't.
    """
    kept = np.flatnonzero(score >= score.max() - NEGLIGIBLE_NATS)
    log_weight = score[kept] - logsumexp(score[kept])
    probability = np.zeros((gain.shape[1] + 1, gain.shape[2] + 1))
    for row, weight in zip(kept, np.exp(log_weight), strict=True):
        probability += weight * sinkhorn_with_dustbin(gain[row])
    mean_odds = logsumexp(gain[kept] + log_weight[:, None, None], axis=0)
    cost = np.where(compatible, -np.maximum(mean_odds, -_WORST_COST), np.inf)
    return Match(cost, probability, _order(probability[:-1, :-1]))


def _order(probability: FloatArray) -> IntArray:
    """(k, 2) likely pairs, likeliest first."""
    pairs = np.argwhere(probability >= LEAST_PROBABILITY)
    likely = probability[pairs[:, 0], pairs[:, 1]]
    return np.asarray(pairs[np.argsort(-likely, kind="stable")], dtype=np.int64)
