"""The probability that an element exists in each pass, from where it was seen and missed.

A persistence filter (Rosen, Mason, Leonard: Towards lifelong feature-based mapping in semi-static
environments, ICRA 2016) over passes, with two additions. An element can also appear: a change
between two passes is the likelier, the more time is between them, if that is known. And the misses
of one pass are not independent, since what hides an element hides it in all frames: with an unknown
probability of its own, an element is hidden throughout a pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
"""Probability that an element vanishes, or another appears, from one pass to the next, if the time
between them is not known."""
LIFETIME_S = 3000.0 * 86400.0
"""Expected lifetime of an element: passes without dates count as a month apart."""
_NEVER_THERE = 0.02
"""Probability that an element of the map is none."""
_CLUTTER = 0.5
"""Probability that a candidate is none."""
_MISSING = 0.2
"""Probability that a candidate was there before the first pass."""
_LEAST_S = 600.0
"""Passes within ten minutes count as so far apart."""
_FACTORS, _FACTOR_PRIOR = (1.0, 4.0, 16.0), (0.6, 0.3, 0.1)
"""How much faster than expected a place may change, and the weights of it before any pass. Not
slower: few passes do not tell how rare changes are."""
_MOST_CHANGE = 0.2
_MOVED = 0.5
"""Probability that an element vanished where a new one of its class appeared close by."""
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
    ever: FloatArray
    """(n,) The probability that it exists in any pass: that it is no false detection."""

    @property
    def now(self) -> FloatArray:
        """(n,) The probability in the last pass."""
        return self.probability[:, -1]


def change_between(start_s: Sequence[float | None]) -> FloatArray:
    """Return the probabilities (p - 1,) that an element vanishes from each of p passes to the next.

    ``start_s`` are their times, oldest first. Unless all are known, every two count alike.
    """
    known = [time_s for time_s in start_s if time_s is not None]
    if len(known) < len(start_s):
        return np.full(len(start_s) - 1, CHANGE_PER_PASS)
    return np.asarray(-np.expm1(-np.maximum(np.diff(known), _LEAST_S) / LIFETIME_S))


def existence_of(
    counts: PassCounts,
    is_mapped: BoolArray,
    change: FloatArray | None = None,
    replaced: IntArray | None = None,
) -> Existence:
    """Return the existence of elements; those of the map (n,) cannot appear.

    ``change`` is that of ``change_between``; by default, no time is known. ``replaced`` (n,) is the
    pass in which a new element of its class appeared beside one of the map, -1 if none did.
    """
    absent, exists = _log_likelihoods(counts)
    n, p = absent.shape
    change = change_between([None] * p) if change is None else change
    none = np.zeros(n, np.int64)
    result = Existence(np.zeros((n, p)), none, none.copy(), np.zeros(n))
    by_life = _by_life(absent[is_mapped], exists[is_mapped], _lives_of_mapped(change))
    change = _fitted(change, by_life)
    mapped, candidates = _lives_of_mapped(change), _lives_of_candidates(change)
    weights = _hidden_weights(by_life, mapped)
    prior = np.broadcast_to(mapped.log_prior, (len(by_life), len(mapped.gone)))
    if replaced is not None:
        prior = np.where((replaced >= 0)[is_mapped, None], np.log(1.0 - _MOVED), 0.0) + prior
        moved = replaced[is_mapped, None] == mapped.gone
        prior = np.where(moved, np.logaddexp(prior, np.log(_MOVED)), prior)
    _fill(result, is_mapped, by_life, weights, replace(mapped, log_prior=prior))
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
    result.ever[rows] = np.clip(life @ (lives.gone > lives.first), 0.0, 1.0)


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


@dataclass(frozen=True, eq=False)
class _Lives:
    """From which pass to which an element may exist: l possibilities."""

    first: IntArray
    """(l,)"""
    gone: IntArray
    """(l,) the pass after the last; equal to ``first`` if it never exists."""
    log_prior: FloatArray
    """(l,), or (k, l) of each of k elements"""


def _lives_of_mapped(change: FloatArray) -> _Lives:
    gone = np.arange(len(change) + 2)
    first = np.zeros_like(gone)
    prior = (1.0 - _NEVER_THERE) * _lasting(first, gone, change)
    prior[0] = _NEVER_THERE
    return _Lives(first, gone, np.log(prior))


def _lives_of_candidates(change: FloatArray) -> _Lives:
    first, gone = np.triu_indices(len(change) + 2, 1)
    appeared = (1.0 - _CLUTTER - _MISSING) * np.append(1.0, change) / max(change.sum(), 1e-300)
    prior = np.where(first == 0, _MISSING, appeared[first]) * _lasting(first, gone, change)
    return _Lives(np.append(first, 0), np.append(gone, 0), np.log(np.append(prior, _CLUTTER)))


def _lasting(first: IntArray, gone: IntArray, change: FloatArray) -> FloatArray:
    """Return the probability to stay until the pass before ``gone``, and then to vanish, of what
    exists in the pass ``first``; what is there in the last pass need not vanish."""
    survived = np.concatenate([[0.0], np.log1p(-change).cumsum()])
    lasts = np.exp(survived[gone - 1] - survived[first])
    return np.asarray(lasts * np.append(change, 1.0)[gone - 1])


def _by_life(absent: FloatArray, exists: FloatArray, lives: _Lives) -> FloatArray:
    """Return the log-likelihood (n, l, g) of all passes for each life and probability to hide."""
    none = np.zeros((len(absent), 1))
    away = np.concatenate([none, absent.cumsum(axis=1)], axis=1)
    there = np.concatenate([none[..., None] + 0.0 * HIDDEN, exists.cumsum(axis=1)], axis=1)
    outside = away[:, lives.first] + away[:, -1:] - away[:, lives.gone]
    return np.asarray(outside[..., None] + there[:, lives.gone] - there[:, lives.first])


def _fitted(change: FloatArray, by_life: FloatArray) -> FloatArray:
    """Return ``change``, as much faster as the elements of the map support."""
    fitted = [np.minimum(change * factor, _MOST_CHANGE) for factor in _FACTORS]
    log_evidence = []
    for values in fitted:
        lives = _lives_of_mapped(values)
        log_weights = np.log(_hidden_weights(by_life, lives))
        each = by_life + lives.log_prior[:, None] + log_weights
        log_evidence.append(np.logaddexp.reduce(each, axis=(1, 2)).sum())
    return fitted[int(np.argmax(np.array(log_evidence) + np.log(_FACTOR_PRIOR)))]


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
