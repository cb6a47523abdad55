"""The map so far in viser: mapped elements, the cameras' path, the frame on screen."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semviz.web.colors import Theme
from semviz.web.picking import Offer, Picker
from semviz.web.scene import TRUTH, Scene, class_rows, elements_ends
from semviz.web.shapes import facing
from semviz.web.viewpoint import Viewer, behind
from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

NOWHERE = Pose.identity()


@dataclass(frozen=True, eq=False)
class Shown:
    """What the scene shows."""

    elements: Elements3D
    T_map_camera: Pose | None
    """Of the frame on screen."""
    marked: frozenset[int] = frozenset()
    """Numbers of the selected element and of those that a decision is about."""
    name: str = ""
    """Written on top of them."""


class SceneView:
    """Draws ``Shown`` into one viser server; redraws only what differs. One thread at a time."""

    def __init__(
        self,
        server: "viser.ViserServer",
        trajectory_m: FloatArray,
        camera: Camera,
        classes: ClassSet,
        on_click: Callable[[int], None],
    ) -> None:
        self._scene = Scene(server)
        self._viewer = Viewer(server)
        self._trajectory_m = trajectory_m
        self._camera = camera
        self._classes = classes
        self._picker = Picker(server, lambda _, number: on_click(number))
        self._before: Shown | None = None

    def show(self, shown: Shown) -> None:
        before, self._before = self._before, shown
        with self._scene.in_one_piece():
            if before is None:
                self._start(shown)
            else:
                self._follow(before, shown)
            if before is None or not _same(before.elements, shown.elements):
                self._draw_elements(shown)
            rows = np.flatnonzero(np.isin(shown.elements.id, list(shown.marked)))
            self._scene.highlight(shown.elements[rows], shown.name)

    def set_theme(self, theme: Theme) -> None:
        """Draws everything anew in other colours."""
        shown = self._before
        if shown is None or theme == self._scene.theme:
            return
        self._scene.set_theme(theme)
        self._draw_path()
        self._draw_frame(shown)
        self._draw_elements(shown)

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
        turned = facing(elements.anchor_m, self._trajectory_m)
        looks, rows = self._scene.class_looks(classes), class_rows(elements.class_id, classes)
        self._scene.draw_elements("/map", elements, classes, turned, looks, rows)
        self._picker.offer("element", Offer(elements.id, *elements_ends(elements)))


def _same(one: Elements3D, two: Elements3D) -> bool:
    return (
        np.array_equal(one.id, two.id)
        and np.array_equal(one.class_id, two.class_id)
        and np.array_equal(one.anchor_m, two.anchor_m)
        and np.array_equal(one.end_m, two.end_m, equal_nan=True)
    )
