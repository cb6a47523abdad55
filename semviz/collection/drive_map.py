"""The part of a collection's map that a drive needs to be localized."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz.workspace.localization.localize import ROAD_RADIUS_M
from semviz.workspace.localization.measurements import MeasurementFiles
from semviz.workspace.observations import FAR_M
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.drives.merged_map import in_frame
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.map_tiles.tiled_map import TiledMap

MARGIN_M = 100.0
"""How far beyond its radius a frame may ask: a simulated fix, or the tracker, is off by less."""


def map_along_drive(
    tiles: TiledMap,
    workspace: Workspace,
    frames: Sequence[Frame],
    crop_radius_m: float,
    files: MeasurementFiles,
) -> SemanticMap:
    """Return what frames of a workspace can see or ask for, in the workspace's frame.

    It lies around their poses, if they have any, and their measured fixes. Raise SemvizError if
    there is no element, or the frames of the map and the workspace cannot be compared.
    """
    name = f"the map of {tiles.store.where}"
    nothing = replace(tiles.head, decisions=())
    here = replace(nothing, frame=workspace.map_frame)
    posed = [frame.T_map_camera.translation for frame in frames if frame.T_map_camera is not None]
    way = np.reshape(posed + _fixes(files, workspace, frames, here), (-1, 3))
    there = in_frame(replace(here, trajectory_m=way), tiles.frame, str(workspace.path))
    reach_m = max(crop_radius_m, FAR_M, ROAD_RADIUS_M) + MARGIN_M
    part = in_frame(tiles.along(there.trajectory_m, reach_m), workspace.map_frame, name)
    if not len(part):
        raise SemvizError(
            f"{name} has no element within {reach_m:g} m of the drive {workspace.path}; is it of "
            "another place?"
        )
    if part.frame.origin is None:  # what the workspace knows of it
        part = replace(part, frame=workspace.map_frame)
    return part


def _fixes(
    files: MeasurementFiles, workspace: Workspace, frames: Sequence[Frame], here: SemanticMap
) -> list[FloatArray]:
    """Return the positions (3,) of measured fixes; heights that they do not tell are 0."""
    if files.priors is None:
        return []
    measured = files.read(workspace, replace(here, trajectory_m=np.zeros((1, 3))))
    priors = (measured.prior_of(frame) for frame in frames)
    return [prior.position_m for prior in priors if prior is not None]
