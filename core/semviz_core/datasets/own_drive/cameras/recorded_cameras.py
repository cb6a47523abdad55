"""Find the cameras of a drive: in a calibration file, or in the model that holds its poses.

COLMAP's model is read by ``colmap_model``, nerfstudio's transforms.json here. The latter holds
world from camera, OpenGL axes (x right, y up, z back). Pixels are counted from the corner of the
image there: (0.5, 0.5) is the centre of the first one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_TEXT_BYTES, first_line, parsed_json, read_limited, shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.calibration_files import (
    read_calibration,
    read_rig_calibration,
)
from semviz_core.datasets.own_drive.cameras.colmap_model import (
    is_colmap,
    is_colmap_camera,
    read_colmap,
    read_colmap_camera,
)
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.images.image_files import (
    LeftOutImage,
    UnusableImages,
    refuse_turned_or_dark,
    size_of_images,
    unusable_images,
)
from semviz_core.datasets.own_drive.poses import conventions
from semviz_core.datasets.own_drive.poses.conventions import PosedCameras, RecordedPoses
from semviz_core.datasets.own_drive.recording import DriveFiles, Recording, rows_of_names

_BROWN_NAMES, _FISHEYE_NAMES = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_MODELS: dict[str, tuple[LensModel, tuple[str, ...]]] = {
    "OPENCV": ("brown-conrady", _BROWN_NAMES),
    "PINHOLE": ("brown-conrady", _BROWN_NAMES),
    "SIMPLE_PINHOLE": ("brown-conrady", _BROWN_NAMES),
    "OPENCV_FISHEYE": ("fisheye", _FISHEYE_NAMES),
}


def is_nerfstudio(path: Path) -> bool:
    """Whether a JSON file lists the frames of a model; others are calibrations."""
    return path.suffix == ".json" and b'"frames"' in read_limited(path, MOST_TEXT_BYTES)


def read_nerfstudio(path: Path) -> PosedCameras:
    """Return poses and cameras. Raise SemvizError if the file is damaged, or a model not read."""
    try:
        content = parsed_json(read_limited(path, MOST_TEXT_BYTES))
        names = [str(frame["file_path"]) for frame in content["frames"]]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SemvizError(
            f"{path}: not nerfstudio's transforms.json ({first_line(error)}); name another file"
        ) from None
    if not names:
        raise SemvizError(f"{path}: holds no frames")
    matrices, cameras = [], {}
    for name, frame in zip(names, content["frames"], strict=True):
        where = f"{path}, {shown(name, 80)}"
        matrices.append(_matrix(where, frame.get("transform_matrix")))
        cameras[name] = _camera(where, {**content, **frame})
    poses = RecordedPoses(
        path, "nerfstudio", np.array(matrices), axes="opengl", metric=False, names=tuple(names)
    )
    return PosedCameras(poses, cameras)


def _matrix(where: str, value: Any) -> FloatArray:
    try:
        matrix = np.array(value, dtype=np.float64)
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
            raise ValueError("not 4x4 finite numbers")
    except (TypeError, ValueError, OverflowError) as error:
        raise SemvizError(f"{where}: transform_matrix: {first_line(error)}") from None
    try:
        rotation = nearest_rotation(matrix[:3, :3])
    except SemvizError as error:
        raise SemvizError(f"{where}: transform_matrix: {error}") from None
    return np.column_stack([rotation, matrix[:3, 3]])


def _camera(where: str, table: Mapping[str, Any]) -> OriginalCamera:
    """Return the camera; only nerfstudio's own files name its model, instant-ngp's do not."""
    name = str(table.get("camera_model", "OPENCV"))
    if name not in _MODELS:
        raise SemvizError(
            f"{where}: camera_model {shown(name, 40)} is not read; only {', '.join(_MODELS)} are"
        )
    model, coefficients = _MODELS[name]
    try:
        fx = float(table["fl_x"])
        fy = float(table.get("fl_y", fx))
        cx, cy = float(table["cx"]) - 0.5, float(table["cy"]) - 0.5
        width, height = int(table["w"]), int(table["h"])
        distortion = np.array([float(table.get(term, 0.0)) for term in coefficients])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SemvizError(
            f"{where}: fl_x, cx, cy, w and h are needed ({first_line(error)})"
        ) from None
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if model == "brown-conrady" and not distortion.any():
        model, distortion = "pinhole", np.zeros(0)
    try:
        return OriginalCamera(model, width, height, K, distortion)
    except SemvizError as error:
        raise SemvizError(f"{where}: {error}") from None


def read_cameras(
    files: DriveFiles, recording: Recording, posed: PosedCameras | None
) -> tuple[OriginalRig, CalibrationFile, UnusableImages]:
    """Return the recorded cameras, their calibration, and the images that are unusable with it.

    Raise SemvizError if there is no calibration, it is for other images, or it does not say where
    the right camera is.
    """
    calibration = _calibration(files, recording, posed)
    left = calibration.cameras[0]
    names = recording.names
    unusable = _check_images(calibration.path, recording.images, names.left, left, "left")
    if recording.right is None:
        return OriginalRig(left), calibration, unusable
    if calibration.T_right_left is None:
        raise SemvizError(
            f"{calibration.path}: says nothing about a right camera; give --right-calibration "
            "FILE, a TOML file with T_right_left (see docs/own-drive.md), or leave out --right"
        )
    right = calibration.cameras[1]
    unusable += _check_images(calibration.path, recording.right, names.right, right, "right")
    return OriginalRig(left, right, calibration.T_right_left), calibration, unusable


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
    if is_colmap(path):
        return _model_calibration(files, recording, read_colmap(path))
    if is_colmap_camera(path):
        return read_colmap_camera(path)
    if is_nerfstudio(path):
        return _model_calibration(files, recording, read_nerfstudio(path))
    if files.rig:
        return read_rig_calibration(path, files.rig, files.cameras[0])
    size = size_of_images(recording.images, recording.names.left)
    return read_calibration(path, files.right_calibration, size=size)


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


def _check_images(
    path: Path, folder: Path, names: Sequence[str], camera: OriginalCamera, side: Side
) -> UnusableImages:
    """Return the images that cannot be used.

    Raise SemvizError if a calibration is for images of another size, or these are unusual.
    """
    width, height = size_of_images(folder, names)
    if (width, height) == (camera.width, camera.height):
        why = unusable_images(folder, names, (width, height))
        usable = [name for name in names if name not in why]
        refuse_turned_or_dark(folder / usable[len(usable) // 2])
        return tuple(
            (row, LeftOutImage(name, side, None, why[name]))
            for row, name in enumerate(names)
            if name in why
        )
    scale = width / camera.width
    remedy = "use the images' own calibration"
    if abs(height - scale * camera.height) <= 1.0:
        remedy += (
            f", or, if they were scaled by {scale:.4g}, multiply focal lengths by that and take "
            f"{scale:.4g} * (c + 0.5) - 0.5 for both numbers c of the centre"
        )
    raise SemvizError(
        f"{folder}: images are {width}x{height}, but {path.name} is the calibration of images "
        f"of {camera.width}x{camera.height}; {remedy}"
    )
