"""Read poses of cameras or bodies from files of others, without a guess at what they mean.

TUM, KITTI, EuRoC's CSV, KITTI-360's numbered lines; models of COLMAP and nerfstudio are read by
``colmap_model`` and ``nerfstudio``. Poses are returned as stored, with the conventions of their
format; ``conventions`` applies these, or what the user says instead.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.own_drive.lens import OriginalCamera
from semviz_core.datasets.trajectory import read_text

Direction: TypeAlias = Literal["camera-to-world", "world-to-camera"]
QuaternionOrder: TypeAlias = Literal["xyzw", "wxyz"]
CameraAxes: TypeAlias = Literal["opencv", "opengl"]


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses as a file holds them, and what its format says about them."""

    path: Path
    format: str
    """For people: ``TUM``."""
    matrices: FloatArray
    """(n, 3, 4), of ``direction``."""
    direction: Direction = "camera-to-world"
    axes: CameraAxes = "opencv"
    """Of the cameras: y down and z ahead, or y up and z back."""
    of_body: bool = False
    """Whether the format holds poses of a body, as EuRoC's does, and not of a camera."""
    metric: bool = True
    """Whether lengths are metres by the format's definition."""
    time_s: FloatArray | None = None
    """(n,) or None."""
    time_unit: TimeUnit | None = None
    names: tuple[str, ...] | None = None
    """(n,) images, as the file names them, or None."""
    indices: IntArray | None = None
    """(n,) numbers of frames, or None. Without times, names and numbers, rows follow the images."""
    quaternion: QuaternionOrder | None = None

    @property
    def order(self) -> str:
        """How rows are assigned to images, for people."""
        if self.names is not None:
            return "by name"
        if self.time_s is not None:
            return "by time"
        return "in order" if self.indices is None else "by number"


@dataclass(frozen=True, eq=False)
class PosedCameras:
    """Poses of a model, and the camera of each of its images."""

    poses: RecordedPoses
    cameras: Mapping[str, OriginalCamera]
    """By the names of the poses."""


def read_poses(
    path: Path, quaternion: QuaternionOrder | None = None, unit: TimeUnit | None = None
) -> RecordedPoses:
    """Return the poses of a text file of numbers; its format is recognized by their count.

    ``quaternion`` and ``unit`` replace what the format says. Raise SemvizError with the wrong line.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: no such file of poses; name another with --poses")
    lines = [
        (number, re.split(r"[\s,;]+", line.strip().strip(",;")))
        for number, line in enumerate(read_text(path).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and not is_number(lines[0][1][0]):
        _refuse_degrees(path, lines[0][1])
        lines = lines[1:]  # the names of columns
    if not lines:
        raise SemvizError(f"{path}: holds no poses; name another file with --poses")
    width = len(lines[0][1])
    words = [row for _, row in lines]
    values = _numbers(path, lines, width)
    if width == 8:
        return _timed(path, "TUM", words, values, quaternion or "xyzw", unit)
    if width in (11, 17) and path.suffix == ".csv":
        return _timed(path, "EuRoC", words, values, quaternion or "wxyz", unit, of_body=True)
    if width == 12:
        return RecordedPoses(path, "KITTI", _checked(path, lines, values.reshape(-1, 3, 4)))
    if width in (13, 17):
        matrices = _checked(path, lines, values[:, 1:13].reshape(-1, 3, 4))
        indices = values[:, 0].astype(np.int64)
        return RecordedPoses(path, "KITTI-360", matrices, of_body=width == 13, indices=indices)
    raise SemvizError(
        f"{path}: {width} numbers a line; TUM has 8, KITTI 12, KITTI-360 13 or 17, EuRoC's CSV 17"
    )


def _refuse_degrees(path: Path, columns: list[str]) -> None:
    if any(re.fullmatch(r"lat(itude)?(_deg)?", column.lower()) for column in columns):
        raise SemvizError(
            f"{path}: holds latitude and longitude, and no orientation of a camera; give poses, "
            "for example of a SLAM system or of COLMAP"
        )


def _numbers(path: Path, lines: list[tuple[int, list[str]]], width: int) -> FloatArray:
    for number, row in lines:
        if len(row) != width:
            raise SemvizError(
                f"{path}, line {number}: {len(row)} numbers, but the first line has {width}"
            )
        wrong = next((word for word in row if not is_number(word)), None)
        if wrong is not None:
            raise SemvizError(f"{path}, line {number}: {shown(wrong, 40)!r} is not a finite number")
    return np.array([[float(word) for word in row] for _, row in lines]).reshape(-1, width)


def _timed(
    path: Path,
    format_: str,
    words: list[list[str]],
    values: FloatArray,
    quaternion: QuaternionOrder,
    unit: TimeUnit | None,
    of_body: bool = False,
) -> RecordedPoses:
    time_s, unit = in_seconds([row[0] for row in words], unit, path)
    rotations = rotations_of(values[:, 4:8], quaternion, path)
    order = np.argsort(time_s, kind="stable")
    matrices = np.concatenate([rotations, values[:, 1:4, None]], axis=2)
    return RecordedPoses(
        path,
        format_,
        matrices[order],
        of_body=of_body,
        time_s=time_s[order],
        time_unit=unit,
        quaternion=quaternion,
    )


def rotations_of(quaternions: FloatArray, order: QuaternionOrder, path: Path) -> FloatArray:
    """Return rotations (n, 3, 3). Raise SemvizError if rows (n, 4) are not of length 1."""
    from scipy.spatial.transform import Rotation

    lengths = np.linalg.norm(quaternions.clip(-1e3, 1e3), axis=1)
    wrong = np.flatnonzero((lengths < 0.99) | (lengths > 1.01))
    if len(wrong):
        raise SemvizError(
            f"{path}, pose {wrong[0] + 1}: the quaternion has length {lengths[wrong[0]]:.3g}, not 1"
        )
    xyzw = quaternions if order == "xyzw" else np.roll(quaternions, -1, axis=1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix()).reshape(-1, 3, 3)


def _checked(path: Path, lines: list[tuple[int, list[str]]], matrices: FloatArray) -> FloatArray:
    """Return (n, 3, 4) with the nearest rotations. Raise SemvizError with the wrong line."""
    try:
        rotations = nearest_rotation(matrices[:, :, :3])
    except SemvizError:
        for (number, _), matrix in zip(lines, matrices, strict=True):
            try:
                Pose.from_matrix(matrix)
            except SemvizError as error:
                raise SemvizError(f"{path}, line {number}: {error}") from None
        raise
    return np.concatenate([rotations, matrices[:, :, 3:]], axis=2)
