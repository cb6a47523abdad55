"""Training images from a map: its elements, projected into every frame of a drive, are labels.

A map does not know what hides an element. So an element is a label in an image only where a label
or a stored detection agrees, or where one does shortly before and shortly after; elsewhere it is
ignored. What no map holds is ignored too: only the surroundings of labels count.
"""

from collections.abc import Sequence

import numpy as np

from semviz.presentation.progress import track
from semviz.research.detector_data import LabelledSide, boxes_of
from semviz.research.mapped_elements import ElementsInView, elements_in_view
from semviz.workspace.localize import check_map_frame
from semviz.workspace.observations import matched_rows
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_elements
from semviz_annotation.labels.proposals import load_proposals
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import joined
from semviz_core.base.frame import Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray
from semviz_core.common.errors import SemvizError

MOST_BETWEEN = 5
"""An element is taken to be visible between two agreeing images at most this many frames away."""


def mapped_sides(
    workspace: Workspace, map_name: str, frames: range | None = None
) -> list[LabelledSide]:
    """Return the images of a workspace that show elements of a map, frame by frame, left first.

    Raise SemvizError if no label or detection agrees with an element.
    """
    check_map_frame(workspace.read_map(map_name), workspace.source)
    sides: tuple[Side, ...] = ("left",) if workspace.source.rig.right is None else ("left", "right")
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
