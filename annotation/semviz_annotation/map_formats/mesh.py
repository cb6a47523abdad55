"""PLY and GLB, out: poles as thin cylinders, signs as small plates, in the colours of classes.

For looking at in CloudCompare, Blender and the like; nothing reads a map back from it. PLY keeps
the map's axes; GLB has y up, as glTF asks: x of the map is x, z is y, y is -z (glTF 2.0, 3.4).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from semviz_annotation.map_formats.tally import Tally
from semviz_annotation.map_formats.writing import (
    PLATE_M,
    across_road,
    drop_all_but_places,
    unseen_ends,
)
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.files import replacing
from semviz_core.semantic_map import SemanticMap

POLE_RADIUS_M = 0.05
PLATE_THICKNESS_M = 0.02
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SIDES: Mapping[str, int] = {"line": 12, "triangle": 3, "square": 4, "diamond": 4, "pentagon": 5,
                             "circle": 24}  # fmt: skip
_TURNS: Mapping[str, float] = {"square": np.pi / 4}
"""About a plate's axis, from a corner straight up."""


def write_mesh(semantic_map: SemanticMap, path: Path, form: Literal["ply", "glb"]) -> Tally:
    """One mesh of all elements, with a colour at each vertex."""
    import trimesh

    vertices, faces, colors = map_mesh(semantic_map)
    if form == "glb":
        vertices, colors = vertices @ _Y_UP.T, _linear(colors)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    with replacing(path) as temporary:
        mesh.export(temporary, file_type=form)
    tally = Tally()
    drop_all_but_places(semantic_map, tally)
    tally.drop("ends that nobody saw: drawn like the others", unseen_ends(semantic_map))
    tally.drop("numbers and classes: colours only", len(semantic_map))
    tally.drop("digits: coordinates are of single precision", len(semantic_map))
    lines = int(semantic_map.elements.is_line.sum())
    tally.assume(f"poles {200 * POLE_RADIUS_M:g} cm thick", lines)
    tally.assume(f"plates of signs: {PLATE_M:g} m, facing the road", len(semantic_map) - lines)
    return tally


def map_mesh(semantic_map: SemanticMap) -> tuple[FloatArray, IntArray, IntArray]:
    """Vertices (v, 3) in the map frame, triangles (f, 3), colours (v, 4) sRGB from 0 to 255."""
    elements = semantic_map.elements
    across = across_road(semantic_map)
    vertices, faces, colors, count = [], [], [], 0
    for one in semantic_map.classes:
        rows = np.flatnonzero(elements.class_id == one.id)
        corners, triangles = _prism(_SIDES[one.shape], _TURNS.get(one.shape, 0.0))
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
        colors.append(np.tile(_color(one.color), (len(vertices[-1]), 1)))
        count += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors)


def _prism(sides: int, turn_rad: float) -> tuple[FloatArray, IntArray]:
    """Corners (v, 3) and triangles (f, 3) of a prism of length 1 and radius 1 along z.

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
    return corners, np.concatenate([np.column_stack(one) for one in triangles])


def _along(anchor_m: FloatArray, end_m: FloatArray) -> FloatArray:
    """(n, 3, 3) from a unit prism to a pole: its z axis runs from the end to the anchor."""
    axis = anchor_m - end_m
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    z = np.where(length > 0.0, axis / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    side = np.where(np.abs(z[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = np.cross(side, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    return np.stack([x * POLE_RADIUS_M, y * POLE_RADIUS_M, z * length], axis=2)


def _facing(across: FloatArray) -> FloatArray:
    """(n, 3, 3) from a unit prism to a plate: y is up, its z axis faces who drives past."""
    up = np.broadcast_to([0.0, 0.0, 1.0], across.shape)
    facing = np.cross(across, up)
    half = 0.5 * PLATE_M
    return np.stack([across * half, up * half, facing * PLATE_THICKNESS_M], axis=2)


def _color(color: str) -> IntArray:
    """(4,) of ``#RRGGBB``, 0 to 255, opaque."""
    return np.array([*bytes.fromhex(color.removeprefix("#")), 255])


def _linear(colors: IntArray) -> IntArray:
    """Colours as glTF has them at vertices: linear light (sRGB undone, IEC 61966-2-1)."""
    share = colors[:, :3] / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.column_stack([np.round(255.0 * light), colors[:, 3:]]).astype(np.int64)
