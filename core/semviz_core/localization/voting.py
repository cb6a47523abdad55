"""Let the matches near a position vote for headings.

Matches of a block of positions are prepared once. At a position, whole arrays of them in single
precision give the gain and the heading of each; these loops compile to vector instructions. A
vote then raises a few bins of its observed element, and the elements' best gains add up.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.localization.problem import Record, RecordArray
from semviz_core.localization.upright import (
    FALSE_SLOPE,
    FALSE_TURN,
    GIVEN_ANCHOR,
    HIDDEN_CHI2,
    UprightView,
    slope_variances,
)

NEAREST_M, FARTHEST_M = 2.5, 60.0
BINS = 180
"""Bins of the heading, two degrees each."""
STEP_SIGMAS, HEIGHT_SIGMA_M, HEADING_SIGMA_RAD = 1.0 / 6.0, 0.15, float(np.deg2rad(0.8))
"""Sigmas of a position, as a share of the grid step, of its height, and of a heading."""
MOST_SIGMAS = 3.0
"""A vote spreads at most so far."""
BIN_RAD = 2.0 * np.pi / BINS

Float32Array: TypeAlias = NDArray[np.float32]

_EAST, _NORTH, _AZIMUTH = 0, 1, 2  # of the mapped element (m), of the observed one (bins)
_RISE, _SLOPE = (3, 5), (4, 6)  # of anchor and end, over the sigma of their difference
_GAIN, _HIDDEN_GAIN = 7, 8  # nats at best: with its bottom visible, and hidden
_ROWS = 9
_LANES = 8
"""Bins that a vote raises at once; whole vectors, of which the last bins may change nothing."""
_MARGIN = 32
"""Bins on either side of a turn, which votes across north reach into."""
_DISTANCES = int(FARTHEST_M) + 1

# Constants of single precision, with which the loops below stay in it.
_0, _HALF, _1, _2 = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_TINY, _TURN, _START = np.float32(1e-30), np.float32(BINS), np.float32(_MARGIN + 0.5)
_LEAST_SQUARE, _MOST_CHI2 = np.float32(NEAREST_M**2), np.float32(MOST_SIGMAS**2)
_HIDDEN_SIGMAS = np.float32(-np.sqrt(HIDDEN_CHI2))
_HEADING_VARIANCE = np.float32((HEADING_SIGMA_RAD / BIN_RAD) ** 2)
_WIDEST, _MOST_LOST = np.float32(_MARGIN - 2), _HALF * _MOST_CHI2
_A, _B, _C, _D, _E = (
    np.float32(factor / BIN_RAD)  # Abramowitz and Stegun 1964, 4.4.49: exact to 1e-5 rad
    for factor in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
)


class Weights(NamedTuple):
    """Sigmas and gains of matches by whole metres of distance."""

    inverse_sigma: Float32Array  # (m, _DISTANCES, 3) of slopes: anchor, end, end given the anchor
    slope_gain: Float32Array  # (m, _DISTANCES, 3) nats at best
    common: Float32Array  # (m, _DISTANCES) share of the anchor's error that its end has as well
    turn_gain: Float32Array  # (_DISTANCES,)
    position_variance: np.float32  # of a position, times the square of metres per bin


class Voters(NamedTuple):
    """The matches of a block, those of an observed element successive; there may be room for more.

    All but ``first`` and ``value`` is working memory for a position.
    """

    first: IntArray  # (m + 1,) those of observed element i are first[i]:first[i + 1]
    value: Float32Array  # (_ROWS, room)
    near: Float32Array  # (room,) 1 / distance, 0 if out of reach
    gain: Float32Array  # (room,)
    heading: Float32Array  # (room,) bins
    spread: Float32Array  # (room,) bins to either side that a vote raises
    falloff: Float32Array  # (room,) nats that it loses over one bin; over two, four times that
    voting: IntArray  # (room,) rows with a gain
    best: Float32Array  # (BINS + 2 _MARGIN + _LANES,) the best gain of an observed element
    total: Float32Array  # (BINS,) the sum of the elements' best gains: the result


@compiled
def vote_weights(view: UprightView, step_m: float) -> Weights:
    """Return sigmas and gains of matches on a grid of ``step_m``."""
    m = len(view.seen)
    inverse_sigma = np.empty((m, _DISTANCES, 3), dtype=np.float32)
    slope_gain = np.empty((m, _DISTANCES, 3), dtype=np.float32)
    common = np.empty((m, _DISTANCES), dtype=np.float32)
    turn_gain = np.empty(_DISTANCES, dtype=np.float32)
    for row in range(_DISTANCES):
        near, position_m = 1.0 / max(row + 0.5, NEAREST_M), STEP_SIGMAS * step_m
        turn_gain[row] = FALSE_TURN - 0.5 * np.log((position_m * near) ** 2 + HEADING_SIGMA_RAD**2)
        for i in range(m):
            variance, common[i, row] = slope_variances(
                view.seen[i], near, view.up_sigma_rad, position_m, HEIGHT_SIGMA_M
            )
            for k in range(3):
                inverse_sigma[i, row, k] = 1.0 / np.sqrt(variance[k])
                slope_gain[i, row, k] = FALSE_SLOPE - 0.5 * np.log(variance[k])
    position_variance = np.float32((STEP_SIGMAS * step_m / BIN_RAD) ** 2)
    return Weights(inverse_sigma, slope_gain, common, turn_gain, position_variance)


@compiled
def room_for_voters(m: int, room: int) -> Voters:
    """Return memory for as many matches of m observed elements."""
    return Voters(
        np.zeros(m + 1, dtype=np.int64),
        np.empty((_ROWS, room), dtype=np.float32),
        np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.int64),
        np.empty(BINS + 2 * _MARGIN + _LANES, dtype=np.float32),
        np.empty(BINS, dtype=np.float32),
    )


@compiled
def fill_voters(
    setting: Record,
    view: UprightView,
    elements: RecordArray,
    compatible: BoolArray,
    near: IntArray,
    middle_m: tuple[float, float, float],
    weights: Weights,
    voters: Voters,
) -> None:
    """Fill in the matches of elements in rows ``near`` for positions around ``middle_m``."""
    count, value = 0, voters.value
    x, y, z = middle_m
    east, north, rows = _offsets(elements, near, x, y)
    for i in range(len(view.seen)):
        seen, allowed = view.seen[i], compatible[i]
        azimuth = seen.azimuth_rad / BIN_RAD
        for entry in range(len(near)):
            j = near[entry]
            if not allowed[j]:
                continue
            mapped, row = elements[j], rows[entry]
            value[_EAST, count], value[_NORTH, count] = east[entry], north[entry]
            value[_AZIMUTH, count] = azimuth
            gain = hidden_gain = weights.turn_gain[row]
            for end in range(2):
                value[_RISE[end], count] = value[_SLOPE[end], count] = _0
                hidden_gain = gain + setting.log_hidden
                if seen.known[end] and mapped.known[end]:
                    rise, slope, k = mapped.height_m[end] - z, seen.slope[end], end
                    if end == 1 and seen.known[0] and mapped.known[0]:
                        common, k = weights.common[i, row], GIVEN_ANCHOR
                        rise -= common * (mapped.height_m[0] - z)
                        slope -= common * seen.slope[0]
                    value[_RISE[end], count] = rise * weights.inverse_sigma[i, row, k]
                    value[_SLOPE[end], count] = slope * weights.inverse_sigma[i, row, k]
                    gain += weights.slope_gain[i, row, k]
                    if end == 1 and setting.hidden_bottoms > 0.0:
                        gain += setting.log_visible
            value[_GAIN, count], value[_HIDDEN_GAIN, count] = gain, hidden_gain
            count += 1
        voters.first[i + 1] = count


@compiled
def _offsets(
    elements: RecordArray, near: IntArray, x: float, y: float
) -> tuple[Float32Array, Float32Array, IntArray]:
    """Return how far east and north (m) of (x, y) elements in rows ``near`` are, and the distance
    in whole metres."""
    east, north = np.empty(len(near), dtype=np.float32), np.empty(len(near), dtype=np.float32)
    rows = np.empty(len(near), dtype=np.int64)
    for k in range(len(near)):
        position_m = elements[near[k]].position_m
        dx, dy = position_m[0] - x, position_m[1] - y
        east[k], north[k] = dx, dy
        rows[k] = min(int(np.sqrt(dx * dx + dy * dy)), _DISTANCES - 1)
    return east, north, rows


@compiled_leaf
def vote_at(voters: Voters, weights: Weights, x: float, y: float, reach_m: float) -> None:
    """Fill ``voters.total`` at a position (x, y) from the middle of the block; the true one is up
    to half a step away on either axis."""
    count = voters.first[-1]
    value, near, gain = voters.value, voters.near[:count], voters.gain[:count]
    east, north, heading = value[_EAST, :count], value[_NORTH, :count], voters.heading[:count]
    east_m, north_m = np.float32(x), np.float32(y)
    _fill_near(east, north, east_m, north_m, np.float32(reach_m * reach_m), near)
    rise, slope = value[_RISE[1], :count], value[_SLOPE[1], :count]
    _fill_gain_of_ends(near, rise, slope, value[_GAIN, :count], value[_HIDDEN_GAIN, :count], gain)
    _add_gain_of_anchors(near, value[_RISE[0], :count], value[_SLOPE[0], :count], gain)
    _fill_heading(east, north, east_m, north_m, value[_AZIMUTH, :count], heading)
    spread, falloff = voters.spread[:count], voters.falloff[:count]
    _fill_spread(near, gain, weights.position_variance, spread, falloff)
    best, total, voting = voters.best, voters.total, voters.voting
    total[:] = _0
    for i in range(len(voters.first) - 1):
        chosen = 0
        for k in range(voters.first[i], voters.first[i + 1]):
            voting[chosen] = k
            chosen += int(gain[k] > _0)
        if chosen == 0:
            continue
        best[:] = _0
        for k in voting[:chosen]:
            _add_vote(best, heading[k], gain[k], spread[k], falloff[k])
        _add_turn(best, total)


@compiled_leaf
def _fill_near(
    east: Float32Array,
    north: Float32Array,
    x: np.float32,
    y: np.float32,
    most_square: np.float32,
    near: Float32Array,
) -> None:
    for k in range(len(near)):
        dx, dy = east[k] - x, north[k] - y
        square = dx * dx + dy * dy
        near[k] = _1 / np.sqrt(square) if (square > _LEAST_SQUARE and square < most_square) else _0


@compiled_leaf
def _fill_gain_of_ends(
    near: Float32Array,
    rise: Float32Array,
    slope: Float32Array,
    visible_gain: Float32Array,
    hidden_gain: Float32Array,
    gain: Float32Array,
) -> None:
    """Fill in the gains of the slopes of ends, 0 out of reach."""
    for k in range(len(gain)):
        off = rise[k] * near[k] - slope[k]
        of_end = hidden_gain[k] if off < _HIDDEN_SIGMAS else visible_gain[k] - _HALF * off * off
        gain[k] = of_end if near[k] > _0 else _0


@compiled_leaf
def _add_gain_of_anchors(
    near: Float32Array, rise: Float32Array, slope: Float32Array, gain: Float32Array
) -> None:
    for k in range(len(gain)):
        off = rise[k] * near[k] - slope[k]
        gain[k] -= _HALF * off * off


@compiled_leaf
def _fill_heading(
    east: Float32Array,
    north: Float32Array,
    x: np.float32,
    y: np.float32,
    azimuth: Float32Array,
    heading: Float32Array,
) -> None:
    """Fill in the headings, in bins from 0 to BINS, that make azimuths agree."""
    for k in range(len(heading)):
        dx, dy = east[k] - x, north[k] - y
        larger, smaller = max(abs(dx), abs(dy)), min(abs(dx), abs(dy))
        ratio = smaller / (larger + _TINY)
        s = ratio * ratio
        angle = ratio * (_A + s * (_B + s * (_C + s * (_D + s * _E))))
        angle = _HALF * _HALF * _TURN - angle if abs(dy) > abs(dx) else angle
        angle = _HALF * _TURN - angle if dx < _0 else angle
        angle = (-angle if dy < _0 else angle) - azimuth[k]
        angle = angle + _TURN if angle < _0 else angle
        angle = angle + _TURN if angle < _0 else angle
        heading[k] = angle - _TURN if angle >= _TURN else angle


@compiled_leaf
def _fill_spread(
    near: Float32Array,
    gain: Float32Array,
    position_variance: np.float32,
    spread: Float32Array,
    falloff: Float32Array,
) -> None:
    """Fill in how far votes spread: to where nothing is left of their gain, or MOST_SIGMAS."""
    for k in range(len(near)):
        variance = position_variance * near[k] * near[k] + _HEADING_VARIANCE
        falloff[k] = _HALF / variance
        chi2 = min(_2 * max(gain[k], _0), _MOST_CHI2)
        spread[k] = min(np.sqrt(variance * chi2), _WIDEST)


@compiled_leaf
def _add_vote(
    best: Float32Array,
    heading: np.float32,
    gain: np.float32,
    spread: np.float32,
    falloff: np.float32,
) -> None:
    """Add a vote for ``heading`` (in bins) to whole vectors of bins."""
    first = int(heading - spread + _START)
    off = np.float32(first - _MARGIN) + _HALF - heading
    bin = np.uintp(first)  # unsigned: a number that may be negative would stop vector instructions
    for _ in range((int(spread - off) + _LANES) // _LANES):
        for lane in range(_LANES):
            away = off + np.float32(lane)
            lost, at = away * away * falloff, bin + np.uintp(lane)
            value = gain - lost if lost <= _MOST_LOST else _0
            best[at] = value if value > best[at] else best[at]
        bin += np.uintp(_LANES)
        off += np.float32(_LANES)


@compiled_leaf
def _add_turn(best: Float32Array, total: Float32Array) -> None:
    """Add the best gains of an observed element to the total; the margins are the same turn."""
    for k in range(_MARGIN):
        best[_MARGIN + k] = max(best[_MARGIN + k], best[_MARGIN + BINS + k])
        best[BINS + k] = max(best[BINS + k], best[k])
    for k in range(BINS):
        total[k] += best[_MARGIN + k]
