"""Draw cameras in 3D: truth, estimate, prior, trajectories, images, candidates, base run.

Rays to matched elements have the colour of their residual. Browsers need two screen refreshes to
decode an image, so the images of neighbouring frames are in the scene already, hidden.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz.inspector.state import State, View
from semviz.presentation.plots import STATUS, residual_level
from semviz.runs.frame_table import STATUSES, frame_table
from semviz.runs.images import frame_image
from semviz.runs.run import FrameRecord, Run
from semviz.web.scene import (
    ALTERNATIVE,
    BACKDROP_DEPTH_M,
    CAMERA_HEIGHT_M,
    ESTIMATE,
    FRUSTUM_DEPTH_M,
    TRUTH,
    UP_M,
    ElementStyle,
    PoseStyle,
    SceneDrawer,
    elements_ends,
)
from semviz.web.scene_nodes import PointShape
from semviz.web.shapes import mix
from semviz.web.viewpoint import Pickable, Picker
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Status
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import decode_image

ALTERNATIVES = tuple(f"/{letter}" for letter in "BCDEFGH")
POSES = {"/truth": TRUTH, "/estimate": ESTIMATE, **dict.fromkeys(ALTERNATIVES, ALTERNATIVE)}
LABELLED = ("/estimate", "/truth", *ALTERNATIVES[:2])
"""The card lists as many alternatives: more labels would overlap."""
COINCIDE_M = 1.0
BESIDE_M = 2.0
"""Distance from a camera's centre to its label, just beyond the frustum."""
FACING_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def draw_poses(scene: SceneDrawer, record: FrameRecord, has_image: bool, state: State) -> None:
    """Draw the cameras. The view through the camera shows none: they would hide the image."""
    shown = {} if state.view == "camera" else _poses(record, state)
    for name, style in POSES.items():
        if name in shown:
            camera = record.localization.camera
            scene.draw_camera(name, shown[name], camera, style, fill=not has_image)
        else:
            scene.clear(name)


def label_poses(scene: SceneDrawer, record: FrameRecord, state: State) -> None:
    """Draw names beside the cameras; cameras that nearly coincide share one label.

    The truth has its label on the right, all others on the left: the truth may be close to
    another camera, but estimate and alternatives are never close to each other.
    """
    shown = {} if state.view == "camera" else _poses(record, state)
    labels = merge_labels({name: shown[name].translation for name in LABELLED if name in shown})
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


def draw_pairs(scene: SceneDrawer, localization: Localization) -> None:
    """Draw rays to the matched elements, in the colour of their residual."""
    pose, refinement = estimate(localization), localization.refinement
    if pose is None or refinement is None:
        scene.clear_under("/pairs")
        return
    levels = residual_level(np.sqrt(np.nansum(refinement.residual_px**2, axis=1)))
    targets = _centers_m(localization)[refinement.pairs[:, 1]]
    for level, color in enumerate(scene.palette.residual):
        ends = targets[levels == level]
        starts = np.broadcast_to(pose.translation, ends.shape)
        soft = mix(color, scene.palette.scene, 0.7)
        scene.draw_lines(f"/pairs/{level}", np.stack([starts, ends], axis=1), soft, 1.0)


def merge_labels(positions_m: dict[str, FloatArray]) -> dict[str, str]:
    """Return labels by name; names with positions (3,) within a metre share the first's label."""
    groups: dict[str, list[str]] = {}
    for name, position_m in positions_m.items():
        near = (
            group
            for group in groups
            if np.linalg.norm(positions_m[group] - position_m) < COINCIDE_M
        )
        groups.setdefault(next(near, name), []).append(name.rpartition("/")[2])
    return {first: " + ".join(names) for first, names in groups.items()}


def estimate(localization: Localization) -> Pose | None:
    """Return the estimated T_map_camera; None without a pose."""
    pose = localization.T_camera_map
    return None if pose is None else pose.inverse()


def image_camera_pose(record: FrameRecord) -> Pose | None:
    """Return T_map_camera of the camera that shows the image: the estimate, else the truth."""
    return estimate(record.localization) or record.frame.T_map_camera


def vehicle_pose(record: FrameRecord) -> Pose:
    """Return T_map_camera of the estimate, else the truth, else the prior facing along x."""
    pose = image_camera_pose(record)
    return Pose(FACING_X, record.localization.around_m) if pose is None else pose


def _poses(record: FrameRecord, state: State) -> dict[str, Pose]:
    """Return T_map_camera of all cameras of a frame, by name in the scene."""
    localization = record.localization
    poses = {"/truth": record.frame.T_map_camera, "/estimate": estimate(localization)}
    if state.alternatives and not state.comparing:  # A and B would be mistaken for the runs
        others = [other.T_camera_map.inverse() for other in localization.alternatives]
        poses |= dict(zip(ALTERNATIVES, others, strict=False))
    return {name: pose for name, pose in poses.items() if pose is not None}


def _centers_m(localization: Localization) -> FloatArray:
    submap = localization.submap
    poles = (submap.anchor_m + submap.end_m) / 2
    return np.where(submap.is_line[:, None], poles, submap.anchor_m)


TRAJECTORIES = "/ways"
"""Prefix of their names in the scene."""
MARKS: dict[Status, PointShape] = {"ok": "circle", "ambiguous": "diamond", "cannot": "sparkle"}
"""The viser shapes nearest to the status marks: disc, diamond, cross."""
MARK_M = 0.3
BELOW_M = np.array([0.0, 0.0, CAMERA_HEIGHT_M - 0.3])
"""Offset of trajectories and marks below the cameras, where they hide no frustum."""


def draw_trajectories(scene: SceneDrawer, run: Run) -> None:
    """Draw true and estimated camera centres, with gaps at frames without a pose, and marks."""
    palette = scene.palette
    table = frame_table(run)
    truth, estimated = table.truth_m - BELOW_M, table.estimate_m - BELOW_M
    scene.draw_path(f"{TRAJECTORIES}/truth", truth, mix(palette.truth, palette.scene, 0.5))
    scene.draw_path(
        f"{TRAJECTORIES}/estimate", estimated, mix(palette.estimate, palette.scene, 0.8)
    )
    positions_m = mark_positions_m(run)
    for status, shape in MARKS.items():
        rows = table.status == STATUSES.index(status)
        tone = STATUS[status]
        color = tone.dark if scene.theme == "dark" else tone.light
        scene.draw_points(f"{TRAJECTORIES}/{status}", positions_m[rows], color, MARK_M, shape)


def make_frames_pickable(picker: Picker, run: Run) -> None:
    """Make a click on a mark return the position of its frame in the run."""
    positions_m = mark_positions_m(run)
    picker.set_pickable("frame", Pickable(np.arange(len(positions_m)), positions_m, positions_m))


def mark_positions_m(run: Run) -> FloatArray:
    """Return (frames, 3) positions below the estimate, else the truth, else the prior."""
    table = frame_table(run)
    unknown = ~np.isfinite(table.estimate_m).all(axis=1, keepdims=True) & table.has_truth[:, None]
    return np.asarray(np.where(unknown, table.truth_m, table.around_m) - BELOW_M)


IMAGES = "/photos"
"""Prefix of their names in the scene."""
IMAGES_HELD = 3
"""The image of the frame, and one on each side."""


class CameraImages:
    """The camera images of one run, from the file ``path``."""

    def __init__(self, scene: SceneDrawer, run: Run, path: Path) -> None:
        self._scene = scene
        self._run = run
        self._path = path
        self._is_backdrop = False
        self._held: dict[str, tuple[int, ByteImage]] = {}
        """Position of the frame, and the image, by name in the scene."""

    def show(self, position: int, view: View) -> bool:
        """Show the image of the frame at ``position`` alone. Return whether it has one."""
        if self._is_backdrop != (view == "camera"):
            self._is_backdrop = not self._is_backdrop
            self._scene.remove_under(IMAGES)
            self._held.clear()
        for name in self._held:
            self._scene.clear(name)
        return self._draw(position, visible=True)

    def preload(self, position: int) -> None:
        """Add the images of the frames beside ``position``, hidden. Slow."""
        for near in (position + 1, position - 1):
            if 0 <= near < len(self._run.frames):
                with suppress(SemvizError):  # a broken image is reported when its frame is shown
                    self._draw(near, visible=False)

    def _draw(self, position: int, visible: bool) -> bool:
        record, image = self._run.frames[position], self._image(position)
        pose = vehicle_pose(record) if self._is_backdrop else image_camera_pose(record)
        if image is None or pose is None:
            return False
        depth_m = BACKDROP_DEPTH_M if self._is_backdrop else FRUSTUM_DEPTH_M
        camera = record.localization.camera
        self._scene.draw_image(_name(position), pose, camera, depth_m, image, visible)
        return True

    def _image(self, position: int) -> ByteImage | None:
        """Return the same object each time while it is held."""
        name = _name(position)
        if name not in self._held or self._held[name][0] != position:
            encoded = frame_image(self._run, self._path, position, "left")
            if encoded is None:
                return None
            self._held[name] = position, _decoded(encoded, half=not self._is_backdrop)
        return self._held[name][1]


def _name(position: int) -> str:
    return f"{IMAGES}/{position % IMAGES_HELD}"


def _decoded(encoded: bytes, half: bool) -> ByteImage:
    """Decode an image, at half the size for frusta, which show it small."""
    return decode_image(encoded, "the image of this frame", reduced=half)[:, :, ::-1]


BASE = "/base"
"""Prefix of its names in the scene."""
BASE_STYLE = PoseStyle("prior", 2.2, dash_m=(0.3, 0.2))
NEAR_M = 60.0
MAX_LABELS = 12
"""Labels of the nearest elements: each costs a draw call."""


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """A frame of the base run, with the elements of its map that changed."""

    name: str
    """Name of the run."""
    record: FrameRecord
    elements: Elements3D
    """Elements of the base's map that moved, were removed or changed class."""
    facing_rad: FloatArray
    """(n,) facing of the signs."""
    classes: ClassSet


def draw_base(scene: SceneDrawer, base: BaseFrame | None) -> None:
    """Draw the base's camera, dashed, and its changed elements with names. None: remove them."""
    scene.remove_under(BASE)
    if base is None:
        return
    localization = base.record.localization
    if localization.T_camera_map is not None:
        pose = localization.T_camera_map.inverse()
        scene.draw_camera(BASE, pose, localization.camera, BASE_STYLE)
        below = pose.translation - UP_M - BESIDE_M * pose.rotation[:, 0]
        scene.draw_label(f"{BASE}-label", base.name, below, "center-right")
    _draw_elements(scene, base, localization.around_m)


def _draw_elements(scene: SceneDrawer, base: BaseFrame, around_m: FloatArray) -> None:
    """Draw elements near a point (3,), named at the foot: a selection is named at the top."""
    elements, classes = base.elements, base.classes
    low_m, _ = elements_ends(elements)
    distance_m = np.linalg.norm(elements.anchor_m[:, :2] - around_m[:2], axis=1)
    near = np.argsort(distance_m, kind="stable")[: int((distance_m < NEAR_M).sum())]
    style, style_of = ElementStyle(scene.palette.prior, 1.7), np.zeros(len(near), dtype=np.int64)
    name = f"{BASE}-map"
    scene.draw_elements(name, elements[near], classes, base.facing_rad[near], [style], style_of)
    for row in near[:MAX_LABELS].tolist():
        element = classes.element_name(int(elements.class_id[row]), int(elements.id[row]))
        text = f"{element} in {base.name}"
        scene.draw_label(f"{BASE}-map-{row}", text, low_m[row], "center-left")


SEARCH_POSE = "/hypothesis"
"""Prefix of its names in the scene."""
SEARCH_POSE_STYLE = PoseStyle("alternative", 2.2, dash_m=(0.3, 0.2))
ABOVE_M = np.array([0.0, 0.0, 1.6])
"""Offset of its label, above those of the other poses, which are often close."""


@dataclass(frozen=True)
class SearchPose:
    """A pose of the search, with its letter."""

    letter: str
    T_map_camera: Pose
    camera: Camera


def draw_search_pose(scene: SceneDrawer, shown: SearchPose | None) -> None:
    """Draw a dashed frustum with its letter. None: remove it."""
    if shown is None:
        scene.clear_under(SEARCH_POSE)
        return
    scene.draw_camera(SEARCH_POSE, shown.T_map_camera, shown.camera, SEARCH_POSE_STYLE)
    position_m = shown.T_map_camera.translation + ABOVE_M
    scene.draw_label(f"{SEARCH_POSE}-label", f"pose {shown.letter}", position_m)


CROSS_M = 0.6 * np.array([[[-1.0, 0, 0], [1, 0, 0]], [[0, -1.0, 0], [0, 1, 0]]])


def draw_prior(scene: SceneDrawer, run: Run, record: FrameRecord, view: View) -> None:
    """Draw the prior, if any, with its sigma, and the circle of the submap."""
    prior = record.localization.prior
    if prior is None:
        for name in ("/prior", "/prior-cross", "/prior-label", "/crop"):
            scene.clear_under(name)
        return
    center, color = _on_road(prior.position_m), scene.palette.prior
    scene.draw_circle("/prior", center, prior.horizontal_sigma_m, color)
    scene.draw_lines("/prior-cross", CROSS_M, color, 1.5, T_map_local=Pose(np.eye(3), center))
    _label_prior(scene, prior, center, vehicle_pose(record), view)
    radius = run.info.options.get("crop_radius_m")
    if isinstance(radius, int | float):
        scene.draw_circle("/crop", center, float(radius), scene.palette.faint)


def _label_prior(
    scene: SceneDrawer, prior: Prior, center_m: FloatArray, T_map_camera: Pose, view: View
) -> None:
    """Draw the label on the prior's circle, on the side away from the vehicle and its labels."""
    offset_m, (right, _, ahead) = center_m - T_map_camera.translation, T_map_camera.rotation.T
    is_right = bool(offset_m @ right > 0.0)
    if view == "above":
        outwards = ahead if offset_m @ ahead > 0.0 else -ahead
    else:
        outwards = right if is_right else -right
    position_m = center_m + prior.horizontal_sigma_m * outwards
    text = f"prior ± {prior.horizontal_sigma_m:.1f} m"
    scene.draw_label(
        "/prior-label", text, position_m, "center-left" if is_right else "center-right"
    )


def route(run: Run) -> FloatArray:
    """Return (k, 3) camera centres: of the map's trajectory or the true poses, the longer one."""
    table = frame_table(run)
    if len(run.semantic_map.trajectory_m) > table.has_truth.sum():
        return run.semantic_map.trajectory_m
    return table.truth_m[table.has_truth]


def _on_road(position_m: FloatArray) -> FloatArray:
    return position_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.05]
