"""PLY and PCD, out: the coloured points of a backdrop, in the map frame, metres.

Both are binary and little endian. PLY is Stanford's 1.0; PCD is PCL's 0.7, where a colour is
one unsigned number, 0x00RRGGBB.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.backdrop.backdrop import Backdrop
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
