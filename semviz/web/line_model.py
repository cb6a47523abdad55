"""Lines as a binary glTF model, the only lines of viser's that are not each drawn by themselves."""

import json
import struct
from typing import Any

import numpy as np

from semviz_core.arrays import FloatArray

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
    corners = np.empty((len(segments), 2, 2, 3), dtype="<f4")
    corners[:, :, 0], corners[:, :, 1] = segments, np.reshape(light, (-1, 1, 3))
    tiles = _tiles(segments)
    data = np.concatenate([corners[rows] for rows in tiles]).tobytes()
    text = json.dumps(_described([corners[rows, :, 0] for rows in tiles], len(data))).encode()
    text += b" " * (-len(text) % 4)
    parts = _chunk(b"JSON", text) + _chunk(b"BIN\0", data)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def _tiles(segments: FloatArray) -> list[FloatArray]:
    """Rows of the segments in each tile that has some."""
    tile = np.floor(segments.mean(axis=1)[:, :2] / TILE_M)
    number = np.unique(tile, axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def _described(tiles: list[FloatArray], size: int) -> Json:
    """What the data is: in each tile points (k, 2, 3), with a colour after each."""
    ends = np.cumsum([one.shape[0] * 2 for one in tiles])
    view = {"buffer": 0, "byteLength": size, "byteStride": 24}
    accessors: list[Json] = []
    for points, end in zip(tiles, ends.tolist(), strict=True):
        count = points.shape[0] * 2
        kind = {"bufferView": 0, "componentType": FLOAT, "count": count, "type": "VEC3"}
        start = 24 * (end - count)
        low, high = points.min(axis=(0, 1)).tolist(), points.max(axis=(0, 1)).tolist()
        accessors += [{**kind, "byteOffset": start, "min": low, "max": high}]
        accessors += [{**kind, "byteOffset": start + 12}]
    numbers = range(len(tiles))
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
