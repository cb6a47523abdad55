"""Read poses of cameras or bodies from files of others, without a guess at what they mean.

TUM, KITTI, EuRoC's CSV, KITTI-360's numbered lines, tables of GNSS (``gnss``); models of COLMAP and
nerfstudio are read by ``colmap_model`` and ``nerfstudio``. Poses are returned as stored, with the
conventions of their format; ``conventions`` applies these, or what the user says instead.
"""

import re
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.gnss import is_gnss, read_gnss
from semviz_core.datasets.own_drive.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.own_drive.recorded_poses import (
    QuaternionOrder,
    RecordedPoses,
    rotations_of,
)
from semviz_core.datasets.trajectory import read_text


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
    columns: list[str] = []
    if lines and not is_number(lines[0][1][0]):
        columns, lines = lines[0][1], lines[1:]
    if not lines:
        raise SemvizError(f"{path}: holds no poses; name another file with --poses")
    width = len(lines[0][1])
    if is_gnss(columns):
        _check_width(path, lines, len(columns))
        return read_gnss(path, columns, [row for _, row in lines], unit)
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


def _check_width(path: Path, lines: list[tuple[int, list[str]]], width: int) -> None:
    for number, row in lines:
        if len(row) != width:
            raise SemvizError(
                f"{path}, line {number}: {len(row)} numbers, but the first line has {width}"
            )


def _numbers(path: Path, lines: list[tuple[int, list[str]]], width: int) -> FloatArray:
    _check_width(path, lines, width)
    for number, row in lines:
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
