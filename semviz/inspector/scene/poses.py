"""Camera poses in 3D: truth, estimate, alternatives, and the rays to what was matched."""

import numpy as np

from semviz.inspector.session import State
from semviz.palette import residual_level
from semviz.recording.run import FrameRecord
from semviz.web.colors import mix
from semviz.web.scene import ALTERNATIVE, ESTIMATE, TRUTH, Scene
from semviz_core.arrays import FloatArray
from semviz_core.localization import Localization
from semviz_core.pose import Pose

ALTERNATIVES = tuple(f"/{letter}" for letter in "BCDEFGH")
POSES = {"/truth": TRUTH, "/estimate": ESTIMATE, **dict.fromkeys(ALTERNATIVES, ALTERNATIVE)}
LABELLED = ("/estimate", "/truth", *ALTERNATIVES[:2])
"""As many alternatives as the card lists: more labels would cover each other."""
COINCIDE_M = 1.0
BESIDE_M = 2.0
"""From a camera's centre to its label: just beyond the frustum."""
FACING_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def draw_poses(scene: Scene, record: FrameRecord, has_photo: bool, state: State) -> None:
    """The cameras; from the camera itself frusta would be in the way."""
    shown = {} if state.view == "camera" else _poses(record, state)
    for name, look in POSES.items():
        if name in shown:
            camera = record.localization.camera
            scene.draw_camera(name, shown[name], camera, look, fill=not has_photo)
        else:
            scene.clear(name)


def label_poses(scene: Scene, record: FrameRecord, state: State) -> None:
    """Names beside the cameras; those that nearly coincide share one.

    The truth's is on the right, all others on the left: truth and estimate, or truth and an
    alternative, may be close to each other; estimate and alternatives are not.
    """
    shown = {} if state.view == "camera" else _poses(record, state)
    labels = together({name: shown[name].translation for name in LABELLED if name in shown})
    for name in LABELLED:
        label = f"{name}-label"
        if name in labels:
            center, beside = shown[name].translation, BESIDE_M * shown[name].rotation[:, 0]
            if name == "/truth":
                scene.draw_label(label, labels[name], center + beside, "center-left")
            else:
                scene.draw_label(label, labels[name], center - beside, "center-right")
        else:
            scene.clear(label)


def draw_pairs(scene: Scene, one: Localization) -> None:
    """Rays to the matched elements, in the colour of their residual."""
    pose, fine = estimate(one), one.refinement
    if pose is None or fine is None:
        scene.clear_under("/pairs")
        return
    levels = residual_level(np.sqrt(np.nansum(fine.residual_px**2, axis=1)))
    targets = _middles(one)[fine.pairs[:, 1]]
    for level, color in enumerate(scene.palette.residual):
        ends = targets[levels == level]
        starts = np.broadcast_to(pose.translation, ends.shape)
        soft = mix(color, scene.palette.scene, 0.7)
        scene.draw_lines(f"/pairs/{level}", np.stack([starts, ends], axis=1), soft, 1.0)


def together(places_m: dict[str, FloatArray]) -> dict[str, str]:
    """Labels by the first of the names whose places (3,) lie within a metre of it."""
    groups: dict[str, list[str]] = {}
    for name, place in places_m.items():
        near = (one for one in groups if np.linalg.norm(places_m[one] - place) < COINCIDE_M)
        groups.setdefault(next(near, name), []).append(name.rpartition("/")[2])
    return {first: " + ".join(names) for first, names in groups.items()}


def estimate(localization: Localization) -> Pose | None:
    """T_map_camera; None where there is no answer."""
    pose = localization.T_camera_map
    return None if pose is None else pose.inverse()


def photographer(record: FrameRecord) -> Pose | None:
    """The camera that has the photo: the estimate, else the truth."""
    return estimate(record.localization) or record.frame.T_map_camera


def vehicle(record: FrameRecord) -> Pose:
    """Where the viewer goes: the photographer, else the prior facing along x."""
    pose = photographer(record)
    return Pose(FACING_X, record.localization.prior.position_m) if pose is None else pose


def _poses(record: FrameRecord, state: State) -> dict[str, Pose]:
    """T_map_camera of what is drawn of a frame, by name in the scene."""
    one = record.localization
    known = {"/truth": record.frame.T_map_camera, "/estimate": estimate(one)}
    if state.alternatives and not state.comparing:  # their letters would be taken for runs
        others = [other.T_camera_map.inverse() for other in one.alternatives]
        known |= dict(zip(ALTERNATIVES, others, strict=False))
    return {name: pose for name, pose in known.items() if pose is not None}


def _middles(localization: Localization) -> FloatArray:
    submap = localization.submap
    poles = (submap.anchor_m + submap.end_m) / 2
    return np.where(submap.is_line[:, None], poles, submap.anchor_m)
