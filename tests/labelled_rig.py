"""Label a recorded street in a workspace as a careful person would, from its truth."""

import numpy as np

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddMany, AddObservation
from semviz_annotation.labels.labels import new_id
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.rig_cameras import cameras_by_frame
from semviz_core.simulation.street import Street
from semviz_core.simulation.street_rig import (
    START_S,
    MountedCamera,
    body_pose,
    visible_at,
)

SIGMA_PX = 0.5


def true_pose(street: Street, frame: Frame, camera: MountedCamera) -> Pose:
    """Return where a camera was at the time of a frame's image."""
    return body_pose(street, frame.time_s - START_S) @ camera.T_body_camera


def label(
    workspace: Workspace, street: Street, cameras: dict[str, MountedCamera], sigma_px: float
) -> int:
    """Label everything that is visible, ``sigma_px`` off; return the number of labels."""
    added = labels_of(workspace, street, cameras, sigma_px)
    with workspace.open_labels() as store:
        store.apply(AddMany(tuple(added)), "ann")
    return len(added)


def labels_of(
    workspace: Workspace, street: Street, cameras: dict[str, MountedCamera], sigma_px: float
) -> list[AddObservation]:
    """Return labels of everything that is visible, ``sigma_px`` off; the first of an element has
    its class.

    ``cameras`` are those of the rig by name, or left and right.
    """
    source, rng = workspace.source, np.random.default_rng(0)
    camera_of = cameras_by_frame(source)
    names: dict[int, str] = {}
    added: list[AddObservation] = []
    for frame in source.frames:
        sides = source.rig.sides
        for side in sides:
            mount = cameras[camera_of.get(frame.index, side)]
            model = source.rig.left if source.rig.right is None else source.rig.right
            seen, ids = visible_at(street, model, true_pose(street, frame, mount))
            for row, number in enumerate(ids.tolist()):
                is_line = bool(seen.is_line[row])
                ends = [seen.anchor_px[row], *([seen.end_px[row]] if is_line else [])]
                places = [_clipped(px + rng.normal(0.0, sigma_px, 2), model.width, model.height)
                          for px in ends]  # fmt: skip
                is_new = number not in names
                added.append(
                    AddObservation(
                        observation_id=new_id(),
                        element_id=names.setdefault(number, new_id()),
                        frame_index=frame.index,
                        side=side,
                        anchor_px=places[0],
                        end_px=places[1] if is_line else None,
                        anchor_known=bool(seen.anchor_known[row]),
                        end_known=bool(seen.end_known[row]),
                        class_id=int(seen.class_id[row]) if is_new else None,
                    )
                )
    return added


def _clipped(pixel: FloatArray, width: int, height: int) -> tuple[float, float]:
    u, v = np.clip(pixel, 0.0, (width - 1.0, height - 1.0)).tolist()
    return u, v
