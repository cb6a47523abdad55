"""Find the cameras of a drive: in a calibration file, or in the model that holds its poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive import conventions
from semviz_core.datasets.own_drive.calibration_files import (
    CalibrationFile,
    read_calibration,
    read_rig_calibration,
)
from semviz_core.datasets.own_drive.colmap_model import is_colmap, read_colmap
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.image_files import size_of_images
from semviz_core.datasets.own_drive.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.nerfstudio import read_nerfstudio
from semviz_core.datasets.own_drive.recorded_poses import PosedCameras, RecordedPoses
from semviz_core.datasets.own_drive.recording import Recording
from semviz_core.datasets.own_drive.time_matching import rows_of_names


def read_cameras(
    files: DriveFiles, recording: Recording, posed: PosedCameras | None
) -> tuple[OriginalRig, CalibrationFile]:
    """Return the recorded cameras and their calibration, checked against the size of the images.

    Raise SemvizError if there is no calibration, it is for other images, or it does not say where
    the right camera is.
    """
    calibration = _calibration(files, recording, posed)
    left = calibration.cameras[0]
    _check_size(calibration.path, recording.images, recording.names.left, left)
    if recording.right is None:
        return OriginalRig(left), calibration
    if calibration.T_right_left is None:
        raise SemvizError(
            f"{calibration.path}: says nothing about a right camera; give --right-calibration "
            "FILE, a TOML file with T_right_left (see docs/own-drive.md), or leave out --right"
        )
    right = calibration.cameras[1]
    _check_size(calibration.path, recording.right, recording.names.right, right)
    return OriginalRig(left, right, calibration.T_right_left), calibration


def _calibration(
    files: DriveFiles, recording: Recording, posed: PosedCameras | None
) -> CalibrationFile:
    """Return the calibration of ``--calibration``, of the recording, or of the model of poses."""
    if files.calibration is None:
        if recording.calibration is not None:
            return recording.calibration
        if posed is None or not posed.cameras:
            raise SemvizError(
                f"{files.images}: no calibration. A guess would be wrong; give --calibration FILE "
                "(Kalibr, ROS camera_info, OpenCV, EuRoC, or semviz's TOML)"
            )
        return _model_calibration(files, recording, posed)
    path = files.calibration
    if is_colmap(path) or path.suffix == ".json":
        cameras = read_colmap(path) if is_colmap(path) else read_nerfstudio(path)
        return _model_calibration(files, recording, cameras)
    if files.rig:
        return read_rig_calibration(path, files.rig, files.cameras[0])
    return read_calibration(path, files.right_calibration)


def _model_calibration(
    files: DriveFiles, recording: Recording, posed: PosedCameras
) -> CalibrationFile:
    """Return the cameras of a model, and the mean pose of the right one in it, in metres."""
    names = recording.names
    left = _camera_of(recording.images, names.left, posed)
    if recording.right is None:
        return CalibrationFile(posed.poses.path, posed.poses.format, (left,))
    right = _camera_of(recording.right, names.right, posed)
    T = conventions.camera_poses(posed.poses, files.direction, files.axes)
    rows = zip(
        rows_of_images(recording.images, names.left, posed.poses),
        rows_of_images(recording.right, names.right, posed.poses),
        strict=True,
    )
    pairs = [(T[a], T[b]) for a, b in rows if a is not None and b is not None]
    if not pairs:
        raise SemvizError(f"{posed.poses.path}: no frame has poses of both cameras")
    T_right_left = _mean_pose([b.inverse() @ a for a, b in pairs])
    meters = files.scale or 1.0
    scaled = Pose(T_right_left.rotation, T_right_left.translation * meters)
    return CalibrationFile(posed.poses.path, posed.poses.format, (left, right), scaled)


def _mean_pose(poses: Sequence[Pose]) -> Pose:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(np.array([pose.rotation for pose in poses])).mean()
    return Pose(rotation.as_matrix(), np.mean([pose.translation for pose in poses], axis=0))


def rows_of_images(folder: Path, names: Sequence[str], poses: RecordedPoses) -> list[int | None]:
    """Return the row of ``poses``, which have names, of each image of a folder."""
    assert poses.names is not None
    return rows_of_names([folder.resolve() / name for name in names], poses.names)


def _camera_of(folder: Path, names: Sequence[str], posed: PosedCameras) -> OriginalCamera:
    """Return the camera of a folder's images. Raise SemvizError if they have several."""
    assert posed.poses.names is not None
    rows = [row for row in rows_of_images(folder, names, posed.poses) if row is not None]
    cameras = [posed.cameras[posed.poses.names[row]] for row in rows]
    first = cameras[0]
    for camera in cameras:
        if not _same(camera, first):
            raise SemvizError(
                f"{posed.poses.path}: the images of {folder} have several cameras; calibrate them "
                "as one (COLMAP: --ImageReader.single_camera_per_folder 1)"
            )
    return first


def _same(first: OriginalCamera, second: OriginalCamera) -> bool:
    return (
        first.model == second.model
        and (first.width, first.height) == (second.width, second.height)
        and np.array_equal(first.K, second.K)
        and np.array_equal(first.distortion, second.distortion)
    )


def _check_size(path: Path, folder: Path, names: Sequence[str], camera: OriginalCamera) -> None:
    """Raise SemvizError if a calibration is for images of another size."""
    width, height = size_of_images(folder, names)
    if (width, height) != (camera.width, camera.height):
        raise SemvizError(
            f"{folder}: images are {width}x{height}, but {path.name} is the calibration of images "
            f"of {camera.width}x{camera.height}; use the images' own calibration"
        )
