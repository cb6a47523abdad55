"""Which elements of two drives are one landmark: pairs whose neighbours are shifted alike.

Poses that are off by half a metre bring an element next to its neighbour in another drive. But the
elements of one stretch are off together: a pair is believed if the pairs around it, of the same two
drives, are shifted as it is. A pair whose rival is supported nearly as well waits for the next
round, in which corrected drives lie closer.

At each place a drive is compared with a few others, not with all: a landmark needs a chain of pairs
through its drives, not a pair of each two.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.drives.corrections import CORRELATION_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

STRETCH_M = 40.0
"""Pairs this close are shifted alike."""
PARTNERS = 4
"""With so many drives before it and so many after it a drive is compared at each place."""
_SQUARE_M = 40.0
"""Edge of a place."""
_GATE_SIGMAS = 3.5
_LEAST_SHARE = 0.3
"""Share of the elements around that must be shifted alike."""
_MARGIN = 1.0
"""By this many elements the support of a pair exceeds that of its rivals."""
_KERNEL_SIGMAS = 2.0
"""Shifts that differ by one sigma count for 0.9 of an element, by four for 0.1."""
_ENDS_APART_M = 4.0
"""Two drives may see this much more or less of a pole's top."""
_KINDS_APART_M = 1e6


@dataclass(frozen=True, eq=False)
class Places:
    """Elements of several drives: where they stand, and how high they are."""

    position_m: FloatArray
    """(n, 3) centre of a sign, middle of a pole, and the height of the anchor."""
    covariance_m2: FloatArray
    """(n, 3, 3)"""
    is_line: BoolArray
    """(n,) whether it is a pole, whose height is that of the last visible point."""
    kind: IntArray
    """(n,) class."""
    drive: IntArray
    """(n,)"""


class Pairs(NamedTuple):
    """p pairs of elements of two drives, the first of the lower number."""

    first: IntArray
    """(p,)"""
    second: IntArray
    """(p,)"""
    score: FloatArray
    """(p,) elements that are shifted alike, less those of the best rival."""

    def where(self, rows: BoolArray | IntArray | slice) -> "Pairs":
        return Pairs(self.first[rows], self.second[rows], self.score[rows])


def vote(places: Places, sigma_m: float) -> Pairs:
    """Return the pairs that are believed, each element at most once for each other drive.

    Drives are off by ``sigma_m`` in each direction, as ``corrections`` says.
    """
    pairs, of = _near(places, compared(places), sigma_m)
    starts = [*np.flatnonzero(np.diff(of, prepend=-1)).tolist(), len(of)]
    parts = [_support(places, pairs.where(slice(*rows)), sigma_m) for rows in pairwise(starts)]
    support, around = np.concatenate([np.zeros((2, 0)), *parts], axis=1)
    apart = of * len(places.drive)
    rivals = [_best_rival(apart + each, support) for each in (pairs.first, pairs.second)]
    score = support - np.maximum(*rivals)
    is_clear = (support >= _LEAST_SHARE * around) & (score >= _MARGIN)
    return Pairs(pairs.first, pairs.second, score).where(is_clear)


def compared(places: Places) -> IntArray:
    """Return each two drives (d, 2) that are compared, the lower first: of those with elements in
    one place, ordered in a circle, each and the next ``PARTNERS``."""
    square = np.floor(places.position_m[:, :2] / _SQUARE_M).astype(np.int64)
    passes = np.unique(np.column_stack([square, places.drive]), axis=0)
    _, start, number, count = np.unique(
        passes[:, :2], axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    start, count, drive = start[number.ravel()], count[number.ravel()], passes[:, 2]
    step = np.arange(1, PARTNERS + 1)[:, None]
    other = drive[start + (np.arange(len(passes)) - start + step) % count]
    both = np.sort([np.broadcast_to(drive, other.shape).ravel(), other.ravel()], axis=0).T
    return np.unique(both[both[:, 0] < both[:, 1]], axis=0)


def _near(places: Places, drives: IntArray, sigma_m: float) -> tuple[Pairs, IntArray]:
    """Return pairs of one class within reach of each two ``drives`` (d, 2), by these and by their
    first elements; and the row in ``drives`` of each pair (p,)."""
    first, second, of = _within_reach(places, drives, sigma_m)
    apart_m = places.position_m[first] - places.position_m[second]
    covariance_m2 = places.covariance_m2[first] + places.covariance_m2[second]
    covariance_m2 = covariance_m2 + 2.0 * sigma_m**2 * np.eye(3)
    near = _squared_on_ground(apart_m, covariance_m2) <= _GATE_SIGMAS**2
    gate_m = _GATE_SIGMAS * np.sqrt(covariance_m2[:, 2, 2])
    visible_m = np.where(places.is_line[first], _ENDS_APART_M, 0.0)
    near &= np.abs(apart_m[:, 2]) <= gate_m + visible_m
    return Pairs(first[near], second[near], np.zeros(int(near.sum()))), of[near]


def _within_reach(places: Places, drives: IntArray, sigma_m: float) -> IntArray:
    """Return what ``_near`` does (3, p), with what is as far apart as any elements of both drives
    may be."""
    from scipy.spatial import cKDTree

    points = np.column_stack([places.position_m[:, :2], places.kind * _KINDS_APART_M])
    widest_m2 = np.trace(places.covariance_m2[:, :2, :2], axis1=1, axis2=2)
    reach_m = _GATE_SIGMAS * np.sqrt(2.0 * (sigma_m**2 + widest_m2))
    ends = np.cumsum(np.bincount(places.drive))
    elements = np.split(np.argsort(places.drive, kind="stable"), ends[:-1])
    trees = [cKDTree(points[rows]) for rows in elements]
    widest_m = [reach_m[rows].max(initial=0.0) for rows in elements]
    parts = [np.zeros((3, 0), np.int64)]
    for row, (one, other) in enumerate(drives.tolist()):
        furthest_m = max(widest_m[one], widest_m[other])
        near = trees[one].sparse_distance_matrix(trees[other], furthest_m, output_type="ndarray")
        first, second = elements[one][near["i"]], elements[other][near["j"]]
        parts.append(np.stack([first, second, np.full(len(near), row)]))
    pairs = np.concatenate(parts, axis=1)
    return pairs[:, np.lexsort((pairs[1], pairs[0], pairs[2]))]


def _support(places: Places, pairs: Pairs, sigma_m: float) -> FloatArray:
    """Return how many elements around each pair (p,) are shifted alike, itself included, and how
    many there are."""
    at_m = places.position_m[pairs.first]
    shift_m = places.position_m[pairs.second] - at_m
    covariance_m2 = places.covariance_m2[pairs.first] + places.covariance_m2[pairs.second]
    away_m = np.linalg.norm(at_m[:, None, :2] - at_m[:, :2], axis=2)
    change_m2 = 4.0 * sigma_m**2 * (1.0 - np.exp(-away_m / CORRELATION_M))
    allowed_m2 = covariance_m2[:, None] + covariance_m2 + change_m2[..., None, None] * np.eye(3)
    off_m = shift_m[:, None] - shift_m
    squared = _squared_on_ground(off_m, allowed_m2)
    is_point = ~places.is_line[pairs.first]
    squared += (is_point[:, None] & is_point) * off_m[..., 2] ** 2 / allowed_m2[..., 2, 2]
    near = away_m <= STRETCH_M
    alike = near * np.exp(-squared / (2.0 * _KERNEL_SIGMAS**2))
    starts = np.flatnonzero(np.diff(pairs.first, prepend=-1))
    support = np.maximum.reduceat(alike, starts, axis=1).sum(axis=1)
    around = np.maximum.reduceat(near, starts, axis=1).sum(axis=1)
    return np.stack([support, around])


def _squared_on_ground(offset_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Return the squared horizontal length (...,) of offsets (..., 3) in sigmas."""
    x, y = offset_m[..., 0], offset_m[..., 1]
    a, b, d = covariance_m2[..., 0, 0], covariance_m2[..., 0, 1], covariance_m2[..., 1, 1]
    return np.asarray((d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b))


def _best_rival(element: IntArray, support: FloatArray) -> FloatArray:
    """Return the largest support (p,) of another pair with the same element; 0 without one."""
    order = np.lexsort((-support, element))
    ordered, ranked = element[order], support[order]
    is_first = np.diff(ordered, prepend=-1) != 0
    best = ranked[is_first]
    number = np.cumsum(is_first) - 1
    is_second = ~is_first & np.concatenate([[False], is_first[:-1]])
    second = np.zeros(len(best))
    second[number[is_second]] = ranked[is_second]
    rival = np.empty(len(element))
    rival[order] = np.where(is_first, second[number], best[number])
    return rival
