"""Nodes of a viser scene by the names under which they were drawn.

Making a node costs a millisecond here and a shader in the browser, so nodes stay and change, or are
hidden until they are drawn again; what stays equal is not sent again (viser sees to that).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np

from semviz.web.colors import rgb, scene_rgb
from semviz_core.arrays import ByteImage, FloatArray, IntArray
from semviz_core.pose import Pose

if TYPE_CHECKING:
    import viser

    Held = dict[str, viser.SceneNodeHandle]

Anchor = Literal["bottom-center", "center-left", "center-right"]
MIDDLE = np.zeros(3)
PointShape = Literal["square", "diamond", "circle", "sparkle"]


class Place(TypedDict, total=False):
    """Of a node, as viser's functions take it; empty for one that stays."""

    wxyz: FloatArray
    position: FloatArray


class Nodes:
    """What stands in one viser scene. All in the map frame (metres, z up)."""

    def __init__(self, api: "viser.SceneApi") -> None:
        self._api = api
        self._drawn: dict[str, Held] = {}

    @contextmanager
    def drawing(self, name: str) -> Iterator["Drawing"]:
        """Draws under ``name``; what was there before and is not drawn again inside is hidden."""
        held = self._drawn.setdefault(name, {})
        drawing = Drawing(self._api, name, held)
        yield drawing
        for path in set(held) - drawing.paths:
            held[path].visible = False

    def clear(self, name: str) -> None:
        """Hides what was drawn under ``name``: it stays, ready to be drawn again."""
        for node in self._drawn.get(name, {}).values():
            node.visible = False

    def clear_under(self, prefix: str) -> None:
        """Hides all that was drawn under names that begin so."""
        for name in self._drawn:
            if name.startswith(prefix):
                self.clear(name)

    def remove_under(self, prefix: str) -> None:
        """Removes all that was drawn under names that begin so, for what cannot be changed to
        become what is drawn next, or has other names then."""
        for name in tuple(self._drawn):
            if name.startswith(prefix):
                for node in self._drawn.pop(name).values():
                    node.remove()


class Drawing:
    """The nodes under one name while they are drawn. Each has a ``part`` of it: a path below it."""

    def __init__(self, api: "viser.SceneApi", name: str, held: "Held") -> None:
        self._api = api
        self._name = name
        self._held = held
        self.paths: set[str] = set()
        """Of what has been drawn so far."""

    def lines(
        self,
        part: str,
        segments: FloatArray,
        color: str,
        width_px: float,
        T_map_local: Pose | None = None,
    ) -> None:
        """Segments (k, 2, 3), ``width_px`` wide on the screen; nothing where there are none."""
        if not len(segments):
            return
        points, colors = segments.astype(np.float32), np.array(scene_rgb(color), dtype=np.uint8)
        place: Place = {} if T_map_local is None else _place(T_map_local)
        self._put(
            part,
            lambda path: self._api.add_line_segments(
                path, points, colors, thickness=width_px, thickness_units="screen", **place
            ),
            points=points,
            colors=colors,
            thickness=width_px,
            **place,
        )

    def hairlines(
        self, part: str, model: bytes, middle_m: FloatArray = MIDDLE, scale: float = 1.0
    ) -> None:
        """A ``line_model`` around ``middle_m``, a pixel wide: for what is many and stays.

        Where the processor draws, it takes 24 us for each of the wide lines and 5 us for these. A
        change of place or scale is quick; other segments are read anew a picture or two later.
        """
        if not model:
            return
        self._put(
            part,
            lambda path: self._api.add_glb(
                path,
                model,
                scale=scale,
                position=middle_m,
                cast_shadow=False,
                receive_shadow=False,
            ),
            glb_data=model,
            scale=scale,
            position=middle_m,
        )

    def points(
        self,
        part: str,
        points_m: FloatArray,
        colors: str | IntArray,
        size_m: float,
        shape: PointShape,
    ) -> None:
        """Points (k, 3), at least a pixel in size, of one colour or of colours (k, 3) in bytes."""
        if not len(points_m):
            return
        places = points_m.astype(np.float32)
        one = rgb(colors) if isinstance(colors, str) else colors
        bytes_ = np.asarray(one, dtype=np.uint8)
        self._put(
            part,
            lambda path: self._api.add_point_cloud(
                path,
                places,
                bytes_,
                point_size=size_m,
                point_shape=shape,
                precision="float32",
                point_shading="flat",
            ),
            points=places,
            colors=bytes_,
        )

    def mesh(
        self,
        part: str,
        vertices: FloatArray,
        faces: IntArray,
        color: str,
        opacity: float | None = None,
    ) -> None:
        """Faces, colour and opacity stay those of the first drawing."""
        corners = vertices.astype(np.float32)
        self._put(
            part,
            lambda path: self._api.add_mesh_simple(
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

    def balls(
        self,
        part: str,
        middles_m: FloatArray,
        axes_m: FloatArray,
        wxyz: FloatArray,
        color: str,
        opacity: float,
    ) -> None:
        """Ellipsoids around middles (k, 3), with half axes (k, 3) turned by ``wxyz`` (k, 4).

        All in one draw call; made anew each time, as viser cannot change their number.
        """
        if not len(middles_m):
            return
        vertices, faces = _ball()
        path = self._path(part)
        if path in self._held:
            self._held.pop(path).remove()
        self._put(
            part,
            lambda path: self._api.add_batched_meshes_simple(
                path,
                vertices,
                faces,
                batched_wxyzs=wxyz,
                batched_positions=middles_m,
                batched_scales=axes_m,
                batched_colors=scene_rgb(color),
                opacity=opacity,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            ),
        )

    def image(
        self,
        part: str,
        T_map_camera: Pose,
        corners: FloatArray,
        image: ByteImage,
        visible: bool,
    ) -> None:
        """``image`` between corners (4, 3), clockwise from the top left one."""
        place = {**_place(T_map_camera), "position": corners.mean(axis=0)}
        self._put(
            part,
            lambda path: self._api.add_image(
                path,
                image,
                render_width=float(np.linalg.norm(corners[1] - corners[0])),
                render_height=float(np.linalg.norm(corners[3] - corners[0])),
                format="jpeg",
                jpeg_quality=85,
                cast_shadow=False,
                receive_shadow=False,
                visible=visible,
                **place,
            ),
            visible,
            image=image,
            **place,
        )

    def label(self, part: str, text: str, position_m: FloatArray, anchor: Anchor) -> None:
        """Text whose ``anchor`` is at a point. Keep them under 100: each costs a draw call."""
        self._put(
            part,
            lambda path: self._api.add_label(
                path, text, position=position_m, anchor=anchor, font_screen_scale=0.8
            ),
            text=text,
            anchor=anchor,
            position=position_m,
        )

    def light(self, intensity: float) -> None:
        """Light from everywhere."""
        self._put("", lambda path: self._api.add_light_ambient(path, intensity=intensity))

    def _path(self, part: str) -> str:
        return f"{self._name}/{part}" if part else self._name

    def _put(
        self,
        part: str,
        make: "Callable[[str], viser.SceneNodeHandle]",
        visible: bool = True,
        **changing: Any,
    ) -> None:
        """Makes a node, or gives the one that is there what is ``changing``: no object that it has
        already, as viser would encode an image again."""
        path = self._path(part)
        self.paths.add(path)
        if path not in self._held:
            self._held[path] = make(path)
            return
        node = self._held[path]
        for name, value in changing.items():
            if getattr(node, name) is not value:
                setattr(node, name, value)
        node.visible = visible


def _place(T_map_local: Pose) -> Place:
    x, y, z, w = T_map_local.as_quaternion()
    return {"wxyz": np.array([w, x, y, z]), "position": T_map_local.translation}


def _ball() -> tuple[FloatArray, IntArray]:
    """A ball of radius 1: 42 vertices, 80 faces."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    return np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int64)
