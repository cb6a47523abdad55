"""Move a mark to the edges under it: a pole's axis, a sign's centre."""

from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_annotation.assist.pole_ends import with_visible_ends
from semviz_annotation.assist.score import probability
from semviz_annotation.labels.views import PosedView
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ElementClass
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import Axis, edge_support, find_axes, stripe
from semviz_core.subpixel.pole_fit import refine_axis
from semviz_core.subpixel.sign_outline import find_outlines

REACH_PX = 4.0
"""The largest error of a click across a pole."""
CLEAR = 0.6
"""Below this probability a mark stays where it was clicked."""
_SHORTEST_PX = 8.0
_THIN_PX, _DIFFERS = 4.0, 0.35
"""A thinner line must differ from both sides in this share of its rows."""
_AXES = 3
"""Candidates for a pole's axis that are tried, the likeliest first, until one is clear."""
_LARGEST_SHIFT = 0.75
"""Largest distance of a sign's centre from the click, in half sizes of the sign."""


@dataclass(frozen=True)
class Snapped:
    """A mark moved onto the edges in the image."""

    mark: Mark
    moved_px: float
    """Largest displacement of an end."""
    anchor_snapped: bool
    """Whether the peak was also found along the pole; always True for signs."""
    end_snapped: bool


@dataclass(frozen=True, eq=False)
class Snap:
    """A candidate for a snapped mark, with its evidence."""

    snapped: Snapped
    evidence: FloatArray
    size_px: float
    """A pole's width, or half a sign's mean width and height."""


def snap(
    image: MarkedImage, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snapped | None:
    """Return ``mark`` moved onto the edges in the image; None if they are not clear.

    A pole's ends move across to its axis, by at most ``reach_px``. Known ends also move along it to
    its visible end, if that is clear. A sign's centre is found from a click on its face; its class
    gives its shape, and the image what the middle of a triangle is.
    """
    candidate = best_snap(image, mark, element_class, reach_px)
    what = "snap pole" if mark.end_px is not None else "snap sign"
    if candidate is None or probability(what, candidate.evidence) < CLEAR:
        return None
    return candidate.snapped


def best_snap(
    image: MarkedImage, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snap | None:
    """Return the candidate of ``snap``, whatever its probability."""
    if mark.end_px is not None:
        return _pole(image, mark, reach_px)
    return _sign(image, mark, element_class)


def warm_up() -> None:
    """Compile what a snap runs, or load it from disk, by snapping to a drawn pole and signs."""
    size = 240
    camera = Camera(size, size, np.array([[size, 0.0, 120.0], [0.0, size, 120.0], [0.0, 0.0, 1.0]]))
    rgb = np.full((size, size, 3), 200, np.uint8)
    rgb[40:200, 40:48] = rgb[105:135, 135:165] = 40
    image = MarkedImage.of(PosedView(camera, Pose.identity()), rgb)
    for element_class in DEFAULT_CLASSES:
        is_line = element_class.kind == "line"
        mark = Mark((44.5, 42.0), (44.5, 198.0)) if is_line else Mark((150.5, 119.5))
        snap(image, mark, element_class)


def _pole(image: MarkedImage, mark: Mark, reach_px: float) -> Snap | None:
    marked = mark.ends_px
    if np.linalg.norm(marked[1] - marked[0]) < _SHORTEST_PX:
        return None
    best: Snap | None = None
    most = 0.0
    axes = find_axes(image, marked, reach_px, _AXES + 1)
    for axis in axes[:_AXES]:
        others = [other.score for other in axes if other is not axis]
        found = _on_axis(image, mark, axis, max(others, default=axis.score - 5.0), reach_px)
        clear = 0.0 if found is None else probability("snap pole", found.evidence)
        if clear > most:
            best, most = found, clear
        if most >= CLEAR:
            break
    return best


def _on_axis(
    image: MarkedImage, mark: Mark, found: Axis, next_score: float, reach_px: float
) -> Snap | None:
    """Return a pole on a candidate for its axis; None if it is too far, or only one edge."""
    marked = mark.ends_px
    axis = refine_axis(image, found)
    moved = np.linalg.norm(axis.ends_px - marked, axis=1)
    if moved.max() > reach_px + 1.0:
        return None
    differs = stripe(image, axis.ends_px, axis.width_px)
    if axis.width_px < _THIN_PX and differs < _DIFFERS:
        return None
    margin = found.score - next_score
    drift = np.abs(axis.ends_px - found.ends_px).max()
    evidence = np.array(
        [
            *edge_support(image, axis.ends_px, axis.width_px), differs, np.clip(margin, 0.0, 3.0),
            moved.max() / reach_px, drift, np.log(axis.width_px),
            np.log(np.linalg.norm(marked[1] - marked[0])),
        ]
    )  # fmt: skip
    across = replace(mark, anchor_px=pixel(axis.ends_px[0]), end_px=pixel(axis.ends_px[1]))
    snapped, peak, foot = with_visible_ends(image, across, axis.width_px, reach_px)
    furthest = float(np.linalg.norm(snapped.ends_px - marked, axis=1).max())
    return Snap(Snapped(snapped, furthest, peak, foot), evidence, axis.width_px)


def _sign(image: MarkedImage, mark: Mark, element_class: ElementClass) -> Snap | None:
    outlines = find_outlines(image, mark.ends_px[0], element_class.shape)
    if not outlines:
        return None
    best = outlines[0]
    middle = best.middle_px(image.triangle_center)
    shift = middle - mark.ends_px[0]
    if np.abs(shift / best.half_px).max() > _LARGEST_SHIFT:
        return None
    margins = [
        best.score - outline.score
        for outline in outlines[1:]
        if np.linalg.norm(outline.middle_px(image.triangle_center) - middle) > 1.0
    ]
    evidence = np.array(
        [*best.evidence[1:], best.score, min([5.0, *margins]), np.abs(shift / best.half_px).max()]
    )
    moved = replace(mark, anchor_px=pixel(middle))
    snapped = Snapped(moved, float(np.linalg.norm(shift)), True, False)
    return Snap(snapped, evidence, float(best.half_px.mean()))
