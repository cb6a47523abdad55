"""Lines that a pole's axis could be: as the model sees it, and as edges in the image show it."""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.detection.region import Region
from semviz_core.detection.sigma import sigma_px
from semviz_core.measuring.picture import Picture
from semviz_core.measuring.pole import WIDEST_PX, Axis, across, find_axes, shifted, stripe, support
from semviz_core.measuring.profile import refine

SHORTEST_PX = 3.0
AGREE_SIGMAS, WORSE = 3.0, 2.0
"""Lines agree within so many sigmas; one of a sigma so many times as large is much worse."""
_REACHES_PX = (1.5, 2.5, 4.0)
"""How far from a first line edges are looked for: the fewest that two sigmas need."""
_THIN_PX, _DIFFERS = 4.0, 0.35
"""A thinner pole must differ from both sides in this share of its rows."""
_WIDTHS_PX = (8.0, 14.0, 24.0, WIDEST_PX)


@dataclass(frozen=True, eq=False)
class Line:
    """A candidate for a pole's axis."""

    kind: str
    """What it was made of; ``sigma`` knows how good each kind is."""
    ends_px: FloatArray
    """(2, 2) the upper one first."""
    width_px: float
    """Of the pole; a guess where edges did not tell."""
    evidence: FloatArray
    """(k,) of its kind."""

    @property
    def sigma_px(self) -> float:
        """Across, at its ends."""
        return sigma_px(self.kind, self.evidence)


def best_line(picture: Picture, region: Region) -> Line | None:
    """The axis of a pole with the least sigma, and what others that agree say of it; None where
    the region has no length."""
    lines = first_lines(region)
    if not lines:
        return None
    edges = line_by_edges(picture, region, min(lines, key=lambda one: one.sigma_px))
    every = [*lines, *([] if edges is None else [edges])]
    return _agreed(min(every, key=lambda one: one.sigma_px), every)


def _agreed(best: Line, lines: list[Line]) -> Line:
    """The best line, moved to the mean, by 1 / sigma^2, of all that agree with it and are not much
    worse: they say little that is new, and what they are off by is no noise."""
    total, weights = np.zeros(2), 0.0
    normal = across(best.ends_px)
    for one in [line for line in lines if line.sigma_px <= WORSE * best.sigma_px]:
        gap = one.ends_px[0] - best.ends_px
        off = (gap @ across(one.ends_px)) / max(float(normal @ across(one.ends_px)), 0.1)
        if np.abs(off).max() <= AGREE_SIGMAS * np.hypot(one.sigma_px, best.sigma_px):
            total += off / one.sigma_px**2
            weights += 1.0 / one.sigma_px**2
    moved = total / weights
    return replace(best, ends_px=shifted(best.ends_px, float(moved[0]), float(moved[1])))


def first_lines(region: Region) -> list[Line]:
    """What the model says: by its ends and its mask, or else by its box."""
    found = [_by_ends(region), _by_mask(region)]
    lines = [one for one in found if one is not None] or [_by_box(region)]
    return [one for one in lines if _length_px(one.ends_px) >= SHORTEST_PX]


def line_by_edges(picture: Picture, region: Region, first: Line) -> Line | None:
    """The likeliest two parallel edges near a line, to a fraction of a pixel."""
    near = (one for one in _REACHES_PX if one >= 2.0 * first.sigma_px)
    reach = next(near, _REACHES_PX[-1])
    box_px = region.box_px[2:] - region.box_px[:2]
    most = 1.3 * float(box_px.min()) + 5.0
    widest = next((one for one in _WIDTHS_PX if one >= most), WIDEST_PX)
    axes = find_axes(picture, first.ends_px, reach, 2, widest)
    if not axes:
        return None
    chosen = next((one for one in axes if not _is_step(picture, one)), axes[0])
    axis = refine(picture, chosen)
    margin = min([5.0, *(chosen.score - one.score for one in axes if one is not chosen)])
    moved = np.abs((axis.ends_px - first.ends_px) @ across(first.ends_px)).max()
    evidence = np.array(
        [
            *support(picture, axis.ends_px, axis.width_px),
            stripe(picture, axis.ends_px, axis.width_px),
            np.clip(margin, -3.0, 3.0),
            np.log(moved / first.sigma_px + 0.5),
            np.log(first.sigma_px),
            np.log(axis.width_px),
            np.log(_length_px(axis.ends_px)),
            abs(np.log((axis.width_px + 1.0) / (first.width_px + 1.0))),
        ]
    )
    return Line("line by edges", axis.ends_px, axis.width_px, evidence)


def _is_step(picture: Picture, axis: Axis) -> bool:
    """Whether both edges are flanks of one: what is between them differs from neither side."""
    thin = axis.width_px < _THIN_PX
    return bool(thin and stripe(picture, axis.ends_px, axis.width_px) < _DIFFERS)


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
    """A line through the middles of the mask's rows, whatever juts out or is missing in some."""
    points = mask_points(region)
    if len(points) < 3:
        return None
    start, along = _principal(points)
    for _ in range(2):
        places, middles, widths = _slices(points, start, along)
        if len(places) < 3:
            return None
        first, slope, residual = _robust_line(places, middles, widths)
        normal = np.array([along[1], -along[0]])
        start, along = start + first * normal, along + slope * normal
        along = along / np.linalg.norm(along)
    places = (points - start) @ along
    extent = np.array([places.min(), places.max()])
    width = float(np.median(widths))
    evidence = np.array(
        [np.log(extent[1] - extent[0] + 1.0), np.log(residual + 0.2), np.log(width)]
    )
    return Line("line by mask", start + extent[:, None] * along, width, evidence)


def mask_points(region: Region) -> FloatArray:
    """(n, 2) middles of the mask's pixels; none without a mask."""
    if region.mask is None:
        return np.zeros((0, 2))
    rows, columns = np.nonzero(region.mask)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    return np.asarray(points + np.asarray(region.corner_px))


def _principal(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The middle (2,) of points (n, 2), and the direction (2,) of their largest extent, down."""
    middle = points.mean(axis=0)
    centred = points - middle
    along = np.linalg.eigh(centred.T @ centred)[1][:, 1]
    return middle, along if along[1] > 0.0 else -along


def _slices(
    points: FloatArray, start: FloatArray, along: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(k,) places along a line, and the middles and widths across it of the points there."""
    places = (points - start) @ along
    offsets = (points - start) @ np.array([along[1], -along[0]])
    slot = np.round(places - places.min()).astype(np.int64)
    low, high = np.full(slot.max() + 1, np.inf), np.full(slot.max() + 1, -np.inf)
    np.minimum.at(low, slot, offsets)
    np.maximum.at(high, slot, offsets)
    rows = np.flatnonzero(low <= high)
    low, high = low[rows], high[rows]
    return places.min() + rows.astype(np.float64), (low + high) / 2.0, high - low + 1.0


def _robust_line(
    places: FloatArray, middles: FloatArray, widths: FloatArray
) -> tuple[float, float, float]:
    """Offset, slope and residual of a line; what is off, and wide slices, count little."""
    usual = np.minimum(1.0, np.median(widths) / widths)
    weight = usual
    for _ in range(5):
        total = float(weight.sum())
        at, level = float(weight @ places) / total, float(weight @ middles) / total
        from_at = places - at
        slope = float(weight @ (from_at * (middles - level))) / float(weight @ from_at**2)
        off = np.abs(middles - level - slope * from_at)
        scale = max(1.48 * float(np.median(off)), 0.3)
        weight = usual / (1.0 + (off / (2.0 * scale)) ** 2)
    return level - slope * at, slope, scale


def _box_width_px(region: Region) -> float:
    return float(max(1.0, (region.box_px[2:] - region.box_px[:2]).min() + 1.0))


def _length_px(ends_px: FloatArray) -> float:
    return float(np.linalg.norm(ends_px[1] - ends_px[0]))
