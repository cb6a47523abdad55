"""Recognize the layout of a recording and read it; those of smaller data sets are read here.

- Argoverse 2: feather tables of calibration and poses, images named in ns. ``k1, k2, k3`` are
  radial terms; there are no tangential ones. Poses are of the vehicle, to the city, quaternions w
  first.
- Boreas: rectified images named in us, poses of the camera in UTM, with seven digits before the
  point. Angles are in rad; the rotation to east, north and up is the product of the transposed
  elementary rotations about x (roll), y (pitch) and z (heading).
- EuRoC: ``mav0`` with cam0, cam1 and state_groundtruth_estimate0.
- comma2k19's ``global_pose``: a pose for each frame of its video, in earth-centred metres.
  ``frame_orientations`` are quaternions, w first, from ECEF to axes ahead, right, down; the camera
  looks ahead. The arrays are .npy files without that ending. Nothing is unpickled.
"""

from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import check_file, first_line, read_limited, shown
from semviz_core.datasets.own_drive import recording
from semviz_core.datasets.own_drive.adapters import kitti, nuscenes, rosbag
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.datasets.own_drive.images import image_files
from semviz_core.datasets.own_drive.poses.conventions import (
    NAMED_EXTRINSICS,
    RecordedPoses,
    matrices_of,
    rotations_of,
)
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.trajectory import parsed_numbers, read_text

_MOST_BYTES = 2**22
"""Of a table: a log of half a minute has 0.2 MB. Tables are compressed, and may unpack to more."""
_FRONT = "ring_front_center"
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")


def is_argoverse2(path: Path) -> bool:
    """Whether a path is the folder of a log."""
    return (path / "city_SE3_egovehicle.feather").is_file()


def read_argoverse2(files: recording.DriveFiles) -> recording.Recording:
    """Return one camera or two; default: ring_front_center."""
    log = files.images
    folder = log / "sensors" / "cameras"
    known = sorted(path.name for path in folder.glob("*") if path.is_dir())
    chosen = recording.chosen_cameras(files, known, [_FRONT] if _FRONT in known else [])
    names = image_files.list_images(folder / chosen[0], None)
    time_s, _ = image_files.in_seconds(
        [Path(name).stem for name in names.left], "ns", folder / chosen[0]
    )
    if len(chosen) == 2:
        others = image_files.list_images(folder / chosen[1], None).left
        other_s, _ = image_files.in_seconds(
            [Path(name).stem for name in others], "ns", folder / chosen[1]
        )
        names, rows = image_files.pairs_by_time(names.left, time_s, others, other_s)
        time_s = time_s[rows]
    table = log / "calibration" / "intrinsics.feather"
    mounts = log / "calibration" / "egovehicle_SE3_sensor.feather"
    cameras = [_camera(table, name) for name in chosen]
    T_ego_camera = [_mounted(mounts, name) for name in chosen]
    T_right_left = T_ego_camera[1].inverse() @ T_ego_camera[0] if len(chosen) == 2 else None
    return recording.Recording(
        folder / chosen[0],
        folder / chosen[1] if len(chosen) == 2 else None,
        names,
        CalibrationFile(
            table, f"Argoverse 2, {chosen[0]}", tuple(cameras), T_right_left, T_ego_camera[0]
        ),
        image_files.ImageTimes(time_s, "names of the images", "ns"),
        _poses(log / "city_SE3_egovehicle.feather"),
    )


def _camera(path: Path, name: str) -> OriginalCamera:
    fx, fy, cx, cy, k1, k2, k3, width, height = _row(path, name, _INTRINSICS).tolist()
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = np.array([k1, k2, 0.0, 0.0, k3])
    return OriginalCamera("brown-conrady", int(width), int(height), K, distortion)


def _mounted(path: Path, name: str) -> Pose:
    values = _row(path, name, _POSE)
    return Pose(rotations_of(values[None, :4], "wxyz", path)[0], values[4:])


def _poses(path: Path) -> RecordedPoses:
    table = _read_table(path)
    values = _columns(path, table, ("timestamp_ns", *_POSE))
    order = np.argsort(values[:, 0], kind="stable")
    matrices = matrices_of(values[:, 5:], values[:, 1:5], "wxyz", path)
    return RecordedPoses(
        path,
        "Argoverse 2",
        matrices[order],
        of_body=True,
        time_s=values[order, 0] * 1e-9,
        time_unit="ns",
        quaternion="wxyz",
    )


def _row(path: Path, name: str, columns: tuple[str, ...]) -> FloatArray:
    """Return the numbers of the sensor called ``name``."""
    table = _read_table(path)
    is_named = "sensor_name" in table.column_names and _is_text(table["sensor_name"])
    names = table["sensor_name"].to_pylist() if is_named else []
    if name not in names:
        raise SemvizError(f"{path}: no sensor {shown(name, 60)}; copy the file of this log")
    return np.asarray(_columns(path, table, columns)[names.index(name)])


def _columns(path: Path, table: Any, columns: tuple[str, ...]) -> FloatArray:
    try:
        values = np.column_stack([table[name].to_numpy().astype(np.float64) for name in columns])
    except (KeyError, ValueError, TypeError) as error:
        raise SemvizError(f"{path}: not a table of Argoverse 2 ({first_line(error)})") from None
    if not len(values) or not np.isfinite(values).all():
        raise SemvizError(f"{path}: empty, or with numbers that are not finite; copy it again")
    return values


def _read_table(path: Path) -> Any:
    from pyarrow import ArrowException, feather

    check_file(path, _MOST_BYTES)
    try:
        table = feather.read_table(path)
        table.validate(full=True)  # else texts could lie outside of their memory
    except (ArrowException, OSError) as error:
        raise SemvizError(f"{path}: not a feather table ({first_line(error)})") from None
    if len(set(table.column_names)) != len(table.column_names):
        raise SemvizError(f"{path}: two columns of one name; copy the file again")
    return table


def _is_text(column: Any) -> bool:
    import pyarrow as pa

    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


_COLUMNS = ("GPSTime", "easting", "northing", "altitude", "roll", "pitch", "heading")


def is_boreas(path: Path) -> bool:
    """Whether a path is the folder of a sequence."""
    return (path / "applanix" / "camera_poses.csv").is_file()


def read_boreas(files: recording.DriveFiles) -> recording.Recording:
    """Return the images of the only camera, with its poses."""
    recording.chosen_cameras(files, ["camera"], ["camera"])
    images = files.images / "camera"
    names = image_files.list_images(images, None)
    path = files.images / "calib" / "P_camera.txt"
    P = parsed_numbers(" ".join(read_text(path).split()[:12]), 12, str(path)).reshape(3, 4)
    size = image_files.size_of_images(images, names.left)
    camera = OriginalCamera("pinhole", *size, P[:, :3], np.zeros(0))
    poses = _read_poses(files.images / "applanix" / "camera_poses.csv")
    return recording.Recording(
        images, None, names, CalibrationFile(path, "Boreas", (camera,)), None, poses
    )


def _read_poses(path: Path) -> RecordedPoses:
    header, *lines = [line for line in read_text(path).splitlines() if line.strip()] or [""]
    columns = header.split(",")
    missing = [name for name in _COLUMNS if name not in columns]
    if missing or not lines:
        raise SemvizError(f"{path}: {f'no column {missing[0]}' if missing else 'no poses'}")
    rows = np.array(
        [
            parsed_numbers(line.replace(",", " "), len(columns), f"{path}, line {number}")
            for number, line in enumerate(lines, 2)
        ]
    )
    time_us, east, north, up, roll, pitch, heading = rows[:, list(map(columns.index, _COLUMNS))].T
    R = _about(0, roll) @ _about(1, pitch) @ _about(2, heading)
    matrices = np.concatenate([R, np.column_stack([east, north, up])[:, :, None]], axis=2)
    order = np.argsort(time_us, kind="stable")
    return RecordedPoses(
        path, "Boreas", matrices[order], time_s=time_us[order] * 1e-6, time_unit="us"
    )


def _about(axis: int, angle_rad: FloatArray) -> FloatArray:
    """Return (n, 3, 3), the transposed rotations about an axis."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_rotvec(angle_rad[:, None] * np.eye(3)[axis])
    return np.asarray(rotations.inv().as_matrix()).reshape(-1, 3, 3)


_POSES = ("state_groundtruth_estimate0", "data.csv")


def is_euroc(path: Path) -> bool:
    """Whether a path is ``mav0`` or the folder around it."""
    return (_folder(path) / "cam0" / "sensor.yaml").is_file()


def read_euroc(files: recording.DriveFiles) -> recording.Recording:
    """Return cam0 and cam1, or the chosen cameras; images are named by their time in ns."""
    folder = _folder(files.images)
    known = sorted(path.parent.name for path in folder.glob("cam*/sensor.yaml"))
    cameras = recording.chosen_cameras(files, known, known[:2])
    sides = [folder / camera for camera in cameras]
    calibration = read_calibration(*(side / "sensor.yaml" for side in sides))
    if calibration.T_body_left is None:
        raise SemvizError(f"{sides[0] / 'sensor.yaml'}: no T_BS; complete it")
    images, *right = (side / "data" for side in sides)
    poses = folder.joinpath(*_POSES)
    return recording.Recording(
        images,
        right[0] if right else None,
        image_files.list_images(images, right[0] if right else None),
        calibration,
        poses=read_poses(poses, files.quaternion, files.time_unit) if poses.is_file() else None,
    )


def _folder(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


_MOST_ARRAY_BYTES = 2**27


def is_comma(path: Path) -> bool:
    """Whether a path is a folder ``global_pose``."""
    return (path / "frame_positions").is_file()


def read_comma_poses(path: Path) -> RecordedPoses:
    """Return a pose of the camera for each frame, in order. Raise SemvizError if damaged."""
    positions = _array(path / "frame_positions", 3)
    quaternions = _array(path / "frame_orientations", 4)
    if len(positions) != len(quaternions):
        raise SemvizError(
            f"{path}: {len(positions)} positions, but {len(quaternions)} orientations; copy again"
        )
    rotations = rotations_of(quaternions, "wxyz", path) @ NAMED_EXTRINSICS["frd"].rotation
    matrices = np.concatenate([rotations, positions[:, :, None]], axis=2)
    return RecordedPoses(path, "comma2k19", matrices, quaternion="wxyz")


def _array(path: Path, width: int) -> FloatArray:
    data = BytesIO(read_limited(path, _MOST_ARRAY_BYTES))
    try:
        values = np.lib.format.read_array(data, allow_pickle=False)
        return float_array(values, (None, width), str(path))
    except (ValueError, TypeError, EOFError, MemoryError, SyntaxError, TokenError) as error:
        raise SemvizError(f"{path}: not an array of numbers ({first_line(error)})") from None


ADAPTERS: dict[str, tuple[Callable[[Path], bool], recording.Adapter]] = {
    "bag": (rosbag.is_bag, rosbag.read_bag),
    "nuScenes": (nuscenes.is_nuscenes, nuscenes.read_nuscenes),
    "KITTI-360": (kitti.is_kitti360, kitti.read_kitti360),
    "KITTI raw": (kitti.is_kitti_raw, kitti.read_kitti_raw),
    "EuRoC": (is_euroc, read_euroc),
    "Argoverse 2": (is_argoverse2, read_argoverse2),
    "Boreas": (is_boreas, read_boreas),
}
"""By the name of a layout: whether a path has it, and its adapter."""


def read_recording(files: recording.DriveFiles) -> recording.Recording:
    """Return the recording at ``files.images``: one of a known layout, or folders of images.

    Raise SemvizError if it is damaged, or an option is not for such a source.
    """
    for is_layout, read in ADAPTERS.values():
        if is_layout(files.images):
            if files.right is not None:
                raise SemvizError(
                    f"{files.images}: a recording of several cameras; choose the right one with "
                    "--cameras LEFT,RIGHT instead of --right"
                )
            return read(files)
    if files.rig and files.sequence is None:
        return recording.read_image_folders(replace(files, images=_folder_of_camera(files)))
    if files.cameras or files.sequence is not None:
        option = "--cameras" if files.cameras else "--sequence"
        raise SemvizError(
            f"{files.images}: a folder of images, where {option} has no meaning; if it holds a "
            "folder for each of several cameras, add --rig"
        )
    return recording.read_image_folders(files)


def _folder_of_camera(files: recording.DriveFiles) -> Path:
    """Return the folder of the one camera of a rig that ``files`` are of."""
    (name,) = files.cameras
    folder = files.images / name
    if Path(name).name != name or not folder.is_dir():
        known = sorted(path.name for path in files.images.glob("*") if path.is_dir())
        raise SemvizError(
            f"{files.images}: no folder {shown(name, 60)} of a camera; --cameras FIRST,SECOND,... "
            f"of {shown(', '.join(known) or 'none', 300)}"
        )
    return folder
