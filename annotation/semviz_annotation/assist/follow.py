"""Find a mapped element in other images: expected from its place, refined in the image.

For poles the images of one moment are searched together: what is off to the left of where it is
expected in one of them is so in the other too, but for what the depth may be wrong. So of two that
stand side by side in the image only the one at the right depth suits both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.align import aligned_pole, aligned_sign
from semviz_annotation.assist.ends import same_ends
from semviz_annotation.assist.expect import SIGMA_PX, expected_px, spread_px2, upright
from semviz_annotation.assist.look import (
    LIKENESS,
    half_of,
    likeness,
    pole_look,
    pole_points,
    seen_rows,
    sign_points,
    width_of,
)
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.shot import Mark, Proposed, Shot, clipped
from semviz_annotation.assist.together import Choice, chosen
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass
from semviz_core.measuring.picture import Samples
from semviz_core.measuring.pole import Axis, across, shifted, support
from semviz_core.measuring.profile import refine

_REACH_PX = 24.0
"""Nothing is looked for further away from where it is expected."""
_NEAR_PX = 1.0
_LEAN_PX = 0.4
_WHOLE = 0.07
"""An end that is not compared, but for this share of the pole, is one of which nothing is known."""


@dataclass(frozen=True, eq=False)
class Sight:
    """An image in which to look for an element, and one in which it is labelled."""

    there: Shot
    here: Shot
    marked: Mark


@dataclass(frozen=True, eq=False)
class Followed:
    """What was found, with what speaks for it."""

    mark: Mark
    evidence: FloatArray


@dataclass(frozen=True, eq=False)
class _Expected:
    """An element where one image should show it."""

    sight: Sight
    ends_px: FloatArray
    spread_px2: FloatArray
    """(e, 2, e, 2)"""
    mark: Mark
    """Says which ends are known."""


@dataclass(frozen=True, eq=False)
class _Search:
    """How like the element each place of one image is."""

    expected: _Expected
    look: Samples
    start_px: FloatArray
    """(e, 2) what is compared, where it is expected: of a pole perhaps a part."""
    shares: FloatArray
    """(2,) which part."""
    size_px: FloatArray
    """A pole's width, or a sign's half width and height, there."""
    scale: float
    """How much larger it is there than here."""
    axes: FloatArray
    """(m, 2) unit directions in which it is looked for: across a pole, and both of a sign."""
    offs: FloatArray
    """(n, m) places, px along the axes from the expected one."""
    total: FloatArray
    """(n,) likeness."""


@dataclass(frozen=True, eq=False)
class _Settled:
    """Found at sub-pixel accuracy, ``off`` (m,) from where it was expected."""

    mark: Mark
    off: FloatArray
    evidence: FloatArray


def follow(
    sights: Sequence[Sight],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> list[Proposed | None]:
    """A mapped element in the images of one moment; None for those that it is out of.

    ``element`` and all views share the map frame. What is hidden there, or cannot be told, comes
    with a low score.
    """
    what = "follow pole" if element.is_line else "follow sign"
    return [
        None if one is None else Proposed(one.mark, probability(what, one.evidence))
        for one in found_in(sights, element, element_class, sigma_px)
    ]


def found_in(
    sights: Sequence[Sight],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> list[Followed | None]:
    """As ``follow``, not judged yet."""
    element = upright(element)
    spread = spread_px2(element, [one.there.view for one in sights], sigma_px)
    searches = _searched(sights, element, element_class, spread)
    found: dict[int, Followed] = {}
    # poles stand side by side in an image; signs don't, and each is found better by itself
    for group in [[*searches]] if element.is_line else [[k] for k in searches]:
        found |= _together({k: searches[k] for k in group}, spread)
    return [found.get(k) for k in range(len(sights))]


def _searched(
    sights: Sequence[Sight], element: Triangulated, element_class: ElementClass, spread: FloatArray
) -> dict[int, _Search]:
    """By sight, those that the element is in."""
    mark = Mark((0.0, 0.0), None, element.anchor_known, element.end_known)
    searches: dict[int, _Search] = {}
    for k, sight in enumerate(sights):
        ends = expected_px(element, sight.there.view)
        if ends is None:
            continue
        expected = _Expected(sight, ends, spread[k, :, :, k], mark)
        search = (
            _search_pole(expected, element)
            if element.is_line
            else _search_sign(expected, element, element_class)
        )
        if search is not None:
            searches[k] = search
    return searches


# -- the images of one moment together


def _joint_px2(searches: dict[int, _Search], spread: FloatArray) -> FloatArray:
    """(s m, s m) covariance of the offsets of s searches along their m axes each."""
    rows = [
        [
            np.einsum("xi,aiaj,yj->xy", one.axes, spread[k, :, :, j], other.axes) / spread.shape[1]
            for j, other in searches.items()
        ]
        for k, one in searches.items()
    ]
    return np.asarray(np.block(rows), dtype=np.float64)


def _together(by_sight: dict[int, _Search], spread: FloatArray) -> dict[int, Followed]:
    """Where an element is in images of one moment, by sight."""
    if not by_sight:
        return {}
    searches = [*by_sight.values()]
    information = np.asarray(np.linalg.inv(_joint_px2(by_sight, spread)), dtype=np.float64)
    choices = chosen([one.offs for one in searches], [one.total for one in searches], information)
    is_line = len(searches[0].axes) == 1
    settled = [
        (_settled_pole if is_line else _settled_sign)(search, choice)
        for search, choice in zip(searches, choices, strict=True)
    ]
    off = np.concatenate([one.off for one in settled])
    pull = float(np.sqrt(off @ information @ off / len(off)))
    worst = min(one.total for one in choices)
    return {
        k: Followed(one.mark, np.array([*one.evidence, worst, pull]))
        for k, one in zip(by_sight, settled, strict=True)
    }


# -- poles


def _search_pole(expected: _Expected, element: Triangulated) -> _Search | None:
    """Across the pole, what both images show of it."""
    here, there = expected.sight.here, expected.sight.there
    part = _part(element, here.view, expected.sight.marked, there.view, expected.ends_px)
    if part is None:
        return None
    ends_here, shares = part
    axis = _axis(here, ends_here, width_of(here, ends_here))
    line = expected.ends_px
    start = line[0] + shares[:, None] * (line[1] - line[0])
    long_px = np.linalg.norm(np.diff([start, axis.ends_px], axis=1)[:, 0], axis=1)
    scale = float(long_px[0] / long_px[1])
    width = float(np.clip(axis.width_px * scale, 0.7, 60.0))
    # beside the pole, both looks reach equally far relative to its width
    look = here.sample(pole_points(axis.ends_px, axis.width_px))
    normal = across(line)
    reach = float(np.clip(3.0 * _sigma_px(expected, normal), 2.0, _REACH_PX))
    offs = np.arange(-np.ceil(reach), np.ceil(reach) + 0.5)
    points = np.stack([pole_points(shifted(start, off, off), width) for off in offs])
    looks = there.sample(points.reshape(-1, *points.shape[2:])).reshape(len(offs), *look.shape)
    total = likeness(look, looks) @ LIKENESS
    return _Search(
        expected, look, start, shares, np.array([width]), scale, normal[None], offs[:, None], total
    )


def _sigma_px(expected: _Expected, direction: FloatArray) -> float:
    """How far a pole's ends may be off in a direction: root of the mean of both."""
    return float(np.sqrt(np.einsum("aiaj,i,j->", expected.spread_px2, direction, direction) / 2.0))


def _settled_pole(search: _Search, choice: Choice) -> _Settled:
    expected, there = search.expected, search.expected.sight.there
    normal, width, start = search.axes[0], float(search.size_px[0]), search.start_px
    along = np.array([-normal[1], normal[0]])
    sigma, lengthwise = _sigma_px(expected, normal), _sigma_px(expected, along)
    sideways = np.einsum("aibj,i,j->ab", expected.spread_px2, normal, normal)
    lean = float(np.sqrt(max(sideways[0, 0] + sideways[1, 1] - 2.0 * sideways[0, 1], 0.0)))
    begun = shifted(start, choice.off[0], choice.off[0])
    ends = aligned_pole(search.look, there, begun, width, max(lean, _LEAN_PX), lengthwise)
    now = pole_look(there, ends, width)
    alike = likeness(search.look, now[None])[0]
    ends = _axis(there, ends, width).ends_px
    moved = (ends - start) @ normal
    mark, whole = _seen_part(expected.mark, ends, search.shares, seen_rows(search.look, now))
    found = clipped(mark, whole, there.view.camera)
    found, stayed = same_ends(
        expected.sight.here, there, expected.sight.marked, found, width, lengthwise
    )
    evidence = np.array(
        [
            *alike, *support(there, ends, width), choice.total, choice.margin,
            np.abs(moved).max() / sigma, np.log(lengthwise), abs(np.log(search.scale)),
            np.log(width), stayed,
        ]
    )  # fmt: skip
    return _Settled(found, np.array([moved.mean()]), evidence)


def _seen_part(
    mark: Mark, ends: FloatArray, shares: FloatArray, rows: tuple[float, float]
) -> tuple[Mark, FloatArray]:
    """A pole's mark and ends (2, 2) of which ``ends`` are at ``shares``, as far as it is seen.

    ``rows`` say from where to where, along ``ends``, it is like what it was. An end that was not
    compared, or is unlike, is hidden.
    """
    whole = _extended(ends, shares)
    known = [mark.anchor_known, mark.end_known]
    compared = [shares[0] < _WHOLE and rows[0] == 0.0, shares[1] > 1.0 - _WHOLE and rows[1] == 1.0]
    for k in range(2):
        if not compared[k]:
            known[k] = False
            whole[k] = ends[0] + rows[k] * (ends[1] - ends[0])
    return replace(mark, anchor_known=known[0], end_known=known[1]), whole


def _axis(shot: Shot, ends_px: FloatArray, width_px: float) -> Axis:
    """The axis of a pole of known width, where the image shows it near a line; or the line."""
    line = Axis(ends_px, width_px, np.zeros(0), 0.0)
    found = refine(shot, line)
    near = np.abs(found.ends_px - ends_px).max() < _NEAR_PX
    return found if near and abs(np.log(found.width_px / width_px)) < 0.4 else line


def _part(
    element: Triangulated, here: View, mark: Mark, there: View, expected: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """The part of a pole that ``here`` shows and ``there`` has in its image.

    Its ends (2, 2) in ``here``, on the mark, and where along the projection in ``there`` (2,).
    """
    ends_m = np.stack([element.anchor_m, element.end_m])
    share = np.linspace(0.0, 1.0, 65)
    points = ends_m[0] + share[:, None] * (ends_m[1] - ends_m[0])
    at_here, at_there = here.project(points), there.project(points)
    marked = mark.ends_px
    along = marked[1] - marked[0]
    place = (at_here - marked[0]) @ along / (along @ along)
    step = expected[1] - expected[0]
    place_there = (at_there - expected[0]) @ step / (step @ step)
    ok = np.isfinite(place) & (place > -0.02) & (place < 1.02)
    ok &= np.isfinite(place_there) & there.camera.contains(np.nan_to_num(at_there, nan=-9.0))
    rows = np.flatnonzero(ok)
    if len(rows) < 2:
        return None
    chosen = rows[[0, -1]]
    return marked[0] + place[chosen][:, None] * along, place_there[chosen]


def _extended(ends: FloatArray, shares: FloatArray) -> FloatArray:
    """(2, 2) the whole line of which ``ends`` are at ``shares``."""
    step = (ends[1] - ends[0]) / (shares[1] - shares[0])
    first = ends[0] - shares[0] * step
    return np.stack([first, first + step])


# -- signs


def _search_sign(
    expected: _Expected, element: Triangulated, element_class: ElementClass
) -> _Search:
    """Round where its middle is expected."""
    here, there = expected.sight.here, expected.sight.there
    middle = expected.sight.marked.ends_px[0]
    half = half_of(here, middle, element_class)
    depths = [float(one.depth_m(element.anchor_m[None])[0]) for one in (here.view, there.view)]
    focal = there.view.camera.K[0, 0] / here.view.camera.K[0, 0]
    scale = float(focal * depths[0] / depths[1])
    look = here.sample(sign_points(middle, half))
    variances, axes = np.linalg.eigh(expected.spread_px2[0, :, 0])
    places = [_places(3.0 * one) for one in np.sqrt(variances)]
    offs = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
    points = sign_points(expected.ends_px[0], half * scale) + (offs @ axes.T)[:, None, None]
    looks = there.sample(points.reshape(-1, *points.shape[2:])).reshape(len(offs), *look.shape)
    total = likeness(look, looks) @ LIKENESS
    whole = np.array([0.0, 1.0])
    return _Search(
        expected, look, expected.ends_px, whole, half * scale, scale, axes.T, offs, total
    )


def _places(reach_px: float) -> FloatArray:
    """Evenly from -reach to reach, as far as is looked; closely where that is not far."""
    reach = float(np.clip(reach_px, 2.0, _REACH_PX))
    return np.linspace(-reach, reach, 2 * int(np.ceil(reach / 1.5)) + 1)


def _settled_sign(search: _Search, choice: Choice) -> _Settled:
    expected, half = search.expected, search.size_px
    there = expected.sight.there
    begun = search.start_px[0] + choice.off @ search.axes
    found, fit = aligned_sign(search.look, there, begun, half)
    off = search.axes @ (found - search.start_px[0])
    sigmas = np.sqrt(np.diag(search.axes @ expected.spread_px2[0, :, 0] @ search.axes.T))
    moved = float(np.linalg.norm(off / sigmas))
    evidence = np.array(
        [
            *fit, choice.total, choice.margin, moved, abs(np.log(search.scale)),
            np.log(half.mean()),
        ]
    )  # fmt: skip
    return _Settled(clipped(expected.mark, found[None], there.view.camera), off, evidence)
