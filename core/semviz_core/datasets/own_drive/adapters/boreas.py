"""Read a sequence of Boreas: rectified images named in us, poses of the camera in UTM.

Positions have seven digits before the point. Angles are in rad; the rotation to east, north and up
is the product of the transposed elementary rotations about x (roll), y (pitch) and z (heading).
"""

from pathlib import Path

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.calibration_files import CalibrationFile
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.image_files import list_images, size_of_images
from semviz_core.datasets.own_drive.lens import OriginalCamera
from semviz_core.datasets.own_drive.recorded_poses import RecordedPoses
from semviz_core.datasets.own_drive.recording import Recording, chosen_cameras
from semviz_core.datasets.trajectory import parsed_numbers, read_text

_COLUMNS = ("GPSTime", "easting", "northing", "altitude", "roll", "pitch", "heading")


def is_boreas(path: Path) -> bool:
    """Whether a path is the folder of a sequence."""
    return (path / "applanix" / "camera_poses.csv").is_file()


def read_boreas(files: DriveFiles) -> Recording:
    """Return the images of the only camera, with its poses."""
    chosen_cameras(files, ["camera"], ["camera"])
    images = files.images / "camera"
    names = list_images(images, None)
    path = files.images / "calib" / "P_camera.txt"
    P = parsed_numbers(" ".join(read_text(path).split()[:12]), 12, str(path)).reshape(3, 4)
    size = size_of_images(images, names.left)
    camera = OriginalCamera("pinhole", *size, P[:, :3], np.zeros(0))
    poses = _read_poses(files.images / "applanix" / "camera_poses.csv")
    return Recording(images, None, names, CalibrationFile(path, "Boreas", (camera,)), None, poses)


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
