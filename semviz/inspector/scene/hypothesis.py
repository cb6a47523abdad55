"""The camera of a pose that the search found, where a person asked to see it."""

from dataclasses import dataclass

import numpy as np

from semviz.web.scene import PoseLook, Scene
from semviz_core.camera import Camera
from semviz_core.pose import Pose

HYPOTHESIS = "/hypothesis"
"""All names of it in the scene begin so."""
LOOK = PoseLook("alternative", 2.2, dash_m=(0.3, 0.2))
ABOVE_M = np.array([0.0, 0.0, 1.6])
"""Of its label, above those of the other poses: it is often where they are."""


@dataclass(frozen=True)
class Hypothesis:
    """A pose of the search, with its letter."""

    letter: str
    T_map_camera: Pose
    camera: Camera


def draw_hypothesis(scene: Scene, shown: Hypothesis | None) -> None:
    """A dashed frustum with its letter; None takes it away."""
    if shown is None:
        scene.clear_under(HYPOTHESIS)
        return
    scene.draw_camera(HYPOTHESIS, shown.T_map_camera, shown.camera, LOOK)
    place_m = shown.T_map_camera.translation + ABOVE_M
    scene.draw_label(f"{HYPOTHESIS}-label", f"pose {shown.letter}", place_m)
