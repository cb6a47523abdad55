"""Search an image for a mapped pole or sign, and move the mark to the edges there.

A mark that only follows another keeps that one's offset, which grows as the camera comes near.
So the axis of a found pole is fitted to its edges. A sign's outline in all views at once tells
where its middle is, if it is clear: see ``joint_outlines``. Of a pole, the part that both images
show is compared across the pole.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist import appearance
from semviz_annotation.assist.image_search import (
    REACH_PX,
    ChosenOffset,
    ExpectedMark,
    ImageSearch,
    PropagatedMark,
    ReferenceView,
    RefinedMark,
)
from semviz_annotation.assist.marked_image import Mark, MarkedImage, clip_to_image, pixel
from semviz_annotation.assist.score import LabelledView, Track, apparent_size, probability, score_of
from semviz_annotation.assist.snap import CLEAR, align_ends, best_snap
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ElementClass
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.joint_outlines import (
    EdgeProfile,
    JointOutline,
    OutlineView,
    edge_profile,
    joint_outlines,
)
from semviz_core.subpixel.pole_axis import Axis, across, edge_support, shift_line
from semviz_core.subpixel.pole_fit import refine_axis


def search_sign(
    expected: ExpectedMark, element: Triangulated, element_class: ElementClass
) -> ImageSearch:
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
    return ImageSearch(
        expected, patch, expected.ends_px, whole, half * scale, scale, axes.T, offsets, total
    )


def _places(reach_px: float) -> FloatArray:
    """Return evenly spaced offsets from -reach to reach, at most 1.5 px apart."""
    reach = float(np.clip(reach_px, 2.0, REACH_PX))
    return np.linspace(-reach, reach, 2 * int(np.ceil(reach / 1.5)) + 1)


def refine_sign(search: ImageSearch, choice: ChosenOffset) -> RefinedMark:
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
    mark = clip_to_image(expected.mark, place[None], target.view.camera)
    return RefinedMark(mark, "followed sign", offset, evidence)


LOOK_PX = 1.2
"""Standard deviation of a mark where somebody looked at it."""
_SAME_PX = 1.5
"""Outlines whose middles are closer agree about the sign."""
_MOST_MARGIN = 0.5
_LEAST_EDGES, _MOST_SPREAD_PX, _LEAST_HALF_PX = 0.95, 0.8, 2.5
"""Bounds of a clear outline: its edges, how well its images agree, and its size."""


def with_outlines(
    marks: Mapping[int, PropagatedMark],
    references: Sequence[ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    track: Track,
) -> dict[int, PropagatedMark]:
    """Return the marks of a sign by rows of ``references``, on its outline where that is likelier
    to be right."""
    if not marks:
        return {}
    targets = [LabelledView(references[k].target, marks[k].mark) for k in marks]
    sources = {
        (id(reference.source), reference.marked): LabelledView(reference.source, reference.marked)
        for reference in references
    }
    views = [*targets, *sources.values(), *track.views]
    seen = _outline_views(views, element, element_class, track)
    shape = element_class.shape
    outlines = joint_outlines(seen, shape, targets[0].image.triangle_center)
    result = dict(marks)
    for n, k in enumerate(marks):
        moved = outlined(marks[k], n, seen, outlines, targets[n].image)
        if moved is not None and (
            score_of(moved, track, element) > score_of(marks[k], track, element)
        ):
            result[k] = moved
    return result


def _outline_views(
    views: Sequence[LabelledView], element: Triangulated, element_class: ElementClass, track: Track
) -> list[OutlineView]:
    sizes = [apparent_size(element, view.image.view) for view in views]
    look = sizes[0] / max(track.growth, 1.0)
    return [
        OutlineView(
            view.image,
            _profile(view.image, view.mark, element_class),
            view.mark.ends_px[0],
            scale,
            max(LOOK_PX * scale / look, 0.5 * LOOK_PX),
        )
        for view, scale in zip(views, sizes, strict=True)
        if scale > 0.0
    ]


def _profile(image: MarkedImage, mark: Mark, element_class: ElementClass) -> EdgeProfile:
    """Return the edges around a mark, computed once for each image."""
    key = (mark, element_class.shape)
    if key not in image.profiles:
        image.profiles[key] = edge_profile(image, mark.ends_px[0], element_class.shape)
    return image.profiles[key]


def outlined(
    followed: PropagatedMark,
    row: int,
    views: Sequence[OutlineView],
    outlines: Sequence[JointOutline],
    image: MarkedImage,
) -> PropagatedMark | None:
    """Return a followed mark moved to the outline; ``row`` is its image's among ``views``."""
    if not outlines:
        return None
    best = outlines[0]
    relative = views[row].scale / views[0].scale
    spread_px, half_px = best.spread_px * relative, float(best.half_px.min()) * relative
    own_px = float(np.linalg.norm(best.moves[row] - best.move)) * relative
    if best.edges < _LEAST_EDGES or half_px < _LEAST_HALF_PX:
        return None
    if max(spread_px, own_px) > _MOST_SPREAD_PX:
        return None
    likeliest = max(outlines, key=lambda each: each.fit)
    if np.linalg.norm(likeliest.move - best.move) * relative > _SAME_PX:
        return None  # edges beside the sign may be longer than its own
    other = max(
        (
            each.edges
            for each in outlines[1:]
            if np.linalg.norm(each.move - best.move) * relative > _SAME_PX
        ),
        default=-np.inf,
    )
    move = best.move * relative
    evidence = np.array(
        [
            best.edges,
            np.clip(best.edges - other, 0.0, _MOST_MARGIN),
            np.log(spread_px + 0.2),
            best.fits[row],
            np.log(own_px + 0.2),
            np.linalg.norm(move) / views[row].sigma_px,
            np.log(half_px),
            np.log(len(views)),
            *followed.evidence,
        ]
    )
    place = followed.mark.ends_px + move
    return PropagatedMark(
        clip_to_image(followed.mark, place, image.view.camera), "seen sign", evidence
    )


_NEAR_PX = 1.0
_LEAN_PX = 0.4
_WHOLE = 0.07
"""If a larger share of the pole at an end is not compared, nothing is known about that end."""
_EDGE_REACH_PX = (2.0, 4.0)
"""Bounds of the distance from where a pole is followed to, to its edges."""
_OTHER_WIDTH = 0.5
"""Edges whose distance differs by a larger logarithm are of something else."""
_NO_EDGES = np.zeros(3)


def search_pole(expected: ExpectedMark, element: Triangulated) -> ImageSearch | None:
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
    reach = float(np.clip(3.0 * _sigma_px(expected, normal), 2.0, REACH_PX))
    offsets = np.arange(-np.ceil(reach), np.ceil(reach) + 0.5)
    points = np.stack(
        [appearance.pole_points(shift_line(start, offset, offset), width) for offset in offsets]
    )
    patches = target.sample(points.reshape(-1, *points.shape[2:])).reshape(
        len(offsets), *patch.shape
    )
    total = appearance.similarity(patch, patches) @ appearance.SIMILARITY_WEIGHTS
    return ImageSearch(
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


def _sigma_px(expected: ExpectedMark, direction: FloatArray) -> float:
    """Return the RMS standard deviation of a pole's two ends in a direction."""
    return float(np.sqrt(np.einsum("aiaj,i,j->", expected.spread_px2, direction, direction) / 2.0))


def refine_pole(search: ImageSearch, choice: ChosenOffset) -> RefinedMark:
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
    edged = _on_edges(target, ends, width, sigma)
    edges = _NO_EDGES if edged is None else edged.evidence
    ends = ends if edged is None else edged.ends_px
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
            np.log(width), stayed, *edges, abs(moved[1] - moved[0]),
        ]
    )  # fmt: skip
    what = "followed pole" if edged is None else "seen pole"
    return RefinedMark(clipped_mark, what, np.array([moved.mean()]), evidence)


@dataclass(frozen=True, eq=False)
class _Edged:
    """A pole on its edges in an image."""

    ends_px: FloatArray
    evidence: FloatArray
    """(3,) log-odds of the edges, distance from where the pole was followed to, change of width."""


def _on_edges(
    image: MarkedImage, ends_px: FloatArray, width_px: float, sigma_px: float
) -> _Edged | None:
    """Return the pole near a line whose edges are clear, and about as far apart as expected."""
    mark = Mark(pixel(ends_px[0]), pixel(ends_px[1]), False, False)
    reach_px = float(np.clip(sigma_px, _EDGE_REACH_PX[0], _EDGE_REACH_PX[1]))
    found = best_snap(image, mark, DEFAULT_CLASSES[POLE], reach_px)
    if found is None:
        return None
    clear = probability("snap pole", found.evidence)
    ends = found.snapped.mark.ends_px
    wider = abs(float(np.log(found.size_px / width_px)))
    if clear < CLEAR or wider > _OTHER_WIDTH:
        return None
    moved = float(np.abs((ends - ends_px) @ across(ends_px)).max())
    odds = float(np.log(clear / max(1.0 - clear, 1e-3)))
    return _Edged(ends, np.array([odds, moved, wider]))


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
