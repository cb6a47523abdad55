"""Read measured poses of a camera or body, from a table or a file of poses, into the map.

A pose may be known in part: a fix without heading, a heading without gravity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.adapters.data_sets import is_comma, read_comma_poses
from semviz_core.datasets.own_drive.cameras.colmap_model import is_colmap, read_colmap
from semviz_core.datasets.own_drive.cameras.recorded_cameras import is_nerfstudio, read_nerfstudio
from semviz_core.datasets.own_drive.poses import conventions
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.poses.sensor_table import SensorTable, read_table
from semviz_core.datasets.own_drive.recording import rows_of_names
from semviz_core.datasets.trajectory import T_MAP_WORLD


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is needed to move measurements to the camera and into the map."""

    T_map_world: Pose | None = field(default_factory=Pose.identity)
    """From the coordinates of the file; None if they are not known."""
    T_map_ecef: Pose | None = None
    """From earth-centred coordinates; None if it is not known where the map is on Earth."""
    T_body_camera: Pose | None = None
    """None: files of camera poses hold those of the left camera, others those of a body in its
    place with x ahead, y left and z up."""
    images: Mapping[int, Path] = field(default_factory=dict)
    """Image files by the numbers of their frames, for files that name images."""

    def frames_named(self, names: Sequence[str]) -> IntArray:
        """Return the number of the frame (n,) that each name is that of, -1 for none."""
        if not self.images:
            raise SemvizError(
                f"names of images such as {names[0]}, but the frames have no image files; give "
                "times or numbers of frames"
            )
        numbers = np.full(len(names), -1)
        rows = rows_of_names(list(self.images.values()), names)
        for frame, row in zip(self.images, rows, strict=True):
            if row is not None:
                numbers[row] = frame
        return numbers

    def in_map(self, path: Path, positions_m: FloatArray) -> Pose:
        """Return what takes the positions (n, 3) of a file to the map; raise SemvizError without.

        Earth-centred positions are recognized by their distance from the earth's centre.
        """
        if conventions.is_earth_centred(positions_m):
            return self.of_earth(path)
        if self.T_map_world is None:
            raise SemvizError(
                f"{path}: this workspace does not know the coordinates of the poses that it was "
                "made with; make it again with 'semviz new', or give --coordinates map"
            )
        return self.T_map_world

    def of_earth(self, path: Path) -> Pose:
        """Return ``T_map_ecef``; raise SemvizError without it."""
        if self.T_map_ecef is None:
            raise SemvizError(
                f"{path}: holds places on Earth, and where the map's origin is on Earth is not "
                "known; give --anchor LATITUDE,LONGITUDE[,HEIGHT]"
            )
        return self.T_map_ecef

    def extrinsic(self, of_body: bool) -> Pose:
        if self.T_body_camera is not None:
            return self.T_body_camera
        return conventions.NAMED_EXTRINSICS["flu" if of_body else "camera"]


@dataclass(frozen=True, eq=False)
class MeasuredPoses:
    """n rows of measurements of the left camera, in the map."""

    path: Path
    position_m: FloatArray
    """(n, 3); a height that was not measured is NaN, a fix that is missing NaN everywhere."""
    R_map_camera: FloatArray
    """(n, 3, 3); level where only a heading was measured, NaN without."""
    has_up: BoolArray
    """(n,) whether the vertical was measured, so that ``R_map_camera`` tells it."""
    time_s: FloatArray | None
    """(n,) ascending; None if rows are those of frames."""
    frame: IntArray | None
    """(n,) numbers of frames, if the file has them."""
    table: SensorTable | None
    """With sigmas and other columns, its rows in the order of these."""

    @property
    def has_heading(self) -> BoolArray:
        """(n,)"""
        return np.asarray(np.isfinite(self.R_map_camera).all(axis=(1, 2)))

    def poses(self) -> list[Pose | None]:
        """Return T_map_camera of each row; None where it is known in part only."""
        known = self.has_heading & np.isfinite(self.position_m).all(axis=1)
        rows = zip(self.R_map_camera, self.position_m, known.tolist(), strict=True)
        return [Pose(R, t) if is_known else None for R, t, is_known in rows]


def read_poses_or_table(path: Path, around: Surroundings) -> MeasuredPoses:
    """Return poses from a table or a file of whole poses. Raise SemvizError if it is missing."""
    if not path.exists():
        raise SemvizError(f"{path}: no such file; name another")
    is_model = path.is_dir() or path.suffix == ".bin" or is_nerfstudio(path)
    table = None if is_model else read_table(path)
    return read_measured_poses(path, around) if table is None else poses_of_table(table, around)


def read_measured_poses(path: Path, around: Surroundings) -> MeasuredPoses:
    """Return poses from a file or folder of whole poses, in the formats of 'semviz new'."""
    recorded = _read(path)
    T = conventions.camera_poses(recorded, None, None)
    positions = np.array([pose.translation for pose in T])
    T_map_file = _of_kitti(recorded, around) or around.in_map(path, positions)
    T_body_camera = around.extrinsic(recorded.of_body)
    T = [T_map_file @ pose @ T_body_camera for pose in T]
    frame = recorded.indices
    if recorded.names is not None:
        frame = around.frames_named(recorded.names)
    elif recorded.time_s is None and frame is None:
        frame = np.arange(len(T))
    return MeasuredPoses(
        path,
        np.array([pose.translation for pose in T]),
        np.array([pose.rotation for pose in T]),
        np.ones(len(T), dtype=bool),
        None if recorded.names is not None else recorded.time_s,
        frame,
        None,
    )


def _read(path: Path) -> conventions.RecordedPoses:
    if is_colmap(path):
        return read_colmap(path).poses
    if is_nerfstudio(path):
        return read_nerfstudio(path).poses
    return read_comma_poses(path) if is_comma(path) else read_poses(path)


def _of_kitti(recorded: conventions.RecordedPoses, around: Surroundings) -> Pose | None:
    """Return T_map_world of KITTI's axes, where the map's axes are those of TUM's files."""
    is_own = around.T_map_world is None or np.array_equal(around.T_map_world.as_matrix(), np.eye(4))
    return T_MAP_WORLD if recorded.format == "KITTI" and is_own else None


def poses_of_table(table: SensorTable, around: Surroundings) -> MeasuredPoses:
    """Return the poses in a table; columns of positions or rotations may be missing."""
    table = table.rows(table.order)
    position_m, R_map_file = _positions(table, around)
    R_file_body, has_up, of_body = _rotations(table, compass=table.has("latitude", "longitude"))
    T_body_camera = around.extrinsic(of_body)
    R_map_body = R_map_file @ R_file_body
    lever = R_map_body @ T_body_camera.translation
    known = np.asarray(np.isfinite(lever).all(axis=1))
    return MeasuredPoses(
        table.path,
        position_m + np.where(known[:, None], lever, 0.0),
        R_map_body @ T_body_camera.rotation,
        has_up,
        table.values.get("time"),
        _frames(table, around),
        table,
    )


def _frames(table: SensorTable, around: Surroundings) -> IntArray | None:
    if "time" in table:
        return None
    if table.names is not None:
        return around.frames_named(table.names)
    return table.values["frame"].astype(np.int64) if "frame" in table else None


def _positions(table: SensorTable, around: Surroundings) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3) in the map, and R_map_file (n, 3, 3) of the file's axes there."""
    if table.has("latitude", "longitude"):
        latitude, longitude, height = table.columns("latitude", "longitude", "height").T
        T_map_ecef = around.of_earth(table.path)
        positions = conventions.earth_centred(latitude, longitude, np.nan_to_num(height))
        position_m = T_map_ecef.apply(np.where(np.isfinite(positions), positions, np.nan))
        position_m[~np.isfinite(height), 2] = np.nan
        places = zip(latitude.tolist(), longitude.tolist(), strict=True)
        R_map_enu = [T_map_ecef.rotation @ conventions.axes_at(*place).T for place in places]
        return position_m, np.array(R_map_enu)
    positions = table.columns("x", "y", "z")
    known = np.asarray(np.isfinite(positions).all(axis=1))
    T_map_file = around.in_map(table.path, positions[known]) if known.any() else Pose.identity()
    flat = np.asarray(np.isfinite(positions[:, :2]).all(axis=1)) & ~known  # without a height
    position_m = T_map_file.apply(np.where(flat[:, None], np.nan_to_num(positions), positions))
    position_m[flat, 2] = np.nan
    return position_m, np.broadcast_to(T_map_file.rotation, (len(table), 3, 3))


def _rotations(table: SensorTable, compass: bool) -> tuple[FloatArray, BoolArray, bool]:
    """Return R_file_body (n, 3, 3), NaN if unknown; (n,) whether they tell the vertical; and
    whether they are of a body.

    A heading is anticlockwise from x, with ``compass`` clockwise from north, in axes east and
    north.
    """
    if table.has("qx", "qy", "qz", "qw"):
        quaternions = table.columns("qx", "qy", "qz", "qw")
        known = np.asarray(np.isfinite(quaternions).all(axis=1))
        R = np.full((len(table), 3, 3), np.nan)
        if known.any():
            R[known] = conventions.rotations_of(quaternions[known], "xyzw", table.path)
        return R, known, False
    heading, pitch, roll = table.columns("heading", "pitch", "roll").T
    yaw = np.pi / 2.0 - heading if compass else heading
    has_up = np.isfinite(pitch) & np.isfinite(roll)
    R = np.full((len(table), 3, 3), np.nan)
    known = np.isfinite(yaw)
    if known.any():
        angles = -np.nan_to_num(pitch[known]), np.nan_to_num(roll[known])
        R[known] = conventions.body_axes(yaw[known], *angles)
    return R, has_up & known, True
