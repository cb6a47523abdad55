"""Candidates for a pole's axis near a line: two parallel edges along it, smooth between them.

In the strip straightened along the line, edges vote along tilted lines (a Hough transform), with a
capped vote for each row, so that one strong edge behind the pole counts no more than its share.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Picture, Samples

STEP_PX = 0.5
WIDEST_PX = 42.0
_ROWS = (12, 24)
"""Fewest and most samples along a pole; those of longer ones are means."""
_EDGE = 6.0
"""Levels per px above the slope around it at which an edge has half a vote."""
_CHANGE = 8.0
"""Levels from row to row at which a sample counts as half smooth."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A candidate for a pole's axis."""

    ends_px: FloatArray
    """(2, 2)"""
    width_px: float
    evidence: FloatArray
    """(k,) what speaks for and against it."""
    score: float
    """Log-odds that it is a pole's axis."""


WEIGHTS = np.array([0.0, 14.4, 13.72, -3.71, 13.46, -16.31, -1.1, -0.63, -9.08, -4.4, -7.16, 7.23])
"""Of evidence: one; weaker and stronger edge; edge inside; smooth inside and outside; clutter; log
width; off; tilt; varied inside and outside."""


def straighten(picture: Picture, ends_px: FloatArray, offsets_px: FloatArray) -> Samples:
    """(rows, columns, 3) colours beside a line: evenly along, and ``offsets_px`` to its right."""
    length = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    rows = int(np.clip(length, *_ROWS))
    repeats = max(1, round(length / rows))
    share = (np.arange(rows * repeats) + 0.5) / (rows * repeats)
    points = ends_px[0] + share[:, None] * (ends_px[1] - ends_px[0])
    samples = picture.sample(points[:, None] + offsets_px[:, None] * across(ends_px))
    return np.asarray(samples.reshape(rows, repeats, len(offsets_px), 3).mean(axis=1))


def across(ends_px: FloatArray) -> FloatArray:
    """(2,) unit vector to the right of a line (2, 2) that runs down."""
    x, y = ends_px[1] - ends_px[0]
    return np.asarray(np.array([y, -x]) / np.hypot(x, y))


def shifted(ends_px: FloatArray, at_first_px: float, at_last_px: float) -> FloatArray:
    """A line (2, 2) moved to its right at either end."""
    return np.asarray(ends_px + np.array([[at_first_px], [at_last_px]]) * across(ends_px))


def find_axes(
    picture: Picture,
    ends_px: FloatArray,
    reach_px: float,
    count: int = 3,
    widest_px: float = WIDEST_PX,
) -> list[Axis]:
    """Up to ``count`` candidates for a pole's axis near a line, likeliest first; to 0.5 px.

    Their ends are at most ``reach_px`` across from the line's.
    """
    grid = _grid(reach_px, widest_px)
    features = _features(straighten(picture, ends_px, grid.offsets), grid)
    scores = features @ WEIGHTS
    found: list[Axis] = []
    flat = scores.reshape(-1)
    order = np.argsort(-flat, kind="stable")[: 40 * count]
    for at in order:
        if len(found) == count:
            break
        t, w, c = np.unravel_index(at, scores.shape)
        tilt, middle = float(grid.tilts[t]), float(grid.middles[w, c])
        width = float(grid.widths[w])
        ends = shifted(ends_px, middle - tilt, middle + tilt)
        if not any(_same(ends, width, one) for one in found):
            found.append(Axis(ends, width, features[t, w, c], float(flat[at])))
    return found


def _same(ends_px: FloatArray, width_px: float, other: Axis) -> bool:
    near = np.abs(ends_px - other.ends_px).max() < 1.2
    return bool(near and abs(width_px - other.width_px) < max(1.2, 0.3 * width_px))


@dataclass(frozen=True, eq=False)
class _Grid:
    """All hypotheses within a reach."""

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
    """(tilts, widths, c, k)"""
    edge, smooth = _votes(strip)
    index = _shear(*strip.shape[:2], tuple(grid.tilts.tolist()))
    rows = np.arange(len(edge))[:, None]
    edges = edge[rows, index].mean(axis=1)  # (tilts, columns)
    smooths = smooth[rows, index].mean(axis=1)
    varied = _variation(strip, index)
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


def _variation(strip: Samples, index: NDArray[np.int64]) -> FloatArray:
    """(tilts, columns) logarithm of how much colours differ along the pole."""
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
    """(tilts, widths, c) the strongest edge well between two columns."""
    result = np.zeros((len(edges), *a.shape))
    for w in range(6, len(a)):  # w and w - 2 share the middle
        grown = np.maximum(edges[:, a[w] + 3], edges[:, b[w] - 3])
        result[:, w] = np.maximum(result[:, w - 2], grown)
    return result


def _votes(strip: Samples) -> tuple[FloatArray, FloatArray]:
    """(rows, columns) each: how much of an edge, and how smooth along the pole; 0 to 1."""
    change = np.empty_like(strip)
    change[:-1] = strip[1:] - strip[:-1]
    change[-1] = change[-2]
    smooth = 1.0 / (1.0 + (change**2).mean(axis=2) / _CHANGE**2)
    return edge_votes(strip), smooth.astype(np.float64)


def edge_votes(strip: Samples) -> FloatArray:
    """(rows, columns) how much of an edge along a pole each sample is, 0 to 1."""
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
    """(tilts, rows, columns) which column each sample of a tilted line comes from."""
    share = (np.arange(rows) + 0.5) / rows * 2.0 - 1.0
    shift = np.round(np.outer(tilts, share) / STEP_PX).astype(np.int64)
    return np.asarray(np.clip(np.arange(columns) + shift[..., None], 0, columns - 1))


def support(picture: Picture, ends_px: FloatArray, width_px: float) -> FloatArray:
    """(4,) of an axis: mean vote of its weaker and stronger edge, share of rows with either edge,
    how much its colours vary along it (logarithm)."""
    half = width_px / 2.0 + 4.0
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    strip = straighten(picture, ends_px, offsets)
    edge = edge_votes(strip)
    left, right = (
        edge[:, np.abs(offsets - at) <= 0.75].max(axis=1) for at in (-width_px / 2, width_px / 2)
    )
    inner = np.abs(offsets) <= max(0.3, width_px / 4.0)
    level = strip[:, inner].mean(axis=1)
    varied = np.abs(level - np.median(level, axis=0)).mean()
    weaker, stronger = sorted((float(left.mean()), float(right.mean())))
    either = float((np.maximum(left, right) > 0.5).mean())
    return np.array([weaker, stronger, either, np.log(varied + 3.0)])


def stripe(picture: Picture, ends_px: FloatArray, width_px: float) -> float:
    """Share of the rows in which a line differs from both of its sides and all between them.

    A blurred step, such as a house's corner, has two flanks too, but nothing that differs.
    """
    beside = width_px / 2.0 + 1.5
    left, inner, right = np.moveaxis(
        straighten(picture, ends_px, np.array([-beside, 0.0, beside])), 1, 0
    )
    step = right - left
    share = ((inner - left) * step).sum(axis=1) / ((step**2).sum(axis=1) + 1.0)
    between = left + np.clip(share, 0.0, 1.0)[:, None] * step
    off = np.sqrt(((inner - between) ** 2).mean(axis=1))
    return float((off**2 / (off**2 + _EDGE**2)).mean())
