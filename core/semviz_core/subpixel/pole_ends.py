"""Find the visible end of a pole along its axis.

One method finds the change of colour along the axis. The other examines rows across the pole:
edges on both sides, and the pole's colour between them. Each row near the end is weak evidence
for or against the pole. The end is where the evidence for the rows before it and against the rows
beyond it is largest in sum.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.common.jit import compiled
from semviz_core.subpixel.pole_axis import (
    STEP_PX,
    across,
    edges_of_pole,
    mean_colors,
    median_color,
)
from semviz_core.subpixel.sampling import SampledImage, Samples, color_at

_STEP_PX = 0.5
_BEFORE, _AFTER = 2.0, 3.0
"""Lengths (px) before and after the end that are compared."""
_PLAIN_STEP = 14.0
"""Largest mean deviation (grey levels) before the end from the pole's colour."""
_LEVELS = 20.0
"""Least step (grey levels) at the end."""


def visible_end(
    image: SampledImage,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    reach_px: float,
) -> float | None:
    """Return how far beyond ``end_px`` (px; negative: before it) a pole from ``other_px`` ends.

    None without exactly one clear change of colour within ``reach_px``.
    """
    place, most = _visible_end(image.image, np.array([other_px, end_px]), width_px, reach_px)
    return float(place) if abs(place) <= most else None


@compiled
def _visible_end(
    image: ByteImage, line_px: FloatArray, width_px: float, reach_px: float
) -> tuple[float, float]:
    """Return how far beyond a line (2, 2) the pole's colour ends, infinite if that is unclear, and
    the largest distance that counts."""
    du, dv = line_px[1, 0] - line_px[0, 0], line_px[1, 1] - line_px[0, 1]
    length = np.hypot(du, dv)
    most = min(reach_px, 0.3 * length)
    reach = most + _BEFORE + _AFTER
    offsets = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    points, body = np.empty((len(offsets), 2)), np.empty((24, 2))
    for k in range(len(offsets)):
        points[k, 0] = line_px[1, 0] + offsets[k] * (du / length)
        points[k, 1] = line_px[1, 1] + offsets[k] * (dv / length)
    height, width = image.shape[:2]
    for k in (0, len(offsets) - 1):
        if not (0.0 <= points[k, 0] <= width - 1.0 and 0.0 <= points[k, 1] <= height - 1.0):
            return np.inf, most
    for k in range(24):
        share = 0.05 + 0.55 * k / 23.0
        body[k, 0], body[k, 1] = line_px[1, 0] - share * du, line_px[1, 1] - share * dv
    normal, half = across(line_px), max(0.0, width_px / 2.0 - 0.75)
    beside, used = half * np.linspace(-1.0, 1.0, 5), np.ones(5, np.bool_)
    colors = mean_colors(rows_across(image, points, normal, beside), used)
    pole = median_color(mean_colors(rows_across(image, body, normal, beside), used))
    return _color_change(colors, pole, offsets), most


@compiled
def rows_across(
    image: ByteImage, points_px: FloatArray, normal: FloatArray, beside_px: FloatArray
) -> Samples:
    """Return colours (n, m, 3) beside points (n, 2), at distances (m,) along a normal (2,)."""
    strip = np.empty((len(points_px), len(beside_px), 3), np.float32)
    for row in range(len(points_px)):
        u, v = points_px[row, 0], points_px[row, 1]
        for column in range(len(beside_px)):
            off = beside_px[column]
            color = color_at(image, u + off * normal[0], v + off * normal[1])
            for channel in range(3):
                strip[row, column, channel] = color[channel]
    return strip


@compiled
def _color_change(colors: FloatArray, pole: FloatArray, offsets: FloatArray) -> float:
    """Return the offset (px) where colours (n, 3) at ``offsets`` (n,) leave the pole's colour (3,).

    Infinite without exactly one clear change.
    """
    inner, outer = int(_BEFORE / _STEP_PX), int(_AFTER / _STEP_PX)
    sums = np.zeros(len(colors) + 1)
    for k in range(len(colors)):
        square = 0.0
        for channel in range(3):
            square += (colors[k, channel] - pole[channel]) ** 2
        sums[k + 1] = sums[k] + np.sqrt(square / 3.0)
    splits = np.arange(inner, len(offsets) - outer + 1)  # the end is before this sample
    before = (sums[splits] - sums[splits - inner]) / inner
    step = (sums[splits + outer] - sums[splits]) / outer - before
    best = int(np.argmax(step))
    if before[best] > _PLAIN_STEP or step[best] < _LEVELS:
        return np.inf
    for k in range(len(splits)):
        is_second = abs(k - best) > outer and before[k] < _PLAIN_STEP
        if is_second and step[k] > 0.6 * step[best]:
            return np.inf
    first, last = splits[best] - inner, splits[best] + outer
    beyond = median_color(colors[splits[best] + 1 : last]) - pole
    squares, share = (beyond**2).sum(), 0.0
    for k in range(first, last):
        share += min(max(((colors[k] - pole) * beyond).sum() / squares, 0.0), 1.0)
    return float(offsets[last - 1] + 0.5 * _STEP_PX - share * _STEP_PX)


_SAME_COLOR = 14.0
"""Difference in grey levels at which a row's colour counts as half the pole's."""
_APART_PX = 3.0
"""Ends further apart than this are different."""
_FEWEST = 4
_MOST_SHARE = 0.4
"""Largest distance of the end before its predicted position, as a share of the pole's length."""
WEIGHTS = np.array([-3.5281, 2.2309, 2.1028, 3.3147])
"""Log-odds weights of a row of the pole: constant, weaker and stronger edge, colour. Fitted on
simulated streets with seeds from 20_000 by ``python bench/subpixel.py --fit``."""


class RowsEnd(NamedTuple):
    """The end of a pole by its rows."""

    off_px: float
    """Distance beyond the predicted end; negative: before it."""
    margin: float
    """Log-odds between this end and the best end that is not next to it."""


def end_by_rows(
    image: SampledImage,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    sigma_px: float,
    hidden: bool = False,
) -> RowsEnd | None:
    """Return the end of a pole from ``other_px`` near ``end_px``, which has ``sigma_px``.

    ``hidden``: the pole is covered before ``end_px``, so only rows beyond count. None if the image
    has too few rows.
    """
    off, evidence = row_evidence(image, other_px, end_px, width_px, 2.5 * sigma_px)
    if hidden:
        off, evidence = off[off > 0.0], evidence[off > 0.0]
    if len(off) < _FEWEST:
        return None
    return RowsEnd(*_likeliest_end(off, evidence, sigma_px))


@compiled
def _likeliest_end(off: FloatArray, evidence: FloatArray, sigma_px: float) -> tuple[float, float]:
    """Return the values of ``RowsEnd`` from rows (n,) and their evidence (n, 3)."""
    places, total = np.append(off - 0.5, off[-1] + 0.5), np.zeros(len(off) + 1)
    for row in range(len(off)):
        total[row + 1] = total[row] + WEIGHTS[0] + (evidence[row] * WEIGHTS[1:]).sum()
    total -= 0.5 * (places / sigma_px) ** 2
    best, second = np.argmax(total), -np.inf
    for k in range(len(places)):
        if abs(places[k] - places[best]) > _APART_PX:
            second = max(second, total[k])
    return places[best], total[best] - second


def row_evidence(
    image: SampledImage,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    reach_px: float,
) -> tuple[FloatArray, FloatArray]:
    """Return rows (n,) inside the image, in px beyond the end, and their evidence (n, 3).

    The evidence are the votes of the weaker and the stronger edge, and the likeness to the pole's
    colour.
    """
    return _row_evidence(image.image, np.array([other_px, end_px]), width_px, reach_px)


@compiled
def _row_evidence(
    image: ByteImage, line_px: FloatArray, width_px: float, reach_px: float
) -> tuple[FloatArray, FloatArray]:
    height, width = image.shape[:2]
    du, dv = line_px[1, 0] - line_px[0, 0], line_px[1, 1] - line_px[0, 1]
    length = np.hypot(du, dv)
    back, count = round(min(reach_px, _MOST_SHARE * length)), 0
    off = np.arange(-back, round(reach_px) + 1.0)
    points = np.empty((len(off), 2))
    for place in off:
        u, v = line_px[1, 0] + place * du / length, line_px[1, 1] + place * dv / length
        if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
            off[count], points[count, 0], points[count, 1] = place, u, v
            count += 1
    off, points = off[:count], points[:count]
    if count < 2:
        return off, np.zeros((count, 3))
    pole = _pole_color(image, line_px, width_px)
    return off, _votes_like(image, line_px, width_px, points, pole)[:, :3].copy()


@compiled
def _columns(width_px: float) -> tuple[FloatArray, BoolArray]:
    """Return where rows across a pole are sampled, and which samples are on the pole."""
    half = width_px / 2.0 + 4.0
    beside = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    return beside, np.abs(beside) <= max(0.3, width_px / 2.0 - 0.75)


@compiled
def _pole_color(image: ByteImage, line_px: FloatArray, width_px: float) -> FloatArray:
    """Return the colour (3,) of a pole before the end of a line."""
    beside, inner = _columns(width_px)
    body = np.empty((16, 2))
    for k in range(16):
        share = 0.2 + 0.5 * k / 15.0
        for axis in range(2):
            body[k, axis] = line_px[1, axis] + share * (line_px[0, axis] - line_px[1, axis])
    return median_color(mean_colors(rows_across(image, body, across(line_px), beside), inner))


@compiled
def _votes_like(
    image: ByteImage, line_px: FloatArray, width_px: float, points: FloatArray, pole: FloatArray
) -> FloatArray:
    """Return (n, 4) the evidence of rows of a line whose middles are points (n, 2), and clutter.

    ``pole`` (3,) is its colour. Clutter is the mean vote for an edge in and beside the pole.
    """
    beside, inner = _columns(width_px)
    strip = rows_across(image, points, across(line_px), beside)
    edges, colors = edges_of_pole(strip, beside, width_px), mean_colors(strip, inner)
    votes = np.empty((len(points), 4))
    for row in range(len(points)):
        difference = 0.0
        for channel in range(3):
            difference += (colors[row, channel] - pole[channel]) ** 2 / 3.0
        votes[row, 0] = min(edges[row, 0], edges[row, 1])
        votes[row, 1] = max(edges[row, 0], edges[row, 1])
        votes[row, 2] = 1.0 / (1.0 + difference / _SAME_COLOR**2)
        votes[row, 3] = edges[row, 2]
    return votes


_LONGEST_GAP_PX, _GAP_SHARE = 6.0, 0.12
"""A pole is followed over a gap of so many rows, or over this share of its length."""
_CLEAR_ROW = 3.0
"""Largest log-odds of one row: neighbouring rows are not independent."""
_CAUTION = 0.5
"""Log-odds that a row needs in addition, beyond the end of a mask."""
_STRAIGHT_PX = 0.75
"""A line that is off by less than this at its far end is taken as it is."""
_BEYOND = 10
"""Number of rows after the end that tell how clear it is."""
_AT_ONCE, _AT_FIRST = 10, 40
"""Number of rows that are examined at once, up to the second number; then twice as many, until the
pole ends."""


class GrownEnd(NamedTuple):
    """Where a pole ends that goes on past the end of its mask."""

    off_px: float
    """Distance beyond that end; 0 if the pole does not go on."""
    gain: float
    """Log-odds of the pole between both ends."""
    fall: float
    """Mean log-odds of the rows just after the end; low after a clear end."""
    clutter: float
    """Mean votes (0 to 1) for edges along the pole just after the end, beside it and in it."""


NOT_GROWN = GrownEnd(0.0, 0.0, 0.0, 0.0)


def grown_end(
    image: SampledImage,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    most_aside: float,
) -> GrownEnd:
    """Follow a pole from ``other_px`` (2,) past ``end_px`` (2,), at most to the image border.

    Its edges and colour may be missing in some rows. ``most_aside`` is how far the pole may be
    beside the line, per px beyond its end.
    """
    line = np.array([other_px, end_px])
    return GrownEnd(*_followed(image.image, line, width_px, most_aside))


@compiled
def _followed(
    image: ByteImage,
    line_px: FloatArray,
    width_px: float,
    most_aside: float,
) -> tuple[float, float, float, float]:
    """Return the values of ``GrownEnd``; each row up to the image border is examined once."""
    length = np.hypot(line_px[1, 0] - line_px[0, 0], line_px[1, 1] - line_px[0, 1])
    gap = _CLEAR_ROW * max(_LONGEST_GAP_PX, _GAP_SHARE * length)
    to_border = int(_to_border_px(image, line_px))
    if to_border < _FEWEST:
        return 0.0, 0.0, 0.0, 0.0
    at_first = min(_AT_FIRST, to_border)
    seen, examined, slopes = min(_AT_ONCE, at_first), 0, _slopes(most_aside, at_first)
    odds, clutter = np.empty((len(slopes), to_border)), np.empty((len(slopes), to_border))
    pole = _pole_color(image, line_px, width_px)
    while True:
        _examine(image, line_px, width_px, pole, slopes, examined, odds[:, :seen], clutter)
        examined = seen
        slope, last, stopped = _furthest(odds[:, :seen], gap)
        if seen == to_border or (stopped and (seen == _AT_FIRST or last + _BEYOND <= seen)):
            break
        if seen < at_first:
            seen = min(seen + _AT_ONCE, at_first)
            continue
        wider = slopes if stopped else _slopes(most_aside, to_border)
        if len(wider) != len(slopes):
            slopes, examined = wider, 0
            odds, clutter = np.empty((len(slopes), to_border)), np.empty((len(slopes), to_border))
        seen = min(2 * seen, to_border)
    gain = odds[slope, :last].sum()
    if last == to_border:
        return float(last), gain, 0.0, 0.0
    end = min(last + _BEYOND, seen)
    return float(last), gain, odds[slope, last:end].mean(), clutter[slope, last:end].mean()


@compiled
def _slopes(most_aside: float, count: int) -> FloatArray:
    """Return (n,) how far, per px, a pole may be beside its line; 0 only if it is hardly so."""
    sure = most_aside * count < _STRAIGHT_PX
    return np.zeros(1) if sure else most_aside * np.linspace(-1.0, 1.0, 5)


@compiled
def _examine(
    image: ByteImage,
    line_px: FloatArray,
    width_px: float,
    pole: FloatArray,
    slopes: FloatArray,
    first: int,
    odds: FloatArray,
    clutter: FloatArray,
) -> None:
    """Fill the columns from ``first`` of ``odds`` (slopes, rows), of rows beyond the end of a line
    being the pole's, and of ``clutter``."""
    right, count = across(line_px), odds.shape[1] - first
    length = np.hypot(line_px[1, 0] - line_px[0, 0], line_px[1, 1] - line_px[0, 1])
    points = np.empty((count, 2))
    for k in range(len(slopes)):
        for row in range(count):
            for axis in range(2):
                step = (line_px[1, axis] - line_px[0, axis]) / length + slopes[k] * right[axis]
                points[row, axis] = line_px[1, axis] + (first + row + 0.5) * step
        votes = _votes_like(image, line_px, width_px, points, pole)
        for row in range(count):
            total = WEIGHTS[0] - _CAUTION
            for part in range(3):
                total += votes[row, part] * WEIGHTS[1 + part]
            odds[k, first + row] = min(max(total, -_CLEAR_ROW), _CLEAR_ROW)
            clutter[k, first + row] = votes[row, 3]


@compiled
def _to_border_px(image: ByteImage, line_px: FloatArray) -> float:
    """Return how far beyond the end of a line (2, 2) the image ends; 0 outside."""
    length = np.hypot(line_px[1, 0] - line_px[0, 0], line_px[1, 1] - line_px[0, 1])
    most = np.inf
    for axis in range(2):
        along = (line_px[1, axis] - line_px[0, axis]) / length
        last = image.shape[1 - axis] - 1.0
        room = last - line_px[1, axis] if along > 0.0 else line_px[1, axis]
        most = min(most, room / max(abs(along), 1e-6))
    return max(0.0, most)


@compiled
def _furthest(odds: FloatArray, gap: float) -> tuple[int, int, bool]:
    """Return slope and number of rows with the largest sum of log-odds (slopes, rows).

    Third is whether the pole ends there: whether the sum falls by ``gap`` after each maximum.
    """
    slope, last, largest, stopped = 0, 0, 0.0, 0
    for k in range(len(odds)):
        total, most = 0.0, 0.0
        for row in range(odds.shape[1]):
            total += odds[k, row]
            most = max(most, total)
            if most - total > gap:
                stopped += 1
                break
            if total > largest:
                slope, last, largest = k, row + 1, total
    return slope, last, stopped == len(odds)
