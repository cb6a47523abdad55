"""Where a scene is looked at from: behind the vehicle, above it, or through its camera."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semviz.web.scene import FIELD_OF_VIEW_DEG
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.camera import Camera
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose, heading_rad

if TYPE_CHECKING:
    import viser

UP = np.array([0.0, 0.0, 1.0])
PICTURE_S = 60.0
"""So long the browser may take to draw a picture."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """An eye (3,), what it looks at (3,), both in the map frame, and its field of view."""

    eye_m: FloatArray
    target_m: FloatArray
    tangents: tuple[float, float] | None = None
    """Half the width and half the height that must be seen at depth 1; None for the usual view."""

    def fov_rad(self, aspect: float) -> float:
        """Vertical field of view in a pane that is ``aspect`` times as wide as high."""
        if self.tangents is None:
            return float(np.deg2rad(FIELD_OF_VIEW_DEG))
        width, height = self.tangents
        return float(2.0 * np.arctan(max(height, width / aspect)))


def behind(T_map_camera: Pose) -> Viewpoint:
    """Over the shoulder: the vehicle and the road ahead."""
    center, ahead = T_map_camera.translation, _ahead(T_map_camera)
    return Viewpoint(center - 12.0 * ahead + 7.0 * UP, center + 8.0 * ahead)


def above(T_map_camera: Pose, height_m: float = 65.0) -> Viewpoint:
    """From above, driving direction up."""
    center, ahead = T_map_camera.translation, _ahead(T_map_camera)
    target = center + 12.0 * ahead
    return Viewpoint(target + height_m * UP - 0.02 * height_m * ahead, target)


def through(T_map_camera: Pose, camera: Camera) -> Viewpoint:
    """From the camera's centre along its optical axis, so that the whole image fits."""
    center = T_map_camera.translation
    axis = T_map_camera.rotation[:, 2]
    tangents = (camera.width / 2 / camera.K[0, 0], camera.height / 2 / camera.K[1, 1])
    return Viewpoint(center - 0.01 * axis, center + 5.0 * axis, tangents)


class Viewer:
    """Moves the cameras of everybody who looks at a scene, and of those who come later."""

    def __init__(self, server: "viser.ViserServer") -> None:
        self._server = server
        self._view = Viewpoint(np.array([-10.0, 0.0, 8.0]), np.zeros(3))
        server.on_client_connect(self._turn)

    def show(self, view: Viewpoint) -> None:
        """Takes a viewpoint."""
        self._view = view
        initial = self._server.initial_camera
        initial.position, initial.look_at = _triple(view.eye_m), _triple(view.target_m)
        for client in self._server.get_clients().values():
            self._turn(client)

    def now(self) -> Viewpoint:
        """Where the scene is looked at from at present; as last shown while nobody looks."""
        for client in self._server.get_clients().values():
            camera = client.camera
            return Viewpoint(np.array(camera.position), np.array(camera.look_at))
        return self._view

    def picture(self, width: int, height: int) -> ByteImage:
        """(height, width, 4) The scene as it is looked at, drawn by the browser; where nothing is,
        it is transparent. Takes a second. SemvizError while nobody looks."""
        for client in self._server.get_clients().values():
            try:
                return np.asarray(
                    client.get_render(height, width, transport_format="png", timeout=PICTURE_S)
                )
            except (TimeoutError, RuntimeError):
                break
        raise SemvizError("the 3D pane does not answer; wait until it is drawn, then try again")

    def move_along(self, before: Pose, after: Pose) -> None:
        """Carries the cameras along with the vehicle: each one's view relative to it stays."""
        self._view = _carried(self._view, before, after)
        for client in self._server.get_clients().values():
            camera = client.camera
            now = Viewpoint(np.array(camera.position), np.array(camera.look_at))
            moved = _carried(now, before, after)
            with client.atomic():
                camera.position, camera.look_at = moved.eye_m, moved.target_m

    def _turn(self, client: "viser.ClientHandle") -> None:
        with client.atomic():
            client.camera.position = self._view.eye_m
            client.camera.look_at = self._view.target_m
            client.camera.fov = self._view.fov_rad(client.camera.aspect)


def _carried(view: Viewpoint, before: Pose, after: Pose) -> Viewpoint:
    turn = Pose.from_rotvec((heading_rad(after) - heading_rad(before)) * UP, np.zeros(3))
    start, end = before.translation, after.translation
    eye, target = turn.apply(view.eye_m - start), turn.apply(view.target_m - start)
    return Viewpoint(end + eye, end + target, view.tangents)


def _ahead(T_map_camera: Pose) -> FloatArray:
    heading = heading_rad(T_map_camera)
    return np.array([np.cos(heading), np.sin(heading), 0.0])


def _triple(point: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(one) for one in point)
    return x, y, z
