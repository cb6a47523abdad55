"""Draw the 3D pane for the page's state: map, cameras and what-if result."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz.inspector.scene import scene_cameras, scene_map
from semviz.inspector.state import State, View
from semviz.inspector.views import MapLegend
from semviz.runs.run import FrameRecord, Run
from semviz.web import viewpoint
from semviz.web.scene import BackdropLayer, PoseStyle, SceneDrawer
from semviz.web.viewpoint import Picker, Viewpoint
from semviz_annotation.mapping.backdrop import Backdrop
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage
from semviz_core.localizability.predict import Localizability

if TYPE_CHECKING:
    import viser

WHAT_IF = "/tried"
"""Prefix of its names in the scene."""
WHAT_IF_STYLE = PoseStyle("estimate", 2.2, dash_m=(0.3, 0.2))
ABOVE_M = np.array([0.0, 0.0, 2.0])
"""Offset of its label, above those of the other poses, which are often close."""


def draw_what_if_camera(scene: SceneDrawer, result: Localization | None) -> None:
    """Draw a dashed frustum with its name. None, or no pose: remove it."""
    if result is None or result.T_camera_map is None:
        scene.clear_under(WHAT_IF)
        return
    pose = result.T_camera_map.inverse()
    scene.draw_camera(WHAT_IF, pose, result.camera, WHAT_IF_STYLE)
    scene.draw_label(f"{WHAT_IF}-label", "what if", pose.translation + ABOVE_M)


class InspectorScene:
    """Draws a run's map once, and poses and pairs for each frame.

    ``on_click`` gets ``element`` and an id, or ``frame`` and a position, in a viser thread.
    ``path_of`` returns the file of a run, by name.
    """

    _map: scene_map.MapLayer
    _images: scene_cameras.CameraImages
    _usage: scene_map.Usage
    _coloring: scene_map.Coloring

    def __init__(
        self,
        server: "viser.ViserServer",
        on_click: Callable[[str, int], None],
        path_of: Callable[[str], Path],
    ) -> None:
        self._path_of = path_of
        self._scene = SceneDrawer(server)
        self._viewer = viewpoint.Viewer(server)
        self._picker = Picker(server, on_click)
        self._backdrop = BackdropLayer(self._scene)
        self._route = np.zeros((0, 3))
        self._forecast: Localizability | None = None
        self._shown: tuple[Pose, View] | None = None

    def show_run(self, run: Run, state: State) -> None:
        """Draw map and trajectories from scratch, then the state's frame."""
        self._route, self._forecast, self._usage = (
            scene_cameras.route(run),
            None,
            scene_map.usage_of(run),
        )
        with self._scene.atomic():
            self._scene.set_theme(state.theme)
            self._map = scene_map.MapLayer(self._scene, self._picker, run.semantic_map, self._route)
            self._images = scene_cameras.CameraImages(self._scene, run, self._path_of(state.run))
            self._recolor(run, state)
            scene_cameras.make_frames_pickable(self._picker, run)
        self._shown = None
        self.show_frame(run, state)

    def show_frame(self, run: Run, state: State) -> None:
        """Draw the state's frame: submap, prior, poses, pairs, selection."""
        record = run.frames[state.position]
        with self._scene.atomic():
            self._draw_around(run, record, state)
            self._draw_backdrop(state)
            self._draw_map(record, state)
            scene_cameras.draw_prior(self._scene, run, record, state.view)
            has_image = self._images.show(state.position, state.view)
            scene_cameras.draw_poses(self._scene, record, has_image, state)
            scene_cameras.label_poses(self._scene, record, state)
            scene_cameras.draw_pairs(self._scene, record.localization)
            self._select(run, state)
            self._follow(record, state)

    def preload_images(self, state: State) -> None:
        """Preload the images of the neighbouring frames, so that a step to them is fast."""
        self._images.preload(state.position)

    def select(self, run: Run, state: State) -> None:
        """Draw the ring around the selected element."""
        with self._scene.atomic():
            self._select(run, state)

    def recolor(self, run: Run, state: State) -> None:
        """Draw the map in the state's colours, with or without ellipsoids."""
        with self._scene.atomic():
            self._recolor(run, state)
            self._draw_map(run.frames[state.position], state)

    def legend(self, state: State) -> MapLegend:
        """Return the legend of the map's colours."""
        return scene_map.legend(state.colors, self._usage, state.theme)

    def set_view(self, run: Run, state: State) -> None:
        """Move to the state's viewpoint, even if it is unchanged."""
        self._shown = None
        self.show_frame(run, state)
        self.show_forecast(self._forecast, run, state)

    def go_to(self, target: Viewpoint, run: Run, state: State) -> None:
        """Move to a saved viewpoint."""
        self.set_view(run, state)
        self._viewer.show(target)

    def viewpoint(self) -> Viewpoint:
        """Return the user's present viewpoint."""
        return self._viewer.now()

    def render(self, width: int, height: int) -> ByteImage:
        """Return (height, width, 4) the user's view, rendered by the browser; see ``Viewer``."""
        return self._viewer.render(width, height)

    def show_forecast(self, predicted: Localizability | None, run: Run, state: State) -> None:
        """Draw the expected error along the route. None: remove it."""
        self._forecast = predicted
        with self._scene.atomic():
            if predicted is None or state.view == "camera":  # it would hide the image
                self._scene.clear_under(scene_map.FORECAST)
            else:
                scene_map.draw_forecast(self._scene, predicted, run.semantic_map.classes)

    def show_backdrop(self, backdrop: Backdrop | None, state: State) -> None:
        """Draw the drive's backdrop behind the map. None: remove it."""
        with self._scene.atomic():
            self._backdrop.use(backdrop)
            self._draw_backdrop(state)

    def show_what_if(self, result: Localization | None, state: State) -> None:
        """Draw the camera of a what-if result. None: remove it."""
        with self._scene.atomic():  # through the camera its frustum would be in the way
            draw_what_if_camera(self._scene, None if state.view == "camera" else result)

    def show_search_pose(self, shown: scene_cameras.SearchPose | None, state: State) -> None:
        """Draw the camera of a candidate pose of the search. None: remove it."""
        with self._scene.atomic():
            scene_cameras.draw_search_pose(self._scene, None if state.view == "camera" else shown)

    def show_base(self, base: scene_cameras.BaseFrame | None, state: State) -> None:
        """Draw the frame of the base run. None: remove it."""
        with self._scene.atomic():
            scene_cameras.draw_base(self._scene, None if state.view == "camera" else base)

    def _draw_backdrop(self, state: State) -> None:
        self._backdrop.draw(state.backdrop and state.view != "camera")  # that has the image

    def _recolor(self, run: Run, state: State) -> None:
        self._coloring = scene_map.coloring(
            state.colors, run.semantic_map, self._usage, self._scene
        )

    def _draw_around(self, run: Run, record: FrameRecord, state: State) -> None:
        """Draw ground and trajectories, but not through the camera: they hide the image."""
        was_camera = self._shown is not None and self._shown[1] == "camera"
        if state.view == "camera":
            self._scene.clear("/grid")
            self._scene.clear("/road")
            self._scene.clear_under(scene_cameras.TRAJECTORIES)
            return
        self._scene.draw_grid(scene_cameras.vehicle_pose(record).translation)
        if self._shown is None or was_camera:
            self._scene.draw_road(self._route)
            scene_cameras.draw_trajectories(self._scene, run)

    def _draw_map(self, record: FrameRecord, state: State) -> None:
        submap = record.localization.submap
        self._map.draw(scene_cameras.vehicle_pose(record).translation, self._coloring)
        if state.colors == "class":
            self._map.draw_submap(submap)
        else:  # these colours are of the whole map
            self._scene.clear("/submap")
        if state.ellipsoids:
            scene_map.draw_ellipsoids(self._scene, submap)
        else:
            self._scene.clear(scene_map.ELLIPSOIDS)

    def _select(self, run: Run, state: State) -> None:
        elements, id = run.semantic_map.elements, state.selection.element
        selected = elements[[] if id is None else np.flatnonzero(elements.id == id)]
        name = ""
        if len(selected):
            classes = run.semantic_map.classes
            name = classes.element_name(int(selected.class_id[0]), int(selected.id[0]))
        self._scene.highlight(selected, name)

    def _follow(self, record: FrameRecord, state: State) -> None:
        """Move to a new viewpoint, or move along with the vehicle."""
        viewer, pose, before = self._viewer, scene_cameras.vehicle_pose(record), self._shown
        self._shown = (pose, state.view)
        if state.view == "camera":
            viewer.show(viewpoint.through(pose, record.localization.camera))
        elif (before is None or before[1] != state.view) and state.view != "free":
            viewer.show(viewpoint.above(pose) if state.view == "above" else viewpoint.behind(pose))
        elif before is not None and before[0] is not pose:
            viewer.move_along(before[0], pose)
