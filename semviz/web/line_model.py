"""Lines as a binary glTF model, the only lines of viser's that are not each drawn by themselves."""

import json
import struct
from typing import Any

import numpy as np

from semviz_core.arrays import FloatArray, IntArray

TILE_M = 300.0
"""What lies in the same tile is one object: none out of sight is drawn."""
FLOAT, LINES = 5126, 1

Json = dict[str, Any]


def line_model(segments: FloatArray, light: FloatArray) -> bytes:
    """glTF 2.0 (GLB) of segments (k, 2, 3), a pixel wide; empty where there are none.

    ``light`` (k, 3) or (3,) are their colours as ``scene_light`` gives them.
    """
    if not len(segments):
        return b""
    order, starts = _tiles(segments)
    corners = np.empty((len(segments), 2, 2, 3), dtype="<f4")
    corners[:, :, 0] = segments[order]
    corners[:, :, 1] = np.broadcast_to(light, (len(segments), 3))[order, None]
    text = json.dumps(_described(corners[:, :, 0], starts, corners.nbytes)).encode()
    text += b" " * (-len(text) % 4)
    parts = _chunk(b"JSON", text) + _chunk(b"BIN\0", corners.tobytes())
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def _tiles(segments: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows of the segments, tile by tile, and where among them each tile starts."""
    tile = np.floor((segments[:, 0, :2] + segments[:, 1, :2]) / (2 * TILE_M)).astype(np.int64)
    east, north = (tile - tile.min(axis=0)).T
    number = east * (north.max() + 1) + north
    order = np.argsort(number, kind="stable")
    return order, np.flatnonzero(np.diff(number[order], prepend=-1))


def _described(points: FloatArray, starts: IntArray, size: int) -> Json:
    """What the data is: in each tile some of the points (k, 2, 3), with a colour after each."""
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
        "meshes": [{"primitives": [{"attributes": one, "mode": LINES}]} for one in lines],
        "accessors": accessors,
        "bufferViews": [view],
        "buffers": [{"byteLength": size}],
    }


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack("<I4s", len(data), kind) + data
