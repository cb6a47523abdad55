"""Draw the map so far in viser: elements, open tracks, the cameras' path, the current frame.

Elements are those triangulated so far. Only what changed is redrawn. One thread at a time.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.tracks.detection_tracks import DetectionTrack, OpenTracks
from semviz.web.scene import TRUTH, BackdropLayer, SceneDrawer, class_rows, elements_ends
from semviz.web.shapes import Theme, element_segments, facing
from semviz.web.viewpoint import Pickable, Picker, Viewer, behind
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.backdrop import Backdrop
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray

if TYPE_CHECKING:
    import viser


class SceneElements:
    """The contents of the 3D scene; the same objects until they change. One thread at a time."""

    def __init__(
        self,
        labels: Callable[[], Labels],
        positions: ElementPositions,
        tracks: Callable[[], OpenTracks],
    ) -> None:
        self._labels = labels
        self._positions = positions
        self._last_tracks = tracks
        nothing = Elements3D.from_ends([], [], [], [])
        self._elements = -1, -1, nothing
        """As of this operation and version of the positions."""
        self._tracks: tuple[tuple[int, ...], Elements3D] = (), nothing
        """Those in these places."""

    def elements(self) -> Elements3D:
        """Return the elements triangulated so far, their numbers as ids, except those left out."""
        labels = self._labels()
        mapped = self._positions.mapped(labels)
        if self._elements[:2] != (labels.operation, self._positions.version):
            kept = {id_: at for id_, at in mapped.items() if not labels.is_left_out(id_)}
            elements = [labels.elements[element_id] for element_id in kept]
            shown = Elements3D.from_ends(
                [element.number for element in elements],
                [position.anchor_m for position in kept.values()],
                [position.end_m for position in kept.values()],
                [element.class_id for element in elements],
            )
            self._elements = labels.operation, self._positions.version, shown
        return self._elements[2]

    def tracks(self) -> Elements3D:
        """Return the open tracks as elements of the last map; their ids are places in
        ``track_at``."""
        tracks = self._last_tracks()
        places = tracks.places(self._labels())
        if self._tracks[0] is not places:
            rows = np.array(places, dtype=np.int64)
            self._tracks = places, tracks.tracks.elements[rows]
        return self._tracks[1]

    def open_tracks(self, element_ids: Iterable[str]) -> list[tuple[int, DetectionTrack]]:
        """Return the open tracks among some elements, with their places."""
        return self._last_tracks().named(element_ids, self._labels())

    def track_at(self, place: int) -> DetectionTrack:
        """Return a track of the last map by its place; raise IndexError if there is none."""
        return self._last_tracks().tracks.tracks[place]


NOWHERE = Pose.identity()
TRACK_DASH_M = (0.25, 0.2)
TRACK_PX = 1.5


@dataclass(frozen=True, eq=False)
class Shown:
    """The contents of the scene."""

    elements: Elements3D
    T_map_camera: Pose | None
    """Pose of the frame on screen."""
    tracks: Elements3D = field(default_factory=lambda: Elements3D.from_ends([], [], [], []))
    """Open tracks of detections, drawn like proposals."""
    marked: frozenset[int] = frozenset()
    """Numbers of the selected element and of those that the open decision is about."""
    marked_tracks: frozenset[int] = frozenset()
    """Ids in ``tracks`` of those that are selected, or that the open entry is about."""
    name: str = ""
    """Label on top of them."""


class AnnotatorScene:
    """Draws ``Shown`` into one viser server; redraws only what differs. One thread at a time."""

    def __init__(
        self,
        server: "viser.ViserServer",
        trajectory_m: FloatArray,
        camera: Camera,
        classes: ClassSet,
        on_click: Callable[[str, int], None],
    ) -> None:
        """``on_click`` gets ``element`` or ``track``, and the id of what was clicked."""
        self._scene = SceneDrawer(server)
        self._viewer = Viewer(server)
        self._trajectory_m = trajectory_m
        self._camera = camera
        self._classes = classes
        self._picker = Picker(server, on_click)
        self._backdrop = BackdropLayer(self._scene)
        self._shown: Shown | None = None

    def show(self, shown: Shown) -> None:
        before, self._shown = self._shown, shown
        with self._scene.atomic():
            if before is None:
                self._start(shown)
            else:
                self._follow(before, shown)
            if before is None or not _same(before.elements, shown.elements):
                self._draw_elements(shown)
            if before is None or not _same(before.tracks, shown.tracks):
                self._draw_tracks(shown)
            marked = _rows_of(shown.elements, shown.marked)
            marked = marked if len(marked) else _rows_of(shown.tracks, shown.marked_tracks)
            self._scene.highlight(marked, shown.name)

    def set_theme(self, theme: Theme) -> None:
        """Redraw everything in the colours of a theme."""
        shown = self._shown
        if shown is None or theme == self._scene.theme:
            return
        self._scene.set_theme(theme)
        self._draw_path()
        self._draw_frame(shown)
        self._draw_elements(shown)
        self._draw_tracks(shown)

    def show_backdrop(self, backdrop: Backdrop | None, shown: bool) -> None:
        """What stands behind the map, if anything."""
        with self._scene.atomic():
            self._backdrop.use(backdrop)
            self._backdrop.draw(shown)

    def _start(self, shown: Shown) -> None:
        self._draw_path()
        self._draw_frame(shown)
        self._viewer.show(behind(shown.T_map_camera or NOWHERE))

    def _follow(self, before: Shown, shown: Shown) -> None:
        if before.T_map_camera is shown.T_map_camera:
            return
        self._draw_frame(shown)
        if before.T_map_camera is not None and shown.T_map_camera is not None:
            self._viewer.move_along(before.T_map_camera, shown.T_map_camera)

    def _draw_path(self) -> None:
        self._scene.draw_road(self._trajectory_m)
        if len(self._trajectory_m) > 1:
            accent = self._scene.palette.accent
            self._scene.draw_path("/trajectory", self._trajectory_m, accent)

    def _draw_frame(self, shown: Shown) -> None:
        pose = shown.T_map_camera or NOWHERE
        self._scene.draw_grid(pose.translation)
        if shown.T_map_camera is not None:
            self._scene.draw_camera("/camera", pose, self._camera, TRUTH)
        else:
            self._scene.clear("/camera")

    def _draw_elements(self, shown: Shown) -> None:
        elements, classes = shown.elements, self._classes
        facing_rad = facing(elements.anchor_m, self._trajectory_m)
        styles, rows = self._scene.class_styles(classes), class_rows(elements.class_id, classes)
        self._scene.draw_elements("/map", elements, classes, facing_rad, styles, rows)
        self._picker.set_pickable("element", Pickable(elements.id, *elements_ends(elements)))

    def _draw_tracks(self, shown: Shown) -> None:
        """Draw open tracks dashed, in the colours of their classes."""
        tracks, classes = shown.tracks, self._classes
        facing_rad = facing(tracks.anchor_m, self._trajectory_m)
        styles, style_of = self._scene.class_styles(classes), class_rows(tracks.class_id, classes)
        for number, style in enumerate(styles):
            rows = np.flatnonzero(style_of == number)
            segments = element_segments(tracks[rows], classes, facing_rad[rows])
            name = f"/tracks/{number}"
            self._scene.draw_lines(name, segments, style.color, TRACK_PX, TRACK_DASH_M)
        self._picker.set_pickable("track", Pickable(tracks.id, *elements_ends(tracks)))


def _rows_of(elements: Elements3D, ids: frozenset[int]) -> Elements3D:
    return elements[np.flatnonzero(np.isin(elements.id, list(ids)))]


def _same(before: Elements3D, after: Elements3D) -> bool:
    return (
        np.array_equal(before.id, after.id)
        and np.array_equal(before.class_id, after.class_id)
        and np.array_equal(before.anchor_m, after.anchor_m)
        and np.array_equal(before.end_m, after.end_m, equal_nan=True)
    )
