"""A map and camera poses, drawn into a viser server.

Elements are lines of a fixed width on the screen, one viser node a colour: the only thing in viser
that stays legible from afar and whose colour comes out exact. What is faint and many is hairlines.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from semviz.web import shapes
from semviz.web.colors import PALETTES, Palette, Theme, mix, scene_light
from semviz.web.line_model import line_model
from semviz.web.nodes import Anchor, Nodes, PointShape
from semviz_core.arrays import ByteImage, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

CAMERA_HEIGHT_M = 1.65
"""The road lies so far below the trajectory of the cameras (KITTI's car)."""

FRUSTUM_DEPTH_M = 2.0
GRID_M = 10.0
HAIRLINE_PX = 1.0
"""Elements whose lines are no wider are drawn as hairlines."""
BACKDROP_DEPTH_M = 150.0
FIELD_OF_VIEW_DEG = 55.0
AMBIENT = float(np.pi)
"""Intensity at which three.js shows a surface in its own colour."""


UP_M = np.array([0.0, 0.0, 1.2])
"""From the top of an element to its label."""


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


@dataclass(frozen=True)
class ElementLook:
    """How elements are drawn: sRGB hex, and how wide their lines are on the screen."""

    color: str
    width_px: float


class Scene:
    """Draws into one viser server. Drawing under a name again replaces what was there.

    Everything is in the map frame (metres, z up); names are paths such as ``/map``.
    """

    def __init__(self, server: "viser.ViserServer", theme: Theme = "dark") -> None:
        self.server = server
        self._nodes = Nodes(server.scene)
        self.clear = self._nodes.clear
        self.clear_under = self._nodes.clear_under
        self.remove_under = self._nodes.remove_under
        self.set_theme(theme)
        server.initial_camera.fov = float(np.deg2rad(FIELD_OF_VIEW_DEG))

    @contextmanager
    def in_one_piece(self) -> Iterator[None]:
        """What is drawn meanwhile, and where it is looked at from, is sent together and at once.

        viser sends cameras apart from the rest, and each up to 17 ms late, as more might come.
        """
        clients = self.server.get_clients().values()
        senders: tuple[viser.ViserServer | viser.ClientHandle, ...]
        senders = (*clients, self.server)  # cameras first, as they are quick to apply
        with ExitStack() as held:
            for sender in reversed(senders):
                held.enter_context(sender.atomic())
            yield
        for sender in senders:
            sender.flush()

    @property
    def palette(self) -> Palette:
        return PALETTES[self.theme]

    def set_theme(self, theme: Theme) -> None:
        """Empties the scene; whoever drew into it draws again. The ground is the page's."""
        self.theme: Theme = theme
        scene = self.server.scene
        self.remove_under("")
        scene.world_axes.visible = False
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        with self._nodes.drawing("/light") as drawing:
            drawing.light(AMBIENT)

    def class_looks(
        self, classes: ClassSet, strength: float = 1.0, width_px: float = 1.7
    ) -> tuple[ElementLook, ...]:
        """A look for each class; ``strength`` below 1 fades towards the ground."""
        dark = self.theme == "dark"
        plain = [one.color if dark else one.color_light for one in classes]
        return tuple(ElementLook(mix(one, self.palette.scene, strength), width_px) for one in plain)

    def draw_grid(self, around_m: FloatArray) -> None:
        """A level grid of 10 m on the road around a camera centre (3,)."""
        middle = np.array([*(np.round(around_m[:2] / GRID_M) * GRID_M), around_m[2]])
        middle[2] -= CAMERA_HEIGHT_M
        with self._nodes.drawing("/grid") as drawing:
            drawing.hairlines("", _grid(self.palette.grid), middle)

    def draw_road(self, trajectory_m: FloatArray) -> None:
        """The road under camera centres (k, 3)."""
        with self._nodes.drawing("/road") as drawing:
            if len(trajectory_m) > 1:
                below = trajectory_m - [0.0, 0.0, CAMERA_HEIGHT_M - 0.02]
                drawing.mesh("", *shapes.ribbon(below, width_m=7.0), self.palette.road)

    def draw_band(
        self, name: str, points_m: FloatArray, pieces: IntArray, width_m: float, color: str
    ) -> None:
        """A level band along points (k, 3): its ``pieces``, each from one point to the next."""
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
        looks: Sequence[ElementLook],
        look_of: IntArray,
    ) -> None:
        """Poles as lines with a cap, signs as outlines of their class's shape.

        ``facing_rad`` (n,) turns the signs (``shapes.facing`` knows how the road goes);
        ``look_of`` (n,) says which of the ``looks`` each element has.
        """
        with self._nodes.drawing(name) as drawing:
            for number, look in enumerate(looks):
                rows = np.flatnonzero(look_of == number)
                segments = shapes.element_segments(elements[rows], classes, facing_rad[rows])
                if look.width_px > HAIRLINE_PX:
                    drawing.lines(str(number), segments, look.color, look.width_px)
                else:
                    model = line_model(segments, scene_light(look.color))
                    drawing.hairlines(f"thin-{number}", model)

    def draw_far(
        self, name: str, elements: Elements3D, looks: Sequence[ElementLook], look_of: IntArray
    ) -> None:
        """One hairline for each element, however many; ``look_of`` as in ``draw_elements``."""
        light = np.array([scene_light(look.color) for look in looks])
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", line_model(shapes.strokes(elements), light[look_of]))

    def draw_points(
        self,
        name: str,
        points_m: FloatArray,
        colors: str | IntArray,
        size_m: float,
        shape: PointShape = "circle",
    ) -> None:
        """Points (k, 3), at least a pixel in size: one colour, or bytes (k, 3)."""
        with self._nodes.drawing(name) as drawing:
            drawing.points("", points_m, colors, size_m, shape)

    def draw_ellipsoids(
        self,
        name: str,
        middles_m: FloatArray,
        covariances_m2: FloatArray,
        magnified: float,
        color: str,
    ) -> None:
        """Ellipsoids of 1 sigma around middles (k, 3) of covariances (k, 3, 3), ``magnified``."""
        axes_m, wxyz = shapes.ellipsoids(covariances_m2)
        with self._nodes.drawing(name) as drawing:
            drawing.balls("", middles_m, magnified * axes_m, wxyz, color, opacity=0.5)

    def highlight(self, elements: Elements3D, label: str = "") -> None:
        """Rings around ``elements``, usually one or none, in the accent colour."""
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
        """Segments (k, 2, 3) of one colour, dashed on request."""
        cut = segments_m if dash_m is None else shapes.dashed(segments_m, *dash_m)
        with self._nodes.drawing(name) as drawing:
            drawing.lines("", cut, color, width_px, T_map_local)

    def draw_path(self, name: str, points_m: FloatArray, color: str) -> None:
        """A line through points (k, 3), a pixel wide; gaps at NaN."""
        segments = np.stack([points_m[:-1], points_m[1:]], axis=1)
        whole = segments[np.isfinite(segments).all(axis=(1, 2))]
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", line_model(whole, scene_light(color)))

    def draw_circle(self, name: str, center_m: FloatArray, radius_m: float, color: str) -> None:
        """A dashed level circle, such as the uncertainty of a prior, a pixel wide."""
        with self._nodes.drawing(name) as drawing:
            drawing.hairlines("", _dashed_circle(color), center_m, radius_m)

    def draw_camera(
        self,
        name: str,
        T_map_camera: Pose,
        camera: Camera,
        look: PoseLook,
        fill: bool = True,
    ) -> None:
        """A frustum; ``fill`` is off where something else is on its far plane."""
        color = str(getattr(self.palette, look.role))
        segments = shapes.frustum_segments(camera, FRUSTUM_DEPTH_M)
        cut = segments if look.dash_m is None else shapes.dashed(segments, *look.dash_m)
        corners = shapes.frustum_corners(T_map_camera, camera, FRUSTUM_DEPTH_M)
        with self._nodes.drawing(name) as drawing:
            drawing.lines("lines", cut, color, look.width_px, T_map_camera)
            if fill and look.fill:
                faces = np.array([[0, 1, 2], [0, 2, 3]])
                drawing.mesh("fill", corners, faces, color, opacity=look.fill)

    def draw_image(
        self,
        name: str,
        T_map_camera: Pose,
        camera: Camera,
        depth_m: float,
        image: ByteImage,
        visible: bool = True,
    ) -> None:
        """``image`` as the camera has it at a depth, such as ``FRUSTUM_DEPTH_M``; or
        ``BACKDROP_DEPTH_M``, behind everything that the camera sees.

        Browsers take two pictures longer to show another image than to place what is there: have
        it there beforehand, not ``visible``.
        """
        corners = shapes.frustum_corners(T_map_camera, camera, depth_m)
        with self._nodes.drawing(name) as drawing:
            drawing.image("", T_map_camera, corners, image, visible)

    def draw_label(
        self, name: str, text: str, position_m: FloatArray, anchor: Anchor = "bottom-center"
    ) -> None:
        """Text at a point, which is its ``anchor``. Keep them under 100: each costs a draw call."""
        with self._nodes.drawing(name) as drawing:
            drawing.label("", text, position_m, anchor)


@lru_cache(maxsize=4)
def _grid(color: str) -> bytes:
    return line_model(shapes.grid_segments(120.0, GRID_M), scene_light(color))


@lru_cache(maxsize=4)
def _dashed_circle(color: str) -> bytes:
    """Of radius 1."""
    return line_model(shapes.circle_segments(np.zeros(3), 1.0)[::2], scene_light(color))


def class_rows(class_id: IntArray, classes: ClassSet) -> IntArray:
    """(n,) which of the classes, in their order, each element is of."""
    ids = np.array([one.id for one in classes])
    order = np.argsort(ids)
    return order[np.searchsorted(ids[order], class_id)]


def elements_ends(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest points (n, 3); both the middle for signs."""
    low = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    return low, elements.anchor_m
