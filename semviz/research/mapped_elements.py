"""The elements of a map that an image shows, projected at the true pose: a detector's truth.

A map does not know what hides an element: one in view may be behind a car or a house. A detector is
evaluated on all of them. It is trained on those where a label or a stored detection agrees, or
where one does shortly before and shortly after; the others are ignored in training. What no map
holds is ignored too: only the surroundings of labels count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semviz.presentation.terminal import track
from semviz.research.detector_evaluation import EvaluationImage
from semviz.research.workspace_data import LabelledSide, boxes_of
from semviz.workspace.chosen_frames import check_map_frame
from semviz.workspace.observations import matched_rows
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_elements
from semviz_annotation.labels.proposals import load_proposals
from semviz_annotation.labels.views import camera_of
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.camera import Rig
from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import Elements2D, joined
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import ImageGroundTruth
from semviz_core.research.training.detector_crops import clipped

NEAREST_DEPTH_M = 1.0
"""Elements that come nearer to the image plane are left out."""
MOST_BETWEEN = 5
"""An element is taken to be visible between two agreeing images at most this many frames away."""


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


def mapped_sides(
    workspace: Workspace, map_name: str, frames: range | None = None
) -> list[LabelledSide]:
    """Return the images of a workspace that show elements of a map, frame by frame, left first.

    Raise SemvizError if no label or detection agrees with an element.
    """
    check_map_frame(workspace.read_map(map_name), workspace.source)
    sides = workspace.source.rig.sides
    labelled = [row for side in sides for row in _of_side(workspace, map_name, side, frames)]
    if not labelled:
        raise SemvizError(
            f"{workspace.path}: no label or detection agrees with an element of map {map_name}; "
            f"run 'semviz detect {workspace.path}' first, or choose another map"
        )
    return sorted(labelled, key=lambda row: (row.frame_index, row.side))


def _of_side(
    workspace: Workspace, map_name: str, side: Side, frames: range | None
) -> list[LabelledSide]:
    """Return the images of one camera with their labels."""
    semantic_map, rig = workspace.read_map(map_name), workspace.source.rig
    posed = [
        (frame.index, frame.T_map_camera)
        for frame in workspace.source.frames
        if frame.T_map_camera is not None and (frames is None or frame.index in frames)
    ]
    views = [
        elements_in_view(semantic_map, pose, rig, side, RANGE_M[1])
        for _, pose in track(posed, f"projecting into {side} images", len(posed))
    ]
    agreed = _agreed(workspace, semantic_map, side, [index for index, _ in posed], views)
    visible = bridged(np.array(agreed).reshape(len(posed), -1))
    labelled = []
    for (index, _), view, ids in zip(posed, views, visible, strict=True):
        taught = np.isin(view.id, np.flatnonzero(ids))
        if taught.any():
            doubtful = boxes_of(view.elements[~taught])
            labelled.append(
                LabelledSide(workspace.path, index, side, view.elements[taught], False, doubtful)
            )
    return labelled


def _agreed(
    workspace: Workspace,
    semantic_map: SemanticMap,
    side: Side,
    indices: Sequence[int],
    views: Sequence[ElementsInView],
) -> list[BoolArray]:
    """Return for each image (ids,) whether a label or detection agrees with the element."""
    labels = workspace.read_labels()
    proposals = load_proposals(workspace.proposals_path, workspace.classes)
    count = 1 + max((int(view.id.max()) for view in views if len(view.id)), default=-1)
    agreed = []
    for index, view in zip(indices, views, strict=True):
        detected = as_elements(proposals.in_frame(index, side), semantic_map.triangle_center)
        seen = joined(observe(labels, index, side, semantic_map)[0], detected)
        rows = matched_rows(seen, view.elements)
        is_agreed = np.zeros(count, bool)
        is_agreed[view.id[rows[rows >= 0]]] = True
        agreed.append(is_agreed)
    return agreed


def bridged(agreed: BoolArray) -> BoolArray:
    """Return (images, ids) what is seen, or is between two images that see it, close to both."""
    images = np.arange(len(agreed))[:, None]
    never = 10 * len(agreed) + 10 * MOST_BETWEEN
    before = np.maximum.accumulate(np.where(agreed, images, -never), axis=0)
    after = np.minimum.accumulate(np.where(agreed, images, never)[::-1], axis=0)[::-1]
    near = (images - before <= MOST_BETWEEN) & (after - images <= MOST_BETWEEN)
    return np.asarray(agreed | near)
