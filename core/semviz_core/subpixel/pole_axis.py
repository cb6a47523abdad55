"""Find a pole's axis near a line, and fit its two edges at sub-pixel accuracy.

Candidates are two parallel edges with smooth colours between them. The strip along the line is
straightened, and edges vote along tilted lines (a Hough transform). Each row's vote is capped, so
one strong edge behind the pole does not dominate.

In the fit, every row across the pole has three levels: left, pole and right. They are free in
every row (variable projection; Golub and Pereyra 1973), so the background, and even the sign of
the contrast, may change along the pole. Only the positions of the edges are shared.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.sampling import SampledImage, Samples

STEP_PX = 0.5
WIDEST_PX = 42.0
_ROWS = (12, 24)
"""Least and largest number of rows along a pole; rows of longer poles are means."""
_EDGE = 6.0
"""Slope in grey levels per px, above that around it, at which an edge has half a vote."""
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


def straighten(image: SampledImage, ends_px: FloatArray, offsets_px: FloatArray) -> Samples:
    """Return (rows, columns, 3) colours evenly along a line, at ``offsets_px`` to its right."""
    length = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    rows = int(np.clip(length, *_ROWS))
    repeats = max(1, round(length / rows))
    share = (np.arange(rows * repeats) + 0.5) / (rows * repeats)
    points = ends_px[0] + share[:, None] * (ends_px[1] - ends_px[0])
    samples = image.sample(points[:, None] + offsets_px[:, None] * across(ends_px))
    return np.asarray(samples.reshape(rows, repeats, len(offsets_px), 3).mean(axis=1))


def across(ends_px: FloatArray) -> FloatArray:
    """Return the unit vector (2,) to the right of a line (2, 2) that runs down."""
    x, y = ends_px[1] - ends_px[0]
    return np.asarray(np.array([y, -x]) / np.hypot(x, y))


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
    features = _features(straighten(image, ends_px, grid.offsets), grid)
    scores = features @ WEIGHTS
    axes: list[Axis] = []
    flat = scores.reshape(-1)
    order = np.argsort(-flat, kind="stable")[: 40 * count]
    for at in order:
        if len(axes) == count:
            break
        t, w, c = np.unravel_index(at, scores.shape)
        tilt, middle = float(grid.tilts[t]), float(grid.middles[w, c])
        width = float(grid.widths[w])
        ends = shift_line(ends_px, middle - tilt, middle + tilt)
        if not any(_same_axis(ends, width, axis) for axis in axes):
            axes.append(Axis(ends, width, features[t, w, c], float(flat[at])))
    return axes


def _same_axis(ends_px: FloatArray, width_px: float, other: Axis) -> bool:
    near = np.abs(ends_px - other.ends_px).max() < 1.2
    return bool(near and abs(width_px - other.width_px) < max(1.2, 0.3 * width_px))


@dataclass(frozen=True, eq=False)
class _Grid:
    """All tilts, widths and middles within a reach."""

    reach_px: float
    offsets: FloatArray
    tilts: FloatArray
    widths: FloatArray
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
    return _Grid(
        reach_px,
        offsets,
        tilts,
        np.asarray(steps * STEP_PX, dtype=np.float64),
        (offsets[left] + offsets[right]) / 2.0,
        left,
        right,
    )


def _features(strip: Samples, grid: _Grid) -> FloatArray:
    """Return the evidence (tilts, widths, c, k) of all axes of a grid."""
    edge, smooth = _votes(strip)
    index = _shear(*strip.shape[:2], tuple(grid.tilts.tolist()))
    rows = np.arange(len(edge))[:, None]
    edges = edge[rows, index].mean(axis=1)  # (tilts, columns)
    smooths = smooth[rows, index].mean(axis=1)
    varied = _log_variation(strip, index)
    total = np.cumsum(np.stack([smooths, varied]), axis=2)
    a, b = grid.left, grid.right
    left, right = edges[:, a], edges[:, b]
    inner = (total[..., b - 1] - total[..., a]) / (b - a - 1)
    outer = (total[..., b + 6] - total[..., b + 1] + total[..., a - 2] - total[..., a - 7]) / 10.0
    window = 24
    low, high = np.maximum(a - window, 0), np.minimum(b + window, edges.shape[1] - 1)
    sums = np.cumsum(edges, axis=1)
    clutter = (sums[:, high] - sums[:, low]) / (high - low)[None]
    inside = _inside(edges, a, b)
    shape = left.shape
    middle = np.broadcast_to(grid.middles, shape)
    tilt = np.broadcast_to(grid.tilts[:, None, None], shape)
    width = np.broadcast_to(np.log(grid.widths)[:, None], shape)
    parts = [
        np.ones(shape), np.minimum(left, right), np.maximum(left, right), inside, inner[0],
        outer[0], clutter, width, (middle / grid.reach_px) ** 2, (tilt / grid.reach_px) ** 2,
        inner[1], outer[1],
    ]  # fmt: skip
    return np.stack(parts, axis=-1)


def _log_variation(strip: Samples, index: NDArray[np.int64]) -> FloatArray:
    """Return (tilts, columns) the logarithm of the colours' standard deviation along the pole."""
    rows = np.arange(len(strip))[:, None]
    total, square = 0.0, 0.0
    for channel in range(3):
        values = strip[..., channel][rows, index]
        total = total + values.mean(axis=1) ** 2
        square = square + (values**2).mean(axis=1)
    return np.asarray(
        np.log(np.sqrt(np.maximum(square - total, 0.0) / 3.0) + 3.0), dtype=np.float64
    )


def _inside(edges: FloatArray, a: NDArray[np.int64], b: NDArray[np.int64]) -> FloatArray:
    """Return (tilts, widths, c) the strongest edge well between two columns."""
    result = np.zeros((len(edges), *a.shape))
    for w in range(6, len(a)):  # w and w - 2 share the middle
        grown = np.maximum(edges[:, a[w] + 3], edges[:, b[w] - 3])
        result[:, w] = np.maximum(result[:, w - 2], grown)
    return result


def _votes(strip: Samples) -> tuple[FloatArray, FloatArray]:
    """Return votes (rows, columns) for an edge, and for smoothness along the pole; 0 to 1."""
    change = np.empty_like(strip)
    change[:-1] = strip[1:] - strip[:-1]
    change[-1] = change[-2]
    smooth = 1.0 / (1.0 + (change**2).mean(axis=2) / _CHANGE**2)
    return edge_votes(strip), smooth.astype(np.float64)


def edge_votes(strip: Samples) -> FloatArray:
    """Return votes (rows, columns) for an edge along a pole, 0 to 1."""
    slope = np.zeros_like(strip)
    # a smoothed central difference: [1 2 1] * [1 0 -1]
    slope[:, 2:-2] = (
        strip[:, 4:] + 2.0 * strip[:, 3:-1] - 2.0 * strip[:, 1:-3] - strip[:, :-4]
    ) / (8.0 * STEP_PX)
    size = np.sqrt((slope**2).mean(axis=2))
    before, after = size.copy(), size.copy()
    for k in range(1, 6):
        before[:, k:] = np.minimum(before[:, k:], size[:, :-k])
        after[:, :-k] = np.minimum(after[:, :-k], size[:, k:])
    above = size - np.maximum(before, after)
    square = above**2
    return np.asarray(square / (square + _EDGE**2), dtype=np.float64)


@lru_cache(maxsize=64)
def _shear(rows: int, columns: int, tilts: tuple[float, ...]) -> NDArray[np.int64]:
    """Return (tilts, rows, columns) the column of each sample of a tilted line."""
    share = (np.arange(rows) + 0.5) / rows * 2.0 - 1.0
    shift = np.round(np.outer(tilts, share) / STEP_PX).astype(np.int64)
    return np.asarray(np.clip(np.arange(columns) + shift[..., None], 0, columns - 1))


def edge_support(image: SampledImage, ends_px: FloatArray, width_px: float) -> FloatArray:
    """Return (4,) features of an axis.

    They are the mean votes of its weaker and its stronger edge, the share of rows with either edge,
    and the logarithm of the variation of its colour.
    """
    half = width_px / 2.0 + 4.0
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    strip = straighten(image, ends_px, offsets)
    edge = edge_votes(strip)
    left, right = (
        edge[:, np.abs(offsets - edge_at) <= 0.75].max(axis=1)
        for edge_at in (-width_px / 2, width_px / 2)
    )
    inner = np.abs(offsets) <= max(0.3, width_px / 4.0)
    level = strip[:, inner].mean(axis=1)
    varied = np.abs(level - np.median(level, axis=0)).mean()
    weaker, stronger = sorted((float(left.mean()), float(right.mean())))
    either = float((np.maximum(left, right) > 0.5).mean())
    return np.array([weaker, stronger, either, np.log(varied + 3.0)])


def stripe(image: SampledImage, ends_px: FloatArray, width_px: float) -> float:
    """Return the share of rows in which a line differs from both sides and all colours between.

    A blurred step, for example the corner of a house, has two flanks too, but no such colour.
    """
    beside = width_px / 2.0 + 1.5
    left, inner, right = np.moveaxis(
        straighten(image, ends_px, np.array([-beside, 0.0, beside])), 1, 0
    )
    step = right - left
    share = ((inner - left) * step).sum(axis=1) / ((step**2).sum(axis=1) + 1.0)
    between = left + np.clip(share, 0.0, 1.0)[:, None] * step
    off = np.sqrt(((inner - between) ** 2).mean(axis=1))
    return float((off**2 / (off**2 + _EDGE**2)).mean())


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
    width = axis.width_px
    ends = axis.ends_px
    level = None
    for reach, step in ((1.75, 0.25), (0.5, 0.1)):
        table = _profiles(max(1.0, round(2.0 * width) / 2.0), reach, step)
        strip = straighten(image, ends, table.offsets)
        cost, level = _costs(strip, table, level)
        first, last, w = _cheapest_line(cost, table.middles)
        ends = shift_line(ends, first, last)
        width = float(table.widths[w])
    return Axis(ends, width, axis.evidence, axis.score)


def _costs(
    strip: Samples, table: _Profiles, level: NDArray[np.float32] | None
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return (rows, widths, middles) squared residuals of all profiles, and the pole's level."""
    rows, columns, _ = strip.shape
    w, c, k, m = table.around.shape
    if level is None:
        inner = np.abs(table.offsets) <= max(0.25, float(table.widths[4]) / 4.0)
        level = np.median(strip[:, inner].mean(axis=1), axis=0)
    data = (strip - level).transpose(1, 0, 2).reshape(columns, rows * 3)
    around = (table.around.reshape(-1, m) @ data).reshape(w * c, k, rows, 3)
    own = (table.pole.reshape(-1, m) @ data).reshape(w * c, rows, 3)
    weight = table.weight.reshape(-1, 1)
    share = weight / (weight + _LEVEL_PRIOR)
    explained = (around**2).sum(axis=(1, 3)) + share * (own**2).sum(axis=2)
    whole = (data**2).reshape(columns, rows, 3).sum(axis=(0, 2))
    cost = np.asarray((whole - explained).T.reshape(rows, w, c), dtype=np.float64)
    return cost, level


def _cheapest_line(cost: FloatArray, middles: FloatArray) -> tuple[float, float, int]:
    """Return start and end (px) of the cheapest line through costs (rows, widths, middles).

    Third is the index of its width. A row's cost is bounded, since a sign or a car may hide it.
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
    """Return (rows, count, count) which of ``count`` positions each line passes in each row."""
    share = ((np.arange(rows) + 0.5) / rows)[:, None, None]
    places = np.arange(count)
    return np.round(places[:, None] * (1.0 - share) + places * share).astype(np.int64)


def _vertex(values: FloatArray, at: int) -> float:
    """Return the minimum of the parabola through the least value and its neighbours, in steps."""
    if not 0 < at < len(values) - 1:
        return 0.0
    low, mid, high = values[at - 1 : at + 2]
    bend = low + high - 2.0 * mid
    return float(0.5 * (low - high) / bend) if bend > 0.0 else 0.0
