"""Read poses of cameras or bodies from files of others, without a guess at what they mean.

Tables with named columns and records of JSON (``pose_tables``), TUM, KITTI, EuRoC's CSV,
KITTI-360's numbered lines, and matrices behind times; models of COLMAP and nerfstudio are read by
``colmap_model`` and ``recorded_cameras``. Poses are returned as stored, with the conventions of
their format; ``conventions`` applies these, or what the user says instead.
"""

import re
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.images.image_files import (
    SUFFIXES,
    TimeUnit,
    in_seconds,
    is_number,
)
from semviz_core.datasets.own_drive.poses.conventions import (
    QuaternionOrder,
    RecordedPoses,
    matrices_of,
    pose_in,
)
from semviz_core.datasets.own_drive.poses.pose_tables import poses_of_columns
from semviz_core.datasets.own_drive.poses.sensor_table import read_table
from semviz_core.datasets.trajectory import MOST_LINES, read_text

_HEAD = 1000
"""Characters of a file in which columns are named."""
_WIDTHS = (8, 12, 13, 17)
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
"""Of a 4x4 matrix."""
_UNIT = 1e-3
"""Of the length of quaternions, to tell them from other numbers."""
_LEAST_TIME = 1e8
"""Numbers before a pose from here on, or with a fraction, are times."""


def read_poses(
    path: Path, quaternion: QuaternionOrder | None = None, unit: TimeUnit | None = None
) -> RecordedPoses:
    """Return the poses of a text file: by the names of its columns, or else by their number.

    ``quaternion`` and ``unit`` replace what the format says. Raise SemvizError with the wrong line.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: no such file of poses; name another with --poses")
    if path.suffix == ".json":
        return _of_records(path, quaternion, unit)
    text = read_text(path)
    lines = [
        (number, re.split(r"[\s,;]+", line.strip().strip(",;")))
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    is_named = bool(lines) and not _is_number_or_image(lines[0][1][0])
    lines = lines[is_named:]
    if not lines:
        raise SemvizError(f"{path}: holds no poses; name another file with --poses")
    if is_named or not _is_known(path, len(lines[0][1])):
        table = read_table(path, unit)
        found = None if table is None else poses_of_columns(table, quaternion)
        if found is not None:
            return found
    return _of_width(path, text, lines, quaternion, unit)


def _of_records(
    path: Path, quaternion: QuaternionOrder | None, unit: TimeUnit | None
) -> RecordedPoses:
    table = read_table(path, unit)
    found = None if table is None else poses_of_columns(table, quaternion)
    if found is None:
        raise SemvizError(
            f"{path}: no poses by names that are known; name each record's position x, y, z and "
            "rotation w, x, y, z, or give nerfstudio's transforms.json"
        )
    return found


def read_pose_folder(folder: Path) -> RecordedPoses | None:
    """Return the poses of a folder with a text file of a matrix, 3x4 or 4x4, for each image.

    Files are called like the images. None if there are none. Raise SemvizError for another file.
    """
    files = sorted(folder.glob("*.txt"))
    if not files:
        return None
    if len(files) > MOST_LINES:
        raise SemvizError(f"{folder}: more than {MOST_LINES} poses; split the drive")
    matrices = [pose_in(file, "the pose of the camera").as_matrix()[:3] for file in files]
    names = tuple(file.stem for file in files)
    return RecordedPoses(folder, "a matrix for each image", np.array(matrices), names=names)


def _is_known(path: Path, width: int) -> bool:
    """Whether the number of columns tells the format, whatever a comment calls them."""
    return width in _WIDTHS or (width == 11 and path.suffix == ".csv")


def _of_width(
    path: Path,
    text: str,
    lines: list[tuple[int, list[str]]],
    quaternion: QuaternionOrder | None,
    unit: TimeUnit | None,
) -> RecordedPoses:
    width = len(lines[0][1])
    words = [row for _, row in lines]
    if Path(words[0][0]).suffix.lower() in SUFFIXES:
        return _named(path, lines, quaternion)
    values = _line_numbers(path, lines, width)
    if width == 8 and "q_RS_w" in text[:_HEAD]:  # TUM-VI's, without the velocities of EuRoC's
        return _timed(path, "EuRoC", words, values, quaternion or "wxyz", unit, of_body=True)
    if width == 8:
        return _timed(path, "TUM", words, values, quaternion or "xyzw", unit)
    if width == 7 and np.allclose(np.linalg.norm(values[:, 3:], axis=1), 1.0, atol=_UNIT):
        order = quaternion or "xyzw"
        matrices = matrices_of(values[:, :3], values[:, 3:], order, path)
        return RecordedPoses(path, "TUM without times", matrices, quaternion=order)
    is_whole = width in (16, 17) and bool((values[:, -4:] == _LAST_ROW).all())
    if width in (11, 17) and path.suffix == ".csv" and not is_whole:
        return _timed(path, "EuRoC", words, values, quaternion or "wxyz", unit, of_body=True)
    if width in (12, 13, 17) or is_whole:
        return _of_matrices(path, lines, values, unit)
    raise SemvizError(
        f"{path}: {width} numbers a line; TUM has 8, KITTI 12, KITTI-360 13 or 17, EuRoC's CSV 17; "
        "of others, name the columns in the first line: time_s,x_m,y_m,z_m,qx,qy,qz,qw, or of "
        "NCLT time_us,northing,easting,down,roll_rad,pitch_rad,yaw_rad"
    )


def _is_number_or_image(word: str) -> bool:
    return is_number(word) or Path(word).suffix.lower() in SUFFIXES


def _named(
    path: Path, lines: list[tuple[int, list[str]]], quaternion: QuaternionOrder | None
) -> RecordedPoses:
    """Return poses whose lines begin with the name of an image: TUM's numbers, or KITTI's."""
    names = tuple(row[0] for _, row in lines)
    rest = [(number, row[1:]) for number, row in lines]
    width = len(rest[0][1])
    if width not in (7, 12):
        raise SemvizError(f"{path}: {width} numbers behind a name; TUM has 7, KITTI 12")
    values = _line_numbers(path, rest, width)
    if width == 7:
        order = quaternion or "xyzw"
        matrices = matrices_of(values[:, :3], values[:, 3:], order, path)
        return RecordedPoses(path, "TUM", matrices, names=names, quaternion=order)
    matrices = _checked(path, rest, values.reshape(-1, 3, 4))
    return RecordedPoses(path, "KITTI", matrices, names=names)


def _of_matrices(
    path: Path, lines: list[tuple[int, list[str]]], values: FloatArray, unit: TimeUnit | None
) -> RecordedPoses:
    """Return matrices 3x4 or 4x4, in order, or behind a time or KITTI-360's number of a frame."""
    width = values.shape[1]
    has_label = width in (13, 17)
    numbers = values[:, 1:13] if has_label else values[:, :12]
    matrices = _checked(path, lines, numbers.reshape(-1, 3, 4))
    if not has_label:
        return RecordedPoses(path, "KITTI" if width == 12 else "4x4", matrices)
    label = values[:, 0]
    if np.all(label == np.round(label)) and label.max() < _LEAST_TIME:
        indices = label.astype(np.int64)
        return RecordedPoses(path, "KITTI-360", matrices, of_body=width == 13, indices=indices)
    time_s, unit = in_seconds([row[0] for _, row in lines], unit, path)
    order = np.argsort(time_s, kind="stable")
    name = "3x4 with times" if width == 13 else "4x4 with times"
    return RecordedPoses(path, name, matrices[order], time_s=time_s[order], time_unit=unit)


def _check_width(path: Path, lines: list[tuple[int, list[str]]], width: int) -> None:
    for number, row in lines:
        if len(row) != width:
            raise SemvizError(
                f"{path}, line {number}: {len(row)} numbers, but the first line has {width}"
            )


def _line_numbers(path: Path, lines: list[tuple[int, list[str]]], width: int) -> FloatArray:
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
    matrices = matrices_of(values[:, 1:4], values[:, 4:8], quaternion, path)
    order = np.argsort(time_s, kind="stable")
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
