"""Propagation of a mapped element to the images of another moment.

The search starts at the expected position. For poles all images are searched jointly: apart from
errors in depth, the offset from the expected position is the same in all of them. So if two poles
stand side by side in one image, only the one at the right depth fits all images.
"""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.assist import element_search, image_search
from semviz_annotation.assist.expected_position import SIGMA_PX, expected_px, spread_px2, upright
from semviz_annotation.assist.marked_image import Mark, ProposedMark
from semviz_annotation.assist.score import NO_TRACK, Track, log_growth, score_of
from semviz_annotation.assist.whole_ends import whole_marks
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray


def propagate(
    references: Sequence[image_search.ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
    track: Track = NO_TRACK,
) -> list[ProposedMark | None]:
    """Return the marks of a mapped element in the images of one moment; None where it is outside.

    ``element`` and all views share the map frame. An element that is hidden or unclear gets a low
    score; one that only follows another mark and has grown a lot is never sure.
    """
    return [
        None if view is None else ProposedMark(view.mark, score_of(view, track, element))
        for view in search_views(references, element, element_class, sigma_px, track)
    ]


def search_views(
    references: Sequence[image_search.ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
    track: Track = NO_TRACK,
) -> list[image_search.PropagatedMark | None]:
    """Return the marks of ``propagate`` with their evidence."""
    element = upright(element)
    spread = spread_px2(element, [reference.target.view for reference in references], sigma_px)
    searches = _search_each(references, element, element_class, spread)
    marks: dict[int, image_search.PropagatedMark] = {}
    if element.is_line:  # poles may stand side by side in an image
        marks = _search_jointly(searches, spread, track)
    else:
        for k in searches:
            marks |= _search_jointly({k: searches[k]}, spread, track)
        marks = element_search.with_outlines(marks, references, element, element_class, track)
    return [marks.get(k) for k in range(len(references))]


def _search_each(
    references: Sequence[image_search.ReferenceView],
    element: Triangulated,
    element_class: ElementClass,
    spread: FloatArray,
) -> dict[int, image_search.ImageSearch]:
    """Search each image that shows the element; keys are rows of ``references``."""
    mark = Mark((0.0, 0.0), None, element.anchor_known, element.end_known)
    searches: dict[int, image_search.ImageSearch] = {}
    for k, reference in enumerate(references):
        ends = expected_px(element, reference.target.view)
        if ends is None:
            continue
        expected = image_search.ExpectedMark(reference, ends, spread[k, :, :, k], mark)
        search = (
            element_search.search_pole(expected, element)
            if element.is_line
            else element_search.search_sign(expected, element, element_class)
        )
        if search is not None:
            searches[k] = search
    return searches


# -- the images of one moment together


def _joint_px2(searches: dict[int, image_search.ImageSearch], spread: FloatArray) -> FloatArray:
    """Return the covariance (s m, s m) of the offsets of s searches along their m axes each."""
    blocks = [
        [
            np.einsum("xi,aiaj,yj->xy", a.axes, spread[k, :, :, j], b.axes)
            for j, b in searches.items()
        ]
        for k, a in searches.items()
    ]
    return np.asarray(np.block(blocks) / spread.shape[1], dtype=np.float64)


def _search_jointly(
    by_view: dict[int, image_search.ImageSearch], spread: FloatArray, track: Track
) -> dict[int, image_search.PropagatedMark]:
    """Combine the searches of one moment; return marks by rows of the references."""
    if not by_view:
        return {}
    searches = [*by_view.values()]
    information = np.asarray(np.linalg.inv(_joint_px2(by_view, spread)), dtype=np.float64)
    choices = image_search.joint_maximum(
        [search.offsets for search in searches], [search.total for search in searches], information
    )
    is_line = len(searches[0].axes) == 1
    refined_marks = [
        (element_search.refine_pole if is_line else element_search.refine_sign)(search, choice)
        for search, choice in zip(searches, choices, strict=True)
    ]
    offset = np.concatenate([result.offset for result in refined_marks])
    pull = float(np.sqrt(offset @ information @ offset / len(offset)))
    worst = min(choice.total for choice in choices)
    moment = (worst, pull, log_growth(track))
    marks = [result.mark for result in refined_marks]
    if is_line:
        targets = [search.expected.reference.target for search in searches]
        marks = whole_marks(targets, marks, [float(search.size_px[0]) for search in searches])
    return {
        k: image_search.PropagatedMark(
            mark,
            result.what,
            np.array([*result.evidence, _apart_px(result, refined_marks), *moment]),
            is_longer=is_line and mark.ends_px.tolist() != result.mark.ends_px.tolist(),
        )
        for k, mark, result in zip(by_view, marks, refined_marks, strict=True)
    }


def _apart_px(result: image_search.RefinedMark, marks: Sequence[image_search.RefinedMark]) -> float:
    """Return how far the offset in one image is from those in the others; 0 without others."""
    return max(float(np.abs(result.offset - other.offset).max()) for other in marks)
