"""Keep the nodes of a viser scene by the names under which they were drawn.

A new node costs a millisecond here and a shader in the browser. So nodes are updated or hidden
instead of replaced; viser does not send unchanged values. Coordinates are in the map frame
(metres, z up).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from semviz.web.shapes import rgb, scene_rgb
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray

if TYPE_CHECKING:
    import viser

    Handles = dict[str, viser.SceneNodeHandle]

Anchor = Literal["bottom-center", "center-left", "center-right"]
ORIGIN = np.zeros(3)
PointShape = Literal["square", "diamond", "circle", "sparkle"]


class NodePose(TypedDict, total=False):
    """Pose arguments of viser's functions; empty to leave the pose unchanged."""

    wxyz: FloatArray
    position: FloatArray


class SceneNodes:
    """The nodes of one viser scene, in the map frame (metres, z up)."""

    def __init__(self, api: "viser.SceneApi") -> None:
        self._api = api
        self._drawn: dict[str, Handles] = {}

    @contextmanager
    def drawing(self, name: str) -> Iterator["NodeBatch"]:
        """Draw under ``name``; hide earlier nodes under it that the block does not draw again."""
        handles = self._drawn.setdefault(name, {})
        drawing = NodeBatch(self._api, name, handles)
        yield drawing
        for path in set(handles) - drawing.paths:
            handles[path].visible = False

    def clear(self, name: str) -> None:
        """Hide the nodes under ``name``; they can be drawn again."""
        for node in self._drawn.get(name, {}).values():
            node.visible = False

    def clear_under(self, prefix: str) -> None:
        """Hide all nodes under names with this prefix."""
        for name in self._drawn:
            if name.startswith(prefix):
                self.clear(name)

    def remove_under(self, prefix: str) -> None:
        """Remove all nodes under names with this prefix, if updating them is not possible."""
        for name in tuple(self._drawn):
            if name.startswith(prefix):
                for node in self._drawn.pop(name).values():
                    node.remove()


class NodeBatch:
    """The nodes under one name while they are drawn; ``part`` is the path of a node below it."""

    def __init__(self, api: "viser.SceneApi", name: str, handles: "Handles") -> None:
        self._api = api
        self._name = name
        self._handles = handles
        self.paths: set[str] = set()
        """Paths of the nodes drawn so far."""

    def lines(
        self,
        part: str,
        segments: FloatArray,
        color: str,
        width_px: float,
        T_map_local: Pose | None = None,
    ) -> None:
        """Draw segments (k, 2, 3), ``width_px`` wide on the screen."""
        if not len(segments):
            return
        points, colors = segments.astype(np.float32), np.array(scene_rgb(color), dtype=np.uint8)
        pose: NodePose = {} if T_map_local is None else _node_pose(T_map_local)
        self._put(
            part,
            lambda path: self._api.add_line_segments(
                path, points, colors, thickness=width_px, thickness_units="screen", **pose
            ),
            points=points,
            colors=colors,
            thickness=width_px,
            **pose,
        )

    def hairlines(
        self, part: str, model: bytes, center_m: FloatArray = ORIGIN, scale: float = 1.0
    ) -> None:
        """Draw a ``line_model`` around ``center_m``, a pixel wide: for many static lines.

        Without a GPU a wide line takes 24 us, a hairline 5 us. Moving or scaling is fast; new
        segments appear one or two renderings later.
        """
        if not model:
            return
        self._put(
            part,
            lambda path: self._api.add_glb(
                path,
                model,
                scale=scale,
                position=center_m,
                cast_shadow=False,
                receive_shadow=False,
            ),
            glb_data=model,
            scale=scale,
            position=center_m,
        )

    def points(
        self,
        part: str,
        points_m: FloatArray | NDArray[np.float32],
        colors: str | IntArray | NDArray[np.uint8],
        size_m: float,
        shape: PointShape,
    ) -> None:
        """Draw points (k, 3), at least a pixel in size; ``colors``: one colour, or bytes (k, 3)."""
        if not len(points_m):
            return
        positions = np.asarray(points_m, dtype=np.float32)  # the same object is not sent again
        channels = rgb(colors) if isinstance(colors, str) else colors
        bytes_ = np.asarray(channels, dtype=np.uint8)
        self._put(
            part,
            lambda path: self._api.add_point_cloud(
                path,
                positions,
                bytes_,
                point_size=size_m,
                point_shape=shape,
                precision="float32",
                point_shading="flat",
            ),
            points=positions,
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
        """Draw a mesh; a later call changes its vertices only, not faces, colour or opacity."""
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

    def ellipsoids(
        self,
        part: str,
        centers_m: FloatArray,
        axes_m: FloatArray,
        wxyz: FloatArray,
        color: str,
        opacity: float,
    ) -> None:
        """Draw ellipsoids around centers (k, 3), with half axes (k, 3) rotated by ``wxyz`` (k, 4).

        All in one draw call; recreated each time, because viser cannot change their number.
        """
        if not len(centers_m):
            return
        vertices, faces = _sphere()
        path = self._path(part)
        if path in self._handles:
            self._handles.pop(path).remove()
        self._put(
            part,
            lambda path: self._api.add_batched_meshes_simple(
                path,
                vertices,
                faces,
                batched_wxyzs=wxyz,
                batched_positions=centers_m,
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
        """Draw ``image`` between corners (4, 3), clockwise from the top left."""
        pose = {**_node_pose(T_map_camera), "position": corners.mean(axis=0)}
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
                **pose,
            ),
            visible,
            image=image,
            **pose,
        )

    def label(self, part: str, text: str, position_m: FloatArray, anchor: Anchor) -> None:
        """Draw text with its ``anchor`` at a point. Use fewer than 100: each costs a draw call."""
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
        """Add ambient light."""
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
        """Create a node, or update the existing one with the ``changing`` values. Objects that it
        has already are skipped: viser would encode an image again."""
        path = self._path(part)
        self.paths.add(path)
        if path not in self._handles:
            self._handles[path] = make(path)
            return
        node = self._handles[path]
        for name, value in changing.items():
            if getattr(node, name) is not value:
                setattr(node, name, value)
        node.visible = visible


def _node_pose(T_map_local: Pose) -> NodePose:
    x, y, z, w = T_map_local.as_quaternion()
    return {"wxyz": np.array([w, x, y, z]), "position": T_map_local.translation}


def _sphere() -> tuple[FloatArray, IntArray]:
    """A sphere of radius 1: 42 vertices, 80 faces."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=1)
    return np.asarray(sphere.vertices, dtype=np.float64), np.asarray(sphere.faces, dtype=np.int64)
