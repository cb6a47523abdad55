"""A backdrop that is easy to see, without open3d: a coloured wall across the road."""

import numpy as np

from semviz.workspace.maps.backdrop import backdrop_path
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.backdrop import Backdrop, BackdropSource, save_backdrop
from semviz_annotation.mapping.depth_fusion import Cloud, FusionOptions

COLOR = (255, 90, 0)
AHEAD_M, SPACING_M = 3.0, 0.2


def put_backdrop(workspace: Workspace) -> Backdrop:
    """Stands before the first camera, between whoever looks from behind and all poles."""
    drive = workspace.source
    pose = drive.frames[0].T_map_camera
    assert pose is not None
    across, up = np.meshgrid(np.arange(-12.0, 12.0, SPACING_M), np.arange(-2.0, 9.0, SPACING_M))
    local = np.column_stack([across.ravel(), -up.ravel(), np.full(across.size, AHEAD_M)])
    colors = np.tile(np.array(COLOR) / 255.0, (across.size, 1))
    source = BackdropSource.of(drive.map_frame, drive.rig, drive.frames, FusionOptions())
    made = Backdrop.of(Cloud(pose.apply(local), colors, SPACING_M), source)
    save_backdrop(made, backdrop_path(workspace))
    return made
