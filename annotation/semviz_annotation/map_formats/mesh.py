"""PLY, GLB and PCD, out: map elements as solids in class colours, a backdrop as coloured points.

For viewing in CloudCompare, Blender and similar tools; it is not read back. Poles are thin
cylinders, signs small plates. PLY and PCD keep the map's axes, in metres. GLB has y up, as glTF
requires: x of the map is x, z is y, y is -z (glTF 2.0, 3.4). Point files are binary and little
endian. PLY is Stanford's 1.0; PCD is PCL's 0.7, where a colour is one unsigned number, 0x00RRGGBB.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.map_formats import conversion
from semviz_annotation.map_formats.attributes import drop_attributes
from semviz_annotation.mapping.backdrop import Backdrop
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray, unit_vectors
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

CloudFormat: TypeAlias = Literal["ply", "pcd"]
_BY_ENDING: Mapping[str, CloudFormat] = {".ply": "ply", ".pcd": "pcd"}
_PLY = """ply
format binary_little_endian 1.0
comment semviz backdrop in the map frame {frame}, metres
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""
_PCD = """# .PCD v0.7 - semviz backdrop in the map frame {frame}, metres
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F U
COUNT 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def cloud_format(path: Path, format_: CloudFormat | None) -> CloudFormat:
    """Return ``format_`` or, if None, that of the file's ending. SemvizError if it is unknown."""
    chosen = format_ or _BY_ENDING.get(path.suffix.lower())
    if chosen is None:
        raise SemvizError(f"{path}: no format has this ending; say which with --format")
    return chosen


def export_backdrop(backdrop: Backdrop, path: Path, format_: CloudFormat) -> None:
    """Write a backdrop to ``path``. Raises SemvizError where that fails; then nothing is."""
    head, rows = (_PLY, _ply_rows) if format_ == "ply" else (_PCD, _pcd_rows)
    frame = backdrop.source.map_frame.encode("ascii", "replace").decode()
    text = head.format(frame=frame, count=len(backdrop))
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode("ascii") + rows(backdrop).tobytes())


def _ply_rows(backdrop: Backdrop) -> NDArray[np.void]:
    rows = np.empty(len(backdrop), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = backdrop.points_m, backdrop.colors
    return rows


def _pcd_rows(backdrop: Backdrop) -> NDArray[np.void]:
    rows = np.empty(len(backdrop), [("xyz", "<f4", 3), ("rgb", "<u4")])
    red, green, blue = backdrop.colors.astype(np.uint32).T
    rows["xyz"], rows["rgb"] = backdrop.points_m, red << 16 | green << 8 | blue
    return rows


POLE_RADIUS_M = 0.05
PLATE_THICKNESS_M = 0.02
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SIDES: Mapping[str, int] = {"line": 12, "triangle": 3, "square": 4, "diamond": 4, "pentagon": 5,
                             "circle": 24}  # fmt: skip
_TURNS: Mapping[str, float] = {"square": np.pi / 4}
"""Rotation about the plate's axis, from a corner straight up."""


def write_mesh(
    semantic_map: SemanticMap, path: Path, form: Literal["ply", "glb"]
) -> conversion.ConversionTally:
    """Write one mesh of all elements, with a colour per vertex."""
    import trimesh

    vertices, faces, colors = map_mesh(semantic_map)
    if form == "glb":
        vertices, colors = vertices @ _Y_UP.T, _linear(colors)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    content = _as_ply(mesh) if form == "ply" else _as_glb(mesh)
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    tally = conversion.ConversionTally()
    conversion.drop_all_but_places(semantic_map, tally)
    drop_attributes(semantic_map, tally)
    tally.drop("ends that nobody saw: drawn like the others", conversion.unseen_ends(semantic_map))
    tally.drop("numbers and classes: colours only", len(semantic_map))
    tally.drop("digits: coordinates are of single precision", len(semantic_map))
    lines = int(semantic_map.elements.is_line.sum())
    tally.assume(f"poles {200 * POLE_RADIUS_M:g} cm thick", lines)
    tally.assume(
        f"plates of signs: {conversion.PLATE_M:g} m, facing the road", len(semantic_map) - lines
    )
    return tally


def _as_ply(mesh: Any) -> bytes:
    """Return a PLY file whose comment names semviz, so that it may be replaced later."""
    content: bytes = mesh.export(file_type="ply")
    head, line, rest = content.partition(b"comment https://github.com/mikedh/trimesh\n")
    return head + (line and b"comment semviz\n") + rest


def _as_glb(mesh: Any) -> bytes:
    """Return a GLB file whose generator is semviz, so that it may be replaced later."""

    def name_generator(tree: dict[str, Any]) -> None:
        tree["asset"]["generator"] = "semviz"

    content: bytes = mesh.export(file_type="glb", tree_postprocessor=name_generator)
    return content


def map_mesh(semantic_map: SemanticMap) -> tuple[FloatArray, IntArray, IntArray]:
    """Return vertices (v, 3) in the map frame, triangles (f, 3), sRGB colours (v, 4) 0 to 255."""
    elements = semantic_map.elements
    across = conversion.across_road(semantic_map)
    vertices, faces, colors, count = [], [], [], 0
    for class_ in semantic_map.classes:
        rows = np.flatnonzero(elements.class_id == class_.id)
        corners, triangles = _prism(_SIDES[class_.shape], _TURNS.get(class_.shape, 0.0))
        is_line = elements.is_line[rows][:, None, None]
        frames = np.where(
            is_line, _along(elements.anchor_m[rows], np.nan_to_num(elements.end_m[rows])),
            _facing(across[rows]),
        )  # fmt: skip
        middles = np.where(
            is_line[..., 0],
            0.5 * (elements.anchor_m[rows] + elements.end_m[rows]),
            elements.anchor_m[rows],
        )
        placed = np.einsum("nij,vj->nvi", frames, corners) + middles[:, None]
        starts = count + len(corners) * np.arange(len(rows))
        vertices.append(placed.reshape(-1, 3))
        faces.append((triangles + starts[:, None, None]).reshape(-1, 3))
        colors.append(np.tile(_color(class_.color), (len(vertices[-1]), 1)))
        count += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors)


def _prism(sides: int, turn_rad: float) -> tuple[FloatArray, IntArray]:
    """Return corners (v, 3) and triangles (f, 3) of a prism of length 1 and radius 1 along z.

    A corner is at +y, unless turned.
    """
    angles = 0.5 * np.pi + turn_rad + 2.0 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    corners = np.concatenate(
        [np.column_stack([ring, np.full(sides, z)]) for z in (-0.5, 0.5)]
        + [np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])]
    )
    this, following = np.arange(sides), (np.arange(sides) + 1) % sides
    below, above = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    triangles = [
        (this, following, following + sides),
        (this, following + sides, this + sides),
        (following, this, below),
        (this + sides, following + sides, above),
    ]
    return corners, np.concatenate([np.column_stack(triangle) for triangle in triangles])


def _along(anchor_m: FloatArray, end_m: FloatArray) -> FloatArray:
    """Return (n, 3, 3) from unit prisms to poles; the z axis runs from the end to the anchor."""
    axis = anchor_m - end_m
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    z = np.where(length > 0.0, axis / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    side = np.where(np.abs(z[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = unit_vectors(np.cross(side, z))
    y = np.cross(z, x)
    return np.stack([x * POLE_RADIUS_M, y * POLE_RADIUS_M, z * length], axis=2)


def _facing(across: FloatArray) -> FloatArray:
    """Return (n, 3, 3) from unit prisms to plates; y is up, z faces the approaching driver."""
    up = np.broadcast_to([0.0, 0.0, 1.0], across.shape)
    facing = np.cross(across, up)
    half = 0.5 * conversion.PLATE_M
    return np.stack([across * half, up * half, facing * PLATE_THICKNESS_M], axis=2)


def _color(color: str) -> IntArray:
    """Return ``#RRGGBB`` as opaque colour (4,), 0 to 255."""
    return np.array([*bytes.fromhex(color.removeprefix("#")), 255])


def _linear(colors: IntArray) -> IntArray:
    """Return colours in linear light, as glTF needs them (inverse sRGB, IEC 61966-2-1)."""
    share = colors[:, :3] / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.column_stack([np.round(255.0 * light), colors[:, 3:]]).astype(np.int64)
