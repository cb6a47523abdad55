"""Draw a map, camera poses and a backdrop into a viser server.

Elements are lines of a fixed screen width, one viser node a colour: only these stay legible
from afar and keep exact colours. Faint and numerous lines are hairlines, in one glTF model,
because viser draws all others one by one. A backdrop is dim and nearly grey, so that poles and
signs stand out.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semviz.web import shapes
from semviz.web.scene_nodes import Anchor, PointShape, SceneNodes
from semviz.web.shapes import PALETTES, Palette, Theme, mix, scene_light
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray

if TYPE_CHECKING:
    import viser


from semviz.web.shapes import rgb
from semviz_annotation.mapping.backdrop import Backdrop

TILE_M = 300.0
"""Segments in one tile are one object, so the renderer can skip tiles out of view."""
FLOAT, LINES = 5126, 1

Json = dict[str, Any]


def line_model(segments: FloatArray, light: FloatArray) -> bytes:
    """Return segments (k, 2, 3), one pixel wide, as glTF 2.0 (GLB); empty without segments.

    ``light`` (k, 3) or (3,) are their colours, from ``scene_light``.
    """
    if not len(segments):
        return b""
    order, starts = _tiles(segments)
    corners = np.empty((len(segments), 2, 2, 3), dtype="<f4")
    corners[:, :, 0] = segments[order]
    corners[:, :, 1] = np.broadcast_to(light, (len(segments), 3))[order, None]
    text = json.dumps(_gltf(corners[:, :, 0], starts, corners.nbytes)).encode()
    text += b" " * (-len(text) % 4)
    parts = _chunk(b"JSON", text) + _chunk(b"BIN\0", corners.tobytes())
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def _tiles(segments: FloatArray) -> tuple[IntArray, IntArray]:
    """The rows of the segments in order of tiles, and the start of each tile among them."""
    tile = np.floor((segments[:, 0, :2] + segments[:, 1, :2]) / (2 * TILE_M)).astype(np.int64)
    east, north = (tile - tile.min(axis=0)).T
    number = east * (north.max() + 1) + north
    order = np.argsort(number, kind="stable")
    return order, np.flatnonzero(np.diff(number[order], prepend=-1))


def _gltf(points: FloatArray, starts: IntArray, size: int) -> Json:
    """The glTF description of points (k, 2, 3) by tile, each followed by its colour."""
    counts = 2 * np.diff(starts, append=len(points))
    lows = np.minimum.reduceat(np.minimum(points[:, 0], points[:, 1]), starts)
    highs = np.maximum.reduceat(np.maximum(points[:, 0], points[:, 1]), starts)
    view = {"buffer": 0, "byteLength": size, "byteStride": 24}
    accessors: list[Json] = []
    for start, count, low, high in zip(
        (48 * starts).tolist(), counts.tolist(), lows.tolist(), highs.tolist(), strict=True
    ):
        kind = {"bufferView": 0, "componentType": FLOAT, "count": count, "type": "VEC3"}
        accessors += [{**kind, "byteOffset": start, "min": low, "max": high}]
        accessors += [{**kind, "byteOffset": start + 12}]
    numbers = range(len(starts))
    lines = [{"POSITION": 2 * tile, "COLOR_0": 2 * tile + 1} for tile in numbers]
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(numbers)}],
        "nodes": [{"mesh": tile} for tile in numbers],
        "meshes": [{"primitives": [{"attributes": line, "mode": LINES}]} for line in lines],
        "accessors": accessors,
        "bufferViews": [view],
        "buffers": [{"byteLength": size}],
    }


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack("<I4s", len(data), kind) + data


CAMERA_HEIGHT_M = 1.65
"""Height of the cameras above the road (KITTI's car)."""

FRUSTUM_DEPTH_M = 2.0
GRID_M = 10.0
HAIRLINE_PX = 1.0
"""Elements with lines up to this width are drawn as hairlines."""
BACKDROP_DEPTH_M = 150.0
FIELD_OF_VIEW_DEG = 55.0
AMBIENT = float(np.pi)
"""Light intensity at which three.js shows a surface in its own colour."""

UP_M = np.array([0.0, 0.0, 1.2])
"""Offset of a label from the top of its element."""


@dataclass(frozen=True)
class PoseStyle:
    """Style of a camera pose; ``role`` names its colour in the palette."""

    role: str
    width_px: float
    dash_m: tuple[float, float] | None = None
    fill: float = 0.0


TRUTH = PoseStyle("truth", 1.5)
ESTIMATE = PoseStyle("estimate", 2.2, fill=0.18)
PRIOR = PoseStyle("prior", 1.5, dash_m=(0.25, 0.18))
ALTERNATIVE = PoseStyle("alternative", 1.8, dash_m=(0.08, 0.14))


@dataclass(frozen=True)
class ElementStyle:
    """Style of elements: sRGB hex, and line width on the screen."""

    color: str
    width_px: float


class SceneDrawer:
    """Draws into one viser server. Drawing under a name replaces what was drawn under it before.

    Everything is in the map frame (metres, z up); names are paths such as ``/map``.
    """

    def __init__(self, server: "viser.ViserServer", theme: Theme = "dark") -> None:
        self.server = server
        self._nodes = SceneNodes(server.scene)
        self.clear = self._nodes.clear
        self.clear_under = self._nodes.clear_under
        self.remove_under = self._nodes.remove_under
        self.set_theme(theme)
        server.initial_camera.fov = float(np.deg2rad(FIELD_OF_VIEW_DEG))

    @contextmanager
    def atomic(self) -> Iterator[None]:
        """Send all changes of the block, viewpoints included, as one update and without delay.

        viser sends viewpoints separately, and delays each message up to 17 ms to batch them.
        """
        clients = self.server.get_clients().values()
        senders: tuple[viser.ViserServer | viser.ClientHandle, ...]
        senders = (*clients, self.server)  # cameras first, as they are quick to apply
        with ExitStack() as stack:
            for sender in reversed(senders):
                stack.enter_context(sender.atomic())
            yield
        for sender in senders:
            sender.flush()

    @property
    def palette(self) -> Palette:
        return PALETTES[self.theme]

    def set_theme(self, theme: Theme) -> None:
        """Clear the scene for a theme; the caller redraws it. The page draws the background."""
        self.theme: Theme = theme
        scene = self.server.scene
        self.remove_under("")
        scene.world_axes.visible = False
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        with self._nodes.drawing("/light") as drawing:
            drawing.light(AMBIENT)

    def class_styles(
        self, classes: ClassSet, strength: float = 1.0, width_px: float = 1.7
    ) -> tuple[ElementStyle, ...]:
        """Return a style for each class; ``strength`` below 1 fades towards the background."""
        dark = self.theme == "dark"
        colors = [class_.color if dark else class_.color_light for class_ in classes]
        return tuple(
            ElementStyle(mix(color, self.palette.scene, strength), width_px) for color in colors
        )

    def draw_grid(self, around_m: FloatArray) -> None:
        """Draw a level grid of 10 m on the road around a camera centre (3,)."""
        middle = np.array([*(np.round(around_m[:2] / GRID_M) * GRID_M), around_m[2]])
        middle[2] -= CAMERA_HEIGHT_M
        with self._nodes.drawing("/grid") as drawing:
            drawing.hairlines("", _grid(self.palette.grid), middle)

    def draw_road(self, trajectory_m: FloatArray) -> None:
        """Draw the road under camera centres (k, 3)."""
        with self._nodes.drawing("/road") as drawing:
            if len(trajectory_m) > 1:
                below = trajectory_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.02]
                drawing.mesh("", *shapes.ribbon(below, width_m=7.0), self.palette.road)

    def draw_band(
        self, name: str, points_m: FloatArray, pieces: IntArray, width_m: float, color: str
    ) -> None:
        """Draw pieces of a level band along points (k, 3); piece i is from point i to i + 1."""
        with self._nodes.drawing(name) as drawing:
            if len(pieces):
                corners, faces = shapes.ribbon(points_m, width_m)
                both = np.concatenate([faces[pieces], faces[pieces + len(points_m) - 1]])
                drawing.mesh("", corners, both, color)

    def draw_elements(
        self,
        name: str,
        elements: Elements3D,
        classes: ClassSet,
        facing_rad: FloatArray,
        styles: Sequence[ElementStyle],
        style_of: IntArray,
    ) -> None:
        """Draw poles as lines with a cap, signs as outlines of their class's shape.

        ``facing_rad`` (n,) turns the signs, see ``shapes.facing``. ``style_of`` (n,) indexes
        ``styles``.
        """
        with self._nodes.drawing(name) as drawing:
            for number, style in enumerate(styles):
                rows = np.flatnonzero(style_of == number)
                segments = shapes.element_segments(elements[rows], classes, facing_rad[rows])
                if style.width_px > HAIRLINE_PX:
                    drawing.lines(str(number), segments, style.color, style.width_px)
                else:
                    model = line_model(segments, scene_light(style.color))
                    drawing.hairlines(f"thin-{number}", model)

    def draw_far(
        self, name: str, elements: Elements3D, styles: Sequence[ElementStyle], style_of: IntArray
    ) -> None:
        """Draw each element as one hairline; ``style_of`` as in ``draw_elements``."""
        light = np.array([scene_light(style.color) for style in styles])
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", line_model(shapes.strokes(elements), light[style_of]))

    def draw_points(
        self,
        name: str,
        points_m: FloatArray | NDArray[np.float32],
        colors: str | IntArray | NDArray[np.uint8],
        size_m: float,
        shape: PointShape = "circle",
    ) -> None:
        """Draw points (k, 3), at least a pixel in size; ``colors``: one colour, or bytes (k, 3)."""
        with self._nodes.drawing(name) as drawing:
            drawing.points("", points_m, colors, size_m, shape)

    def draw_ellipsoids(
        self,
        name: str,
        centers_m: FloatArray,
        covariances_m2: FloatArray,
        magnified: float,
        color: str,
    ) -> None:
        """Draw 1-sigma ellipsoids of covariances (k, 3, 3) around centers (k, 3), ``magnified``."""
        axes_m, wxyz = shapes.ellipsoids(covariances_m2)
        with self._nodes.drawing(name) as drawing:
            drawing.ellipsoids("", centers_m, magnified * axes_m, wxyz, color, opacity=0.5)

    def highlight(self, elements: Elements3D, label: str = "") -> None:
        """Draw rings around ``elements``, usually one or none, in the accent colour."""
        segments = shapes.ring_segments(*elements_ends(elements))
        with self._nodes.drawing("/selection") as drawing:
            drawing.lines("rings", segments, self.palette.accent, 2.4)
            if label and len(elements):
                drawing.label("label", label, elements.anchor_m[0] + UP_M, "bottom-center")

    def draw_lines(
        self,
        name: str,
        segments_m: FloatArray,
        color: str,
        width_px: float,
        dash_m: tuple[float, float] | None = None,
        T_map_local: Pose | None = None,
    ) -> None:
        """Draw segments (k, 2, 3) in one colour, optionally dashed."""
        cut = segments_m if dash_m is None else shapes.dashed(segments_m, *dash_m)
        with self._nodes.drawing(name) as drawing:
            drawing.lines("", cut, color, width_px, T_map_local)

    def draw_path(self, name: str, points_m: FloatArray, color: str) -> None:
        """Draw a line through points (k, 3), a pixel wide, with gaps at NaN."""
        segments = np.stack([points_m[:-1], points_m[1:]], axis=1)
        whole = segments[np.isfinite(segments).all(axis=(1, 2))]
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", line_model(whole, scene_light(color)))

    def draw_circle(self, name: str, center_m: FloatArray, radius_m: float, color: str) -> None:
        """Draw a dashed level circle a pixel wide, for example the uncertainty of a prior."""
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", _dashed_circle(color), center_m, radius_m)

    def draw_camera(
        self,
        name: str,
        T_map_camera: Pose,
        camera: Camera,
        style: PoseStyle,
        fill: bool = True,
    ) -> None:
        """Draw a frustum; turn ``fill`` off if its far plane shows something else."""
        color = str(getattr(self.palette, style.role))
        segments = shapes.frustum_segments(camera, FRUSTUM_DEPTH_M)
        cut = segments if style.dash_m is None else shapes.dashed(segments, *style.dash_m)
        corners = shapes.frustum_corners(T_map_camera, camera, FRUSTUM_DEPTH_M)
        with self._nodes.drawing(name) as drawing:
            drawing.lines("lines", cut, color, style.width_px, T_map_camera)
            if fill and style.fill:
                faces = np.array([[0, 1, 2], [0, 2, 3]])
                drawing.mesh("fill", corners, faces, color, opacity=style.fill)

    def draw_image(
        self,
        name: str,
        T_map_camera: Pose,
        camera: Camera,
        depth_m: float,
        image: ByteImage,
        visible: bool = True,
    ) -> None:
        """Draw a camera's image at a depth: ``FRUSTUM_DEPTH_M``, or ``BACKDROP_DEPTH_M`` behind
        everything in view.

        A browser shows a new image two renderings later than a moved one: draw it in advance, not
        ``visible``.
        """
        corners = shapes.frustum_corners(T_map_camera, camera, depth_m)
        with self._nodes.drawing(name) as drawing:
            drawing.image("", T_map_camera, corners, image, visible)

    def draw_label(
        self, name: str, text: str, position_m: FloatArray, anchor: Anchor = "bottom-center"
    ) -> None:
        """Draw text with its ``anchor`` at a point. Use fewer than 100: each costs a draw call."""
        with self._nodes.drawing(name) as drawing:
            drawing.label("", text, position_m, anchor)


@lru_cache(maxsize=4)
def _grid(color: str) -> bytes:
    return line_model(shapes.grid_segments(120.0, GRID_M), scene_light(color))


@lru_cache(maxsize=4)
def _dashed_circle(color: str) -> bytes:
    """A dashed circle of radius 1."""
    return line_model(shapes.circle_segments(np.zeros(3), 1.0)[::2], scene_light(color))


def class_rows(class_id: IntArray, classes: ClassSet) -> IntArray:
    """Return the index (n,) of each element's class in ``classes``."""
    ids = np.array([class_.id for class_ in classes])
    order = np.argsort(ids)
    return order[np.searchsorted(ids[order], class_id)]


def elements_ends(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Return lowest and highest points (n, 3); both are the center for signs."""
    low = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    return low, elements.anchor_m


NAME = "/backdrop"
STRENGTH = {"dark": 0.5, "light": 0.42}
"""Share of the points' colours; the rest is the ground's."""
BRIGHTENING = {"dark": 0.7, "light": 1.0}
"""Exponent of the points' colours: shadows must differ from a dark ground."""
SATURATION = 0.45
SIZE = 1.15
"""Of a point, as a share of the distance between points. Near ones are larger on the screen."""
LUMA = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601"""


class BackdropLayer:
    """The backdrop in one scene. It is sent once, and again in the colours of another theme."""

    def __init__(self, scene: SceneDrawer) -> None:
        self._scene = scene
        self._backdrop: Backdrop | None = None
        self._colors: dict[Theme, NDArray[np.uint8]] = {}

    def use(self, backdrop: Backdrop | None) -> None:
        """Which one it is from here on; ``draw`` shows it."""
        if backdrop is self._backdrop:
            return
        self._scene.remove_under(NAME)
        self._backdrop = backdrop
        self._colors = {}

    def draw(self, shown: bool) -> None:
        """Shows or hides it."""
        if self._backdrop is None or not shown:
            self._scene.clear(NAME)
            return
        theme = self._scene.theme
        if theme not in self._colors:
            self._colors[theme] = muted(self._backdrop.colors, theme)
        size_m = SIZE * self._backdrop.spacing_m
        self._scene.draw_points(NAME, self._backdrop.points_m, self._colors[theme], size_m)


def muted(colors: NDArray[np.uint8], theme: Theme) -> NDArray[np.uint8]:
    """Return sRGB colours (n, 3) nearer to grey, and to the ground of ``theme``."""
    wanted = 255.0 * (colors.astype(np.float32) / 255.0) ** BRIGHTENING[theme]
    grey = (wanted @ LUMA)[:, None]
    plain = grey + SATURATION * (wanted - grey)
    strength, ground = STRENGTH[theme], np.array(rgb(PALETTES[theme].scene))
    mixed: FloatArray = strength * plain + (1.0 - strength) * ground
    return np.rint(mixed).astype(np.uint8)
