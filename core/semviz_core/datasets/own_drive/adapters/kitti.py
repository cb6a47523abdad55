"""Read KITTI raw and KITTI-360: images, calibration in text files, GNSS/IMU or fused poses.

KITTI raw: ``DATE/DATE_drive_NNNN_sync`` (rectified) or ``_extract`` (as recorded), calibration in
``DATE``, ``oxts`` beside the images. KITTI-360: a root with ``data_2d_raw``, ``calibration`` and
``data_poses``; its perspective pair is rectified, its fisheyes (MEI) are not read.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.datasets.own_drive.images import image_files
from semviz_core.datasets.own_drive.poses.conventions import RecordedPoses, body_axes, local_poses
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.recording import DriveFiles, Recording, chosen_cameras
from semviz_core.datasets.trajectory import parsed_numbers, read_text

_OXTS_NUMBERS = 30
_Table = Mapping[str, FloatArray]


def is_kitti_raw(path: Path) -> bool:
    """Whether a path is a drive of KITTI raw, in the folder of its date."""
    return (path / "oxts").is_dir() or (path.parent / "calib_cam_to_cam.txt").is_file()


def read_kitti_raw(files: DriveFiles) -> Recording:
    """Return cameras 02 and 03, or the chosen ones of image_00 to image_03, with oxts poses."""
    drive = files.images
    known = sorted(path.name for path in drive.glob("image_0[0-3]"))
    pair = [name for name in ("image_02", "image_03") if name in known]
    cameras = chosen_cameras(files, known, pair or known[:1])
    folders = [drive / camera / "data" for camera in cameras]
    right = folders[1] if len(folders) == 2 else None
    names = image_files.list_images(folders[0], right)
    table = _read_table(drive.parent / "calib_cam_to_cam.txt")
    size = image_files.size_of_images(folders[0], names.left)
    T_velo_imu = _rigid(drive.parent / "calib_imu_to_velo.txt")
    T_camera0_velo = _rigid(drive.parent / "calib_velo_to_cam.txt")
    calibration = _calibration(
        drive.parent / "calib_cam_to_cam.txt",
        table,
        [camera[-2:] for camera in cameras],
        size,
        (T_camera0_velo @ T_velo_imu).inverse(),
        "KITTI raw",
    )
    times = _image_times(drive / cameras[0] / "timestamps.txt", folders[0], names)
    return Recording(folders[0], right, names, calibration, times, _read_oxts(drive / "oxts"))


def is_kitti360(path: Path) -> bool:
    """Whether a path is the root of KITTI-360."""
    return (path / "data_2d_raw").is_dir() and (path / "calibration").is_dir()


def read_kitti360(files: DriveFiles) -> Recording:
    """Return the perspective pair of a sequence, or one of it, with the poses of the IMU."""
    root = files.images
    raw = root / "data_2d_raw"
    sequences = sorted(path.name for path in raw.iterdir() if path.is_dir())
    sequence = files.sequence or (sequences[0] if len(sequences) == 1 else "")
    if sequence not in sequences:
        raise SemvizError(
            f"{raw}: choose --sequence of {shown(', '.join(sequences), 300)}, not "
            f"{shown(sequence or 'none', 60)}"
        )
    cameras = chosen_cameras(files, ("image_00", "image_01"), ("image_00", "image_01"))
    folders = [raw / sequence / camera / "data_rect" for camera in cameras]
    right = folders[1] if len(folders) == 2 else None
    names = image_files.list_images(folders[0], right)
    path = root / "calibration" / "perspective.txt"
    to_pose = root / "calibration" / "calib_cam_to_pose.txt"
    T = _numbers(to_pose, _read_table(to_pose), "image_00", 12).reshape(3, 4)
    calibration = _calibration(
        path,
        _read_table(path),
        [camera[-2:] for camera in cameras],
        image_files.size_of_images(folders[0], names.left),
        _pose(to_pose, T[:, :3], T[:, 3]),
        "KITTI-360",
    )
    times = _image_times(raw / sequence / cameras[0] / "timestamps.txt", folders[0], names)
    poses = root / "data_poses" / sequence / "poses.txt"
    recorded = read_poses(poses) if poses.is_file() else None
    return Recording(folders[0], right, names, calibration, times, recorded)


def _calibration(
    path: Path,
    table: _Table,
    cameras: Sequence[str],
    size: tuple[int, int],
    T_body_camera0: Pose,
    format_: str,
) -> CalibrationFile:
    """Return the calibration of one camera or two, of rectified images or of recorded ones.

    The size of the images tells which; rectified cameras are turned by R_rect_00 and shifted along
    x as their P_rect says, recorded ones lie where R and T say.
    """
    rectified = _numbers(path, table, f"S_rect_{cameras[0]}", 2).astype(int).tolist() == [*size]
    found, T_camera_camera0 = [], []
    for name in cameras:
        if rectified:
            P = _numbers(path, table, f"P_rect_{name}", 12).reshape(3, 4)
            found.append(OriginalCamera("pinhole", *size, P[:, :3], np.zeros(0)))
            R_rectified = _pose(path, _numbers(path, table, "R_rect_00", 9), np.zeros(3))
            shift = np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64)
            T_camera_camera0.append(Pose(np.eye(3), shift) @ R_rectified)
        else:
            width, height = _numbers(path, table, f"S_{name}", 2).astype(int).tolist()
            K = _numbers(path, table, f"K_{name}", 9).reshape(3, 3)
            D = _numbers(path, table, f"D_{name}", 5)
            found.append(OriginalCamera("brown-conrady", width, height, K, D))
            R, t = _numbers(path, table, f"R_{name}", 9), _numbers(path, table, f"T_{name}", 3)
            T_camera_camera0.append(_pose(path, R, t))
    T_body_left = T_body_camera0 @ T_camera_camera0[0].inverse()
    T_right_left = None
    if len(cameras) == 2:
        T_right_left = T_camera_camera0[1] @ T_camera_camera0[0].inverse()
    kind = f"{format_}, {'rectified' if rectified else 'as recorded'}"
    return CalibrationFile(path, kind, tuple(found), T_right_left, T_body_left)


def _read_table(path: Path) -> _Table:
    """Return the numbers behind ``name:`` in each line; lines of words are left out."""
    table = {}
    for line in read_text(path).splitlines():
        name, colon, rest = line.partition(":")
        try:
            numbers = [float(word) for word in rest.split()]
        except ValueError:
            continue
        if colon and numbers:
            table[name.strip()] = np.array(numbers)
    return table


def _numbers(path: Path, table: _Table, name: str, count: int) -> FloatArray:
    values = table.get(name)
    if values is None or values.shape != (count,) or not np.isfinite(values).all():
        raise SemvizError(f"{path}: no line {name} with {count} numbers; copy the file again")
    return values


def _rigid(path: Path) -> Pose:
    """Return the pose in a file with the lines R and T."""
    table = _read_table(path)
    return _pose(path, _numbers(path, table, "R", 9), _numbers(path, table, "T", 3))


def _pose(path: Path, R: FloatArray, t: FloatArray) -> Pose:
    """Return the pose of nine numbers of a rotation and three of a translation."""
    try:
        return Pose.from_matrix(np.column_stack([R.reshape(3, 3), t]))
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}") from None


def _image_times(
    path: Path, folder: Path, names: image_files.ImageNames
) -> image_files.ImageTimes | None:
    """Return the times of the listed images; line n is that of image n, which is its name."""
    if not path.is_file():
        return None
    time_s = _read_stamps(path)
    stems = [Path(name).stem for name in names.left]
    if not all(stem.isdecimal() and int(stem) < len(time_s) for stem in stems):
        raise SemvizError(
            f"{path}: {len(time_s)} times, but {folder} has images up to {shown(stems[-1], 40)}; "
            "copy both again"
        )
    return image_files.ImageTimes(_known(path, time_s, [int(stem) for stem in stems]), path.name)


def _read_stamps(path: Path) -> FloatArray:
    """Return times (n,) in s since 1970 of lines such as ``2011-09-26 13:02:25.964389445``.

    Blank lines, which KITTI raw has where a sensor dropped out, are NaN.
    """
    found = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not line.strip():
            found.append(np.nan)
            continue
        seconds, _, fraction = line.strip().partition(".")
        try:
            whole = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            found.append(whole.timestamp() + float(f"0.{fraction or '0'}"))
        except ValueError:
            raise SemvizError(
                f"{path}, line {number}: {shown(line, 40)!r} is not a date and time"
            ) from None
    return np.array(found)


def _known(path: Path, time_s: FloatArray, rows: Sequence[int]) -> FloatArray:
    """Return the times of rows. Raise SemvizError if the line of one is blank."""
    blank = next((row for row in rows if np.isnan(time_s[row])), None)
    if blank is not None:
        raise SemvizError(
            f"{path}, line {blank + 1}: blank, but there is a file of number {blank}; copy the "
            "times again, or remove that file"
        )
    return time_s[list(rows)]


def _read_oxts(folder: Path) -> RecordedPoses | None:
    """Return the poses of the IMU, in metres east, north and up of the first one."""
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        return None
    rows = np.array([parsed_numbers(read_text(file), _OXTS_NUMBERS, str(file)) for file in files])
    stamps = folder / "timestamps.txt"
    time_s = _read_stamps(stamps)
    numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
    if len(numbers) != len(files) or max(numbers) >= len(time_s):
        raise SemvizError(
            f"{folder}: {len(time_s)} times for {len(files)} files; copy the folder again"
        )
    latitude, longitude, height, roll, pitch, yaw = rows[:, :6].T
    matrices = local_poses(latitude, longitude, height, body_axes(yaw, pitch, roll))
    return RecordedPoses(
        folder,
        "oxts",
        matrices,
        of_body=True,
        time_s=_known(stamps, time_s, numbers),
        note=f"yaw from east, metres east and north of {latitude[0]:.7f}, {longitude[0]:.7f}",
    )
