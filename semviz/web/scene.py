"""A map and camera poses, drawn into a viser server.

Elements are lines of a fixed width on the screen, one viser node a class: the only thing in viser
that stays legible from afar and whose colour comes out exact. Lines cannot be clicked, so
invisible boxes around the elements take the clicks.

Making a node costs a millisecond here and a shader in the browser, so nodes stay and change.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz.web import shapes
from semviz.web.colors import PALETTES, Palette, Theme, mix, rgb, scene_rgb
from semviz_core.arrays import ByteImage, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

CLICKABLE = 4000
"""At most so many elements, the nearest ones, take clicks: boxes are dear in the browser."""

CAMERA_HEIGHT_M = 1.65
"""The road lies so far below the trajectory of the cameras (KITTI's car)."""

FRUSTUM_DEPTH_M = 2.0
BACKDROP_DEPTH_M = 150.0
FIELD_OF_VIEW_DEG = 55.0
AMBIENT = float(np.pi)
"""Intensity at which three.js shows a surface in its own colour."""


@dataclass(frozen=True)
class PoseLook:
    """How a pose is drawn: ``role`` names its colour in the palette."""

    role: str
    width_px: float
    dash_m: tuple[float, float] | None = None
    fill: float = 0.0


TRUTH = PoseLook("truth", 1.5)
ESTIMATE = PoseLook("estimate", 2.2, fill=0.18)
PRIOR = PoseLook("prior", 1.5, dash_m=(0.25, 0.18))
ALTERNATIVE = PoseLook("alternative", 1.8, dash_m=(0.08, 0.14))


class Scene:
    """Draws into one viser server. Drawing under a name again replaces what was there.

    Everything is in the map frame (metres, z up); names are paths such as ``/map``.
    """

    def __init__(self, server: "viser.ViserServer", theme: Theme = "dark") -> None:
        self.server = server
        self._nodes: dict[str, dict[str, viser.SceneNodeHandle]] = {}
        """Of each name that was drawn, its nodes by path."""
        self._drawn: set[str] = set()
        self.set_theme(theme)
        server.initial_camera.fov = float(np.deg2rad(FIELD_OF_VIEW_DEG))

    @property
    def palette(self) -> Palette:
        return PALETTES[self.theme]

    def set_theme(self, theme: Theme) -> None:
        """Empties the scene and sets its ground; whoever drew into it draws again."""
        self.theme: Theme = theme
        scene = self.server.scene
        for name in tuple(self._nodes):
            self.clear(name)
        scene.world_axes.visible = False
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        self._put("/light", "/light", lambda: scene.add_light_ambient("/light", intensity=AMBIENT))
        ground = np.array([[rgb(self.palette.scene)]], dtype=np.uint8)
        scene.set_background_image(ground, format="png")

    def clear(self, name: str) -> None:
        """Removes what was drawn under ``name``; nothing where there is nothing."""
        for node in self._nodes.pop(name, {}).values():
            node.remove()

    def clear_under(self, prefix: str) -> None:
        """Removes all that was drawn under names that begin so."""
        for name in tuple(self._nodes):
            if name.startswith(prefix):
                self.clear(name)

    def draw_grid(self, around_m: FloatArray) -> None:
        """A level grid of 10 m on the road around a camera centre (3,)."""
        floor = np.array([*around_m[:2], around_m[2] - CAMERA_HEIGHT_M])
        self.draw_lines("/grid", shapes.grid_segments(floor, 120.0, 10.0), self.palette.grid, 1.0)

    def draw_road(self, trajectory_m: FloatArray) -> None:
        """The road under camera centres (k, 3)."""
        with self._drawing("/road"):
            if len(trajectory_m) > 1:
                below = trajectory_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.02]
                self._mesh("/road", "/road", *shapes.ribbon(below, width_m=7.0), self.palette.road)

    def draw_band(
        self, name: str, points_m: FloatArray, pieces: IntArray, width_m: float, color: str
    ) -> None:
        """A level band along points (k, 3): its ``pieces``, each from one point to the next."""
        with self._drawing(name):
            if len(pieces):
                corners, faces = shapes.ribbon(points_m, width_m)
                both = np.concatenate([faces[pieces], faces[pieces + len(points_m) - 1]])
                self._mesh(name, name, corners, both, color)

    def draw_elements(
        self,
        name: str,
        elements: Elements3D,
        classes: ClassSet,
        facing_rad: FloatArray | None = None,
        strength: float = 1.0,
        width_px: float = 1.7,
    ) -> None:
        """Poles as lines with a cap, signs as outlines of their class's shape.

        ``facing_rad`` (n,) turns the signs (``shapes.facing`` knows how the road goes);
        ``strength`` below 1 fades towards the ground.
        """
        turned = np.zeros(len(elements)) if facing_rad is None else facing_rad
        with self._drawing(name):
            for one in classes:
                rows = np.flatnonzero(elements.class_id == one.id)
                if not len(rows):
                    continue
                some = elements[rows]
                if one.kind == "line":
                    segments = shapes.pole_segments(some)
                else:
                    segments = shapes.sign_segments(some, one.shape, turned[rows])
                plain = one.color if self.theme == "dark" else one.color_light
                color = mix(plain, self.palette.scene, strength)
                self._lines(name, f"{name}/{one.id}", segments, color, width_px)

    def make_clickable(
        self, elements: Elements3D, around_m: FloatArray, on_click: Callable[[int], None]
    ) -> None:
        """Calls ``on_click`` with the id of the element that was clicked, in a thread of viser's.

        Only the ``CLICKABLE`` elements nearest to ``around_m`` on the ground plane answer.
        """
        self.clear("/pick")
        offset = elements.anchor_m[:, :2] - np.asarray(around_m)[:2]
        rows = np.argsort(np.linalg.norm(offset, axis=1), kind="stable")[:CLICKABLE]
        if not len(rows):
            return
        middle, size = _boxes(elements[rows])
        ids = elements.id[rows]
        corners, faces = _cube()
        node = self.server.scene.add_batched_meshes_simple(
            "/pick",
            corners,
            faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
            batched_positions=middle,
            batched_scales=size,
            opacity=0.0,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._put("/pick", "/pick", lambda: node)

        @node.on_click
        def clicked(event: "viser.SceneNodePointerEvent[viser.BatchedMeshHandle]") -> None:
            if event.instance_index is not None:
                on_click(int(ids[event.instance_index]))

    def highlight(self, elements: Elements3D, label: str = "") -> None:
        """Rings around ``elements``, usually one or none, in the accent colour."""
        segments = shapes.ring_segments(*_ends(elements))
        with self._drawing("/selection"):
            self._lines("/selection", "/selection/rings", segments, self.palette.accent, 2.4)
            if label and len(elements):
                top = elements.anchor_m[0] + [0.0, 0.0, 1.2]
                self._label("/selection", "/selection/label", label, top)

    def draw_lines(
        self,
        name: str,
        segments_m: FloatArray,
        color: str,
        width_px: float,
        dash_m: tuple[float, float] | None = None,
    ) -> None:
        """Segments (k, 2, 3) of one colour, dashed on request."""
        cut = segments_m if dash_m is None else shapes.dashed(segments_m, *dash_m)
        with self._drawing(name):
            self._lines(name, name, cut, color, width_px)

    def draw_path(self, name: str, points_m: FloatArray, color: str, width_px: float) -> None:
        """A line through points (k, 3); gaps at NaN."""
        segments = np.stack([points_m[:-1], points_m[1:]], axis=1)
        whole = segments[np.isfinite(segments).all(axis=(1, 2))]
        self.draw_lines(name, whole, color, width_px)

    def draw_circle(self, name: str, center_m: FloatArray, radius_m: float, color: str) -> None:
        """A dashed level circle, such as the uncertainty of a prior."""
        ring = shapes.circle_segments(center_m, radius_m)
        self.draw_lines(name, ring[::2], color, 1.2)

    def draw_camera(
        self,
        name: str,
        T_map_camera: Pose,
        camera: Camera,
        look: PoseLook,
        image: ByteImage | None = None,
    ) -> None:
        """A frustum, with ``image`` on its far plane where given."""
        color = str(getattr(self.palette, look.role))
        segments = shapes.frustum_segments(T_map_camera, camera, FRUSTUM_DEPTH_M)
        cut = segments if look.dash_m is None else shapes.dashed(segments, *look.dash_m)
        corners = shapes.frustum_corners(T_map_camera, camera, FRUSTUM_DEPTH_M)
        with self._drawing(name):
            self._lines(name, f"{name}/lines", cut, color, look.width_px)
            if image is not None:
                self._image(name, f"{name}/image", T_map_camera, corners, image)
            elif look.fill:
                faces = np.array([[0, 1, 2], [0, 2, 3]])
                self._mesh(name, f"{name}/fill", corners, faces, color, opacity=look.fill)

    def draw_backdrop(
        self, name: str, T_map_camera: Pose, camera: Camera, image: ByteImage
    ) -> None:
        """``image`` behind everything that the camera sees: for looking through the camera."""
        corners = shapes.frustum_corners(T_map_camera, camera, BACKDROP_DEPTH_M)
        with self._drawing(name):
            self._image(name, name, T_map_camera, corners, image)

    def draw_label(self, name: str, text: str, position_m: FloatArray) -> None:
        """Text at a point. Keep them under 100: each costs a draw call."""
        with self._drawing(name):
            self._label(name, name, text, position_m)

    @contextmanager
    def _drawing(self, group: str) -> Iterator[None]:
        """What was drawn under ``group`` before and is not drawn again inside goes."""
        self._drawn = set()
        yield
        nodes = self._nodes.get(group, {})
        for path in set(nodes) - self._drawn:
            nodes.pop(path).remove()

    def _put(
        self, group: str, path: str, make: "Callable[[], viser.SceneNodeHandle]", **changing: Any
    ) -> None:
        """Makes the node at ``path``, or gives the one that is there what is ``changing``."""
        nodes = self._nodes.setdefault(group, {})
        self._drawn.add(path)
        if path not in nodes:
            nodes[path] = make()
            return
        for name, value in changing.items():
            setattr(nodes[path], name, value)

    def _lines(
        self, group: str, path: str, segments: FloatArray, color: str, width_px: float
    ) -> None:
        """The width stays that of the first drawing under ``path``."""
        if not len(segments):
            return
        points, colors = segments.astype(np.float32), np.array(scene_rgb(color), dtype=np.uint8)
        self._put(
            group,
            path,
            lambda: self.server.scene.add_line_segments(
                path, points, colors, thickness=width_px, thickness_units="screen"
            ),
            points=points,
            colors=colors,
        )

    def _mesh(
        self,
        group: str,
        path: str,
        vertices: FloatArray,
        faces: IntArray,
        color: str,
        opacity: float | None = None,
    ) -> None:
        """Faces, colour and opacity stay those of the first drawing under ``path``."""
        corners = vertices.astype(np.float32)
        self._put(
            group,
            path,
            lambda: self.server.scene.add_mesh_simple(
                path,
                corners,
                faces.astype(np.uint32),
                color=scene_rgb(color),
                opacity=opacity,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            ),
            vertices=corners,
        )

    def _image(
        self, group: str, path: str, T_map_camera: Pose, corners: FloatArray, image: ByteImage
    ) -> None:
        x, y, z, w = T_map_camera.as_quaternion()
        place = {"wxyz": (w, x, y, z), "position": corners.mean(axis=0)}
        self._put(
            group,
            path,
            lambda: self.server.scene.add_image(
                path,
                image,
                render_width=float(np.linalg.norm(corners[1] - corners[0])),
                render_height=float(np.linalg.norm(corners[3] - corners[0])),
                format="jpeg",
                jpeg_quality=85,
                cast_shadow=False,
                receive_shadow=False,
                **place,
            ),
            image=image,
            **place,
        )

    def _label(self, group: str, path: str, text: str, position_m: FloatArray) -> None:
        self._put(
            group,
            path,
            lambda: self.server.scene.add_label(
                path, text, position=position_m, anchor="bottom-center", font_screen_scale=0.8
            ),
            text=text,
            position=position_m,
        )


def _ends(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest points (n, 3); both the middle for signs."""
    low = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    return low, elements.anchor_m


def _boxes(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Middles and sizes (n, 3) of upright boxes that are easy to hit."""
    low, high = _ends(elements)
    size = np.maximum(np.abs(high - low) + 0.5, 1.0)
    return (low + high) / 2, size


def _cube() -> tuple[FloatArray, IntArray]:
    """A unit cube around the origin."""
    import trimesh

    box = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    return np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int64)
