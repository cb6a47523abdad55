"""Mapped elements, projected into a frame in which they are not labelled yet."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.shot import pixel
from semviz_annotation.labels import Labels, Pixel
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import camera_of
from semviz_core.arrays import FloatArray
from semviz_core.camera import Rig
from semviz_core.pose import Pose
from semviz_core.sources.source import Side

REACH_M = 60.0
"""Elements further ahead are too small to label."""
ALONG = 9
"""Points of a pole that are looked at: both its ends may be out of the image, and it be in it."""


@dataclass(frozen=True)
class Ghost:
    """Where an element should be in one image."""

    element_id: str
    side: Side
    anchor_px: Pixel
    end_px: Pixel | None
    depth_m: float
    """Of its anchor, in this camera."""


def ghosts_in(
    frame_index: int,
    side: Side,
    T_camera_map: Pose,
    rig: Rig,
    labels: Labels,
    mapped: Mapping[str, Triangulated],
) -> tuple[Ghost, ...]:
    """What is expected in one image of a frame and not labelled there, nearest first.

    The frame's left camera is at ``T_camera_map``. An element counts as visible where some of it is
    inside, and all of it is less than ``REACH_M`` ahead.
    """
    if not mapped:
        return ()
    ids = list(mapped)
    ends_m = np.array([[mapped[one].anchor_m, mapped[one].end_m] for one in ids])
    found = [
        ghost
        for ghost in _in_image(ids, ends_m, T_camera_map, rig, side)
        if labels.find(ghost.element_id, frame_index, side) is None
    ]
    return tuple(sorted(found, key=lambda ghost: ghost.depth_m))


def _in_image(
    ids: list[str], ends_m: FloatArray, T_left_map: Pose, rig: Rig, side: Side
) -> list[Ghost]:
    """``ends_m`` is (n, 2, 3); the end is NaN for signs."""
    camera, T_camera_left = camera_of(rig, side)
    ends = (T_camera_left @ T_left_map).apply(ends_m)
    depth = ends[..., 2]
    near = ((depth > 0.5) & (depth < REACH_M)) | np.isnan(depth)
    pixels = camera.project(ends.reshape(-1, 3)).reshape(-1, 2, 2)
    along = pixels[:, :1] + np.linspace(0.0, 1.0, ALONG)[:, None] * (pixels[:, 1:] - pixels[:, :1])
    points = np.where(np.isnan(along), pixels[:, :1], along)
    inside = camera.contains(points.reshape(-1, 2)).reshape(-1, ALONG)
    rows = np.flatnonzero(near.all(axis=1) & inside.any(axis=1))
    return [
        Ghost(
            element_id=ids[row],
            side=side,
            anchor_px=pixel(pixels[row, 0]),
            end_px=None if np.isnan(pixels[row, 1]).any() else pixel(pixels[row, 1]),
            depth_m=float(depth[row, 0]),
        )
        for row in rows
    ]
