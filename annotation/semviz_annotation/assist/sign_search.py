"""Search an image for a mapped sign, and move it to its outline.

A sign that only follows another mark keeps that one's offset, which grows as the camera comes near.
Its outline in all views at once tells where the middle is, if it is clear: see ``joint_outlines``.
"""

from collections.abc import Mapping, Sequence

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
from semviz_annotation.assist.marked_image import Mark, MarkedImage, clip_to_image
from semviz_annotation.assist.track import LabelledView, Track, score_of, size
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.joint_outlines import (
    EdgeProfile,
    JointOutline,
    OutlineView,
    edge_profile,
    joint_outlines,
)


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
    sizes = [size(element, view.image.view) for view in views]
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
