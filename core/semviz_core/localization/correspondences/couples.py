"""Take candidate pairs by twos: the upright pose they imply, and how well they agree.

Two mapped elements, and the distances and azimuths of two observed ones, make a triangle on the
ground. Its third side must be as long as the mapped elements are apart, which corrects the
distances by least squares; its direction is the heading. Elements on one post have no such
direction, but one must be seen above the other.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import ComplexArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.correspondences.candidate_pairs import (
    BIN_RAD,
    BINS,
    NEAREST_M,
    USUAL_FIX_SIGMAS,
    CandidatePairs,
    Compass,
    compass_chi2,
    pair_distance_m,
)

SPREAD_RAD = 0.6 * BIN_RAD
"""Width of the Gaussian weights by which a couple counts in its bin and the adjacent ones."""
ON_ONE_POST_M = 1.5
FARTHEST_APART_M = 85.0
_MAP_SIGMA_M = 0.25
_LEAST_SIDE_M = 0.3
_MOST_SIGMAS = 5.0
"""By which the third side may differ at first."""
_CORRECTED_SIGMAS = 3.0
_MOST_CHI2 = 16.0
_MOST_FIX_SIGMAS = 2.8
_MOST_COMPASS_CHI2 = 12.0
_MOST_TURN_RAD = 0.5
"""Couples whose heading is less certain are dropped."""
_TURN_SIGMA_RAD = 0.01


class Couples(NamedTuple):
    """E couples of two pairs each, the first pair with the smaller row."""

    first: IntArray  # (E,) row of a pair
    second: IntArray  # (E,) row of the other
    feature: FloatArray  # (E, 7)
    bin: IntArray  # (E, 3) headings
    weight: FloatArray  # (E, 3) of these, in (0, 1]
    camera_m: ComplexArray  # (E,)
    turn: ComplexArray  # (E,) unit: from the level frame to the local one


class Posts(NamedTuple):
    """F couples of elements on one post; they agree in every heading."""

    first: IntArray  # (F,)
    second: IntArray  # (F,)
    feature: FloatArray  # (F, 3)


def couples(pairs: CandidatePairs, compass: Compass) -> tuple[Couples, Posts]:
    """Return the couples that agree with the fix and the compass, and those on one post."""
    rows, numbers, turns, post_rows, post_feature = _agreeing(pairs, compass)
    chi2, side_variance, turn_variance, apart, from_fix = numbers.T
    feature = np.column_stack(
        [
            chi2 / 5.0,
            np.sqrt(chi2),
            np.log(side_variance),
            0.5 * np.log(turn_variance) + 3.0,
            np.log(apart) - 2.5,
            from_fix,
            np.abs(from_fix - USUAL_FIX_SIGMAS),
        ]
    )
    bins, weight = _spread(np.angle(turns[:, 1]), turn_variance)
    found = Couples(rows[:, 0], rows[:, 1], feature, bins, weight, turns[:, 0], turns[:, 1])
    return found, Posts(post_rows[:, 0], post_rows[:, 1], post_feature)


@compiled
def _agreeing(
    pairs: CandidatePairs, compass: Compass
) -> tuple[IntArray, FloatArray, ComplexArray, IntArray, FloatArray]:
    """Return of each couple its pairs (E, 2), (E, 5) chi2, variances of third side and heading,
    length and distance from the fix, and (E, 2) camera and turn; of those on one post their pairs
    (F, 2) and features (F, 3)."""
    rows, numbers = np.empty((256, 2), np.int64), np.empty((256, 5))
    turns = np.empty((256, 2), np.complex128)
    post_rows, post_feature = np.empty((64, 2), np.int64), np.empty((64, 3))
    e = f = 0
    for first in range(len(pairs.seen)):
        for second in range(first + 1, len(pairs.seen)):
            is_one = pairs.seen[first] == pairs.seen[second]
            if is_one or pairs.mapped[first] == pairs.mapped[second]:
                continue
            apart = pairs.place_m[second] - pairs.place_m[first]
            length = abs(apart)
            if length < ON_ONE_POST_M:
                if f == len(post_rows):
                    post_rows = np.concatenate((post_rows, np.empty_like(post_rows)))
                    post_feature = np.concatenate((post_feature, np.empty_like(post_feature)))
                if _on_one_post(pairs, first, second, length, post_feature[f]):
                    post_rows[f, 0], post_rows[f, 1] = first, second
                    f += 1
            elif length < FARTHEST_APART_M:
                if e == len(rows):
                    rows = np.concatenate((rows, np.empty_like(rows)))
                    numbers = np.concatenate((numbers, np.empty_like(numbers)))
                    turns = np.concatenate((turns, np.empty_like(turns)))
                if _fits(pairs, compass, first, second, apart, numbers[e], turns[e]):
                    rows[e, 0], rows[e, 1] = first, second
                    e += 1
    return rows[:e], numbers[:e], turns[:e], post_rows[:f], post_feature[:f]


@compiled
def _on_one_post(
    pairs: CandidatePairs, first: int, second: int, length: float, feature: FloatArray
) -> bool:
    """Return whether two pairs can be on one post; fill their ``feature`` (3,)."""
    first_m, second_m = 1.0 / pairs.nearness[first], 1.0 / pairs.nearness[second]
    turn = abs((pairs.direction[first] * np.conj(pairs.direction[second])).imag)
    sideways, depth = turn * 0.5 * (first_m + second_m), abs(first_m - second_m)
    wide = np.hypot(pairs.wide_m[first], pairs.wide_m[second])
    feature[0], feature[2] = sideways, length
    feature[1] = depth / np.hypot(pairs.sigma_m[first], pairs.sigma_m[second])
    return sideways < ON_ONE_POST_M and depth < _CORRECTED_SIGMAS * wide


class _Triangle(NamedTuple):
    """Two distances, corrected by the length of the third side in the map."""

    first_m: float
    second_m: float
    side: complex
    """In the level frame: from the first element to the second."""
    by_first: float
    """Derivative of the third side by the first distance."""
    by_second: float
    variance: float
    """Of the third side."""
    off_m: float
    """By how much the third side is too short at the given distances."""


@compiled
def _fits(
    pairs: CandidatePairs,
    compass: Compass,
    first: int,
    second: int,
    apart: complex,
    numbers: FloatArray,
    turns: ComplexArray,
) -> bool:
    """Return whether two pairs fit one pose within the prior; fill their entries."""
    u, v = pairs.direction[first], pairs.direction[second]
    length = abs(apart)
    d, e = 1.0 / pairs.nearness[first], 1.0 / pairs.nearness[second]
    # distances for a level road, with sigmas that cover its slope
    at = _corrected(u, v, length, d, e, pairs.wide_m[first], pairs.wide_m[second], d, e)
    if at.off_m**2 >= _MOST_SIGMAS**2 * at.variance:
        return False
    sigma, other = pairs.sigma_m[first], pairs.sigma_m[second]
    for _ in range(2):  # the road's slope depends on the heading
        turn = _unit(apart * np.conj(at.side))
        d, e = pair_distance_m(pairs, first, turn), pair_distance_m(pairs, second, turn)
        at = _corrected(u, v, length, d, e, sigma, other, at.first_m, at.second_m)
    turn = _unit(apart * np.conj(at.side))
    left = (length - max(abs(at.side), _LEAST_SIDE_M)) / _MAP_SIGMA_M
    chi2 = ((at.first_m - d) / sigma) ** 2 + ((at.second_m - e) / other) ** 2
    chi2 += min(left * left, 100.0)
    variance = _turn_variance(u, v, at, sigma, other, length)
    sides = at.first_m * u + at.second_m * v
    camera = 0.5 * (pairs.place_m[first] + pairs.place_m[second] - sides * turn)
    from_fix = abs(camera) / pairs.fix_sigma_m
    numbers[0], numbers[1], numbers[2], numbers[3] = chi2, at.variance, variance, length
    numbers[4] = from_fix
    turns[0], turns[1] = camera, turn
    if not (chi2 < _MOST_CHI2 and from_fix < _MOST_FIX_SIGMAS and variance < _MOST_TURN_RAD**2):
        return False
    return compass_chi2(compass, np.angle(turn), variance) < _MOST_COMPASS_CHI2


@compiled
def _corrected(
    u: complex,
    v: complex,
    length: float,
    given: float,
    other_given: float,
    sigma: float,
    other_sigma: float,
    first_m: float,
    second_m: float,
) -> _Triangle:
    """Return the triangle after a Gauss-Newton step of the distances towards the length of the
    third side in the map, from ``first_m`` and ``second_m``."""
    side = v * second_m - u * first_m
    third = max(abs(side), _LEAST_SIDE_M)
    by_first, by_second = -(np.conj(u) * side).real / third, (np.conj(v) * side).real / third
    variance = (by_first * sigma) ** 2 + (by_second * other_sigma) ** 2 + _MAP_SIGMA_M**2
    moved = by_first * (first_m - given) + by_second * (second_m - other_given)
    off = length - third + moved
    step = _limited(sigma**2 * by_first * off / variance, _CORRECTED_SIGMAS * sigma)
    other = _limited(other_sigma**2 * by_second * off / variance, _CORRECTED_SIGMAS * other_sigma)
    first_m, second_m = (
        max(given + step, 0.8 * NEAREST_M),
        max(other_given + other, 0.8 * NEAREST_M),
    )
    side = v * second_m - u * first_m
    return _Triangle(first_m, second_m, side, by_first, by_second, variance, off)


@compiled
def _limited(value: float, most: float) -> float:
    return min(max(value, -most), most)


@compiled
def _unit(value: complex) -> complex:
    """Return ``value`` with length 1; 0 for 0."""
    length = abs(value)
    return value / length if length > 0.0 else value


@compiled
def _turn_variance(
    u: complex, v: complex, at: _Triangle, sigma: float, other: float, length: float
) -> float:
    """Return the variance of the heading, given the length of the third side."""
    square = max(at.side.real**2 + at.side.imag**2, _LEAST_SIDE_M**2)
    by_first = (u * np.conj(at.side)).imag / square
    by_second = -(v * np.conj(at.side)).imag / square
    shared = by_first * at.by_first * sigma**2 + by_second * at.by_second * other**2
    own = (by_first * sigma) ** 2 + (by_second * other) ** 2 - shared**2 / at.variance
    return max(own, 0.0) + (_LEAST_SIDE_M / length) ** 2 + _TURN_SIGMA_RAD**2


def _spread(heading_rad: FloatArray, variance: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the three nearest bins (k, 3) of each heading, and their weights."""
    at = (heading_rad / BIN_RAD)[:, None]
    bins = np.round(at) + np.arange(-1, 2)
    chi2 = np.square((bins - at) * BIN_RAD) / (variance + SPREAD_RAD**2)[:, None]
    return np.remainder(bins, BINS).astype(np.int64), np.exp(-0.5 * chi2)


class FrameGeometry(NamedTuple):
    """What geometry knows of a frame before anything is learned: the network's input."""

    pairs: CandidatePairs
    compass: Compass
    couples: Couples
    posts: Posts

    @classmethod
    def of(cls, pairs: CandidatePairs, compass: Compass) -> "FrameGeometry":
        return cls(pairs, compass, *couples(pairs, compass))


def pair_features(pairs: CandidatePairs, seen: int) -> FloatArray:
    """Return (N, 14): agreement of slopes and distance, the distance, and crowding, in a frame of
    ``seen`` observed elements.

    The detector's score is left out: in simulated frames it separates false positives perfectly.
    """
    anchor, end = pairs.off.T
    rivals = np.bincount(pairs.seen)[pairs.seen]
    competitors = np.bincount(pairs.mapped)[pairs.mapped]
    same = np.ones(len(pairs.seen))
    features = [
        anchor,
        np.minimum(np.square(anchor), 16.0) / 4.0,
        np.clip(end, -6.0, 6.0),
        np.minimum(np.square(end), 16.0) / 4.0,
        end > 3.0,
        *pairs.known.T,
        -np.log(pairs.nearness) - 2.7,
        np.log(pairs.sigma_m * pairs.nearness),
        np.log(pairs.slope_sigma) + 4.0,
        same * (np.log(pairs.fix_sigma_m) - 2.0),
        np.log(rivals) - 2.0,
        np.log(competitors) - 1.0,
        same * (np.log(seen) - 2.0),
    ]
    return np.column_stack(features).astype(np.float64)
