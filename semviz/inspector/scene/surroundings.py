"""Around a frame in 3D: what was known beforehand, and how far the submap reaches."""

import numpy as np

from semviz.inspector.scene.poses import vehicle
from semviz.inspector.session import View
from semviz.recording.run import FrameRecord, Run
from semviz.web.scene import CAMERA_HEIGHT_M, Scene
from semviz_core.arrays import FloatArray
from semviz_core.frame import Prior
from semviz_core.pose import Pose

CROSS_M = 0.6 * np.array([[[-1.0, 0, 0], [1, 0, 0]], [[0, -1.0, 0], [0, 1, 0]]])


def draw_prior(scene: Scene, run: Run, record: FrameRecord, view: View) -> None:
    """The fix with its uncertainty, and the circle within which the submap lies."""
    prior = record.localization.prior
    center, color = _on_road(prior.position_m), scene.palette.prior
    scene.draw_circle("/prior", center, prior.horizontal_sigma_m, color)
    scene.draw_lines("/prior-cross", CROSS_M, color, 1.5, T_map_local=Pose(np.eye(3), center))
    _label_prior(scene, prior, center, vehicle(record), view)
    radius = run.info.options.get("crop_radius_m")
    if isinstance(radius, int | float):
        scene.draw_circle("/crop", center, float(radius), scene.palette.faint)


def _label_prior(
    scene: Scene, prior: Prior, center_m: FloatArray, T_map_camera: Pose, view: View
) -> None:
    """On the prior's circle, on the side that is away from the vehicle and its labels."""
    away, (right, _, ahead) = center_m - T_map_camera.translation, T_map_camera.rotation.T
    is_right = bool(away @ right > 0.0)
    if view == "above":
        outwards = ahead if away @ ahead > 0.0 else -ahead
    else:
        outwards = right if is_right else -right
    place = center_m + prior.horizontal_sigma_m * outwards
    text = f"prior ± {prior.horizontal_sigma_m:.1f} m"
    scene.draw_label("/prior-label", text, place, "center-left" if is_right else "center-right")


def route(run: Run) -> FloatArray:
    """(k, 3) camera centres: of the run where true poses are known, else of the map."""
    known = [one.frame.T_map_camera for one in run.frames if one.frame.T_map_camera is not None]
    if len(run.semantic_map.trajectory_m) > len(known):
        return run.semantic_map.trajectory_m
    return np.array([pose.translation for pose in known]).reshape(-1, 3)


def _on_road(position_m: FloatArray) -> FloatArray:
    return position_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.05]
