"""Read a model of COLMAP, text or binary: poses, and the camera of each image.

Poses are camera_from_world, in any unit and with any axes. Pixels are counted from the corner of
the image: (0.5, 0.5) is the centre of the first one. Points, rigs and frames are not read.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import read_limited, shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera
from semviz_core.datasets.own_drive.poses.conventions import (
    PosedCameras,
    RecordedPoses,
    matrices_of,
)
from semviz_core.datasets.trajectory import MOST_LINES

_MODEL_NAMES = (  # in the order of COLMAP's numbers
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
_COUNTS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
_FILES = ("images.bin", "images.txt")
_CAMERA_FILES = ("cameras.bin", "cameras.txt")
_MOST_BYTES = 2**30
_IMAGE = struct.Struct("<I7dI")
"""Id, quaternion w first, translation, id of the camera."""
_CAMERA = struct.Struct("<IiQQ")
_POINT_BYTES = 24


@dataclass(frozen=True, eq=False)
class _Images:
    quaternion: FloatArray
    translation: FloatArray
    camera_id: tuple[int, ...]
    name: tuple[str, ...]


def is_colmap(path: Path) -> bool:
    """Whether a path is a folder of a model, one with the folder ``0``, or a file of images."""
    return path.name in _FILES or _file_in(path) is not None


def _file_in(folder: Path) -> Path | None:
    """Return a model's file of images; COLMAP's first model is in ``sparse/0``."""
    candidates = (inner / name for inner in (folder, folder / "0") for name in _FILES)
    return next((file for file in candidates if file.is_file()), None)


def read_colmap(path: Path) -> PosedCameras:
    """Return poses and cameras of a model, from its folder or its file of images.

    Raise SemvizError if a file is damaged, or a camera's model is not read.
    """
    file = _file_in(path) or path
    is_binary = file.suffix == ".bin"
    beside = file.with_name(f"cameras{file.suffix}")
    try:
        images = _of_rows(list((_binary_images if is_binary else _text_images)(file)))
        cameras = dict((_binary_cameras if is_binary else _text_cameras)(beside))
        by_name = {
            name: cameras[camera]
            for name, camera in zip(images.name, images.camera_id, strict=True)
        }
    except KeyError as error:
        raise SemvizError(f"{beside}: no camera {error} that an image has") from None
    except (struct.error, ValueError, IndexError, OverflowError):
        raise SemvizError(f"{file}: not a model of COLMAP, or cut off; export it again") from None
    matrices = matrices_of(images.translation, images.quaternion, "wxyz", file)
    poses = RecordedPoses(
        file,
        "COLMAP",
        matrices,
        direction="world-to-camera",
        metric=False,
        names=images.name,
        quaternion="wxyz",
    )
    return PosedCameras(poses, by_name)


def is_colmap_camera(path: Path) -> bool:
    """Whether a path is a model's file of cameras, which may be without its poses."""
    return path.name in _CAMERA_FILES


def read_colmap_camera(path: Path) -> CalibrationFile:
    """Return the camera in a model's file of cameras. Raise SemvizError if it has several."""
    is_binary = path.suffix == ".bin"
    try:
        cameras = list((_binary_cameras if is_binary else _text_cameras)(path))
    except (struct.error, ValueError, IndexError, OverflowError):
        raise SemvizError(f"{path}: not a model of COLMAP, or cut off; export it again") from None
    if len(cameras) != 1:
        raise SemvizError(
            f"{path}: {len(cameras)} cameras, and nothing says which is that of the images; name "
            "the folder of the model, or keep one"
        )
    return CalibrationFile(path, "COLMAP", (cameras[0][1],))


_Row = tuple[tuple[float, ...], int, str]
"""Quaternion and translation, id of the camera, name."""


def _of_rows(rows: list[_Row]) -> _Images:
    if not rows:
        raise ValueError("no images")
    numbers = np.array([row[0] for row in rows])
    if not np.isfinite(numbers).all():
        raise ValueError("not finite")
    _, camera_id, name = zip(*rows, strict=True)
    return _Images(numbers[:, :4], numbers[:, 4:], camera_id, name)


def _text_images(path: Path) -> Iterator[_Row]:
    """Two lines each; the second one holds the points and may be empty."""
    for line in _lines(path)[::2]:
        if line.strip():
            words = line.decode("utf-8").split(maxsplit=9)
            yield tuple(float(word) for word in words[1:8]), int(words[8]), words[9].strip()


def _lines(path: Path) -> list[bytes]:
    """Return the lines that are no comments; most hold points, and are never decoded."""
    data = read_limited(path, _MOST_BYTES)
    _check_count(path, data.count(b"\n") // 2)
    return [line for line in data.split(b"\n") if not line.startswith(b"#")]


def _check_count(path: Path, count: int) -> None:
    """Raise SemvizError for so many entries that they would not fit into memory."""
    if count > MOST_LINES:
        raise SemvizError(f"{path}: more than {MOST_LINES} images or cameras; split the model")


def _binary_images(path: Path) -> Iterator[_Row]:
    data = read_limited(path, _MOST_BYTES)
    (count,) = struct.unpack_from("<Q", data)
    _check_count(path, count)
    place = 8
    for _ in range(count):
        _, *numbers, camera = _IMAGE.unpack_from(data, place)
        place += _IMAGE.size
        end = data.index(b"\0", place)
        name = data[place:end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        place = end + 9 + points * _POINT_BYTES
        yield tuple(numbers), camera, name


def _text_cameras(path: Path) -> Iterator[tuple[int, OriginalCamera]]:
    for line in _lines(path):
        if line.strip():
            number, model, width, height, *parameters = line.decode("utf-8").split()
            values = [float(word) for word in parameters]
            yield int(number), _camera(path, model, int(width), int(height), values)


def _binary_cameras(path: Path) -> Iterator[tuple[int, OriginalCamera]]:
    data = read_limited(path, _MOST_BYTES)
    (count,) = struct.unpack_from("<Q", data)
    _check_count(path, count)
    place = 8
    for _ in range(count):
        number, model, width, height = _CAMERA.unpack_from(data, place)
        place += _CAMERA.size
        values = struct.unpack_from(f"<{_COUNTS[model]}d", data, place)
        place += 8 * _COUNTS[model]
        yield number, _camera(path, _MODEL_NAMES[model], width, height, list(values))


def _camera(path: Path, model: str, width: int, height: int, values: list[float]) -> OriginalCamera:
    """Return a camera with the centre of the first pixel at (0, 0)."""
    f, *rest = values
    lens: LensModel = "brown-conrady"
    match model:
        case "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL":
            fx, fy, (cx, cy, *terms) = f, f, rest
            terms = [*terms, 0.0, 0.0, 0.0, 0.0][:4]
            terms = [terms[0], terms[1], 0.0, 0.0]
        case "PINHOLE" | "OPENCV" | "FULL_OPENCV":
            fx, (fy, cx, cy, *terms) = f, rest
        case "OPENCV_FISHEYE":
            lens, fx, (fy, cx, cy, *terms) = "fisheye", f, rest
        case _:
            raise SemvizError(
                f"{path}: camera model {shown(model, 40)} is not read; use SIMPLE_RADIAL, RADIAL, "
                "OPENCV, FULL_OPENCV, OPENCV_FISHEYE or a pinhole"
            )
    if lens == "brown-conrady" and not any(terms):
        lens, terms = "pinhole", []
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    try:
        return OriginalCamera(lens, width, height, K, np.array(terms))
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}") from None
