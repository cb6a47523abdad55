"""How much of an element is in an image: a proposal of one that is half out of view is not sure.

Half a sign looks much the same one sign further, and its centre may lie outside the image, where
no mark can be.
"""

from dataclasses import replace

import numpy as np

from semviz_annotation.assist.marked_image import Mark, ProposedMark, clip_to_image
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.common.arrays import FloatArray

SIGN_RADIUS_M = 0.35
"""Half the width of a usual sign."""
MIN_SHARE = {"pole": 0.5, "sign": 0.75}
"""Visible shares from which a proposal may be sure. A sign's is higher, because its size and, by a
wrong pose, its place are only roughly known."""
CUT_SCORE = 0.5
"""The largest score of a proposal with less in view."""


def visible_share(element: Triangulated, view: PosedView) -> float:
    """Return the share of an element that is in an image: of a pole's length, or a sign's area.

    0 behind the camera. ``element`` and ``view`` share the map frame.
    """
    points = np.stack([element.anchor_m, element.end_m])[: 1 + element.is_line]
    pixels = view.project(points)
    if not np.isfinite(pixels).all():
        return 0.0
    if element.is_line:
        return _share_of_line(pixels, view)
    radius_px = view.camera.K[0, 0] * SIGN_RADIUS_M / float(view.depth_m(points)[0])
    size = np.array([view.camera.width, view.camera.height])
    low = np.clip(pixels[0] - radius_px, -0.5, size - 0.5)
    high = np.clip(pixels[0] + radius_px, -0.5, size - 0.5)
    return min(float(np.prod((high - low) / (2.0 * radius_px))), 1.0)


def _share_of_line(pixels: FloatArray, view: PosedView) -> float:
    part = clip_to_image(Mark((0.0, 0.0)), pixels, view.camera).ends_px
    if not view.camera.contains(part).all():
        return 0.0
    length = max(float(np.linalg.norm(pixels[1] - pixels[0])), 1e-9)
    return float(np.linalg.norm(part[1] - part[0])) / length


def not_sure_if_cut(
    proposed: ProposedMark | None, element: Triangulated | None, view: PosedView
) -> ProposedMark | None:
    """Return a proposal with ``CUT_SCORE`` at most if too little of its element is in view."""
    if proposed is None or element is None:
        return proposed
    share = visible_share(element, view)
    if share >= MIN_SHARE["pole" if element.is_line else "sign"]:
        return proposed
    return replace(proposed, score=min(proposed.score, CUT_SCORE))


def matched_element(
    here: PosedView, mark: Mark, there: PosedView, found: ProposedMark | None
) -> Triangulated | None:
    """Return the element that two marks show; None if they do not fix its position."""
    if found is None:
        return None
    rows = [mark.at(0, "left"), found.mark.at(0, "right")]
    element = triangulate([here, there], rows)
    return None if isinstance(element, TriangulationFailure) else element
