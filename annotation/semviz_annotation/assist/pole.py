"""Find a pole's axis near a line: two parallel edges along it, then their profile at sub-pixel.

First edges vote along tilted lines (a Hough transform in the straightened strip), with a capped
vote for each row, so that one strong edge behind the pole counts no more than its share. Then the
pole's two edges are fitted as a profile of three levels for every row, left, pole and right, which
are free (variable projection; Golub & Pereyra 1973): so the background, and even the sign of the
contrast, may change along the pole.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from semviz_annotation.assist.shot import Samples, Shot
from semviz_core.arrays import FloatArray

STEP_PX = 0.5
WIDTH_PX = (1.0, 42.0)
_ROWS = 48
"""Samples along the pole; longer ones are averaged."""
_MARGIN_PX = 3.5
"""Of background on either side that the profile is fitted to."""
_BLUR_PX = 0.6
"""Sigma of an edge: the pixel's own width, the lens and the sampling."""
_CONTRAST = 7.0
"""Levels per px at which an edge gets half a vote."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A pole's axis between two points of it."""

    ends_px: FloatArray
    """(2, 2)"""
    width_px: float
    support: float
    """Share of the rows that show both edges, 0 to 1."""
    evidence: FloatArray
    """What speaks for it, see ``find_axes``."""


def straighten(
    shot: Shot, ends_px: FloatArray, offsets_px: FloatArray, rows: int = _ROWS
) -> Samples:
    """(rows, columns, 3) colours beside a line: evenly along it, and ``offsets_px`` to its right."""
    length = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    repeats = max(1, round(length / rows))
    share = (np.arange(rows * repeats) + 0.5) / (rows * repeats)
    along = (ends_px[1] - ends_px[0]) / length
    across = np.array([along[1], -along[0]])
    points = ends_px[0] + share[:, None] * (ends_px[1] - ends_px[0])
    samples = shot.sample(points[:, None] + offsets_px[:, None] * across)
    return samples.reshape(rows, repeats, len(offsets_px), 3).mean(axis=1)


def votes(strip: Samples) -> FloatArray:
    """(rows, columns) how much of an edge each sample is, 0 to 1, whatever its strength."""
    smooth = np.empty_like(strip)
    smooth[:, 1:-1] = 0.25 * strip[:, :-2] + 0.5 * strip[:, 1:-1] + 0.25 * strip[:, 2:]
    smooth[:, 0], smooth[:, -1] = strip[:, 0], strip[:, -1]
    slope = np.zeros_like(strip)
    slope[:, 1:-1] = (smooth[:, 2:] - smooth[:, :-2]) / (2.0 * STEP_PX)
    square = (slope**2).sum(axis=2) / 3.0
    return np.asarray(square / (square + _CONTRAST**2), dtype=np.float64)


def shifted(ends_px: FloatArray, at_first_px: float, at_last_px: float) -> FloatArray:
    """A line (2, 2) moved to its right at either end."""
    along = (ends_px[1] - ends_px[0]) / np.linalg.norm(ends_px[1] - ends_px[0])
    across = np.array([along[1], -along[0]])
    return np.asarray(ends_px + np.array([[at_first_px], [at_last_px]]) * across)


def find_axes(shot: Shot, ends_px: FloatArray, reach_px: float, count: int = 3) -> list[Axis]:
    """Up to ``count`` candidates for a pole's axis near a line, likeliest first; coarse.

    Each of their ends is at most ``reach_px`` across from the line's.
    """
    half = reach_px + WIDTH_PX[1] / 2.0 + 2.0
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    edge = votes(straighten(shot, ends_px, offsets))
    tilts = np.arange(-reach_px, reach_px + 0.01, STEP_PX)
    support = _sheared(edge, tilts)
    tilt_of, middle_of, width_of, score_of = _pairs(support, offsets, tilts, reach_px)
    found: list[Axis] = []
    for at in np.argsort(-score_of, kind="stable"):
        if len(found) == count or score_of[at] <= 0.0:
            break
        ends = shifted(ends_px, middle_of[at] - tilt_of[at], middle_of[at] + tilt_of[at])
        near = any(
            np.abs(ends - one.ends_px).max() < max(1.5, 0.0)
            and abs(one.width_px - width_of[at]) < max(1.5, 0.3 * one.width_px)
            for one in found
        )
        if not near:
            found.append(Axis(ends, float(width_of[at]), float(score_of[at]), np.zeros(0)))
    return found


def _sheared(edge: FloatArray, tilts_px: FloatArray) -> FloatArray:
    """(tilts, columns) mean of an image (rows, columns) along lines tilted by +-tilt at its ends."""
    rows, columns = edge.shape
    share = np.linspace(-1.0, 1.0, rows)
    shift = np.round(np.outer(tilts_px, share) / STEP_PX).astype(int)
    index = np.clip(np.arange(columns) + shift[..., None], 0, columns - 1)
    return np.asarray(edge[np.arange(rows)[:, None], index].mean(axis=1))


def _pairs(
    support: FloatArray, offsets: FloatArray, tilts: FloatArray, reach_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Tilt, middle, width and score of every pair of edges that could be a pole."""
    columns = len(offsets)
    found = []
    inner = np.zeros_like(support)
    peak = np.zeros(support.shape, dtype=bool)
    peak[:, 1:-1] = (support[:, 1:-1] >= support[:, :-2]) & (support[:, 1:-1] >= support[:, 2:])
    least = max(2, round(WIDTH_PX[0] / STEP_PX))
    for steps in range(least, min(round(WIDTH_PX[1] / STEP_PX), columns - 1) + 1):
        left, right = support[:, : columns - steps], support[:, steps:]
        middle = (offsets[: columns - steps] + offsets[steps:]) / 2.0
        if steps >= least + 4:  # the strongest edge strictly inside, grown by one column a turn
            begin = 3
            inner = (
                support[:, begin : begin + columns - steps].copy()
                if steps == least + 4
                else (np.maximum(inner[:, : columns - steps], support[:, steps - 3 : columns - 3]))
            )
        between = inner[:, : columns - steps] if steps >= least + 4 else 0.0
        good = np.sqrt(left * right)
        score = np.minimum(left, right) + 0.3 * good - 0.5 * between
        score = score - 0.02 * middle**2 - 0.01 * tilts[:, None] ** 2
        ok = peak[:, : columns - steps] & peak[:, steps:]
        extreme = np.abs(middle) + np.abs(tilts[:, None]) <= reach_px
        for t, c in np.argwhere(ok & extreme & (np.minimum(left, right) > 0.25)):
            found.append((tilts[t], middle[c], steps * STEP_PX, score[t, c]))
    table = np.array(found).reshape(-1, 4)
    return table[:, 0], table[:, 1], table[:, 2], table[:, 3]


# -- the profile


@lru_cache(maxsize=128)
def _profiles(
    width_px: float, reach_px: float, step_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Offsets (m,), middles (c,), widths (w,) and orthonormal bases (w, c, m, k) of profiles."""
    half = width_px / 2.0 + _MARGIN_PX
    offsets = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    middles = np.arange(-reach_px, reach_px + step_px / 2, step_px)
    spread = 1.0 + 0.1 * width_px
    widths = np.linspace(max(0.8, width_px - spread), width_px + spread, 9)
    edges = middles[None, :, None] + widths[:, None, None] * np.array([-0.5, 0.5])
    left = _step(offsets - edges[..., :1])
    right = _step(offsets - edges[..., 1:])
    parts = [1.0 - left, left - right, right]
    if width_px > 4.0:  # round poles are lit from a side
        across = (offsets - middles[None, :, None]) / (widths[:, None, None] / 2.0)
        parts += [(left - right) * across, (left - right) * across**2]
    bases = np.linalg.qr(np.stack(parts, axis=-1))[0]
    return offsets, middles, widths, bases.astype(np.float32)


def _step(x_px: FloatArray) -> FloatArray:
    """An edge at 0, blurred: the logistic function is within 1 % of the normal's integral."""
    return np.asarray(1.0 / (1.0 + np.exp(-1.702 / _BLUR_PX * x_px)))


def refine(shot: Shot, axis: Axis) -> Axis:
    """An axis at sub-pixel accuracy; its support and evidence measured."""
    width = axis.width_px
    ends = axis.ends_px
    for reach, step in ((1.5, 0.25), (0.75, 0.125)):
        offsets, middles, widths, bases = _profiles(max(1.0, round(2.0 * width) / 2.0), reach, step)
        strip = straighten(shot, ends, offsets)
        cost = _costs(strip, bases)  # (rows, widths, middles)
        noise = np.median(cost.min(axis=(1, 2))) + 4.0
        capped = cost - cost.min(axis=(1, 2), keepdims=True)
        capped = capped / (capped + 4.0 * noise)
        total = capped.sum(axis=0)
        w, _ = np.unravel_index(np.argmin(total), total.shape)
        first, last = _line(capped[:, w], middles)
        ends = shifted(ends, first, last)
        width = float(widths[w])
    return Axis(ends, width, axis.support, axis.evidence)


def _costs(strip: Samples, bases: FloatArray) -> FloatArray:
    """(rows, widths, middles) squared residuals of every profile in every row."""
    rows, columns, _ = strip.shape
    data = strip.transpose(1, 0, 2).reshape(columns, rows * 3)
    w, c, m, k = bases.shape
    parts = bases.transpose(0, 1, 3, 2).reshape(w * c * k, m) @ data
    explained = (parts**2).reshape(w * c, k, rows, 3).sum(axis=(1, 3))
    whole = (data**2).reshape(columns, rows, 3).sum(axis=(0, 2))
    return np.asarray((whole - explained).T.reshape(rows, w, c), dtype=np.float64)


def _line(cost: FloatArray, middles: FloatArray) -> tuple[float, float]:
    """Where the cheapest line through costs (rows, middles) begins and ends, px."""
    rows = len(cost)
    parts = np.array_split(np.arange(rows), 6)
    share = np.array([(part.mean() + 0.5) / rows for part in parts])
    curves = np.array([cost[part].mean(axis=0) for part in parts])
    step = middles[1] - middles[0]
    at = np.clip(curves.argmin(axis=1), 1, len(middles) - 2)
    one = np.arange(len(parts))
    low, mid, high = curves[one, at - 1], curves[one, at], curves[one, at + 1]
    bend = np.maximum(low + high - 2.0 * mid, 1e-9)
    places = middles[at] + np.clip(0.5 * (low - high) / bend, -1.0, 1.0) * step
    weights = np.ptp(curves, axis=1)
    A = np.stack([1.0 - share, share], axis=1)
    robust = np.ones(len(parts))
    solution = np.zeros(2)
    for _ in range(4):
        w = np.sqrt(weights * robust + 1e-9)
        solution = np.linalg.lstsq(A * w[:, None], places * w, rcond=None)[0]
        robust = 1.0 / (1.0 + ((places - A @ solution) / 0.3) ** 2)
    return float(solution[0]), float(solution[1])
