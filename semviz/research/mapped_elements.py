"""The elements of a map that an image shows, projected at the true pose: a detector's truth.

What hides an element is not known to a map: an element in view may be behind a car or a house.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semviz.research.detector_evaluation import EvaluationImage
from semviz.workspace.localize import check_map_frame
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.views import camera_of
from semviz_core.base.camera import Rig
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import ImageGroundTruth
from semviz_core.research.training.detector_crops import clipped

NEAREST_DEPTH_M = 1.0
"""Elements that come nearer to the image plane are left out."""


@dataclass(frozen=True, eq=False)
class ElementsInView:
    """The n mapped elements in an image, cut off at its edges."""

    elements: Elements2D
    id: IntArray
    """(n,) ids in the map."""
    distance_m: FloatArray
    """(n,) horizontal distance from the left camera."""


def elements_in_view(
    semantic_map: SemanticMap, T_map_left: Pose, rig: Rig, side: Side, reach_m: float
) -> ElementsInView:
    """Return the mapped elements in an image, up to ``reach_m`` from the left camera's pose."""
    camera, T_camera_left = camera_of(rig, side)
    near = semantic_map.crop(T_map_left.translation, reach_m)
    T_camera_map = T_camera_left @ T_map_left.inverse()
    anchor, end = T_camera_map.apply(near.anchor_m), T_camera_map.apply(near.end_m)
    near = near[~(np.fmin(anchor[:, 2], end[:, 2]) < NEAREST_DEPTH_M)]
    anchor_px, end_px = (
        camera.project(T_camera_map.apply(points)) for points in (near.anchor_m, near.end_m)
    )
    line, size = near.is_line, (camera.width, camera.height)
    last = np.where(line[:, None], end_px, anchor_px)
    enter, leave = clipped(anchor_px, last, size)
    shown = np.where(line, leave > enter, camera.contains(anchor_px))
    elements = replace(
        Elements2D.from_ends(anchor_px, end_px, near.class_id),
        anchor_px=anchor_px + np.where(line, enter, 0.0)[:, None] * (last - anchor_px),
        end_px=anchor_px + leave[:, None] * (end_px - anchor_px),
        anchor_known=near.anchor_known & (~line | (enter == 0.0)),
        end_known=near.end_known & (leave == 1.0),
    )
    distance = np.linalg.norm((near.anchor_m - T_map_left.translation)[:, :2], axis=1)
    return ElementsInView(elements[shown], near.id[shown], distance[shown])


def mapped_images(
    workspace: Workspace,
    map_name: str,
    frames: range | None,
    sides: Sequence[Side],
    reach_m: float,
) -> tuple[EvaluationImage, ...]:
    """Return the images in which the map has elements, with these as the ground truth.

    A detection without a mapped element counts as false. Raise SemvizError if there are none.
    """
    source, semantic_map = workspace.source, workspace.read_map(map_name)
    check_map_frame(semantic_map, source)
    images = []
    for frame in source.frames:
        if frame.T_map_camera is None or (frames is not None and frame.index not in frames):
            continue
        for side in sides if source.rig.right is not None else ("left",):
            view = elements_in_view(semantic_map, frame.T_map_camera, source.rig, side, reach_m)
            if len(view.id):
                read = partial(source.image, frame.index, side)
                truth = partial(_truth, view, reach_m)
                image = EvaluationImage(workspace.name, frame.index, side, read, truth)
                center = semantic_map.triangle_center
                images.append(replace(image, triangle_center=center))
    if not images:
        raise SemvizError(
            f"{workspace.path}: no frame with a pose shows elements of map {map_name}; choose "
            "another with --map"
        )
    return tuple(images)


def _truth(view: ElementsInView, reach_m: float) -> ImageGroundTruth:
    return ImageGroundTruth.of(view.elements, view.distance_m, reach_m=reach_m)
