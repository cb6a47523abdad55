"""The camera of an answer that is being tried, beside the one that was recorded."""

import numpy as np

from semviz.web.scene import PoseLook, Scene
from semviz_core.localization import Localization

TRIED = "/tried"
"""All names of it in the scene begin so."""
LOOK = PoseLook("estimate", 2.2, dash_m=(0.3, 0.2))
ABOVE_M = np.array([0.0, 0.0, 2.0])
"""Of its label, above those of the other poses: it is often where they are."""


def draw_tried(scene: Scene, tried: Localization | None) -> None:
    """A dashed frustum with its name; nothing without a pose."""
    if tried is None or tried.T_camera_map is None:
        scene.clear_under(TRIED)
        return
    pose = tried.T_camera_map.inverse()
    scene.draw_camera(TRIED, pose, tried.camera, LOOK)
    scene.draw_label(f"{TRIED}-label", "tried", pose.translation + ABOVE_M)
