"""Fit the two edges of a pole at sub-pixel accuracy.

Every row across the pole has three levels: left, pole and right. They are free in
every row (variable projection; Golub and Pereyra 1973), so the background, and even the sign of
the contrast, may change along the pole. Only the positions of the edges are shared.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import FloatArray
from semviz_core.common.jit import compiled
from semviz_core.subpixel.pole_axis import (
    STEP_PX,
    Axis,
    mean_colors,
    median,
    median_color,
    shift_line,
    straighten,
)
from semviz_core.subpixel.sampling import SampledImage, Samples

_MARGIN_PX = 2.0
"""Background on each side that the profile is fitted to."""
_BLUR_PX = 0.45
"""Sigma of an edge: pixel width, lens and sampling."""
_LIT_PX = 2.9
"""Wider poles show shading."""
_LEVEL_PRIOR = 1.0
"""Prior that a pole's level is equal in all rows: variance of noise over variance of the level."""


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Profiles of poles at middles and widths near a given one."""

    offsets: FloatArray
    """(m,) px"""
    middles: FloatArray
    widths: FloatArray
    around: NDArray[np.float32]
    """(w, c, k, m) orthonormal: the levels left and right, and the shading across a wide pole."""
    pole: NDArray[np.float32]
    """(w, c, m) unit vectors: the pole's own level, orthogonal to ``around``."""
    weight: NDArray[np.float32]
    """(w, c) its square length before normalization."""


@lru_cache(maxsize=128)
def _profiles(width_px: float, reach_px: float, step_px: float) -> _Profiles:
    half = width_px / 2.0 + _MARGIN_PX
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    middles = np.arange(-reach_px, reach_px + step_px / 2, step_px)
    spread = 1.0 + 0.1 * width_px
    widths = np.linspace(max(0.8, width_px - spread), width_px + spread, 9)
    edges = middles[None, :, None] + widths[:, None, None] * np.array([-0.5, 0.5])
    left = _step(offsets - edges[..., :1])
    right = _step(offsets - edges[..., 1:])
    parts = [1.0 - left, right]
    across = (offsets - middles[None, :, None]) / (widths[:, None, None] / 2.0)
    if width_px > _LIT_PX:  # round poles are lit from a side
        parts += [(left - right) * across]
    if width_px > _LIT_PX:
        parts += [(left - right) * across**2]
    bases = np.linalg.qr(np.stack([*parts, left - right], axis=-1))
    weight = bases.R[..., -1, -1] ** 2
    Q = np.swapaxes(bases.Q, -1, -2).astype(np.float32)
    sign = np.sign(bases.R[..., -1, -1])[..., None]
    return _Profiles(
        offsets, middles, widths, Q[..., :-1, :], Q[..., -1, :] * sign.astype(np.float32),
        weight.astype(np.float32),
    )  # fmt: skip


def _step(x_px: FloatArray) -> FloatArray:
    """Return a blurred edge at 0; the logistic is within 1 % of the normal distribution."""
    return np.asarray(1.0 / (1.0 + np.exp(-1.702 / _BLUR_PX * x_px)))


def refine_axis(image: SampledImage, axis: Axis) -> Axis:
    """Return an axis at sub-pixel accuracy, from one within 1.5 px of it."""
    width, ends = axis.width_px, axis.ends_px
    level = None
    for reach, step in ((1.75, 0.25), (0.5, 0.1)):
        table = _profiles(max(1.0, round(2.0 * width) / 2.0), reach, step)
        strip = straighten(image.image, ends, table.offsets)
        if level is None:
            inner = np.abs(table.offsets) <= max(0.25, float(table.widths[4]) / 4.0)
            level = median_color(mean_colors(strip, inner)).astype(np.float32)
        first, last, w = _cheapest_line(_costs(strip - level, table), table.middles)
        ends = shift_line(ends, first, last)
        width = float(table.widths[w])
    return Axis(ends, width, axis.evidence, axis.score)


def _costs(strip: Samples, table: _Profiles) -> FloatArray:
    """Return (rows, middles, widths) squared residuals of all profiles."""
    rows, columns, _ = strip.shape
    w, c, k, m = table.around.shape
    data = np.ascontiguousarray(strip.transpose(1, 0, 2)).reshape(columns, rows * 3)
    around = (table.around.reshape(-1, m) @ data).reshape(w, c, k, rows, 3)
    own = (table.pole.reshape(-1, m) @ data).reshape(w, c, rows, 3)
    return _residuals(strip, around, own, table.weight)


@compiled
def _residuals(strip: Samples, around: Samples, own: Samples, weight: Samples) -> FloatArray:
    """Return (rows, middles, widths) of the parts (w, c, k, rows, 3) and (w, c, rows, 3)."""
    w, c, k, rows, _ = around.shape
    cost = np.empty((rows, c, w))
    for row in range(rows):
        square = 0.0
        for value in strip[row].flat:
            square += np.float64(value) ** 2
        cost[row] = square
    for i in range(w):
        for j in range(c):
            share = weight[i, j] / (weight[i, j] + _LEVEL_PRIOR)
            for row in range(rows):
                for channel in range(3):
                    cost[row, j, i] -= share * own[i, j, row, channel] ** 2
                    for part in range(k):
                        cost[row, j, i] -= around[i, j, part, row, channel] ** 2
    return cost


@compiled
def _cheapest_line(cost: FloatArray, middles: FloatArray) -> tuple[float, float, int]:
    """Return start and end (px) of the cheapest line through costs (rows, middles, widths).

    Third is the index of its width. A row's cost is bounded, since a sign or a car may hide it.
    """
    rows, count, widths = cost.shape
    least = np.empty(rows)
    for row in range(rows):
        least[row] = cost[row].min()
    scale = 4.0 * (median(least.copy()) + 20.0)
    total, bounded = np.zeros((count, count, widths)), np.empty((count, widths))
    for row in range(rows):
        share = (row + 0.5) / rows
        for k in range(count):
            for w in range(widths):
                above = cost[row, k, w] - least[row]
                bounded[k, w] = above / (above + scale)
        for i in range(count):
            for j in range(count):
                at = round(i * (1.0 - share) + j * share)
                for w in range(widths):
                    total[i, j, w] += bounded[at, w]
    at = total.argmin()
    i, j, w = at // (count * widths), at // widths % count, at % widths
    step = middles[1] - middles[0]
    first = middles[i] + step * _vertex(total[:, j, w], i)
    last = middles[j] + step * _vertex(total[i, :, w], j)
    return first, last, w


@compiled
def _vertex(values: FloatArray, at: int) -> float:
    """Return the minimum of the parabola through the least value and its neighbours, in steps."""
    if not 0 < at < len(values) - 1:
        return 0.0
    low, mid, high = values[at - 1], values[at], values[at + 1]
    bend = low + high - 2.0 * mid
    return 0.5 * (low - high) / bend if bend > 0.0 else 0.0
