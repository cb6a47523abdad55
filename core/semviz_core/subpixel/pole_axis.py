"""Find a pole's axis near a line.

Candidates are two parallel edges with smooth colours between them. The strip along the line is
straightened, and edges vote along tilted lines (a Hough transform). Each row's vote is capped, so
one strong edge behind the pole does not dominate.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.subpixel.sampling import SampledImage, Samples, color_at

STEP_PX = 0.5
WIDEST_PX = 42.0
_ROWS = (12, 24)
"""Least and largest number of rows along a pole; rows of longer poles are means."""
_EDGE = 6.0
"""Slope in grey levels per px, above that around it, at which an edge has half a vote."""
_FRINGE = 0.15
"""A step has fringes of other colours by this share of it, from the sensor's colour filter."""
_WINDOW = 24
"""Columns beside a pole in which edges count as clutter."""
_EXAMINED = 40
"""Number of best scores among which each axis is chosen."""
_CHANGE = 8.0
"""Change in grey levels between rows at which a sample counts as half smooth."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A candidate for a pole's axis."""

    ends_px: FloatArray
    """(2, 2)"""
    width_px: float
    evidence: FloatArray
    """(k,) the features that ``WEIGHTS`` weights."""
    score: float
    """Log-odds of being a pole's axis."""


WEIGHTS = np.array([0.0, 14.4, 13.72, -3.71, 13.46, -16.31, -1.1, -0.63, -9.08, -4.4, -7.16, 7.23])
"""Weights of evidence: constant; weaker and stronger edge; edge inside; smoothness inside and
outside; clutter; log width; offset; tilt; variation inside and outside."""


@compiled
def straighten(image: ByteImage, ends_px: FloatArray, offsets_px: FloatArray) -> Samples:
    """Return (rows, columns, 3) colours evenly along a line, at ``offsets_px`` to its right."""
    du, dv = ends_px[1, 0] - ends_px[0, 0], ends_px[1, 1] - ends_px[0, 1]
    length, right = np.hypot(du, dv), across(ends_px)
    rows = int(min(max(length, _ROWS[0]), _ROWS[1]))
    repeats = max(1, round(length / rows))
    strip = np.zeros((rows, len(offsets_px), 3), np.float32)
    for part in range(rows * repeats):
        share, row = (part + 0.5) / (rows * repeats), part // repeats
        u, v = ends_px[0, 0] + share * du, ends_px[0, 1] + share * dv
        for column in range(len(offsets_px)):
            off = offsets_px[column]
            color = color_at(image, u + off * right[0], v + off * right[1])
            for channel in range(3):
                strip[row, column, channel] += color[channel] / repeats
    return strip


@compiled
def across(ends_px: FloatArray) -> FloatArray:
    """Return the unit vector (2,) to the right of a line (2, 2) that runs down."""
    x, y = ends_px[1, 0] - ends_px[0, 0], ends_px[1, 1] - ends_px[0, 1]
    normal, length = np.empty(2), np.hypot(x, y)
    normal[0], normal[1] = y / length, -x / length
    return normal


def shift_line(ends_px: FloatArray, at_first_px: float, at_last_px: float) -> FloatArray:
    """Return a line (2, 2) with its ends moved to the right."""
    return np.asarray(ends_px + np.array([[at_first_px], [at_last_px]]) * across(ends_px))


def find_axes(
    image: SampledImage,
    ends_px: FloatArray,
    reach_px: float,
    count: int = 3,
    widest_px: float = WIDEST_PX,
) -> list[Axis]:
    """Return up to ``count`` candidates for a pole's axis near a line, likeliest first, to 0.5 px.

    Their ends are within ``reach_px`` of the line's, across it.
    """
    grid = _grid(reach_px, widest_px)
    best, evidence, scores = _likeliest(image.image, ends_px, grid, count)
    axes: list[Axis] = []
    for row, (t, w, c) in enumerate(best.tolist()):
        tilt, middle = float(grid.tilts[t]), float(grid.middles[w, c])
        ends = shift_line(ends_px, middle - tilt, middle + tilt)
        axes.append(Axis(ends, float(grid.widths[w]), evidence[row], float(scores[row])))
    return axes


class _Grid(NamedTuple):
    """All tilts, widths and middles within a reach."""

    reach_px: float
    offsets: FloatArray
    tilts: FloatArray
    widths: FloatArray
    log_widths: FloatArray
    middles: FloatArray
    """(widths, c)"""
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    """(widths, c) columns of the edges."""


@lru_cache(maxsize=16)
def _grid(reach_px: float, widest_px: float) -> _Grid:
    half = int(np.ceil((reach_px + widest_px / 2.0 + 4.0) / STEP_PX))
    offsets = np.asarray(np.arange(-half, half + 1) * STEP_PX, dtype=np.float64)
    count = int(reach_px / STEP_PX)
    tilts = np.asarray(np.arange(-count, count + 1) * STEP_PX, dtype=np.float64)
    steps = np.arange(2, round(widest_px / STEP_PX) + 1)
    left = half + np.arange(-count, count + 1) - (steps // 2)[:, None]
    right = left + steps[:, None]
    widths = np.asarray(steps * STEP_PX, dtype=np.float64)
    return _Grid(
        reach_px,
        offsets,
        tilts,
        widths,
        np.log(widths),
        (offsets[left] + offsets[right]) / 2.0,
        left,
        right,
    )


@compiled
def _likeliest(
    image: ByteImage, ends_px: FloatArray, grid: _Grid, count: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return up to ``count`` rows (tilt, width, middle) of the grid, their evidence and scores."""
    means = _means_along(straighten(image, ends_px, grid.offsets), grid.tilts)
    inside, scores = _scores(means, grid, WEIGHTS)
    best = _best(scores, grid, np.abs(across(ends_px)).max(), count)
    evidence, best_scores = np.empty((len(best), len(WEIGHTS))), np.empty(len(best))
    for row in range(len(best)):
        t, w, c = best[row]
        best_scores[row] = scores[t, w, c]
        parts = _parts(means, grid, inside[t, w, c], t, w, c)
        for k in range(len(parts)):
            evidence[row, k] = parts[k]
    return best, evidence, best_scores


class _Means(NamedTuple):
    """Means (tilts, columns) along tilted lines; the others are sums up to a column."""

    edge: FloatArray
    edge_sum: FloatArray
    smooth_sum: FloatArray
    varied_sum: FloatArray
    """Logarithms of the colours' standard deviation along the pole."""


@compiled
def _means_along(strip: Samples, tilts: FloatArray) -> _Means:
    rows, columns, _ = strip.shape
    most = int(np.ceil(np.abs(tilts).max() / STEP_PX))
    planes, sums = _planes(strip, most), np.empty((6, columns))
    shape = (len(tilts), columns)
    means = _Means(np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape))
    for t in range(len(tilts)):
        sums[:] = 0.0
        for row in range(rows):
            first = most + round(tilts[t] * ((row + 0.5) / rows * 2.0 - 1.0) / STEP_PX)
            for part in range(6):
                shifted, total = planes[row, part, first : first + columns], sums[part]
                for column in range(columns):
                    total[column] += shifted[column]
        for column in range(columns):
            variance = sums[5, column]
            for channel in range(3):
                variance -= sums[2 + channel, column] ** 2 / rows
            variance = max(variance, 0.0) / (3.0 * rows)
            means.varied_sum[t, column] = np.log(np.sqrt(variance) + 3.0)
            means.edge[t, column] = means.edge_sum[t, column] = sums[0, column] / rows
            means.smooth_sum[t, column] = sums[1, column] / rows
        for column in range(1, columns):
            for total in (means.edge_sum, means.smooth_sum, means.varied_sum):
                total[t, column] += total[t, column - 1]
    return means


@compiled
def _planes(strip: Samples, most: int) -> FloatArray:
    """Return (rows, 6, columns + 2 most) votes for edges and smoothness, the colours, and the sum
    of their squares; the border is extended."""
    rows, columns, _ = strip.shape
    edges, smooth = edge_votes(strip), _smoothness(strip)
    planes = np.empty((rows, 6, columns + 2 * most))
    for row in range(rows):
        for place in range(columns + 2 * most):
            column, square = min(max(place - most, 0), columns - 1), 0.0
            for channel in range(3):
                value = np.float64(strip[row, column, channel])
                planes[row, 2 + channel, place] = value
                square += value**2
            planes[row, 0, place], planes[row, 1, place] = edges[row, column], smooth[row, column]
            planes[row, 5, place] = square
    return planes


@compiled
def _smoothness(strip: Samples) -> FloatArray:
    """Return votes (rows, columns) for smoothness along the pole, 0 to 1."""
    rows, columns, _ = strip.shape
    smooth = np.empty((rows, columns))
    for row in range(rows):
        before = min(row, rows - 2)
        for column in range(columns):
            square = 0.0
            for channel in range(3):
                change = strip[before + 1, column, channel] - strip[before, column, channel]
                square += change**2 / 3.0
            smooth[row, column] = 1.0 / (1.0 + square / _CHANGE**2)
    return smooth


@compiled
def _scores(means: _Means, grid: _Grid, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (tilts, widths, c) the strongest edge well between both edges, and scores."""
    shape = (len(grid.tilts), *grid.left.shape)
    inside, scores = np.zeros(shape), np.empty(shape)
    for t in range(shape[0]):
        for w in range(shape[1]):
            for c in range(shape[2]):
                if w >= 6:  # w and w - 2 share the middle
                    left = means.edge[t, grid.left[w, c] + 3]
                    right = means.edge[t, grid.right[w, c] - 3]
                    inside[t, w, c] = max(inside[t, w - 2, c], left, right)
                evidence = _parts(means, grid, inside[t, w, c], t, w, c)
                score = 0.0
                for k in range(len(evidence)):
                    score += weights[k] * evidence[k]
                scores[t, w, c] = score
    return inside, scores


@compiled
def _parts(means: _Means, grid: _Grid, inside: float, t: int, w: int, c: int) -> tuple[float, ...]:
    """Return the evidence of one axis of a grid, with the strongest edge inside."""
    a, b = grid.left[w, c], grid.right[w, c]
    left, right = means.edge[t, a], means.edge[t, b]
    low, high = max(a - _WINDOW, 0), min(b + _WINDOW, len(grid.offsets) - 1)
    clutter = (means.edge_sum[t, high] - means.edge_sum[t, low]) / (high - low)
    smooth_inside, smooth_outside = _inside_and_outside(means.smooth_sum[t], a, b)
    varied_inside, varied_outside = _inside_and_outside(means.varied_sum[t], a, b)
    return (
        1.0, min(left, right), max(left, right), inside, smooth_inside, smooth_outside, clutter,
        grid.log_widths[w], (grid.middles[w, c] / grid.reach_px) ** 2,
        (grid.tilts[t] / grid.reach_px) ** 2, varied_inside, varied_outside,
    )  # fmt: skip


@compiled
def _inside_and_outside(total: FloatArray, a: int, b: int) -> tuple[float, float]:
    """Return means between two columns and beside them, from sums up to each column."""
    outside = total[b + 6] - total[b + 1] + total[a - 2] - total[a - 7]
    return (total[b - 1] - total[a]) / (b - a - 1), outside / 10.0


@compiled
def _best(scores: FloatArray, grid: _Grid, turned: float, count: int) -> IntArray:
    """Return up to ``count`` rows (tilt, width, middle) of different axes, best first.

    ``turned`` is the larger part of the unit vector across the line. Only the best scores count.
    """
    chosen = np.empty((count, 3), np.int64)
    for number in range(count):
        best, better = -np.inf, 0
        for t, w, c in np.ndindex(scores.shape):
            if scores[t, w, c] > best and not _is_chosen(grid, turned, t, w, c, chosen[:number]):
                best = float(scores[t, w, c])
                chosen[number, 0], chosen[number, 1], chosen[number, 2] = t, w, c
        for score in scores.flat:
            if score > best:
                better += 1
        if best == -np.inf or better >= _EXAMINED * count:
            return chosen[:number]
    return chosen


@compiled
def _is_chosen(grid: _Grid, turned: float, t: int, w: int, c: int, chosen: IntArray) -> bool:
    """Whether an axis is about the same as one that was chosen."""
    for k in range(len(chosen)):
        other_t, other_w, other_c = chosen[k]
        moved = abs(grid.middles[w, c] - grid.middles[other_w, other_c])
        off = (moved + abs(grid.tilts[t] - grid.tilts[other_t])) * turned
        wider = abs(grid.widths[w] - grid.widths[other_w])
        if off < 1.2 and wider < max(1.2, 0.3 * grid.widths[w]):
            return True
    return False


@compiled
def edge_votes(strip: Samples) -> FloatArray:
    """Return votes (rows, columns) for an edge along a pole, 0 to 1."""
    rows, columns, _ = strip.shape
    votes, size, after = np.empty((rows, columns)), np.zeros(columns), np.zeros(columns)
    for row in range(rows):
        for k in range(2, columns - 2):
            square = 0.0
            for channel in range(3):  # a smoothed central difference: [1 2 1] * [1 0 -1]
                beside = strip[row, k + 2, channel] - strip[row, k - 2, channel]
                slope = beside + 2.0 * (strip[row, k + 1, channel] - strip[row, k - 1, channel])
                square += (slope / (8.0 * STEP_PX)) ** 2
            size[k] = np.sqrt(square / 3.0)
        for k in range(columns):
            after[k] = size[k]
            for beside in range(k + 1, min(k + 6, columns)):
                after[k] = min(after[k], size[beside])
        for k in range(columns):
            before = after[k - 5] if k >= 5 else size[: k + 1].min()
            above = size[k] - max(before, after[k])
            votes[row, k] = above**2 / (above**2 + _EDGE**2)
    return votes


def edge_support(image: SampledImage, ends_px: FloatArray, width_px: float) -> FloatArray:
    """Return (4,) features of an axis.

    They are the mean votes of its weaker and its stronger edge, the share of rows with either edge,
    and the logarithm of the variation of its colour.
    """
    half = width_px / 2.0 + 4.0
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    return _edge_support(image.image, ends_px, width_px, offsets)


@compiled
def _edge_support(
    image: ByteImage, ends_px: FloatArray, width_px: float, offsets: FloatArray
) -> FloatArray:
    strip = straighten(image, ends_px, offsets)
    votes = edges_of_pole(strip, offsets, width_px)
    levels = mean_colors(strip, np.abs(offsets) <= max(0.3, width_px / 4.0))
    left, right, support = votes[:, 0].mean(), votes[:, 1].mean(), np.empty(4)
    support[0], support[1] = min(left, right), max(left, right)
    support[2] = (np.maximum(votes[:, 0], votes[:, 1]) > 0.5).mean()
    support[3] = np.log(np.abs(levels - median_color(levels)).mean() + 3.0)
    return support


@compiled
def edges_of_pole(strip: Samples, offsets_px: FloatArray, width_px: float) -> FloatArray:
    """Return (rows, 3) votes for the left and right edge of a pole, and their mean in all."""
    edge = edge_votes(strip)
    votes = np.zeros((len(strip), 3))
    for row in range(len(strip)):
        for k in range(len(offsets_px)):
            if abs(offsets_px[k] + width_px / 2.0) <= 0.75:
                votes[row, 0] = max(votes[row, 0], edge[row, k])
            if abs(offsets_px[k] - width_px / 2.0) <= 0.75:
                votes[row, 1] = max(votes[row, 1], edge[row, k])
            votes[row, 2] += edge[row, k] / len(offsets_px)
    return votes


@compiled
def mean_colors(strip: Samples, used: BoolArray) -> FloatArray:
    """Return (rows, 3) means of the used columns (columns,)."""
    colors, count = np.zeros((len(strip), 3)), 0
    for column in range(len(used)):
        count += used[column]
    for row in range(len(strip)):
        for column in range(len(used)):
            if used[column]:
                for channel in range(3):
                    colors[row, channel] += strip[row, column, channel] / count
    return colors


@compiled
def median_color(colors: FloatArray) -> FloatArray:
    """Return (3,) the median of colours (n, 3)."""
    middle = np.empty(3)
    for channel in range(3):
        middle[channel] = median(colors[:, channel].copy())
    return middle


@compiled
def median(values: FloatArray) -> float:
    """Return the median of a few values (n,), and sort them; NumPy's takes seconds to compile."""
    for k in range(1, len(values)):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return float(values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2.0


def stripe(image: SampledImage, ends_px: FloatArray, width_px: float) -> float:
    """Return the share of rows in which a line differs from both sides and all colours between.

    A blurred step, for example the corner of a house, has two flanks too, but no such colour.
    """
    return float(_stripe(image.image, ends_px, width_px))


@compiled
def _stripe(image: ByteImage, ends_px: FloatArray, width_px: float) -> float:
    offsets = np.zeros(3)
    offsets[2] = width_px / 2.0 + 1.5
    offsets[0] = -offsets[2]
    strip = straighten(image, ends_px, offsets)
    differs = 0.0
    for row in range(len(strip)):
        inner, step = strip[row, 1] - strip[row, 0], strip[row, 2] - strip[row, 0]
        product, length = 0.0, 1.0
        for channel in range(3):
            product += inner[channel] * step[channel]
            length += step[channel] ** 2
        share, square = min(max(product / length, 0.0), 1.0), 0.0
        for channel in range(3):
            square += (inner[channel] - share * step[channel]) ** 2 / 3.0
        differs += square / (square + _EDGE**2 + _FRINGE**2 * length / 3.0)
    return differs / len(strip)
