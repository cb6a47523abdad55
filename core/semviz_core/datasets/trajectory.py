"""Read and write poses as text in the TUM and KITTI formats, and parse number tables.

A TUM line is ``time x y z qx qy qz qw`` in the map frame, z up. A KITTI line holds the 12 numbers
of a 3x4 matrix in the map frame rotated to KITTI's axes: x right, y down, z forward. Both hold
poses of the left camera, camera to world. KITTI's own files hold poses of camera 0.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, read_limited, shown

TrajectoryFormat: TypeAlias = Literal["tum", "kitti"]
T_MAP_WORLD = Pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""KITTI's world, turned to z up: x ahead, y left."""
MOST_APART_S = 0.01
"""Largest difference in time between a pose of a TUM file and its frame."""
MOST_LINES = 1_000_000
"""Of a file of numbers; a day at 10 Hz has 864,000."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")
_UPRIGHT = 0.5
"""Least mean cosine between the map's z axis and the cameras' up direction."""


@dataclass(frozen=True, eq=False)
class TrajectoryFile:
    """The poses of a file."""

    path: Path
    T_map_camera: tuple[Pose, ...]
    """Of the left camera, in a map frame with z up."""
    time_s: FloatArray | None
    """(n,) of each pose; None where the n-th pose is that of frame n (KITTI)."""

    def of_frames(self, indices: Sequence[int], times_s: FloatArray) -> list[Pose | None]:
        """Return the pose of each frame; None if a file with times has none.

        Raise SemvizError if a file without times ends before the last frame, or if a file with
        times has no pose for any frame.
        """
        poses = self.T_map_camera
        if self.time_s is None:
            if len(poses) <= indices[-1]:
                raise SemvizError(
                    f"{self.path}: {len(poses)} lines, but frame {indices[-1]} needs line "
                    f"{indices[-1] + 1}; complete the file or choose fewer frames"
                )
            return [poses[index] for index in indices]
        nearest = [int(np.abs(self.time_s - time_s).argmin()) for time_s in times_s]
        near = np.abs(self.time_s[nearest] - times_s) <= MOST_APART_S
        if not near.any():
            raise SemvizError(
                f"{self.path}: no pose is within {MOST_APART_S:g} s of a frame: its times are "
                f"{self.time_s.min():g} to {self.time_s.max():g}, those of the frames "
                f"{times_s.min():g} to {times_s.max():g}"
            )
        return [poses[row] if is_near else None for row, is_near in zip(nearest, near, strict=True)]


def save_trajectory(frames: Sequence[Frame], path: Path, format_: TrajectoryFormat) -> None:
    """Write the poses of ``frames``.

    TUM leaves out frames without a pose. KITTI needs a line for each frame: raise SemvizError,
    without writing, if one has no pose.
    """
    posed = [
        (frame.time_s, frame.T_map_camera) for frame in frames if frame.T_map_camera is not None
    ]
    missing = [frame.index for frame in frames if frame.T_map_camera is None]
    if not posed:
        raise SemvizError("no frame has a pose: there is nothing to write")
    if missing and format_ == "kitti":
        raise SemvizError(
            f"frame {missing[0]} has no pose ({len(missing)} of {len(frames)} frames have none), "
            "and KITTI's format cannot leave any out; use --format tum"
        )
    line = _tum_line if format_ == "tum" else _kitti_line
    with replacing(path) as temporary:
        temporary.write_text("".join(line(*row) for row in posed), encoding="utf-8")


def _tum_line(time_s: float, T_map_camera: Pose) -> str:
    numbers = (time_s, *T_map_camera.translation.tolist(), *T_map_camera.as_quaternion().tolist())
    return " ".join(map(repr, numbers)) + "\n"


def _kitti_line(time_s: float, T_map_camera: Pose) -> str:
    T_world_camera = T_MAP_WORLD.inverse() @ T_map_camera
    return " ".join(map(repr, T_world_camera.as_matrix()[:3].ravel().tolist())) + "\n"


def load_trajectory(path: Path) -> TrajectoryFile:
    """Read a file of either format; lines that start with ``#`` are comments.

    Raise SemvizError if the file is of neither format, or its axes are those of the other.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: no such file of poses; name another file")
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    width = len(lines[0][1].split()) if lines else 0
    if width not in (8, 12):
        raise SemvizError(f"{path}: holds neither TUM's 8 numbers a line nor KITTI's 12")
    rows = [parsed_numbers(line, width, f"{path}, line {number}") for number, line in lines]
    poses = []
    for (number, _), row in zip(lines, rows, strict=True):
        try:
            poses.append(_pose_of_tum(row) if width == 8 else _pose_of_kitti(row))
        except SemvizError as error:
            raise SemvizError(f"{path}, line {number}: {error}") from None
    _check_upright(path, poses)
    return TrajectoryFile(path, tuple(poses), np.array(rows)[:, 0] if width == 8 else None)


def _pose_of_tum(row: FloatArray) -> Pose:
    """Return the pose of time, translation and a (rounded) quaternion x, y, z, w."""
    from scipy.spatial.transform import Rotation

    if not 0.99 < np.linalg.norm(row[4:]) < 1.01:
        raise SemvizError("the last four numbers are not a quaternion of length 1")
    return Pose(Rotation.from_quat(row[4:]).as_matrix(), row[1:4])


def _pose_of_kitti(row: FloatArray) -> Pose:
    return T_MAP_WORLD @ Pose.from_matrix(row.reshape(3, 4))


def _check_upright(path: Path, poses: Sequence[Pose]) -> None:
    """Raise SemvizError if the cameras are not upright: the poses then have the other axes."""
    up = float(np.mean([-pose.rotation[2, 1] for pose in poses]))
    if up < _UPRIGHT:
        raise SemvizError(
            f"{path}: the cameras are not upright. In TUM's format the world's z is up, in "
            "KITTI's its y is down; rotate the poses, or give them in the other format"
        )


def read_numbers(path: Path, width: int) -> FloatArray:
    """Return (lines, width) numbers of a text file. Raise SemvizError with the wrong line."""
    lines = read_text(path).rstrip().splitlines()
    rows = [
        parsed_numbers(line, width, f"{path}, line {number}")
        for number, line in enumerate(lines, 1)
    ]
    return np.array(rows).reshape(-1, width)


def parsed_numbers(text: str, width: int, where: str) -> FloatArray:
    """Return (width,) finite numbers. Raise SemvizError with ``where`` if ``text`` has others."""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise SemvizError(f"{where}: {shown(error)}; expected {width} numbers") from None
    if len(numbers) != width:
        raise SemvizError(f"{where}: {len(numbers)} numbers, expected {width}")
    if not np.isfinite(numbers).all():
        raise SemvizError(f"{where}: holds NaN or infinite numbers; repair that line")
    return numbers


def read_text(path: Path) -> str:
    """Return a file's text. Raise SemvizError if it is missing, not text, or too large."""
    if not path.exists():
        raise SemvizError(f"{path}: no such file; a KITTI sequence needs it")
    try:
        text = read_limited(path, MOST_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SemvizError(f"{path}: not a text in UTF-8 ({error}); write it anew") from None
    if max(text.count("\n"), text.count("\r")) > MOST_LINES:
        raise SemvizError(f"{path}: more than {MOST_LINES} lines; split the file")
    return text


def refuse_decimal_commas(path: Path, line: str) -> None:
    """Raise SemvizError if numbers of a line, between spaces or semicolons, have decimal commas."""
    cells = re.split(r"[\s;]+", line.strip())
    cells = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)] if len(cells) > 1 else []
    if cells:
        raise SemvizError(f"{path}: decimal commas, such as {shown(cells[0], 40)}; write points")
