"""Where a mapped element is expected in the images of one moment, and how much of it is in view.

The covariance (px^2) of the position is joint over views and ends. Poles are assumed upright within
a tolerance. A proposal of an element that is half out of view is not sure: half a sign looks much
the same one sign further, and its centre may lie outside the image, where no mark can be.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.assist.appearance import sign_half_size
from semviz_annotation.assist.marked_image import Mark, MarkedImage, ProposedMark, clip_to_image
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray

SIGMA_PX = 1.5
"""Error of an expected position due to pose errors."""
_UPRIGHT_RAD = 0.02
_APART_PX = 0.4
"""Additional error between the calibrated cameras of one moment."""


def expected_px(element: Triangulated, view: PosedView) -> FloatArray | None:
    """Return an element's projection (1 or 2, 2) px; None if it is out of the image."""
    points = np.stack([element.anchor_m, element.end_m])[: 1 + element.is_line]
    pixels = view.project(points)
    if not np.isfinite(pixels).all():
        return None
    along = np.linspace(0.0, 1.0, 9)[:, None]
    return (
        pixels if view.camera.contains(pixels[0] + along * (pixels[-1] - pixels[0])).any() else None
    )


def upright(element: Triangulated) -> Triangulated:
    """Return a pole updated by the prior that poles are upright within ``_UPRIGHT_RAD``.

    One stereo pair hardly shows how far a pole leans towards it, but other frames see it from the
    side. A Kalman update of the Gaussian; z is up in the map frame.
    """
    if not element.is_line:
        return element
    ends = np.concatenate([element.anchor_m, element.end_m])
    length = float(np.linalg.norm(element.end_m - element.anchor_m))
    H = np.array([[-1.0, 0, 0, 1.0, 0, 0], [0, -1.0, 0, 0, 1.0, 0]])
    P = element.covariance_m2
    S = H @ P @ H.T + (_UPRIGHT_RAD * length) ** 2 * np.eye(2)
    gain = P @ H.T @ np.linalg.inv(S)
    ends = ends - gain @ (H @ ends)
    return replace(element, anchor_m=ends[:3], end_m=ends[3:], covariance_m2=P - gain @ H @ P)


def spread_px2(element: Triangulated, views: Sequence[PosedView], sigma_px: float) -> FloatArray:
    """Return the covariance (v, e, 2, v, e, 2) px^2 of an element's e projected ends in v views.

    The pose error of the moment (``sigma_px``) is common to all views. The element's own covariance
    adds to it; its depth error moves the projections in two views apart.
    """
    points = (element.anchor_m, element.end_m)[: 1 + element.is_line]
    size = len(points)
    blocks = np.zeros((len(views), size, 2, size, 3))
    for v, view in enumerate(views):
        for k, point in enumerate(points):
            blocks[v, k, :, k] = view.jacobian(point)
    J = blocks.reshape(-1, 3 * size)
    covariance = J @ element.covariance_m2[: 3 * size, : 3 * size] @ J.T
    alike = np.tile(np.eye(2), (len(views) * size, len(views) * size))
    own = np.kron(np.eye(len(views)), np.tile(np.eye(2), (size, size)))
    covariance += sigma_px**2 * alike + _APART_PX**2 * own
    return covariance.reshape(len(views), size, 2, len(views), size, 2)


SIGN_RADIUS_M = 0.35
"""Half the width of a usual sign; one that is measured may be larger, never smaller."""
MIN_SHARE = {"pole": 0.5, "sign": 0.75}
"""Visible shares from which a proposal may be sure. A sign's is higher, because its size and, by a
wrong pose, its place are only roughly known."""
CUT_SCORE = 0.5
"""The largest score of a proposal with less in view."""


def half_size_m(
    element: Triangulated, image: MarkedImage, mark: Mark, element_class: ElementClass
) -> FloatArray:
    """Return half of a sign's width and height (2,) m, as measured where it is marked."""
    depth_m = float(image.view.depth_m(element.anchor_m[None])[0])
    half_m = sign_half_size(image, mark.ends_px[0], element_class)
    half_m = half_m * max(depth_m, 0.0) / image.view.camera.K[0, 0]
    return np.asarray(np.maximum(half_m, SIGN_RADIUS_M))


def visible_share(
    element: Triangulated, view: PosedView, half_m: FloatArray | float = SIGN_RADIUS_M
) -> float:
    """Return the share of an element that is in an image: of a pole's length, or a sign's area.

    0 behind the camera. ``element`` and ``view`` share the map frame. ``half_m`` is half of a
    sign's width and height, or one number for both.
    """
    points = np.stack([element.anchor_m, element.end_m])[: 1 + element.is_line]
    pixels = view.project(points)
    if not np.isfinite(pixels).all():
        return 0.0
    if element.is_line:
        return _share_of_line(pixels, view)
    half_px = view.camera.K[0, 0] * half_m / float(view.depth_m(points)[0])
    size = np.array([view.camera.width, view.camera.height])
    low = np.clip(pixels[0] - half_px, -0.5, size - 0.5)
    high = np.clip(pixels[0] + half_px, -0.5, size - 0.5)
    return min(float(np.prod((high - low) / (2.0 * half_px))), 1.0)


def _share_of_line(pixels: FloatArray, view: PosedView) -> float:
    part = clip_to_image(Mark((0.0, 0.0)), pixels, view.camera).ends_px
    if not view.camera.contains(part).all():
        return 0.0
    length = max(float(np.linalg.norm(pixels[1] - pixels[0])), 1e-9)
    return float(np.linalg.norm(part[1] - part[0])) / length


def not_sure_if_cut(
    proposed: ProposedMark | None,
    element: Triangulated | None,
    view: PosedView,
    marked: tuple[MarkedImage, Mark],
    element_class: ElementClass,
) -> ProposedMark | None:
    """Return a proposal with ``CUT_SCORE`` at most if too little of its element is in view.

    ``marked`` is where it is labelled; a sign is as large as it is there.
    """
    if proposed is None or element is None:
        return proposed
    half_m = SIGN_RADIUS_M if element.is_line else half_size_m(element, *marked, element_class)
    share = visible_share(element, view, half_m)
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
