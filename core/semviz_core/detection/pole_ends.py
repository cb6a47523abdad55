"""Find the visible ends of a pole along its axis, and whether they are the pole's own.

A visible end can also be the edge of an occluding object, or the image border. A sign at the peak
is treated separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.common.jit import compiled
from semviz_core.detection.pole_axes import SHORTEST_PX, Line
from semviz_core.detection.regions import Region, known, predicted_sigma_px
from semviz_core.subpixel import pole_ends
from semviz_core.subpixel.pole_axis import across
from semviz_core.subpixel.sampling import SampledImage, Samples

_SHORTEST_PX = 6.0
_MOST_PX = 12.0
"""Largest sigma of the range in which rows are examined."""
_REACH_PX = 3.0
"""Search distance for a visible end from the end by rows."""
_LEAST_GROWN_PX, _LEAST_GAIN, _MEAN_GAIN = 4.0, 6.0, 1.0
"""Least length of a part of a pole beyond the model's end, and its least log-odds, in all and for
each px."""
_ASIDE = 0.05
"""Largest error of a line's direction."""
_AT_BORDER_PX = 2.0
_BESIDE_SIGN_PX = 8.0
"""A predicted peak at most this far above a sign is at the sign."""
_BELOW_SIGN = 0.4
"""A predicted peak at most this share of the sign's height below a sign is at the sign."""
_ABOVE_SIGN_PX = 6.0
"""Sigma of the length of the pole above its sign."""
_STEP = 12.0
"""Step in grey levels at which the edge of an occluding object has half a vote."""


@dataclass(frozen=True, eq=False)
class End:
    """A candidate for the visible end of a pole at its peak (0) or bottom (1)."""

    kind: str
    """How it was measured: a key of ``regions.WEIGHTS``."""
    which: int
    place_px: float
    """Position along the axis, from the line's midpoint, downwards."""
    evidence: FloatArray
    """(k,) of its kind."""
    after: pole_ends.GrownEnd | None = None
    """How the pole goes on beyond this end, if that was examined."""

    @cached_property
    def sigma_px(self) -> float:
        """Sigma along the axis."""
        return predicted_sigma_px(self.kind, self.evidence)


@dataclass(frozen=True, eq=False)
class Extent:
    """The visible part of a pole."""

    ends_px: FloatArray
    """(2, 2) upper and lower end."""
    known: tuple[bool, bool]
    """Whether the ends are the pole's peak and bottom."""
    sigma_along_px: float
    """Root mean square of the known ends' sigmas, or of both if none is known."""


def pole_extent(
    image: SampledImage, region: Region, line: Line, signs: Sequence[Region]
) -> Extent | None:
    """Return the extent of a pole on a line; None if it is outside the image.

    ``signs`` are the regions of all signs in the image.
    """
    first = [first_end(region, line, which) for which in range(2)]
    ends = [best_end(image, region, line, signs, end) for end in first]
    middle, along = line.middle_px, line.along
    ends_px = middle + np.array([[end.place_px] for end in ends]) * along
    on_border, cut = within_image(image, ends_px)
    if (on_border[1] - on_border[0]) @ along < SHORTEST_PX:
        return None
    own_ends = ~cut & [
        _is_own(image, region, line, on_border, *pair) for pair in zip(first, ends, strict=True)
    ]
    sigmas = np.array([end.sigma_px for end in ends])
    sigmas_used = sigmas[own_ends] if own_ends.any() else sigmas
    return Extent(
        on_border, (bool(own_ends[0]), bool(own_ends[1])), float(np.sqrt((sigmas_used**2).mean()))
    )


def _is_own(
    image: SampledImage, region: Region, line: Line, ends_px: FloatArray, first: End, end: End
) -> bool:
    """Whether an end is the pole's own: neither hidden, which the model may tell, nor unclear."""
    told = region.ends_known is not None and region.ends_known[end.which]
    if region.ends_known is not None and not told:
        return False
    return known(end_evidence(image, region, line, ends_px, first, end), end.which)


def best_end(
    image: SampledImage, region: Region, line: Line, signs: Sequence[Region], first: End
) -> End:
    """Return the candidate with the least sigma; ``first`` is the model's."""
    return min(all_ends(image, region, line, signs, first), key=lambda end: end.sigma_px)


def all_ends(
    image: SampledImage, region: Region, line: Line, signs: Sequence[Region], first: End
) -> list[End]:
    """Return all candidates, beside the model's first; for a peak at a sign, only that of the
    sign."""
    first = followed_end(image, region, line, first)
    sign = None if first.which else _sign_at(line, signs, first)
    if sign is not None:
        return [end_at_sign(image, line, sign)]
    rows = end_in_image(image, line, first)
    return [first] if rows is None else [first, rows, *visible_end_near(image, line, first, rows)]


def first_end(region: Region, line: Line, which: int) -> End:
    """Return the model's candidate with the least sigma."""
    return min(first_ends(region, line, which), key=lambda end: end.sigma_px)


def followed_end(image: SampledImage, region: Region, line: Line, first: End) -> End:
    """Return the model's end, or the end to which the pole is seen to go on beyond it.

    An end that the model itself tells to be known is not followed.
    """
    grown = _beyond_end(image, line, first)
    told = region.ends_known is not None and region.ends_known[first.which]
    clear = [grown.fall, grown.clutter]
    least_gain = max(_LEAST_GAIN, _MEAN_GAIN * grown.off_px)
    if told or grown.off_px < _LEAST_GROWN_PX or grown.gain < least_gain:
        held = [np.log(first.sigma_px), *clear, float(first.which)]
        return End("end held", first.which, first.place_px, np.array(held), grown)
    evidence = [
        *(np.log(grown.off_px), grown.gain / grown.off_px, *clear),
        *(np.log(line.width_px), np.log(line.sigma_px), float(first.which)),
    ]
    place = _beyond(first, grown.off_px)
    return End("end by growth", first.which, place, np.array(evidence))


def _beyond_end(image: SampledImage, line: Line, end: End) -> pole_ends.GrownEnd:
    """Return how a pole goes on beyond an end."""
    other, end_px = _start_and_end(line, end)
    length = float(np.hypot(*(end_px - other)))
    if length < _SHORTEST_PX:
        return pole_ends.NOT_GROWN
    return pole_ends.grown_end(
        image, other, end_px, line.width_px, min(_ASIDE, 2.0 * line.sigma_px / length)
    )


def _sign_at(line: Line, signs: Sequence[Region], first: End) -> Region | None:
    """Return the sign that hides the predicted peak of a pole; None without one."""
    middle, along = line.middle_px, line.along
    peak_u, peak_v = middle + first.place_px * along
    for sign in signs:
        left, top, right, bottom = sign.box_px
        above, below = _BESIDE_SIGN_PX, _BELOW_SIGN * (bottom - top)
        if left <= peak_u <= right and top - above < peak_v < bottom + below:
            return sign
    return None


def end_at_sign(image: SampledImage, line: Line, sign: Region) -> End:
    """Return a peak at the top of a sign, or further up if the pole continues above it."""
    middle, along = line.middle_px, line.along
    _, top, _, bottom = sign.box_px
    place = float((top - middle[1]) * along[1])
    start, width = middle + place * along, line.width_px
    height = np.log(bottom - top + 1.0)
    rows = pole_ends.end_by_rows(image, line.ends_px[1], start, width, _ABOVE_SIGN_PX, hidden=True)
    beyond = 0.0 if rows is None else rows.off_px
    evidence = np.array([height, np.log(width), np.log(beyond + 1.0)])
    return End("end at sign", 0, place - beyond, evidence)


def first_ends(region: Region, line: Line, which: int) -> list[End]:
    """Return the model's candidates: by its ends and mask, or else by its box."""
    middle, along = line.middle_px, line.along
    candidates: list[End] = []
    length = np.log(float(np.hypot(*(region.box_px[2:] - region.box_px[:2]))) + 1.0)
    slack = np.log(line.sigma_px)
    if region.ends_px is not None:
        position = float((region.ends_px[which] - middle) @ along)
        candidates.append(End("end by model", which, position, np.array([length, slack, which])))
    points = region.mask_points_px
    if len(points):
        low, high = _extent_beside(points, middle, along, line.width_px / 2.0 + 1.5)
        position = high + 0.5 if which else low - 0.5
        candidates.append(End("end by mask", which, position, np.array([length, slack, which])))
    if not candidates:
        corner = np.array([middle[0], region.box_px[3 if which else 1]])
        position = float((corner - middle) @ along)
        candidates.append(End("end by box", which, position, np.array([length, slack, which])))
    return candidates


@compiled
def _extent_beside(
    points: FloatArray, start: FloatArray, along: FloatArray, beside_px: float
) -> tuple[float, float]:
    """Return the first and last place along a line of the points (n, 2) that are at most
    ``beside_px`` beside it; of all points if none is."""
    u, v = points[:, 0] - start[0], points[:, 1] - start[1]
    places = u * along[0] + v * along[1]
    beside = places[np.abs(u * along[1] - v * along[0]) <= beside_px]
    counted = beside if len(beside) else places
    return counted.min(), counted.max()


def end_in_image(image: SampledImage, line: Line, first: End) -> End | None:
    """Return the end by the rows' evidence for the pole, near the model's end; None if unclear."""
    other, end = _start_and_end(line, first)
    if np.hypot(*(end - other)) < _SHORTEST_PX:
        return None
    sigma = min(2.0 * first.sigma_px, _MOST_PX)
    rows = pole_ends.end_by_rows(image, other, end, line.width_px, sigma)
    if rows is None:
        return None
    evidence = np.array(
        [
            min(rows.margin, 8.0),
            np.log(abs(rows.off_px) / first.sigma_px + 0.5),
            *_line_evidence(line, first),
        ]
    )
    return End("end by rows", first.which, _beyond(first, rows.off_px), evidence)


def visible_end_near(image: SampledImage, line: Line, first: End, rows: End) -> list[End]:
    """Return the end where the pole's colour changes, near the end by rows; empty if unclear."""
    other, end = _start_and_end(line, rows)
    if np.hypot(*(end - other)) < _SHORTEST_PX:
        return []
    off = pole_ends.visible_end(image, other, end, line.width_px, _REACH_PX)
    if off is None:
        return []
    place = _beyond(rows, off)
    moved = np.log(abs(place - first.place_px) / first.sigma_px + 0.5)
    evidence = np.array(
        [rows.evidence[0], np.log(abs(off) + 0.5), moved, *_line_evidence(line, first)]
    )
    return [End("end by edges", first.which, place, evidence)]


def _start_and_end(line: Line, end: End) -> tuple[FloatArray, FloatArray]:
    """Return the line's other end (2,) and this end (2,)."""
    middle, along = line.middle_px, line.along
    return line.ends_px[1 - end.which], middle + end.place_px * along


def _beyond(end: End, off_px: float) -> float:
    return end.place_px + (off_px if end.which else -off_px)


def _line_evidence(line: Line, first: End) -> tuple[float, ...]:
    sigmas = np.log([first.sigma_px, line.width_px, line.sigma_px])
    return (*sigmas.tolist(), float(first.which))


def within_image(image: SampledImage, ends_px: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return ends (2, 2) clipped to the image along their line, and (2,) which are cut off."""
    height, width = image.image.shape[:2]
    low, high = np.array([-0.5, -0.5]), np.array([width - 0.5, height - 0.5])
    step = ends_px[1] - ends_px[0]
    level = np.where(np.abs(step) < 1e-9, 1e-9, step)
    to_low, to_high = (low - ends_px[0]) / level, (high - ends_px[0]) / level
    enters = np.minimum(to_low, to_high).max()
    leaves = np.maximum(to_low, to_high).min()
    near = _AT_BORDER_PX / float(np.linalg.norm(level))
    cut = np.array([enters + near >= 0.0, leaves - near <= 1.0])
    share = np.where(cut, [enters, leaves], [0.0, 1.0])
    return ends_px[0] + share[:, None] * step, cut


def end_evidence(
    image: SampledImage, region: Region, line: Line, ends_px: FloatArray, first: End, end: End
) -> FloatArray:
    """Return (k,) evidence for a visible end being the pole's own, and well measured.

    It is against an occluder's edge, a pole that goes on, and clutter in which no end is clear.
    ``first`` is the model's end.
    """
    after = end.after or _beyond_end(image, line, end)
    return np.array(
        [
            float(region.ends_known is not None),
            float(end.kind in ("end by edges", "end by rows")),
            float(end.kind == "end at sign"),
            float(end.kind == "end by growth"),
            crossing(image, ends_px, line.width_px, end.which),
            *background_change(image, ends_px, line.width_px, end.which),
            float(end.which),
            np.log(end.sigma_px),
            np.log(after.off_px + 1.0),
            after.fall,
            after.clutter,
            np.log(abs(end.place_px - first.place_px) + 1.0),
            np.log(line.sigma_px),
        ]
    )


def crossing(image: SampledImage, ends_px: FloatArray, width_px: float, which: int) -> float:
    """Return the vote (0 to 1) for an occluding edge that continues on both sides of the pole."""
    return float(_crossing(image.image, ends_px, width_px, which))


def background_change(
    image: SampledImage, ends_px: FloatArray, width_px: float, which: int
) -> tuple[float, float]:
    """Return how much the background on both sides of a pole changes at its end.

    The pole's own end has the same background before and after it; an occluder has not. First is
    a vote (0 to 1) for another mean colour, then the change of the logarithm of the texture.
    """
    vote, texture = _background_change(image.image, ends_px, width_px, which)
    return float(vote), float(texture)


_BESIDE_PX = np.array([2.0, 3.5, 5.0, 6.5])
"""Distances from the pole's edge at which its background is sampled."""


@compiled
def _beside(
    image: ByteImage,
    ends_px: FloatArray,
    width_px: float,
    which: int,
    side: float,
    rows: FloatArray,
) -> Samples:
    """Return colours (rows, 4, 3) on one side of a pole, at ``rows`` px below one of its ends."""
    normal, points = across(ends_px), np.empty((len(rows), 2))
    for row in range(len(rows)):
        points[row, 0] = ends_px[which, 0] - rows[row] * normal[1]
        points[row, 1] = ends_px[which, 1] + rows[row] * normal[0]
    return pole_ends.rows_across(image, points, normal, side * (width_px / 2.0 + _BESIDE_PX))


@compiled
def _crossing(image: ByteImage, ends_px: FloatArray, width_px: float, which: int) -> float:
    least = 1.0
    for side in (-1.0, 1.0):
        colors = _beside(image, ends_px, width_px, which, side, np.arange(-3.0, 3.5, 1.0))
        steepest = 0.0
        for row in range(len(colors) - 2):
            square = 0.0
            for channel in range(3):
                step = (colors[row + 2, :, channel] - colors[row, :, channel]).mean()
                square += step**2 / 3.0
            steepest = max(steepest, square / 4.0)
        least = min(least, steepest / (steepest + _STEP**2))
    return least


@compiled
def _background_change(
    image: ByteImage, ends_px: FloatArray, width_px: float, which: int
) -> tuple[float, float]:
    down = 1.0 if which else -1.0
    vote, change = 1.0, np.inf
    for side in (-1.0, 1.0):
        rows = np.arange(2.0, 11.0)
        before = _beside(image, ends_px, width_px, which, side, -down * rows)
        after = _beside(image, ends_px, width_px, which, side, down * rows)
        square, spread = 0.0, np.zeros(2)
        for channel in range(3):
            square += (after[..., channel].mean() - before[..., channel].mean()) ** 2 / 3.0
            spread[0] += before[..., channel].std() / 3.0
            spread[1] += after[..., channel].std() / 3.0
        vote = min(vote, square / (square + _STEP**2))
        change = min(change, np.log(spread[1] + 3.0) - np.log(spread[0] + 3.0))
    return vote, change
