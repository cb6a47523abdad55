"""Viewpoints of a 3D scene, and the element under the pointer.

A viewpoint is behind the vehicle, above it, or through its camera. viser reports the ray of
every click. The nearest segment is computed on the server, which costs the browser nothing:
100,000 segments take about 4 ms.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from semviz.web.scene import FIELD_OF_VIEW_DEG
from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    import viser

UP = np.array([0.0, 0.0, 1.0])
RENDER_TIMEOUT_S = 60.0
"""How long the browser may take to render an image."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """An eye (3,) and its target (3,), both in the map frame, and a field of view."""

    eye_m: FloatArray
    target_m: FloatArray
    tangents: tuple[float, float] | None = None
    """Half the width and half the height to be seen at depth 1; None: the default field of view."""

    def fov_rad(self, aspect: float) -> float:
        """Return the vertical field of view in a pane that is ``aspect`` times as wide as high."""
        if self.tangents is None:
            return float(np.deg2rad(FIELD_OF_VIEW_DEG))
        width, height = self.tangents
        return float(2.0 * np.arctan(max(height, width / aspect)))


def behind(T_map_camera: Pose) -> Viewpoint:
    """Return a view from behind: the vehicle and the road ahead."""
    center, ahead = T_map_camera.translation, _ahead(T_map_camera)
    return Viewpoint(center - 12.0 * ahead + 7.0 * UP, center + 8.0 * ahead)


def above(T_map_camera: Pose, height_m: float = 65.0) -> Viewpoint:
    """Return a view from above, driving direction up."""
    center, ahead = T_map_camera.translation, _ahead(T_map_camera)
    target = center + 12.0 * ahead
    return Viewpoint(target + height_m * UP - 0.02 * height_m * ahead, target)


def through(T_map_camera: Pose, camera: Camera) -> Viewpoint:
    """Return the camera's own view along its optical axis; the whole image fits."""
    center = T_map_camera.translation
    axis = T_map_camera.rotation[:, 2]
    tangents = (camera.width / 2 / camera.K[0, 0], camera.height / 2 / camera.K[1, 1])
    return Viewpoint(center - 0.01 * axis, center + 5.0 * axis, tangents)


class Viewer:
    """Moves the scene cameras of all clients, also of those that connect later."""

    def __init__(self, server: "viser.ViserServer") -> None:
        self._server = server
        self._view = Viewpoint(np.array([-10.0, 0.0, 8.0]), np.zeros(3))
        server.on_client_connect(self._turn)

    def show(self, view: Viewpoint) -> None:
        """Show the scene from a viewpoint."""
        self._view = view
        initial = self._server.initial_camera
        initial.position, initial.look_at = _triple(view.eye_m), _triple(view.target_m)
        for client in self._server.get_clients().values():
            self._turn(client)

    def now(self) -> Viewpoint:
        """Return the first client's viewpoint; without clients, the last one shown."""
        for client in self._server.get_clients().values():
            camera = client.camera
            return Viewpoint(np.array(camera.position), np.array(camera.look_at))
        return self._view

    def render(self, width: int, height: int) -> ByteImage:
        """Return the present view as (height, width, 4), rendered by the browser on a transparent
        ground; takes a second. Raise SemvizError if no client answers."""
        for client in self._server.get_clients().values():
            try:
                return np.asarray(
                    client.get_render(
                        height, width, transport_format="png", timeout=RENDER_TIMEOUT_S
                    )
                )
            except (TimeoutError, RuntimeError):
                break
        raise SemvizError("the 3D pane does not answer; wait until it is drawn, then try again")

    def move_along(self, before: Pose, after: Pose) -> None:
        """Move the cameras with the vehicle; their views relative to it stay."""
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
    x, y, z = (float(value) for value in point)
    return x, y, z


REACH = 0.025
"""A click may miss by this share of the pane's height: 10 px of 400."""
STEPS = 4
"""Within the same quarter of the reach, a click picks what is nearest to the eye."""
BEFORE_EYE_M = 0.1

Clicked = Callable[[str, int], None]


@dataclass(frozen=True, eq=False)
class Pickable:
    """Clickable segments of one kind; a point has two equal ends."""

    number: IntArray
    """(n,) reported by a click."""
    low_m: FloatArray
    """(n, 3)"""
    high_m: FloatArray
    """(n, 3)"""

    @cached_property
    def balls(self) -> tuple[FloatArray, FloatArray]:
        """Return center (n, 3) and radius (n,) of the balls around the segments."""
        half_m = (self.high_m - self.low_m) / 2
        return self.low_m + half_m, np.linalg.norm(half_m, axis=1)

    def near(self, origin_m: FloatArray, direction: FloatArray, reach_rad: float) -> IntArray:
        """Return the rows that may lie within ``reach_rad`` of a ray of unit ``direction``."""
        middle_m, radius_m = self.balls
        away_m = middle_m - origin_m
        depth_m = away_m @ direction
        apart_m2 = np.einsum("ni,ni->n", away_m, away_m) - depth_m**2
        within_m = radius_m + reach_rad * np.maximum(depth_m + radius_m, BEFORE_EYE_M)
        return np.flatnonzero((apart_m2 <= within_m**2) & (depth_m + radius_m > BEFORE_EYE_M))

    def __getitem__(self, rows: IntArray) -> "Pickable":
        return Pickable(self.number[rows], self.low_m[rows], self.high_m[rows])


class Picker:
    """Reports kind and number of what was clicked, in a thread of viser's."""

    def __init__(self, server: "viser.ViserServer", on_click: Clicked) -> None:
        self._pickables: dict[str, Pickable] = {}
        self._on_click = on_click
        server.scene.on_click()(self._clicked)

    def set_pickable(self, kind: str, pickable: Pickable) -> None:
        """Replace what can be clicked of one kind."""
        self._pickables = {**self._pickables, kind: pickable}

    def _clicked(self, event: "viser.SceneClickEvent") -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        reach_rad = REACH * event.client.camera.fov
        picked = pick(self._pickables, origin, direction, reach_rad)
        if picked is not None:
            self._on_click(*picked)


def pick(
    pickables: dict[str, Pickable], origin_m: FloatArray, direction: FloatArray, reach_rad: float
) -> tuple[str, int] | None:
    """Return kind and number of what lies within ``reach_rad`` of a ray; None if nothing does."""
    best: tuple[tuple[int, float], str, int] | None = None
    ahead = direction / np.linalg.norm(direction)
    for kind, pickable in pickables.items():
        near = pickable[pickable.near(origin_m, ahead, reach_rad)]
        distance_m, depth_m = ray_distances(near, origin_m, ahead)
        angle = distance_m / np.maximum(depth_m, BEFORE_EYE_M)
        rows = np.flatnonzero((angle <= reach_rad) & (depth_m > BEFORE_EYE_M))
        if not len(rows):
            continue
        step = np.floor(STEPS * angle[rows] / reach_rad).astype(np.int64)
        first = int(np.lexsort((depth_m[rows], step))[0])
        row = int(rows[first])
        rank = (int(step[first]), float(depth_m[row]))
        if best is None or rank < best[0]:
            best = rank, kind, int(near.number[row])
    return None if best is None else best[1:]


def ray_distances(
    pickable: Pickable, origin_m: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the distances (n,) from a line of unit ``direction``, and the depths (n,) along it.

    The closest points of a line and a segment (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    along, start = pickable.high_m - pickable.low_m, pickable.low_m - origin_m
    squared, on_ray = np.einsum("ni,ni->n", along, along), along @ direction
    start_on_ray, start_along = start @ direction, np.einsum("ni,ni->n", start, along)
    spread = squared - on_ray**2  # 0 where the segment is a point, or parallel to the line
    share = (on_ray * start_on_ray - start_along) / np.where(spread > 1e-12, spread, np.inf)
    share = np.clip(share, 0.0, 1.0)
    depth = start_on_ray + share * on_ray
    gap = start + share[:, None] * along - depth[:, None] * direction
    return np.linalg.norm(gap, axis=1), depth
