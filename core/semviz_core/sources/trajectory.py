"""Poses of a drive as text, in the formats of TUM and KITTI; tables of numbers.

TUM: ``time x y z qx qy qz qw`` a line, in the map frame, z up. KITTI: the 12 numbers of a 3x4
matrix a line, in the map frame turned to KITTI's axes: x right, y down, z ahead. Both are
poses of the LEFT camera, camera to world. KITTI's own files are of camera 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.frame import Frame
from semviz_core.pose import Pose

TrajectoryFormat: TypeAlias = Literal["tum", "kitti"]
T_MAP_WORLD = Pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""KITTI's world, turned to z up: x ahead, y left."""
MOST_APART_S = 0.01
"""A pose of a TUM file is of the frame that is so near in time."""
_UPRIGHT = 0.5
"""Cosine between the map's z and the direction in which a vehicle's cameras stand, on average."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The poses that a file holds."""

    path: Path
    T_map_camera: tuple[Pose, ...]
    """Of the left camera, in a map frame with z up."""
    time_s: FloatArray | None
    """(n,) of each pose; None where the n-th pose is that of frame n (KITTI)."""

    def of_frames(self, indices: Sequence[int], times_s: FloatArray) -> list[Pose | None]:
        """The pose of each frame; None where a file with times has none.

        Raises SemvizError where a file without times ends before the last frame, or one with
        times has a pose for no frame at all.
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
    """Write the poses of ``frames``; SemvizError where the format cannot, and nothing is written.

    TUM leaves frames without a pose out. KITTI has a line for each and refuses them.
    """
    posed = [(one.time_s, one.T_map_camera) for one in frames if one.T_map_camera is not None]
    without = [one.index for one in frames if one.T_map_camera is None]
    if not posed:
        raise SemvizError("no frame has a pose; there is nothing to write")
    if without and format_ == "kitti":
        raise SemvizError(
            f"frame {without[0]} has no pose ({len(without)} of {len(frames)} frames have none), "
            "and KITTI's format cannot leave any out; say --format tum"
        )
    line = _tum_line if format_ == "tum" else _kitti_line
    with replacing(path) as temporary:
        temporary.write_text("".join(line(*one) for one in posed), encoding="utf-8")


def _tum_line(time_s: float, T_map_camera: Pose) -> str:
    numbers = (time_s, *T_map_camera.translation.tolist(), *T_map_camera.as_quaternion().tolist())
    return " ".join(map(repr, numbers)) + "\n"


def _kitti_line(time_s: float, T_map_camera: Pose) -> str:
    T_world_camera = T_MAP_WORLD.inverse() @ T_map_camera
    return " ".join(map(repr, T_world_camera.as_matrix()[:3].ravel().tolist())) + "\n"


def load_trajectory(path: Path) -> Trajectory:
    """Read a file of either format; SemvizError where it is neither, or its axes are the other's.

    Lines that start with ``#`` are comments.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: no such file of poses")
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    width = len(lines[0][1].split()) if lines else 0
    if width not in (8, 12):
        raise SemvizError(f"{path}: neither TUM's 8 numbers a line nor KITTI's 12")
    rows = [parsed_numbers(line, width, f"{path}, line {number}") for number, line in lines]
    poses = []
    for (number, _), row in zip(lines, rows, strict=True):
        try:
            poses.append(_pose_of_tum(row) if width == 8 else _pose_of_kitti(row))
        except SemvizError as error:
            raise SemvizError(f"{path}, line {number}: {error}") from None
    _check_upright(path, poses)
    return Trajectory(path, tuple(poses), np.array(rows)[:, 0] if width == 8 else None)


def _pose_of_tum(row: FloatArray) -> Pose:
    """Of time, translation and quaternion x, y, z, w, which may be rounded."""
    from scipy.spatial.transform import Rotation

    if not 0.99 < np.linalg.norm(row[4:]) < 1.01:
        raise SemvizError("the last four numbers are no quaternion of length 1")
    return Pose(Rotation.from_quat(row[4:]).as_matrix(), row[1:4])


def _pose_of_kitti(row: FloatArray) -> Pose:
    return T_MAP_WORLD @ Pose.from_matrix(row.reshape(3, 4))


def _check_upright(path: Path, poses: Sequence[Pose]) -> None:
    """Refuses poses in another world's axes: a vehicle's cameras do not look over their side."""
    up = float(np.mean([-pose.rotation[2, 1] for pose in poses]))
    if up < _UPRIGHT:
        raise SemvizError(
            f"{path}: the cameras do not stand upright. In TUM's format the world's z is up, in "
            "KITTI's its y is down; turn the poses, or give them in the other format"
        )


def read_numbers(path: Path, width: int) -> FloatArray:
    """(lines, width) numbers of a text file. Raises SemvizError naming the line that has others."""
    lines = read_text(path).rstrip().splitlines()
    rows = [
        parsed_numbers(line, width, f"{path}, line {number}")
        for number, line in enumerate(lines, 1)
    ]
    return np.array(rows).reshape(-1, width)


def parsed_numbers(text: str, width: int, where: str) -> FloatArray:
    """(width,) finite numbers; else SemvizError, which says that they are from ``where``."""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise SemvizError(f"{where}: {error}; expected {width} numbers") from None
    if len(numbers) != width:
        raise SemvizError(f"{where}: {len(numbers)} numbers, expected {width}")
    if not np.isfinite(numbers).all():
        raise SemvizError(f"{where}: holds NaN or infinite numbers; repair that line")
    return numbers


def read_text(path: Path) -> str:
    """A whole text file. Raises SemvizError where there is none, or no text in it."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SemvizError(f"{path}: no such file; a KITTI sequence needs it") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SemvizError(f"{path}: not a readable text file ({error}); copy it again") from None
