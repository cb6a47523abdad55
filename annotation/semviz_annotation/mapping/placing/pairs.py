"""Places that no outlier spoils: each from two sightings, and the one that most others agree with.

So does RANSAC (Fischler & Bolles 1981); but which pairs are tried is not left to chance.
"""

import numpy as np

from semviz_annotation.mapping.placing.least_squares import PlaceOptions
from semviz_annotation.mapping.placing.linear import linear_start
from semviz_annotation.mapping.placing.residuals import residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import FloatArray, IntArray

_PAIRS = 24
"""Of each thing. Where two sightings in five are wrong, 24 pairs out of 24 have a wrong one once in
40,000 things."""
_GOLDEN = (5.0**0.5 - 1.0) / 2.0


def best_of_pairs(
    views: Views, sightings: Sightings, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """Places (n, 6: anchor and end) with the least robust cost over all sightings, and that cost
    (n,), infinite where no two sightings meet. Each thing has two sightings or more."""
    best, least = np.zeros((sightings.count, 6)), np.full(sightings.count, np.inf)
    for number in range(_PAIRS):
        rows = _pairs(sightings, number)
        pairs = sightings.taken(rows.ravel(), np.repeat(np.arange(len(rows)), 2), len(rows))
        start = linear_start(views, pairs, min_angle_rad=0.0)
        X = np.where(start.ok[:, None], start.places_m(), 0.0)
        at = residuals(views, sightings, X[:, :3], X[:, 3:])
        cost, _ = at.robust(options.sigma_px, options.outlier_sigmas)
        total = np.where(start.ok, sightings.per_thing(np.add, cost), np.inf)
        better = total < least
        best[better], least[better] = X[better], total[better]
    return best, least


def _pairs(sightings: Sightings, number: int) -> IntArray:
    """(n, 2) rows of two sightings of each thing; with ``number`` they go round, far and near."""
    seen, first = sightings.seen, sightings.first
    one = number * seen // _PAIRS
    apart = 1 + (number * _GOLDEN % 1.0 * (seen - 1)).astype(np.int64)
    return np.stack([first + one, first + (one + apart) % seen], axis=1)
