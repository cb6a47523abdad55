"""The probability that an element exists in each pass, from where it was seen and missed.

A persistence filter (Rosen, Mason, Leonard: Towards lifelong feature-based mapping in semi-static
environments, ICRA 2016), in passes instead of seconds, with two additions. An element can also
appear. And the misses of one pass are not independent, since what hides an element hides it in all
frames: with an unknown probability of its own, an element is hidden throughout a pass.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

HIDDEN: FloatArray = np.array([0.01, 0.03, 0.08, 0.16, 0.3, 0.5, 0.75])
"""(g,) Possible probabilities that an element is hidden throughout a pass."""
HIDDEN_PRIOR: FloatArray = np.array([0.3, 0.25, 0.18, 0.12, 0.08, 0.05, 0.02])
"""(g,) Their weights before any pass."""
_PRIOR_ELEMENTS = 20.0
"""Elements that the prior weights count for, beside those of the map."""
_PARTLY_HIDDEN, _VISIBLE_PART = 0.15, 0.4
"""Share of passes in which an element is detected less often, and how often relative to others."""
_MISTAKEN = ((0.97, 0.01), (0.03, 0.3))
"""How often other things are detected where nothing is: share of the places, rate per frame."""
CHANGE_PER_PASS = 0.01
"""Probability that an element vanishes, or another appears, from one pass to the next."""
_NEVER_THERE = 0.02
"""Probability that an element of the map is none."""
_CLUTTER = 0.5
"""Probability that a candidate is none."""
_MISSING = 0.2
"""Probability that a candidate was there before the first pass."""
_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class PassCounts:
    """What p passes saw of n elements."""

    chances: IntArray
    """(n, p) frames in which it would be in view."""
    expected: FloatArray
    """(n, p) detections that a detector makes in these frames if nothing hides it."""
    seen: IntArray
    """(n, p) frames that detect it."""


class Existence(NamedTuple):
    """Of n elements in p passes."""

    probability: FloatArray
    """(n, p) that it exists in each pass, by all passes."""
    first: IntArray
    """(n,) the pass in which it most likely appeared; 0: it was there before."""
    gone: IntArray
    """(n,) the pass from which on it is most likely gone; p: it is not."""

    @property
    def now(self) -> FloatArray:
        """(n,) The probability in the last pass."""
        return self.probability[:, -1]


def existence_of(counts: PassCounts, is_mapped: BoolArray) -> Existence:
    """Return the existence of elements; those of the map (n,) cannot appear."""
    absent, exists = _log_likelihoods(counts)
    n, p = absent.shape
    result = Existence(np.zeros((n, p)), np.zeros(n, np.int64), np.zeros(n, np.int64))
    mapped, candidates = _lives_of_mapped(p), _lives_of_candidates(p)
    by_life = _by_life(absent[is_mapped], exists[is_mapped], mapped)
    weights = _hidden_weights(by_life, mapped)
    _fill(result, is_mapped, by_life, weights, mapped)
    by_life = _by_life(absent[~is_mapped], exists[~is_mapped], candidates)
    _fill(result, ~is_mapped, by_life, weights, candidates)
    return result


def _fill(
    result: Existence, rows: BoolArray, by_life: FloatArray, weights: FloatArray, lives: "_Lives"
) -> None:
    """Set the result of some rows by their likelihoods (k, l, g)."""
    if not rows.any():
        return
    log_likelihood = np.logaddexp.reduce(by_life + np.log(weights), axis=2)
    life = _normalized(log_likelihood + lives.log_prior)
    passes = np.arange(result.probability.shape[1])
    during = (lives.first[:, None] <= passes) & (passes < lives.gone[:, None])
    result.probability[rows] = np.clip(life @ during, 0.0, 1.0)
    best = life.argmax(axis=1)
    result.first[rows], result.gone[rows] = lives.first[best], lives.gone[best]


def _log_likelihoods(counts: PassCounts) -> tuple[FloatArray, FloatArray]:
    """Return the log-likelihood of each pass (n, p) if the element is absent, and (n, p, g) if it
    exists, for each of ``HIDDEN``."""
    chances, seen = counts.chances.astype(np.float64), counts.seen.astype(np.float64)
    rate = np.clip(counts.expected / np.maximum(chances, 1.0), 0.02, 0.98)

    def of(rate: FloatArray | float) -> FloatArray:
        return np.asarray(seen * np.log(rate) + (chances - seen) * np.log1p(-np.asarray(rate)))

    absent = np.logaddexp(*(np.log(share) + of(rate) for share, rate in _MISTAKEN))
    visible = np.logaddexp(
        np.log1p(-_PARTLY_HIDDEN) + of(rate), np.log(_PARTLY_HIDDEN) + of(_VISIBLE_PART * rate)
    )
    hidden = absent[..., None] + np.log(HIDDEN)
    return absent, np.logaddexp(hidden, visible[..., None] + np.log1p(-HIDDEN))


class _Lives(NamedTuple):
    """From which pass to which an element may exist: l possibilities."""

    first: IntArray
    """(l,)"""
    gone: IntArray
    """(l,) the pass after the last; equal to ``first`` if it never exists."""
    log_prior: FloatArray
    """(l,)"""


def _lives_of_mapped(p: int) -> _Lives:
    gone = np.arange(p + 1)
    prior = (1.0 - _NEVER_THERE) * _vanishing(gone - 1, p - 1)
    prior[0] = _NEVER_THERE
    return _Lives(np.zeros(p + 1, np.int64), gone, np.log(prior))


def _lives_of_candidates(p: int) -> _Lives:
    first, gone = np.triu_indices(p + 1, 1)
    appeared = (1.0 - _CLUTTER - _MISSING) / max(p - 1, 1)
    prior = np.where(first == 0, _MISSING, appeared) * _vanishing(gone - first - 1, p - first - 1)
    return _Lives(np.append(first, 0), np.append(gone, 0), np.log(np.append(prior, _CLUTTER)))


def _vanishing(after: IntArray, passes: IntArray | int) -> FloatArray:
    """Return the probability to stay for ``after`` more passes and then to vanish; without the
    latter if it stays for all ``passes``."""
    stays = (1.0 - CHANGE_PER_PASS) ** np.maximum(after, 0)
    return np.asarray(np.where(after < passes, CHANGE_PER_PASS, 1.0) * stays)


def _by_life(absent: FloatArray, exists: FloatArray, lives: _Lives) -> FloatArray:
    """Return the log-likelihood (n, l, g) of all passes for each life and probability to hide."""
    none = np.zeros((len(absent), 1))
    away = np.concatenate([none, absent.cumsum(axis=1)], axis=1)
    there = np.concatenate([none[..., None] + 0.0 * HIDDEN, exists.cumsum(axis=1)], axis=1)
    outside = away[:, lives.first] + away[:, -1:] - away[:, lives.gone]
    return np.asarray(outside[..., None] + there[:, lives.gone] - there[:, lives.first])


def _hidden_weights(by_life: FloatArray, lives: _Lives) -> FloatArray:
    """Return the weights (g,) of ``HIDDEN`` that the elements of the map support."""
    start = HIDDEN_PRIOR / HIDDEN_PRIOR.sum()
    weights = start
    log_likelihood = np.logaddexp.reduce(by_life + lives.log_prior[:, None], axis=1)
    for _ in range(_ROUNDS):
        posterior = _normalized(log_likelihood + np.log(weights))
        weights = posterior.sum(axis=0) + _PRIOR_ELEMENTS * start
        weights = weights / weights.sum()
    return np.asarray(weights)


def _normalized(log: FloatArray) -> FloatArray:
    """Return probabilities (n, k) from logarithms (n, k)."""
    values = np.exp(log - log.max(axis=1, keepdims=True))
    return np.asarray(values / values.sum(axis=1, keepdims=True))
