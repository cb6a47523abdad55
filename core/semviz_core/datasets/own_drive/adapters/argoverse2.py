"""Read a log of Argoverse 2: feather tables of calibration and poses, images named in ns.

``k1, k2, k3`` are radial terms; there are no tangential ones. Poses are of the vehicle, to the
city, quaternions w first.
"""

from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import check_file, first_line, shown
from semviz_core.datasets.own_drive.calibration_files import CalibrationFile
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.image_files import (
    ImageTimes,
    in_seconds,
    list_images,
    pairs_by_time,
)
from semviz_core.datasets.own_drive.lens import OriginalCamera
from semviz_core.datasets.own_drive.recorded_poses import RecordedPoses, rotations_of
from semviz_core.datasets.own_drive.recording import Recording, chosen_cameras

_MOST_BYTES = 2**22
"""Of a table: a log of half a minute has 0.2 MB. Tables are compressed, and may unpack to more."""
_FRONT = "ring_front_center"
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")


def is_argoverse2(path: Path) -> bool:
    """Whether a path is the folder of a log."""
    return (path / "city_SE3_egovehicle.feather").is_file()


def read_argoverse2(files: DriveFiles) -> Recording:
    """Return one camera or two; default: ring_front_center."""
    log = files.images
    folder = log / "sensors" / "cameras"
    known = sorted(path.name for path in folder.glob("*") if path.is_dir())
    chosen = chosen_cameras(files, known, [_FRONT] if _FRONT in known else [])
    names = list_images(folder / chosen[0], None)
    time_s, _ = in_seconds([Path(name).stem for name in names.left], "ns", folder / chosen[0])
    if len(chosen) == 2:
        others = list_images(folder / chosen[1], None).left
        other_s, _ = in_seconds([Path(name).stem for name in others], "ns", folder / chosen[1])
        names, rows = pairs_by_time(names.left, time_s, others, other_s)
        time_s = time_s[rows]
    table = log / "calibration" / "intrinsics.feather"
    mounts = log / "calibration" / "egovehicle_SE3_sensor.feather"
    cameras = [_camera(table, name) for name in chosen]
    T_ego_camera = [_mounted(mounts, name) for name in chosen]
    T_right_left = T_ego_camera[1].inverse() @ T_ego_camera[0] if len(chosen) == 2 else None
    return Recording(
        folder / chosen[0],
        folder / chosen[1] if len(chosen) == 2 else None,
        names,
        CalibrationFile(
            table, f"Argoverse 2, {chosen[0]}", tuple(cameras), T_right_left, T_ego_camera[0]
        ),
        ImageTimes(time_s, "names of the images", "ns"),
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
    matrices = np.concatenate(
        [rotations_of(values[:, 1:5], "wxyz", path), values[:, 5:, None]], axis=2
    )
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
