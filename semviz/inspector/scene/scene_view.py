"""The 3D pane: what the state shows, drawn into the session's scene."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz.inspector.scene.base_run import BaseFrame, draw_base
from semviz.inspector.scene.coloring import Coloring, coloring, legend
from semviz.inspector.scene.ellipsoids import ELLIPSOIDS, draw_ellipsoids
from semviz.inspector.scene.forecast_band import FORECAST, draw_forecast
from semviz.inspector.scene.hypothesis import Hypothesis, draw_hypothesis
from semviz.inspector.scene.map_layer import MapLayer
from semviz.inspector.scene.photos import Photos
from semviz.inspector.scene.poses import draw_pairs, draw_poses, label_poses, vehicle
from semviz.inspector.scene.surroundings import draw_prior, route
from semviz.inspector.scene.trajectories import WAYS, draw_ways, offer_frames
from semviz.inspector.scene.tried import draw_tried
from semviz.inspector.scene.usage import Usage, usage_of
from semviz.inspector.session import State, View
from semviz.recording.run import FrameRecord, Run
from semviz.web import viewpoint
from semviz.web.picking import Picker
from semviz.web.scene import Scene
from semviz.web.viewpoint import Viewpoint
from semviz_core.arrays import ByteImage
from semviz_core.localizability.predict import Localizability
from semviz_core.localization import Localization
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

Json = dict[str, Any]


class SceneView:
    """Draws a run's map once, and a frame's poses and pairs each time.

    ``on_click`` is told what was clicked, ``element`` and its id or ``frame`` and its position,
    in a thread of viser's. ``path_of`` is asked for the file of a run, by name.
    """

    _map: MapLayer
    _photos: Photos
    _usage: Usage
    _coloring: Coloring

    def __init__(
        self,
        server: "viser.ViserServer",
        on_click: Callable[[str, int], None],
        path_of: Callable[[str], Path],
    ) -> None:
        self._path_of = path_of
        self._scene = Scene(server)
        self._viewer = viewpoint.Viewer(server)
        self._picker = Picker(server, on_click)
        self._route = np.zeros((0, 3))
        self._forecast: Localizability | None = None
        self._shown: tuple[Pose, View] | None = None

    def show_run(self, run: Run, state: State) -> None:
        """Map and ways, all anew; then the state's frame."""
        self._route, self._forecast, self._usage = route(run), None, usage_of(run)
        with self._scene.in_one_piece():
            self._scene.set_theme(state.theme)
            self._map = MapLayer(self._scene, self._picker, run.semantic_map, self._route)
            self._photos = Photos(self._scene, run, self._path_of(state.run))
            self._recolor(run, state)
            offer_frames(self._picker, run)
        self._shown = None
        self.show_frame(run, state)

    def show_frame(self, run: Run, state: State) -> None:
        """The state's frame: submap, prior, truth, estimate, alternatives, pairs, selection."""
        record = run.frames[state.position]
        with self._scene.in_one_piece():
            self._draw_around(run, record, state)
            self._draw_map(record, state)
            draw_prior(self._scene, run, record, state.view)
            has_photo = self._photos.show(state.position, state.view)
            draw_poses(self._scene, record, has_photo, state)
            label_poses(self._scene, record, state)
            draw_pairs(self._scene, record.localization)
            self._select(run, state)
            self._follow(record, state)

    def expect_photos(self, state: State) -> None:
        """Those of the frames beside the state's, so that a step to one of them is quick."""
        self._photos.expect(state.position)

    def select(self, run: Run, state: State) -> None:
        """The ring around the selected element."""
        with self._scene.in_one_piece():
            self._select(run, state)

    def recolor(self, run: Run, state: State) -> None:
        """The map in the state's colours, with or without ellipsoids."""
        with self._scene.in_one_piece():
            self._recolor(run, state)
            self._draw_map(run.frames[state.position], state)

    def legend(self, state: State) -> Json:
        """What the map's colours mean."""
        return legend(state.colors, self._usage, state.theme)

    def look(self, run: Run, state: State) -> None:
        """Turns to the state's viewpoint, again where it is the same."""
        self._shown = None
        self.show_frame(run, state)
        self.show_forecast(self._forecast, run, state)

    def stand(self, place: Viewpoint, run: Run, state: State) -> None:
        """Turns to a viewpoint of the person's own."""
        self.look(run, state)
        self._viewer.show(place)

    def viewpoint(self) -> Viewpoint:
        """Where the person looks from at present."""
        return self._viewer.now()

    def picture(self, width: int, height: int) -> ByteImage:
        """(height, width, 4) What the person looks at, drawn by their browser; see ``Viewer``."""
        return self._viewer.picture(width, height)

    def show_forecast(self, predicted: Localizability | None, run: Run, state: State) -> None:
        """What the map lets a camera know along the route; None takes it away."""
        self._forecast = predicted
        with self._scene.in_one_piece():
            if predicted is None or state.view == "camera":  # it would hide the image
                self._scene.clear_under(FORECAST)
            else:
                draw_forecast(self._scene, predicted, run.semantic_map.classes)

    def show_tried(self, tried: Localization | None, state: State) -> None:
        """The camera of an answer that is being tried; None takes it away."""
        with self._scene.in_one_piece():  # through the camera its frustum would be in the way
            draw_tried(self._scene, None if state.view == "camera" else tried)

    def show_hypothesis(self, shown: Hypothesis | None, state: State) -> None:
        """The camera of a pose of the search; None takes it away."""
        with self._scene.in_one_piece():
            draw_hypothesis(self._scene, None if state.view == "camera" else shown)

    def show_base(self, base: BaseFrame | None, state: State) -> None:
        """The frame as another run has it; None takes it away."""
        with self._scene.in_one_piece():
            draw_base(self._scene, None if state.view == "camera" else base)

    def _recolor(self, run: Run, state: State) -> None:
        self._coloring = coloring(state.colors, run.semantic_map, self._usage, self._scene)

    def _draw_around(self, run: Run, record: FrameRecord, state: State) -> None:
        """Ground and ways: drawn when the view changes from or to the camera's, which they hide."""
        was_camera = self._shown is not None and self._shown[1] == "camera"
        if state.view == "camera":
            self._scene.clear("/grid")
            self._scene.clear("/road")
            self._scene.clear_under(WAYS)
            return
        self._scene.draw_grid(vehicle(record).translation)
        if self._shown is None or was_camera:
            self._scene.draw_road(self._route)
            draw_ways(self._scene, run)

    def _draw_map(self, record: FrameRecord, state: State) -> None:
        submap = record.localization.submap
        self._map.draw(vehicle(record).translation, self._coloring)
        if state.colors == "class":
            self._map.draw_submap(submap)
        else:  # these colours are read off the whole map
            self._scene.clear("/submap")
        if state.ellipsoids:
            draw_ellipsoids(self._scene, submap)
        else:
            self._scene.clear(ELLIPSOIDS)

    def _select(self, run: Run, state: State) -> None:
        elements, wanted = run.semantic_map.elements, state.selection.element
        chosen = elements[[] if wanted is None else np.flatnonzero(elements.id == wanted)]
        name = ""
        if len(chosen):
            classes = run.semantic_map.classes
            name = classes.element_name(int(chosen.class_id[0]), int(chosen.id[0]))
        self._scene.highlight(chosen, name)

    def _follow(self, record: FrameRecord, state: State) -> None:
        """A new viewpoint is taken; otherwise the viewer is carried along with the vehicle."""
        viewer, pose, before = self._viewer, vehicle(record), self._shown
        self._shown = (pose, state.view)
        if state.view == "camera":
            viewer.show(viewpoint.through(pose, record.localization.camera))
        elif (before is None or before[1] != state.view) and state.view != "free":
            viewer.show(viewpoint.above(pose) if state.view == "above" else viewpoint.behind(pose))
        elif before is not None and before[0] is not pose:
            viewer.move_along(before[0], pose)
