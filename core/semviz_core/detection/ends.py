"""Where along its axis a pole begins and ends in an image, and whether those ends are its own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.detection.line import SHORTEST_PX, Line, mask_points
from semviz_core.detection.region import Region
from semviz_core.detection.sigma import known, sigma_px
from semviz_core.measuring.ends import visible_end
from semviz_core.measuring.picture import Picture
from semviz_core.measuring.pole import across
from semviz_core.measuring.rows import end_by_rows

_SHORTEST_PX = 6.0
_MOST_PX = 12.0
"""Sigma of where rows are looked at, at most."""
_REACH_PX = 3.0
"""How far from there a visible end is looked for."""
_AT_BORDER_PX = 2.0
_BESIDE_SIGN_PX = 8.0
"""So near above a sign a peak is said to be that is truly at the sign."""
_BELOW_SIGN = 0.4
"""How far below its sign, of the sign's height, a model may see a pole begin."""
_ABOVE_SIGN_PX = 6.0
"""Sigma of how far it goes on above."""
_STEP = 12.0
"""Levels at which the edge of something in front of a pole has half a vote."""


@dataclass(frozen=True, eq=False)
class End:
    """A candidate for where a pole's peak (0) or bottom (1) can last be seen."""

    kind: str
    which: int
    place_px: float
    """Along the axis, from the middle of the line, downwards."""
    evidence: FloatArray

    @property
    def sigma_px(self) -> float:
        """Along."""
        return sigma_px(self.kind, self.evidence)


@dataclass(frozen=True, eq=False)
class Extent:
    """A pole from where it begins to where it ends."""

    ends_px: FloatArray
    """(2, 2)"""
    known: tuple[bool, bool]
    sigma_along_px: float
    """Of the ends that are known, or else of both."""


def extent(picture: Picture, region: Region, line: Line, signs: Sequence[Region]) -> Extent | None:
    """Of a pole on a line; ``signs`` are what else the model saw, some of them on poles. None
    where nothing of it is in the image."""
    ends = [best_end(picture, region, line, signs, which) for which in range(2)]
    middle, along = course(line)
    ends_px = middle + np.array([[one.place_px] for one in ends]) * along
    on_border, cut = within_image(picture, ends_px)
    if (on_border[1] - on_border[0]) @ along < SHORTEST_PX:
        return None
    told = region.ends_known
    if told is None:
        evidence = [end_evidence(picture, line, on_border, one) for one in ends]
        told = known(evidence[0]), known(evidence[1])
    own = ~cut & told
    sigmas = np.array([one.sigma_px for one in ends])
    of = sigmas[own] if own.any() else sigmas
    return Extent(on_border, (bool(own[0]), bool(own[1])), float(np.sqrt((of**2).mean())))


def best_end(
    picture: Picture, region: Region, line: Line, signs: Sequence[Region], which: int
) -> End:
    """The candidate with the least sigma."""
    return min(all_ends(picture, region, line, signs, which), key=lambda one: one.sigma_px)


def all_ends(
    picture: Picture, region: Region, line: Line, signs: Sequence[Region], which: int
) -> list[End]:
    """Every candidate; a peak at a sign has only what is seen there."""
    ends = first_ends(region, line, which)
    first = min(ends, key=lambda one: one.sigma_px)
    sign = None if which else _sign_at(line, signs, first)
    if sign is not None:
        return [end_at_sign(picture, line, sign)]
    rows = end_in_image(picture, line, first)
    return ends if rows is None else [*ends, rows, *visible_end_near(picture, line, first, rows)]


def _sign_at(line: Line, signs: Sequence[Region], first: End) -> Region | None:
    """The sign that hides a pole where its peak is said to be; what was seen is what is below."""
    middle, along = course(line)
    column, height = middle + first.place_px * along
    for one in signs:
        left, top, right, bottom = one.box_px
        above, below = _BESIDE_SIGN_PX, _BELOW_SIGN * (bottom - top)
        if left <= column <= right and top - above < height < bottom + below:
            return one
    return None


def end_at_sign(picture: Picture, line: Line, sign: Region) -> End:
    """A peak at the top of a sign, or further up where the pole goes on above it."""
    middle, along = course(line)
    _, top, _, bottom = sign.box_px
    place = float((top - middle[1]) * along[1])
    start, width = middle + place * along, line.width_px
    height = np.log(bottom - top + 1.0)
    rows = end_by_rows(picture, line.ends_px[1], start, width, _ABOVE_SIGN_PX, hidden=True)
    beyond = 0.0 if rows is None else rows.off_px
    evidence = np.array([height, np.log(width), np.log(beyond + 1.0)])
    return End("end at sign", 0, place - beyond, evidence)


def first_ends(region: Region, line: Line, which: int) -> list[End]:
    """What the model says: by its ends and its mask, or else by its box."""
    middle, along = course(line)
    found: list[End] = []
    length = np.log(float(np.linalg.norm(region.box_px[2:] - region.box_px[:2])) + 1.0)
    slack = np.log(line.sigma_px)
    if region.ends_px is not None:
        place = float((region.ends_px[which] - middle) @ along)
        found.append(End("end by model", which, place, np.array([length, slack, which])))
    points = mask_points(region)
    if len(points):
        places = (points - middle) @ along
        beside = np.abs((points - middle) @ across(line.ends_px)) <= line.width_px / 2.0 + 1.5
        if beside.any():
            places = places[beside]
        place = float(places.max() + 0.5) if which else float(places.min() - 0.5)
        found.append(End("end by mask", which, place, np.array([length, slack, which])))
    if not found:
        corner = np.array([middle[0], region.box_px[3 if which else 1]])
        place = float((corner - middle) @ along)
        found.append(End("end by box", which, place, np.array([length, slack, which])))
    return found


def end_in_image(picture: Picture, line: Line, first: End) -> End | None:
    """Where rows stop to look like the pole, near what the model says."""
    other, end = _from_to(line, first)
    if np.linalg.norm(end - other) < _SHORTEST_PX:
        return None
    sigma = min(2.0 * first.sigma_px, _MOST_PX)
    rows = end_by_rows(picture, other, end, line.width_px, sigma)
    if rows is None:
        return None
    evidence = np.array(
        [
            min(rows.margin, 8.0),
            np.log(abs(rows.off_px) / first.sigma_px + 0.5),
            *_usual(line, first),
        ]
    )
    return End("end by rows", first.which, _beyond(first, rows.off_px), evidence)


def visible_end_near(picture: Picture, line: Line, first: End, rows: End) -> list[End]:
    """Where the pole's colour gives way to another, near where its rows end; none if unclear."""
    other, end = _from_to(line, rows)
    if np.linalg.norm(end - other) < _SHORTEST_PX:
        return []
    off = visible_end(picture, other, end, line.width_px, _REACH_PX)
    if off is None:
        return []
    place = _beyond(rows, off)
    moved = np.log(abs(place - first.place_px) / first.sigma_px + 0.5)
    evidence = np.array([rows.evidence[0], np.log(abs(off) + 0.5), moved, *_usual(line, first)])
    return [End("end by edges", first.which, place, evidence)]


def _from_to(line: Line, end: End) -> tuple[FloatArray, FloatArray]:
    """(2,) each: a line's other end, and this one."""
    middle, along = course(line)
    return line.ends_px[1 - end.which], middle + end.place_px * along


def _beyond(end: End, off_px: float) -> float:
    return end.place_px + (off_px if end.which else -off_px)


def _usual(line: Line, first: End) -> tuple[float, ...]:
    sigmas = np.log([first.sigma_px, line.width_px, line.sigma_px])
    return (*sigmas.tolist(), float(first.which))


def within_image(picture: Picture, ends_px: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Ends (2, 2) kept within the image along their line, and which of them (2,) it cuts off."""
    height, width = picture.image.shape[:2]
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


def end_evidence(picture: Picture, line: Line, ends_px: FloatArray, end: End) -> FloatArray:
    """(k,) of whether an end is the pole's own, and not that of something in front of it."""
    return np.array(
        [
            float(end.kind in ("end by edges", "end by rows")),
            float(end.kind == "end at sign"),
            crossing(picture, ends_px, line.width_px, end.which),
            float(end.which),
        ]
    )


def crossing(picture: Picture, ends_px: FloatArray, width_px: float, which: int) -> float:
    """How clearly (0 to 1) an edge runs on to both sides of a pole where it ends: what hides it."""
    along = (ends_px[1] - ends_px[0]) / np.linalg.norm(ends_px[1] - ends_px[0])
    rows = np.arange(-3.0, 3.5, 1.0)[:, None, None]
    beside = width_px / 2.0 + np.array([2.0, 3.5, 5.0, 6.5])
    normal = across(ends_px)
    votes = []
    for side in (-1.0, 1.0):
        columns = (side * beside)[:, None]
        colors = picture.sample(ends_px[which] + rows * along + columns * normal)
        step = colors[2:] - colors[:-2]
        slope = np.sqrt((step.mean(axis=1) ** 2).mean(axis=1)).max() / 2.0
        votes.append(slope**2 / (slope**2 + _STEP**2))
    return float(min(votes))


def course(line: Line) -> tuple[FloatArray, FloatArray]:
    """The middle (2,) of a line and its direction (2,), down."""
    step = line.ends_px[1] - line.ends_px[0]
    return line.ends_px.mean(axis=0), step / np.linalg.norm(step)
