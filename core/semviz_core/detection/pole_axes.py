"""Candidates for a pole's axis: from the model's region and from edges in the image."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.jit import compiled
from semviz_core.detection.regions import Region, predicted_sigma_px
from semviz_core.subpixel import pole_axis
from semviz_core.subpixel.pole_fit import refine_axis
from semviz_core.subpixel.sampling import SampledImage

SHORTEST_PX = 3.0
AGREE_SIGMAS, WORSE = 3.0, 2.0
"""Lines agree within this many sigmas; a line with this many times the sigma is much worse."""
_LONGER = 1.3
"""A pole that is seen to be so many times as long as its mask is measured again."""
_REACHES_PX = (1.5, 2.5, 4.0)
"""Search distances around a first line; the smallest that covers two sigmas is used."""
_THIN_PX, _DIFFERS = 4.0, 0.35
"""A thinner pole must differ from both sides in this share of its rows."""
_WIDTHS_PX = (8.0, 14.0, 24.0, pole_axis.WIDEST_PX)


@dataclass(frozen=True, eq=False)
class Line:
    """A candidate for a pole's axis."""

    kind: str
    """How it was measured: a key of ``regions.WEIGHTS``."""
    ends_px: FloatArray
    """(2, 2) upper end first."""
    width_px: float
    """Width of the pole; approximate without edges."""
    evidence: FloatArray
    """(k,) of its kind."""
    stretched: float = 1.0
    """How many times as long it is as the part that was measured."""

    @cached_property
    def sigma_px(self) -> float:
        """Sigma across the line, at its ends."""
        return self.stretched * predicted_sigma_px(self.kind, self.evidence)

    @cached_property
    def middle_px(self) -> FloatArray:
        """(2,)"""
        return np.asarray((self.ends_px[0] + self.ends_px[1]) / 2.0)

    @cached_property
    def along(self) -> FloatArray:
        """(2,) its direction, downwards."""
        step = self.ends_px[1] - self.ends_px[0]
        return np.asarray(step / np.hypot(*step))


def best_line(image: SampledImage, region: Region) -> Line | None:
    """Return the axis with the least sigma, averaged with candidates that agree.

    None if the region has no length.
    """
    lines = first_lines(region)
    if not lines:
        return None
    edges = line_by_edges(image, region, min(lines, key=lambda line: line.sigma_px))
    candidates = [*lines, *([] if edges is None else [edges])]
    return _agreed(min(candidates, key=lambda line: line.sigma_px), candidates)


def line_over(image: SampledImage, region: Region, line: Line, ends_px: FloatArray) -> Line:
    """Return the axis of a pole whose ends (2, 2) on a line are further apart than the line's.

    It is measured again over the whole length, unless that is less exact there.
    """
    stretched = max(1.0, _length_px(ends_px) / _length_px(line.ends_px))
    longer = replace(line, ends_px=ends_px, stretched=stretched)
    if stretched < _LONGER:
        return longer
    edges = line_by_edges(image, region, longer)
    return longer if edges is None or edges.sigma_px > longer.sigma_px else edges


def _agreed(best: Line, lines: list[Line]) -> Line:
    """Return the best line, moved to the mean, weighted by 1 / sigma^2, of all lines that agree.

    Much worse lines are left out: they add little, and their errors are systematic.
    """
    total, weights = np.zeros(2), 0.0
    normal = pole_axis.across(best.ends_px)
    for line in [line for line in lines if line.sigma_px <= WORSE * best.sigma_px]:
        gap = line.ends_px[0] - best.ends_px
        off = (gap @ pole_axis.across(line.ends_px)) / max(
            float(normal @ pole_axis.across(line.ends_px)), 0.1
        )
        if np.abs(off).max() <= AGREE_SIGMAS * np.hypot(line.sigma_px, best.sigma_px):
            total += off / line.sigma_px**2
            weights += 1.0 / line.sigma_px**2
    moved = total / weights
    return replace(
        best, ends_px=pole_axis.shift_line(best.ends_px, float(moved[0]), float(moved[1]))
    )


def first_lines(region: Region) -> list[Line]:
    """Return the model's candidates: by its ends and mask, or else by its box."""
    candidates = [_by_ends(region), _by_mask(region)]
    lines = [line for line in candidates if line is not None] or [_by_box(region)]
    return [line for line in lines if _length_px(line.ends_px) >= SHORTEST_PX]


def line_by_edges(image: SampledImage, region: Region, first: Line) -> Line | None:
    """Return the likeliest pair of parallel edges near a line, to a fraction of a pixel."""
    sufficient = (reach for reach in _REACHES_PX if reach >= 2.0 * first.sigma_px)
    reach = next(sufficient, _REACHES_PX[-1])
    box_px = region.box_px[2:] - region.box_px[:2]
    most = 1.3 * float(box_px.min()) + 5.0
    widest = next((width for width in _WIDTHS_PX if width >= most), pole_axis.WIDEST_PX)
    axes = pole_axis.find_axes(image, first.ends_px, reach, 2, widest)
    if not axes:
        return None
    chosen = next((axis for axis in axes if not _is_step(image, axis)), axes[0])
    axis = refine_axis(image, chosen)
    margin = min([5.0, *(chosen.score - other.score for other in axes if other is not chosen)])
    moved = np.abs((axis.ends_px - first.ends_px) @ pole_axis.across(first.ends_px)).max()
    evidence = np.array(
        [
            *pole_axis.edge_support(image, axis.ends_px, axis.width_px),
            pole_axis.stripe(image, axis.ends_px, axis.width_px),
            np.clip(margin, -3.0, 3.0),
            np.log(moved / first.sigma_px + 0.5),
            np.log(first.sigma_px),
            np.log(axis.width_px),
            np.log(_length_px(axis.ends_px)),
            abs(np.log((axis.width_px + 1.0) / (first.width_px + 1.0))),
        ]
    )
    return Line("line by edges", axis.ends_px, axis.width_px, evidence)


def _is_step(image: SampledImage, axis: pole_axis.Axis) -> bool:
    """Whether both edges are flanks of one edge: the area between differs from neither side."""
    thin = axis.width_px < _THIN_PX
    return bool(thin and pole_axis.stripe(image, axis.ends_px, axis.width_px) < _DIFFERS)


def _by_ends(region: Region) -> Line | None:
    if region.ends_px is None:
        return None
    length = np.log(_length_px(region.ends_px) + 1.0)
    evidence = np.array([length, 1.0 - region.score])
    return Line("line by ends", region.ends_px, _box_width_px(region), evidence)


def _by_box(region: Region) -> Line:
    left, top, right, bottom = region.box_px
    middle = (left + right) / 2.0
    evidence = np.log([right - left + 1.0, bottom - top + 1.0])
    ends = np.array([[middle, top], [middle, bottom]])
    return Line("line by box", ends, _box_width_px(region), evidence)


def _by_mask(region: Region) -> Line | None:
    """Return a robust line through the centres of the mask's rows."""
    points = region.mask_points_px
    if len(points) < 3:
        return None
    ends, residual, width = _line_through(points)
    if not width:
        return None
    evidence = np.log([_length_px(ends) + 1.0, residual + 0.2, width])
    return Line("line by mask", ends, width, evidence)


@compiled
def _line_through(points: FloatArray) -> tuple[FloatArray, float, float]:
    """Return ends (2, 2), residual and width of a robust line through the middles of slices of
    points (n, 2); with fewer than 3 slices the width is 0."""
    start, along = _principal(points)
    residual = width = 0.0
    ends = np.zeros((2, 2))
    for _ in range(2):
        positions, middles, widths = _slices(points, start, along)
        if len(positions) < 3:
            return ends, 0.0, 0.0
        first, slope, residual = _robust_line(positions, middles, widths)
        width = pole_axis.median(widths)
        u, v = along
        start[0], start[1] = start[0] + first * v, start[1] - first * u
        length = np.hypot(u + slope * v, v - slope * u)
        along[0], along[1] = (u + slope * v) / length, (v - slope * u) / length
    places = (points[:, 0] - start[0]) * along[0] + (points[:, 1] - start[1]) * along[1]
    ends[0], ends[1] = start + places.min() * along, start + places.max() * along
    return ends, residual, width


@compiled
def _principal(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (2,) of points (n, 2) and their principal direction (2,), downwards."""
    middle, along = np.empty(2), np.empty(2)
    middle[0], middle[1] = points[:, 0].mean(), points[:, 1].mean()
    u, v = points[:, 0] - middle[0], points[:, 1] - middle[1]
    angle = 0.5 * np.arctan2(2.0 * (u * v).sum(), (u * u - v * v).sum())
    along[0], along[1] = np.cos(angle), np.sin(angle)
    return middle, along if along[1] > 0.0 else -along


@compiled
def _slices(
    points: FloatArray, start: FloatArray, along: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (k,) positions along a line, and the middles and widths of the points there."""
    places, offsets = np.empty(len(points)), np.empty(len(points))
    for k in range(len(points)):
        u, v = points[k, 0] - start[0], points[k, 1] - start[1]
        places[k], offsets[k] = u * along[0] + v * along[1], u * along[1] - v * along[0]
    first = places.min()
    count = int(np.rint(places.max() - first)) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    for k in range(len(points)):
        slot = int(np.rint(places[k] - first))
        low[slot], high[slot] = min(low[slot], offsets[k]), max(high[slot], offsets[k])
    rows = np.flatnonzero(low <= high)
    low, high = low[rows], high[rows]
    return first + rows.astype(np.float64), (low + high) / 2.0, high - low + 1.0


@compiled
def _robust_line(
    places: FloatArray, middles: FloatArray, widths: FloatArray
) -> tuple[float, float, float]:
    """Return offset, slope and residual of a line; outliers and wide slices get low weights."""
    usual = np.minimum(1.0, pole_axis.median(widths.copy()) / widths)
    weight = usual.copy()
    at = level = slope = scale = 0.0
    for _ in range(5):
        total = weight.sum()
        at, level = (weight * places).sum() / total, (weight * middles).sum() / total
        from_at = places - at
        across_at = (weight * from_at * (middles - level)).sum()
        slope = across_at / (weight * from_at**2).sum()
        off = np.abs(middles - level - slope * from_at)
        scale = max(1.48 * pole_axis.median(off.copy()), 0.3)
        weight = usual / (1.0 + (off / (2.0 * scale)) ** 2)
    return level - slope * at, slope, scale


def _box_width_px(region: Region) -> float:
    return float(max(1.0, (region.box_px[2:] - region.box_px[:2]).min() + 1.0))


def _length_px(ends_px: FloatArray) -> float:
    return float(np.hypot(*(ends_px[1] - ends_px[0])))
