"""Read nerfstudio's transforms.json: poses, and the camera of each image.

World from camera, OpenGL axes (x right, y up, z back). Pixels are counted from the corner of the
image there: (0.5, 0.5) is the centre of the first one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.base.pose import nearest_rotation
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_TEXT_BYTES, first_line, parsed_json, read_limited, shown
from semviz_core.datasets.own_drive.lens import LensModel, OriginalCamera
from semviz_core.datasets.own_drive.recorded_poses import PosedCameras, RecordedPoses

_BROWN_NAMES, _FISHEYE_NAMES = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_MODELS: dict[str, tuple[LensModel, tuple[str, ...]]] = {
    "OPENCV": ("brown-conrady", _BROWN_NAMES),
    "PINHOLE": ("brown-conrady", _BROWN_NAMES),
    "SIMPLE_PINHOLE": ("brown-conrady", _BROWN_NAMES),
    "OPENCV_FISHEYE": ("fisheye", _FISHEYE_NAMES),
}


def read_nerfstudio(path: Path) -> PosedCameras:
    """Return poses and cameras. Raise SemvizError if the file is damaged, or a model not read."""
    try:
        content = parsed_json(read_limited(path, MOST_TEXT_BYTES))
        names = [str(frame["file_path"]) for frame in content["frames"]]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SemvizError(
            f"{path}: not nerfstudio's transforms.json ({first_line(error)}); name another file"
        ) from None
    if not names:
        raise SemvizError(f"{path}: holds no frames")
    matrices, cameras = [], {}
    for name, frame in zip(names, content["frames"], strict=True):
        where = f"{path}, {shown(name, 80)}"
        matrices.append(_matrix(where, frame.get("transform_matrix")))
        cameras[name] = _camera(where, {**content, **frame})
    poses = RecordedPoses(
        path, "nerfstudio", np.array(matrices), axes="opengl", metric=False, names=tuple(names)
    )
    return PosedCameras(poses, cameras)


def _matrix(where: str, value: Any) -> FloatArray:
    try:
        matrix = np.array(value, dtype=np.float64)
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
            raise ValueError("not 4x4 finite numbers")
    except (TypeError, ValueError, OverflowError) as error:
        raise SemvizError(f"{where}: transform_matrix: {first_line(error)}") from None
    try:
        rotation = nearest_rotation(matrix[:3, :3])
    except SemvizError as error:
        raise SemvizError(f"{where}: transform_matrix: {error}") from None
    return np.column_stack([rotation, matrix[:3, 3]])


def _camera(where: str, table: Mapping[str, Any]) -> OriginalCamera:
    """Return the camera; only nerfstudio's own files name its model, instant-ngp's do not."""
    name = str(table.get("camera_model", "OPENCV"))
    if name not in _MODELS:
        raise SemvizError(
            f"{where}: camera_model {shown(name, 40)} is not read; only {', '.join(_MODELS)} are"
        )
    model, coefficients = _MODELS[name]
    try:
        fx = float(table["fl_x"])
        fy = float(table.get("fl_y", fx))
        cx, cy = float(table["cx"]) - 0.5, float(table["cy"]) - 0.5
        width, height = int(table["w"]), int(table["h"])
        distortion = np.array([float(table.get(term, 0.0)) for term in coefficients])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SemvizError(
            f"{where}: fl_x, cx, cy, w and h are needed ({first_line(error)})"
        ) from None
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if model == "brown-conrady" and not distortion.any():
        model, distortion = "pinhole", np.zeros(0)
    try:
        return OriginalCamera(model, width, height, K, distortion)
    except SemvizError as error:
        raise SemvizError(f"{where}: {error}") from None
