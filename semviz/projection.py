"""Map elements in an image, for drawing: cut at the camera, so that half a pole is half a pole."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.pose import Pose

NEAR_M = 0.5
"""Poles are cut off nearer than this."""
MARGIN = 0.25
"""Elements count as near the image up to this share of its size outside."""


@dataclass(frozen=True, eq=False)
class Projected:
    """n elements of a map as seen by a camera; NaN where there is nothing to see."""

    anchor_px: FloatArray
    """(n, 2)"""
    end_px: FloatArray
    """(n, 2) NaN for signs."""
    shown: BoolArray
    """(n,) in front of the camera and in or near the image."""
    behind: BoolArray
    """(n,) wholly behind the camera."""


def project_elements(elements: Elements3D, T_camera_map: Pose, camera: Camera) -> Projected:
    """Elements (n) of the map frame in the image."""
    anchor, end = T_camera_map.apply(elements.anchor_m), T_camera_map.apply(elements.end_m)
    behind = np.fmax(anchor[:, 2], end[:, 2]) < NEAR_M
    anchor, end = _cut(anchor, end), _cut(end, anchor)
    anchor_px, end_px = camera.project(anchor), camera.project(end)
    size = np.array([camera.width, camera.height])
    low = np.fmin(anchor_px, end_px)
    high = np.fmax(anchor_px, end_px)
    shown = (high > -MARGIN * size).all(axis=1) & (low < (1 + MARGIN) * size).all(axis=1)
    return Projected(anchor_px, end_px, np.asarray(shown), np.asarray(behind))


def _cut(points: FloatArray, others: FloatArray) -> FloatArray:
    """Points (n, 3) behind ``NEAR_M`` move along the line to their other end until it."""
    span = others[:, 2] - points[:, 2]
    behind = (points[:, 2] < NEAR_M) & (others[:, 2] > NEAR_M)
    share = np.where(behind, (NEAR_M - points[:, 2]) / np.where(span == 0, 1.0, span), 0.0)
    moved = points + share[:, None] * (others - points)
    return np.where(behind[:, None], moved, points)


def offsets(
    observed: Elements2D, seen: Projected, pairs: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Where residual vectors start (k, 2), and the vectors (k, 2) from detection to map, px.

    ``pairs`` (k, 2) are rows (observed, projected). A sign's vector joins the two middles; a
    pole's goes from the middle of the detected line straight to the projected one.
    """
    i, j = pairs.T
    is_line = observed.is_line[i]
    start = observed.anchor_px[i].copy()
    start[is_line] = (observed.anchor_px[i][is_line] + observed.end_px[i][is_line]) / 2
    vector = seen.anchor_px[j] - start
    along = seen.end_px[j] - seen.anchor_px[j]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    direction = along / length
    across = vector - (vector * direction).sum(axis=1, keepdims=True) * direction
    return start, np.where(is_line[:, None], across, vector)
