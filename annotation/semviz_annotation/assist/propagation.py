"""Propagation of a mapped element to the images of another moment.

The search starts at the expected position. For poles all images are searched jointly: apart from
errors in depth, the offset from the expected position is the same in all of them. So if two poles
stand side by side in one image, only the one at the right depth fits all images.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from semviz_annotation.assist import appearance
from semviz_annotation.assist.expected_position import SIGMA_PX, expected_px, spread_px2, upright
from semviz_annotation.assist.marked_image import Mark, MarkedImage, ProposedMark, clip_to_image
from semviz_annotation.assist.pole_ends import align_ends
from semviz_annotation.assist.score import probability
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import Axis, across, edge_support, shift_line
from semviz_core.subpixel.pole_fit import refine_axis
from semviz_core.subpixel.sampling import Samples

_MAX_CANDIDATES = 6
"""Candidates in each image that are combined with those in the others."""
_APART_PX = 1.6
_OTHER_PX = 2.5
"""Candidates at this distance are different positions."""
_SOFTNESS = 9.0
"""Weight of similarity relative to the prior: three sigma count as one."""


@dataclass(frozen=True, eq=False)
class ChosenOffset:
    """The position chosen in one image."""

    offset: FloatArray
    """(m,)"""
    total: float
    """Its similarity."""
    margin: float
    """Lead over the best combination with another position in this image."""


def joint_maximum(
    offsets: Sequence[FloatArray], totals: Sequence[FloatArray], information: FloatArray
) -> list[ChosenOffset]:
    """Choose one position in each of v images, so that they are likely and have similar offsets.

    ``offsets`` (n, m) are px from the expected position, ``totals`` (n,) their similarities, and
    ``information`` (v m, v m) is the inverse covariance of all offsets together.
    """
    m = offsets[0].shape[1]
    peaks = [
        _peaks(offset, total, information[m * k : m * k + m, m * k : m * k + m])
        for k, (offset, total) in enumerate(zip(offsets, totals, strict=True))
    ]
    combinations = list(product(*peaks))
    sums = np.empty(len(combinations))
    for n, places in enumerate(combinations):
        whole = np.concatenate([offset[at] for offset, at in zip(offsets, places, strict=True)])
        alike = sum(total[at] for total, at in zip(totals, places, strict=True))
        sums[n] = alike - 0.5 * whole @ information @ whole / _SOFTNESS
    best = int(np.argmax(sums))
    result = []
    for k, offset in enumerate(offsets):
        at = combinations[best][k]
        away = [
            np.linalg.norm(offset[places[k]] - offset[at]) > _OTHER_PX for places in combinations
        ]
        margin = float(np.clip(sums[best] - sums[away].max(initial=-np.inf), 0.0, 0.5))
        result.append(ChosenOffset(offset[at], float(totals[k][at]), margin))
    return result


def _peaks(offsets: FloatArray, total: FloatArray, information: FloatArray) -> list[int]:
    """Return the most likely positions in one image, with a minimum distance."""
    pull = np.einsum("ni,ij,nj->n", offsets, information, offsets)
    peaks: list[int] = []
    for at in np.argsort(-(total - 0.5 * pull / _SOFTNESS), kind="stable"):
        gaps = [np.abs(offsets[at] - offsets[peak]).max() for peak in peaks]
        if min(gaps, default=np.inf) > _APART_PX:
            peaks.append(int(at))
        if len(peaks) == _MAX_CANDIDATES:
            break
    return peaks


_REACH_PX = 24.0
"""Largest distance of the search from the expected position."""
_NEAR_PX = 1.0
_LEAN_PX = 0.4
_WHOLE = 0.07
"""If a larger share of the pole at an end is not compared, nothing is known about that end."""


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """An image to search for an element, and one in which it is labelled."""

    target: MarkedImage
    source: MarkedImage
    marked: Mark


@dataclass(frozen=True, eq=False)
class PropagatedMark:
    """A propagated mark with its evidence."""

    mark: Mark
    evidence: FloatArray


@dataclass(frozen=True, eq=False)
class _Expected:
    """The expected position of an element in one image."""

    reference: ReferenceView
    ends_px: FloatArray
    spread_px2: FloatArray
    """(e, 2, e, 2)"""
    mark: Mark
    """States which ends are known."""


@dataclass(frozen=True, eq=False)
class _Search:
    """The similarity of each position in one image to the element."""

    expected: _Expected
    patch: Samples
    start_px: FloatArray
    """(e, 2) expected ends of the part that is compared; of a pole perhaps not all."""
    shares: FloatArray
    """(2,) begin and end of that part, as shares of the pole."""
    size_px: FloatArray
    """A pole's width, or a sign's half width and height, in the target image."""
    scale: float
    """Magnification from the source to the target image."""
    axes: FloatArray
    """(m, 2) unit directions of the search: one across a pole, two for a sign."""
    offsets: FloatArray
    """(n, m) px along the axes from the expected position."""
    total: FloatArray
    """(n,) weighted similarity."""


@dataclass(frozen=True, eq=False)
class _RefinedMark:
    """Found at sub-pixel accuracy, ``offset`` (m,) from where it was expected."""

    mark: Mark
    offset: FloatArray
    evidence: FloatArray


def propagate(
    references: Sequence[ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> list[ProposedMark | None]:
    """Return the marks of a mapped element in the images of one moment; None where it is outside.

    ``element`` and all views share the map frame. An element that is hidden or unclear gets a low
    score.
    """
    what = "propagated pole" if element.is_line else "propagated sign"
    return [
        None if view is None else ProposedMark(view.mark, probability(what, view.evidence))
        for view in search_views(references, element, element_class, sigma_px)
    ]


def search_views(
    references: Sequence[ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> list[PropagatedMark | None]:
    """Return the marks of ``propagate`` with their evidence."""
    element = upright(element)
    spread = spread_px2(element, [reference.target.view for reference in references], sigma_px)
    searches = _search_each(references, element, element_class, spread)
    marks: dict[int, PropagatedMark] = {}
    # poles may stand side by side in an image; signs do not, so each is searched for by itself
    for group in [[*searches]] if element.is_line else [[k] for k in searches]:
        marks |= _search_jointly({k: searches[k] for k in group}, spread)
    return [marks.get(k) for k in range(len(references))]


def _search_each(
    references: Sequence[ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    spread: FloatArray,
) -> dict[int, _Search]:
    """Search each image that shows the element; keys are rows of ``references``."""
    mark = Mark((0.0, 0.0), None, element.anchor_known, element.end_known)
    searches: dict[int, _Search] = {}
    for k, reference in enumerate(references):
        ends = expected_px(element, reference.target.view)
        if ends is None:
            continue
        expected = _Expected(reference, ends, spread[k, :, :, k], mark)
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
    """Return the covariance (s m, s m) of the offsets of s searches along their m axes each."""
    blocks = [
        [
            np.einsum("xi,aiaj,yj->xy", a.axes, spread[k, :, :, j], b.axes)
            for j, b in searches.items()
        ]
        for k, a in searches.items()
    ]
    return np.asarray(np.block(blocks) / spread.shape[1], dtype=np.float64)


def _search_jointly(by_view: dict[int, _Search], spread: FloatArray) -> dict[int, PropagatedMark]:
    """Combine the searches of one moment; return marks by rows of the references."""
    if not by_view:
        return {}
    searches = [*by_view.values()]
    information = np.asarray(np.linalg.inv(_joint_px2(by_view, spread)), dtype=np.float64)
    choices = joint_maximum(
        [search.offsets for search in searches], [search.total for search in searches], information
    )
    is_line = len(searches[0].axes) == 1
    refined_marks = [
        (_refine_pole if is_line else _refine_sign)(search, choice)
        for search, choice in zip(searches, choices, strict=True)
    ]
    offset = np.concatenate([result.offset for result in refined_marks])
    pull = float(np.sqrt(offset @ information @ offset / len(offset)))
    worst = min(choice.total for choice in choices)
    return {
        k: PropagatedMark(result.mark, np.array([*result.evidence, worst, pull]))
        for k, result in zip(by_view, refined_marks, strict=True)
    }


# -- poles


def _search_pole(expected: _Expected, element: Triangulated) -> _Search | None:
    """Search across a pole, with the part of it that both images show."""
    source, target = expected.reference.source, expected.reference.target
    part = _part(element, source.view, expected.reference.marked, target.view, expected.ends_px)
    if part is None:
        return None
    ends_here, shares = part
    axis = _axis(source, ends_here, appearance.pole_width(source, ends_here))
    line = expected.ends_px
    start = line[0] + shares[:, None] * (line[1] - line[0])
    long_px = np.linalg.norm(np.diff([start, axis.ends_px], axis=1)[:, 0], axis=1)
    scale = float(long_px[0] / long_px[1])
    width = float(np.clip(axis.width_px * scale, 0.7, 60.0))
    # both patches extend equally far beyond the pole, relative to its width
    patch = source.sample(appearance.pole_points(axis.ends_px, axis.width_px))
    normal = across(line)
    reach = float(np.clip(3.0 * _sigma_px(expected, normal), 2.0, _REACH_PX))
    offsets = np.arange(-np.ceil(reach), np.ceil(reach) + 0.5)
    points = np.stack(
        [appearance.pole_points(shift_line(start, offset, offset), width) for offset in offsets]
    )
    patches = target.sample(points.reshape(-1, *points.shape[2:])).reshape(
        len(offsets), *patch.shape
    )
    total = appearance.similarity(patch, patches) @ appearance.SIMILARITY_WEIGHTS
    return _Search(
        expected,
        patch,
        start,
        shares,
        np.array([width]),
        scale,
        normal[None],
        offsets[:, None],
        total,
    )


def _sigma_px(expected: _Expected, direction: FloatArray) -> float:
    """Return the RMS standard deviation of a pole's two ends in a direction."""
    return float(np.sqrt(np.einsum("aiaj,i,j->", expected.spread_px2, direction, direction) / 2.0))


def _refine_pole(search: _Search, choice: ChosenOffset) -> _RefinedMark:
    expected, target = search.expected, search.expected.reference.target
    normal, width, start = search.axes[0], float(search.size_px[0]), search.start_px
    along = np.array([-normal[1], normal[0]])
    sigma, lengthwise = _sigma_px(expected, normal), _sigma_px(expected, along)
    sideways = np.einsum("aibj,i,j->ab", expected.spread_px2, normal, normal)
    lean = float(np.sqrt(max(sideways[0, 0] + sideways[1, 1] - 2.0 * sideways[0, 1], 0.0)))
    begun = shift_line(start, choice.offset[0], choice.offset[0])
    ends = appearance.align_pole(
        search.patch, target, begun, width, max(lean, _LEAN_PX), lengthwise
    )
    now = appearance.pole_patch(target, ends, width)
    alike = appearance.similarity(search.patch, now[None])[0]
    ends = _axis(target, ends, width).ends_px
    moved = (ends - start) @ normal
    mark, whole = _seen_part(
        expected.mark, ends, search.shares, appearance.visible_rows(search.patch, now)
    )
    clipped_mark = clip_to_image(mark, whole, target.view.camera)
    clipped_mark, stayed = align_ends(
        expected.reference.source,
        target,
        expected.reference.marked,
        clipped_mark,
        width,
        lengthwise,
    )
    evidence = np.array(
        [
            *alike, *edge_support(target, ends, width), choice.total, choice.margin,
            np.abs(moved).max() / sigma, np.log(lengthwise), abs(np.log(search.scale)),
            np.log(width), stayed,
        ]
    )  # fmt: skip
    return _RefinedMark(clipped_mark, np.array([moved.mean()]), evidence)


def _seen_part(
    mark: Mark, ends: FloatArray, shares: FloatArray, rows: tuple[float, float]
) -> tuple[Mark, FloatArray]:
    """Return a pole's mark and its visible ends (2, 2); ``ends`` are at ``shares`` of the pole.

    ``rows`` is the similar part of ``ends`` (see ``visible_rows``). An end that was not compared,
    or is dissimilar, counts as hidden.
    """
    whole = _extended(ends, shares)
    known = [mark.anchor_known, mark.end_known]
    compared = [shares[0] < _WHOLE and rows[0] == 0.0, shares[1] > 1.0 - _WHOLE and rows[1] == 1.0]
    for k in range(2):
        if not compared[k]:
            known[k] = False
            whole[k] = ends[0] + rows[k] * (ends[1] - ends[0])
    return replace(mark, anchor_known=known[0], end_known=known[1]), whole


def _axis(image: MarkedImage, ends_px: FloatArray, width_px: float) -> Axis:
    """Return the axis of a pole of known width near a line; the line itself if it is not clear."""
    line = Axis(ends_px, width_px, np.zeros(0), 0.0)
    refined = refine_axis(image, line)
    near = np.abs(refined.ends_px - ends_px).max() < _NEAR_PX
    return refined if near and abs(np.log(refined.width_px / width_px)) < 0.4 else line


def _part(
    element: Triangulated, source: PosedView, mark: Mark, target: PosedView, expected: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the part of a pole that both images show; None if there is none.

    Its ends (2, 2) in ``source``, on the mark, and its shares (2,) of the pole in ``target``.
    """
    ends_m = np.stack([element.anchor_m, element.end_m])
    share = np.linspace(0.0, 1.0, 65)
    points = ends_m[0] + share[:, None] * (ends_m[1] - ends_m[0])
    at_here, at_there = source.project(points), target.project(points)
    marked = mark.ends_px
    along = marked[1] - marked[0]
    place = (at_here - marked[0]) @ along / (along @ along)
    step = expected[1] - expected[0]
    place_there = (at_there - expected[0]) @ step / (step @ step)
    ok = np.isfinite(place) & (place > -0.02) & (place < 1.02)
    ok &= np.isfinite(place_there) & target.camera.contains(np.nan_to_num(at_there, nan=-9.0))
    rows = np.flatnonzero(ok)
    if len(rows) < 2:
        return None
    chosen = rows[[0, -1]]
    return marked[0] + place[chosen][:, None] * along, place_there[chosen]


def _extended(ends: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the ends (2, 2) of the whole line; ``ends`` are at ``shares`` of it."""
    step = (ends[1] - ends[0]) / (shares[1] - shares[0])
    first = ends[0] - shares[0] * step
    return np.stack([first, first + step])


# -- signs


def _search_sign(
    expected: _Expected, element: Triangulated, element_class: ElementClass
) -> _Search:
    """Search around the expected centre of a sign."""
    source, target = expected.reference.source, expected.reference.target
    middle = expected.reference.marked.ends_px[0]
    half = appearance.sign_half_size(source, middle, element_class)
    depths = [float(view.depth_m(element.anchor_m[None])[0]) for view in (source.view, target.view)]
    focal = target.view.camera.K[0, 0] / source.view.camera.K[0, 0]
    scale = float(focal * depths[0] / depths[1])
    patch = source.sample(appearance.sign_points(middle, half))
    variances, axes = np.linalg.eigh(expected.spread_px2[0, :, 0])
    places = [_places(3.0 * sigma) for sigma in np.sqrt(variances)]
    offsets = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
    points = (
        appearance.sign_points(expected.ends_px[0], half * scale)
        + (offsets @ axes.T)[:, None, None]
    )
    patches = target.sample(points.reshape(-1, *points.shape[2:])).reshape(
        len(offsets), *patch.shape
    )
    total = appearance.similarity(patch, patches) @ appearance.SIMILARITY_WEIGHTS
    whole = np.array([0.0, 1.0])
    return _Search(
        expected, patch, expected.ends_px, whole, half * scale, scale, axes.T, offsets, total
    )


def _places(reach_px: float) -> FloatArray:
    """Return evenly spaced offsets from -reach to reach, at most 1.5 px apart."""
    reach = float(np.clip(reach_px, 2.0, _REACH_PX))
    return np.linspace(-reach, reach, 2 * int(np.ceil(reach / 1.5)) + 1)


def _refine_sign(search: _Search, choice: ChosenOffset) -> _RefinedMark:
    expected, half = search.expected, search.size_px
    target = expected.reference.target
    begun = search.start_px[0] + choice.offset @ search.axes
    place, fit = appearance.align_sign(search.patch, target, begun, half)
    offset = search.axes @ (place - search.start_px[0])
    sigmas = np.sqrt(np.diag(search.axes @ expected.spread_px2[0, :, 0] @ search.axes.T))
    moved = float(np.linalg.norm(offset / sigmas))
    evidence = np.array(
        [*fit, choice.total, choice.margin, moved, abs(np.log(search.scale)), np.log(half.mean())]
    )
    return _RefinedMark(
        clip_to_image(expected.mark, place[None], target.view.camera), offset, evidence
    )
