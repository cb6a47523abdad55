"""A frame as the base run has it, beside that of the open run: its camera, and of its map what the
other map has not there."""

from dataclasses import dataclass

import numpy as np

from semviz.inspector.scene.poses import BESIDE_M
from semviz.recording.run import FrameRecord
from semviz.web.scene import UP_M, ElementLook, PoseLook, Scene, elements_ends
from semviz_core.arrays import FloatArray
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D

BASE = "/base"
"""All names of it in the scene begin so."""
LOOK = PoseLook("prior", 2.2, dash_m=(0.3, 0.2))
NEAR_M = 60.0
NAMED = 12
"""So many of the nearest elements at most have labels: each costs a draw call."""


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """What there is to draw."""

    name: str
    """Of the run."""
    record: FrameRecord
    elements: Elements3D
    """Those of its map that moved, went or became something else."""
    facing_rad: FloatArray
    """(n,) of them, the way that signs are turned."""
    classes: ClassSet


def draw_base(scene: Scene, base: BaseFrame | None) -> None:
    """A dashed grey camera, and faint elements with names; None takes all away."""
    scene.remove_under(BASE)
    if base is None:
        return
    one = base.record.localization
    if one.T_camera_map is not None:
        pose = one.T_camera_map.inverse()
        scene.draw_camera(BASE, pose, one.camera, LOOK)
        below = pose.translation - UP_M - BESIDE_M * pose.rotation[:, 0]
        scene.draw_label(f"{BASE}-label", base.name, below, "center-right")
    _draw_elements(scene, base, one.prior.position_m)


def _draw_elements(scene: Scene, base: BaseFrame, around_m: FloatArray) -> None:
    """Those near a point (3,), named at the foot: the selected one has its name above."""
    elements, classes = base.elements, base.classes
    low_m, _ = elements_ends(elements)
    distance = np.linalg.norm(elements.anchor_m[:, :2] - around_m[:2], axis=1)
    near = np.argsort(distance, kind="stable")[: int((distance < NEAR_M).sum())]
    looks, first = [ElementLook(scene.palette.prior, 1.7)], np.zeros(len(near), dtype=np.int64)
    name = f"{BASE}-map"
    scene.draw_elements(name, elements[near], classes, base.facing_rad[near], looks, first)
    for row in near[:NAMED].tolist():
        element = classes.element_name(int(elements.class_id[row]), int(elements.id[row]))
        text = f"{element} in {base.name}"
        scene.draw_label(f"{BASE}-map-{row}", text, low_m[row], "center-left")
