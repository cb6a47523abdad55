"""The 3D pane: what the state shows, drawn into the session's scene."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from semviz.inspector.forecast_view import FORECAST, draw_forecast
from semviz.inspector.session import State, View
from semviz.palette import residual_level
from semviz.recording.run import FrameRecord, Run
from semviz.web import shapes, viewpoint
from semviz.web.colors import mix
from semviz.web.scene import ALTERNATIVE, CAMERA_HEIGHT_M, CLICKABLE, ESTIMATE, TRUTH, Scene
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.errors import SemvizError
from semviz_core.localizability.predict import Localizability
from semviz_core.localization import Localization
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

ALTERNATIVES = tuple(f"/{letter}" for letter in "BCDEFGH")
POSES = {"/truth": TRUTH, "/estimate": ESTIMATE, **dict.fromkeys(ALTERNATIVES, ALTERNATIVE)}
LABELLED = ("/estimate", "/truth", *ALTERNATIVES[:2])
"""As many alternatives as the card lists: more labels would cover each other."""
COINCIDE_M = 1.0
UP_M = np.array([0.0, 0.0, 1.2])


class SceneView:
    """Draws a run's map once, and a frame's poses and pairs each time."""

    def __init__(self, server: "viser.ViserServer", on_click: Callable[[int], None]) -> None:
        self._scene = Scene(server)
        self._viewer = viewpoint.Viewer(server)
        self._on_click = on_click
        self._facing = np.zeros(0)
        self._path = np.zeros((0, 3))
        self._forecast: Localizability | None = None
        self._shown: tuple[Pose, View] | None = None

    def show_run(self, run: Run, state: State) -> None:
        """The whole map, faint, and the true path; then the state's frame."""
        scene, semantic_map = self._scene, run.semantic_map
        path = _path(run)
        with scene.server.atomic():
            scene.set_theme(state.theme)
            elements = semantic_map.elements
            self._path, self._forecast = path, None
            self._facing = shapes.facing(elements.anchor_m, path)
            scene.draw_elements(
                "/map", elements, semantic_map.classes, self._facing, strength=0.45, width_px=1.2
            )
            scene.make_clickable(elements, _vehicle(run.frames[0]).translation, self._on_click)
        self._shown = None
        self.show_frame(run, state)

    def show_frame(self, run: Run, state: State) -> None:
        """The state's frame: submap, prior, truth, estimate, alternatives, pairs, selection."""
        record = run.frames[state.position]
        one = record.localization
        with self._scene.server.atomic():
            self._draw_ground(record, state)
            self._draw_submap(run, record)
            self._draw_prior(record, run)
            self._draw_poses(record, state)
            self._label_poses(record, state)
            self._draw_pairs(one)
            self._select(run, state)
        self._follow(record, state)

    def select(self, run: Run, state: State) -> None:
        """The ring around the selected element."""
        with self._scene.server.atomic():
            self._select(run, state)

    def look(self, run: Run, state: State) -> None:
        """Turns to the state's viewpoint, again where it is the same."""
        self._shown = None
        self.show_frame(run, state)
        self.show_forecast(self._forecast, run, state)

    def show_forecast(self, predicted: Localizability | None, run: Run, state: State) -> None:
        """What the map lets a camera know along the route; None takes it away."""
        self._forecast = predicted
        with self._scene.server.atomic():
            if predicted is None or state.view == "camera":  # it would hide the image
                self._scene.clear_under(FORECAST)
            else:
                draw_forecast(self._scene, predicted, run.semantic_map.classes)

    def _draw_ground(self, record: FrameRecord, state: State) -> None:
        """Grid and road; through the camera they would hide its image."""
        if state.view == "camera":
            self._scene.clear("/grid")
            self._scene.clear("/road")
            return
        self._scene.draw_grid(_vehicle(record).translation)
        if self._shown is None or self._shown[1] == "camera":
            self._scene.draw_road(self._path)

    def _draw_submap(self, run: Run, record: FrameRecord) -> None:
        submap, scene = record.localization.submap, self._scene
        ids = run.semantic_map.elements.id
        order = np.argsort(ids)
        rows = order[np.searchsorted(ids, submap.id, sorter=order).clip(max=len(ids) - 1)]
        scene.draw_elements("/submap", submap, run.semantic_map.classes, self._facing[rows])
        if len(ids) > CLICKABLE:
            center = record.localization.prior.position_m
            scene.make_clickable(run.semantic_map.elements, center, self._on_click)

    def _draw_prior(self, record: FrameRecord, run: Run) -> None:
        prior = record.localization.prior
        scene, center = self._scene, _on_road(prior.position_m)
        color = scene.palette.prior
        scene.draw_circle("/prior", center, prior.horizontal_sigma_m, color)
        cross = center + 0.6 * np.array([[[-1.0, 0, 0], [1, 0, 0]], [[0, -1.0, 0], [0, 1, 0]]])
        scene.draw_lines("/prior-cross", cross, color, 1.5)
        sigma_m, right = prior.horizontal_sigma_m, _vehicle(record).rotation[:, 0]
        # beside the road, on the circle: the poses lie along the road
        scene.draw_label("/prior-label", f"prior ± {sigma_m:.1f} m", center - sigma_m * right)
        radius = run.info.options.get("crop_radius_m")
        scene.clear("/crop")
        if isinstance(radius, int | float):
            scene.draw_circle("/crop", center, float(radius), scene.palette.faint)

    def _draw_poses(self, record: FrameRecord, state: State) -> None:
        """From the camera itself its image is all there is; frusta would be in the way."""
        scene, camera = self._scene, record.localization.camera
        if state.view == "camera":
            for name in POSES:
                scene.clear(name)
            if record.image is not None:
                backdrop = _decoded(record.image)
                scene.draw_backdrop("/backdrop", _vehicle(record), camera, backdrop)
            return
        scene.clear("/backdrop")
        shown = _poses(record, state)
        image = None if record.image is None else _decoded(record.image, half=True)
        framed = "/estimate" if "/estimate" in shown else "/truth"
        for name, look in POSES.items():
            if name in shown:
                picture = image if name == framed else None
                scene.draw_camera(name, shown[name], camera, look, picture)
            else:
                scene.clear(name)

    def _label_poses(self, record: FrameRecord, state: State) -> None:
        """Names above the cameras; those that nearly coincide share a label."""
        shown = {} if state.view == "camera" else _poses(record, state)
        labels = together({name: shown[name].translation for name in LABELLED if name in shown})
        for name in LABELLED:
            label = f"{name}-label"
            if name in labels:
                self._scene.draw_label(label, labels[name], shown[name].translation + UP_M)
            else:
                self._scene.clear(label)

    def _draw_pairs(self, one: Localization) -> None:
        """Rays to the matched elements, in the colour of their residual."""
        scene, pose, fine = self._scene, _estimate(one), one.refinement
        if pose is None or fine is None:
            for level in range(len(scene.palette.residual)):
                scene.clear(f"/pairs/{level}")
            return
        size = np.sqrt(np.nansum(fine.residual_px**2, axis=1))
        levels = residual_level(size)
        targets = _middles(one)[fine.pairs[:, 1]]
        for level, color in enumerate(scene.palette.residual):
            ends = targets[levels == level]
            starts = np.broadcast_to(pose.translation, ends.shape)
            soft = mix(color, scene.palette.scene, 0.7)
            scene.draw_lines(f"/pairs/{level}", np.stack([starts, ends], axis=1), soft, 1.0)

    def _select(self, run: Run, state: State) -> None:
        elements = run.semantic_map.elements
        chosen = elements[np.flatnonzero(elements.id == state.selection.element)]
        name = ""
        if len(chosen):
            classes = run.semantic_map.classes
            name = classes.element_name(int(chosen.class_id[0]), int(chosen.id[0]))
        self._scene.highlight(chosen, name)

    def _follow(self, record: FrameRecord, state: State) -> None:
        """A new viewpoint is taken; otherwise the viewer is carried along with the vehicle."""
        viewer, pose, before = self._viewer, _vehicle(record), self._shown
        self._shown = (pose, state.view)
        if state.view == "camera":
            viewer.show(viewpoint.through(pose, record.localization.camera))
        elif before is None or before[1] != state.view:
            viewer.show(viewpoint.above(pose) if state.view == "above" else viewpoint.behind(pose))
        elif before[0] is not pose:
            viewer.move_along(before[0], pose)


def together(places_m: dict[str, FloatArray]) -> dict[str, str]:
    """Labels by the first of the names whose places (3,) lie within a metre of it."""
    groups: dict[str, list[str]] = {}
    for name, place in places_m.items():
        near = (one for one in groups if np.linalg.norm(places_m[one] - place) < COINCIDE_M)
        groups.setdefault(next(near, name), []).append(name.rpartition("/")[2])
    return {first: " + ".join(names) for first, names in groups.items()}


def _poses(record: FrameRecord, state: State) -> dict[str, Pose]:
    """T_map_camera of what is drawn of a frame, by name in the scene."""
    one = record.localization
    known = {"/truth": record.frame.T_map_camera, "/estimate": _estimate(one)}
    if state.alternatives:
        others = [other.T_camera_map.inverse() for other in one.alternatives]
        known |= dict(zip(ALTERNATIVES, others, strict=False))
    return {name: pose for name, pose in known.items() if pose is not None}


def _estimate(localization: Localization) -> Pose | None:
    pose = localization.T_camera_map
    return None if pose is None else pose.inverse()


def _vehicle(record: FrameRecord) -> Pose:
    """Where the viewer goes: the estimate, else the truth, else the prior facing along x."""
    pose = _estimate(record.localization) or record.frame.T_map_camera
    if pose is not None:
        return pose
    facing_x = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return Pose(facing_x, record.localization.prior.position_m)


def _path(run: Run) -> FloatArray:
    """(k, 3) camera centres: of the run where true poses are known, else of the map."""
    known = [one.frame.T_map_camera for one in run.frames if one.frame.T_map_camera is not None]
    if len(run.semantic_map.trajectory_m) > len(known):
        return run.semantic_map.trajectory_m
    return np.array([pose.translation for pose in known]).reshape(-1, 3)


def _middles(localization: Localization) -> FloatArray:
    submap = localization.submap
    poles = (submap.anchor_m + submap.end_m) / 2
    return np.where(submap.is_line[:, None], poles, submap.anchor_m)


def _on_road(position_m: FloatArray) -> FloatArray:
    return position_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.05]


def _decoded(jpeg: bytes, half: bool = False) -> ByteImage:
    """A frustum shows its image small: half the size is enough there, and quicker."""
    import cv2

    image = cv2.imdecode(
        np.frombuffer(jpeg, dtype=np.uint8),
        cv2.IMREAD_REDUCED_COLOR_2 if half else cv2.IMREAD_COLOR,
    )
    if image is None:
        raise SemvizError("the image of this frame is broken; localize again")
    return np.asarray(image[:, :, ::-1], dtype=np.uint8)
