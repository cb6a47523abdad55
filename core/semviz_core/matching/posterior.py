"""Correspondence probabilities from the poses that explain the image, each by its likelihood."""

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.localization import Match
from semviz_core.matching.sinkhorn import sinkhorn_with_dustbin

LEAST_PROBABILITY = 0.01
"""Less likely pairs are not listed in the order."""
_LEAST_ODDS = -30.0  # nats; of a pair beyond every gate
NEGLIGIBLE_NATS = 20.0
"""Modes further below the best add nothing that could be seen."""


def posterior_match(score: FloatArray, gain: FloatArray, compatible: BoolArray) -> Match:
    """Probabilities over b poses with log-likelihoods ``score`` (b,), best first.

    ``gain`` (b, m, n) holds each pair's log-odds against no pair under each pose, -inf for
    impossible ones. The cost is minus the log of the mean odds, capped where classes agree and
    inf where they don't.
    """
    probability, log_odds = _mixed(score, gain)
    cost = np.where(compatible, -np.maximum(log_odds, _LEAST_ODDS), np.inf)
    return Match(cost, probability, _order(probability[:-1, :-1]))


@compiled
def _mixed(score: FloatArray, gain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Probabilities (m + 1, n + 1) and log odds (m, n), each pose by its likelihood."""
    b, m, n = gain.shape
    weight = np.exp(score - score.max())
    weight[score < score.max() - NEGLIGIBLE_NATS] = 0.0
    weight /= weight.sum()
    probability, odds = np.zeros((m + 1, n + 1)), np.zeros((m, n))
    for row in range(b):
        if weight[row] > 0.0:
            probability += weight[row] * sinkhorn_with_dustbin(gain[row])
            odds += weight[row] * np.exp(gain[row])
    return probability, np.log(odds)


def _order(probability: FloatArray) -> IntArray:
    """(k, 2) likely pairs, likeliest first."""
    pairs = np.argwhere(probability >= LEAST_PROBABILITY)
    likely = probability[pairs[:, 0], pairs[:, 1]]
    return np.asarray(pairs[np.argsort(-likely, kind="stable")], dtype=np.int64)
