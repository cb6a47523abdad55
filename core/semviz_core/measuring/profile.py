"""Fit a pole's two edges at sub-pixel accuracy.

Every row across the pole shows three levels: left, pole and right. They are free in every row
(variable projection; Golub & Pereyra 1973), so the background, and even the sign of the contrast,
may change along the pole; only where the edges are is shared.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Picture, Samples
from semviz_core.measuring.pole import STEP_PX, Axis, shifted, straighten

_MARGIN_PX = 2.0
"""Of background on either side that the profile is fitted to."""
_BLUR_PX = 0.45
"""Sigma of an edge: the pixel's own width, the lens and the sampling."""
_LIT_PX = 2.9
"""Wider poles show from which side they are lit."""
_SAME = 1.0
"""How strongly a pole's level is the same in all rows: variance of noise over that of the level."""


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Profiles of poles of about one width, at middles and widths near it."""

    offsets: FloatArray
    """(m,) px"""
    middles: FloatArray
    widths: FloatArray
    around: NDArray[np.float32]
    """(w, c, k, m) orthonormal: the levels left and right, and the light across a wide pole."""
    pole: NDArray[np.float32]
    """(w, c, m) unit vectors: what of the pole's own level is none of those."""
    weight: NDArray[np.float32]
    """(w, c) its square length before."""


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
    """An edge at 0, blurred: the logistic function is within 1 % of the normal's integral."""
    return np.asarray(1.0 / (1.0 + np.exp(-1.702 / _BLUR_PX * x_px)))


def refine(picture: Picture, axis: Axis) -> Axis:
    """An axis at sub-pixel accuracy, from within 1.5 px of it."""
    width = axis.width_px
    ends = axis.ends_px
    level = None
    for reach, step in ((1.75, 0.25), (0.5, 0.1)):
        table = _profiles(max(1.0, round(2.0 * width) / 2.0), reach, step)
        strip = straighten(picture, ends, table.offsets)
        cost, level = _costs(strip, table, level)
        first, last, w = _cheapest_line(cost, table.middles)
        ends = shifted(ends, first, last)
        width = float(table.widths[w])
    return Axis(ends, width, axis.evidence, axis.score)


def _costs(
    strip: Samples, table: _Profiles, level: NDArray[np.float32] | None
) -> tuple[FloatArray, NDArray[np.float32]]:
    """(rows, widths, middles) squared residuals of every profile in every row."""
    rows, columns, _ = strip.shape
    w, c, k, m = table.around.shape
    if level is None:
        inner = np.abs(table.offsets) <= max(0.25, float(table.widths[4]) / 4.0)
        level = np.median(strip[:, inner].mean(axis=1), axis=0)
    data = (strip - level).transpose(1, 0, 2).reshape(columns, rows * 3)
    around = (table.around.reshape(-1, m) @ data).reshape(w * c, k, rows, 3)
    own = (table.pole.reshape(-1, m) @ data).reshape(w * c, rows, 3)
    weight = table.weight.reshape(-1, 1)
    share = weight / (weight + _SAME)
    explained = (around**2).sum(axis=(1, 3)) + share * (own**2).sum(axis=2)
    whole = (data**2).reshape(columns, rows, 3).sum(axis=(0, 2))
    cost = np.asarray((whole - explained).T.reshape(rows, w, c), dtype=np.float64)
    return cost, level


def _cheapest_line(cost: FloatArray, middles: FloatArray) -> tuple[float, float, int]:
    """Where the line through costs (rows, widths, middles) begins and ends (px), and its width.

    A row's cost counts up to a bound: a sign or a car may hide the pole there.
    """
    least = cost.min(axis=(1, 2), keepdims=True)
    scale = 4.0 * (np.median(least) + 20.0)
    bounded = (cost - least) / (cost - least + scale)
    index = _lines(len(cost), len(middles))  # (rows, first, last)
    rows = np.arange(len(cost))[:, None, None]
    total = bounded.transpose(0, 2, 1)[rows, index].sum(axis=0)  # (first, last, widths)
    i, j, w = np.unravel_index(np.argmin(total), total.shape)
    step = middles[1] - middles[0]
    first = middles[i] + step * _vertex(total[:, j, w], int(i))
    last = middles[j] + step * _vertex(total[i, :, w], int(j))
    return float(first), float(last), int(w)


@lru_cache(maxsize=64)
def _lines(rows: int, count: int) -> NDArray[np.int64]:
    """(rows, count, count) which of ``count`` places each line passes in each row."""
    share = ((np.arange(rows) + 0.5) / rows)[:, None, None]
    places = np.arange(count)
    return np.round(places[:, None] * (1.0 - share) + places * share).astype(np.int64)


def _vertex(values: FloatArray, at: int) -> float:
    """Where the parabola through the least value and its neighbours is least, in steps."""
    if not 0 < at < len(values) - 1:
        return 0.0
    low, mid, high = values[at - 1 : at + 2]
    bend = low + high - 2.0 * mid
    return float(0.5 * (low - high) / bend) if bend > 0.0 else 0.0
