"""Read a camera, or a stereo pair, from a calibration file; its format is recognized.

Kalibr's camchain, ROS's camera_info, EuRoC's sensor.yaml, OpenCV's YAML and an own short TOML:

    [left]                                   # and [right]
    size_px = [1024, 768]
    model = "brown-conrady"                  # or "pinhole", "fisheye"
    focal_px = [831.56, 833.68]
    center_px = [510.61, 391.52]             # (0, 0) is the centre of the top-left pixel
    distortion = [-0.357, 0.144, 0.0, 0.0]

    T_right_left = [[1, 0, 0, -0.12], [0, 1, 0, 0], [0, 0, 1, 0]]   # above [left]; stereo
    T_body_left = ...                        # if poses are those of a body, such as an IMU

A rig of several cameras has a table for each, ``[cameras.front]``, with the same and
``T_body_camera`` for any body, such as the first camera.

Others name the numbers of a camera one by one, or list them: ``named_calibrations``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import read_toml, shown
from semviz_core.datasets.own_drive.cameras.calibration import (
    CalibrationFile,
    camera_of_numbers,
    focal_and_center,
    lens_model,
    needed,
    pose_of_numbers,
    unknown_model,
)
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera
from semviz_core.datasets.own_drive.cameras.named_calibrations import (
    Size,
    listed_camera,
    named_camera,
)
from semviz_core.datasets.own_drive.cameras.yaml_files import numbers_of, read_yaml
from semviz_core.datasets.trajectory import read_text


def read_calibration(
    path: Path, right: Path | None = None, *, size: Size | None = None
) -> CalibrationFile:
    """Return the calibration in ``path``; ``right`` is the file of the right camera, if separate.

    ``size`` is that of the images, for files that do not say it. Raise SemvizError if a file is of
    no known format, or its model is not among ``READ_MODELS``.
    """
    left_file = _read_file(path, size)
    if right is None:
        return left_file
    return stereo_calibration(left_file, _read_file(right, size))


def read_rig_calibration(path: Path, names: Sequence[str], name: str) -> CalibrationFile:
    """Return the calibration of one camera of a rig, from a file of all, or a folder of files.

    Of Kalibr, ``cam0`` is the first of ``names``; files in a folder are called like their cameras.
    Raise SemvizError as ``read_calibration`` does, or if the camera is not there.
    """
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.stem == name)
        if len(found) != 1:
            raise SemvizError(f"{path}: {len(found)} files {shown(name, 60)}.*; give one a camera")
        return _read_file(found[0])
    if path.suffix == ".toml":
        return _own_of_rig(path, read_toml(path), name)
    content = read_yaml(path) if path.is_file() else {}
    if "cam0" not in content:
        raise SemvizError(
            f"{path}: not a calibration of a rig: give a Kalibr camchain, semviz's TOML with "
            f"[cameras.{shown(name, 60)}], or a folder with a file for each camera"
        )
    return _kalibr_of_rig(path, content, names.index(name))


def stereo_calibration(left: CalibrationFile, right: CalibrationFile) -> CalibrationFile:
    """Return the calibration of a pair, each camera of which has its own.

    Raise SemvizError if nothing says where the right camera is.
    """
    T_right_left = _relative_pose(left, right)
    if T_right_left is None:
        raise SemvizError(
            f"{right.path}: does not say where the right camera is (no pose in a body, no baseline "
            "in its projection matrix); give T_right_left in a TOML file, see docs/own-drive.md"
        )
    return replace(left, cameras=(left.cameras[0], right.cameras[0]), T_right_left=T_right_left)


def _relative_pose(left: CalibrationFile, right: CalibrationFile) -> Pose | None:
    if left.T_body_left is not None and right.T_body_left is not None:
        return right.T_body_left.inverse() @ left.T_body_left
    (R_left, _), (R_right, offset_m) = left.rectified, right.rectified
    if R_left is None or R_right is None or not offset_m:
        return None
    return R_right.inverse() @ Pose(np.eye(3), np.array([offset_m, 0.0, 0.0])) @ R_left


def _read_file(path: Path, size: Size | None = None) -> CalibrationFile:
    if not path.is_file():
        raise SemvizError(f"{path}: no such calibration file; name another with --calibration")
    if path.suffix == ".toml":
        return _own(path, read_toml(path))
    if path.suffix == ".ini":
        return camera_info(path, _ini(path))
    if path.suffix == ".txt" and (listed := listed_camera(path, size)) is not None:
        return listed
    content = read_yaml(path)
    if content.get("model_type") == "MEI" or "mirror_parameters" in content:
        raise unknown_model(path, "MEI (a mirror or a fisheye with xi)")
    if "cam0" in content:
        return _kalibr(path, content)
    if "T_BS" in content or "intrinsics" in content:
        return _euroc(path, content)
    if "distortion_model" in content or {"d", "k", "p"} <= content.keys():
        return camera_info(path, content)
    if any(name in content for name in _OPENCV_K):
        return _opencv(path, content)
    named = named_camera(path, content, size)
    if named is not None:
        return named
    if "P0" in content:
        raise SemvizError(
            f"{path}: a calibration of KITTI odometry: use --kitti ROOT instead of --images, "
            "or write its numbers into a TOML file (docs/own-drive.md)"
        )
    raise SemvizError(
        f"{path}: no calibration that is read: Kalibr's camchain, ROS's camera_info, EuRoC's "
        "sensor.yaml, OpenCV's camera_matrix, fx, fy, cx, cy by name, or semviz's TOML"
    )


def _own(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    known = {"left", "right", "T_right_left", "T_body_left"}
    if unknown := sorted(content.keys() - known):
        raise SemvizError(f"{path}: unknown {shown(unknown[0])}; it may hold {sorted(known)}")
    cameras = [
        _own_camera(path, f"{path}, [{side}]", content.get(side, {}))
        for side in ("left", "right")
        if side in content or side == "left"
    ]
    T_right_left, T_body_left = (
        pose_of_numbers(content[name], f"{path}, {name}") if name in content else None
        for name in ("T_right_left", "T_body_left")
    )
    if (len(cameras) == 2) != (T_right_left is not None):
        raise SemvizError(f"{path}: give both [right] and T_right_left, or neither")
    return CalibrationFile(path, "semviz", tuple(cameras), T_right_left, T_body_left)


def _own_camera(path: Path, where: str, table: Any) -> OriginalCamera:
    if not isinstance(table, dict):
        raise SemvizError(f"{where}: not a table; see docs/own-drive.md")
    numbers = np.concatenate(
        [
            numbers_of(needed(table, where, name), (2,), f"{where}, {name}")
            for name in ("focal_px", "center_px")
        ]
    )
    size = numbers_of(needed(table, where, "size_px"), (2,), f"{where}, size_px")
    distortion = numbers_of(table.get("distortion", []), (None,), f"{where}, distortion")
    model = lens_model(path, needed(table, where, "model"))
    return camera_of_numbers(where, model, size, numbers, distortion)


def _own_of_rig(path: Path, content: Mapping[str, Any], name: str) -> CalibrationFile:
    cameras = content.get("cameras")
    if not isinstance(cameras, dict) or name not in cameras:
        raise SemvizError(f"{path}: no table [cameras.{shown(name, 60)}]; see docs/own-drive.md")
    where = f"{path}, [cameras.{shown(name, 60)}]"
    camera = _own_camera(path, where, cameras[name])
    T = cameras[name].get("T_body_camera")
    T_body_camera = None if T is None else pose_of_numbers(T, f"{where}, T_body_camera")
    return CalibrationFile(path, "semviz", (camera,), None, T_body_camera)


def _kalibr(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    """Read a camchain: the name of a key says the direction of the pose."""
    left = _kalibr_of_rig(path, content, 0)
    if "cam1" not in content:
        return left
    right = _kalibr_of_rig(path, content, 1)
    T_right_left = None
    if right.T_first_left is not None:
        T_right_left = right.T_first_left.inverse()
    elif left.T_body_left is not None and right.T_body_left is not None:
        T_right_left = right.T_body_left.inverse() @ left.T_body_left
    else:
        return left
    return replace(left, cameras=left.cameras + right.cameras, T_right_left=T_right_left)


def _kalibr_table(path: Path, content: Mapping[str, Any], number: int) -> Mapping[str, Any]:
    table = content.get(f"cam{number}")
    if not isinstance(table, dict):
        raise SemvizError(f"{path}, cam{number}: missing, or not a mapping; repair it")
    return table


def _kalibr_of_rig(path: Path, content: Mapping[str, Any], number: int) -> CalibrationFile:
    """Return the calibration of one camera of a chain."""
    where = f"{path}, cam{number}"
    tables = [_kalibr_table(path, content, other) for other in range(number + 1)]
    table = tables[number]
    if table.get("camera_model", "pinhole") != "pinhole":
        raise unknown_model(path, str(table["camera_model"]))
    camera = _listed_camera(path, where, table, "distortion_coeffs")
    T_first_camera: Pose | None = Pose.identity()
    for other, chained in enumerate(tables[1:], 1):
        before = chained.get("T_cn_cnm1")
        if before is None or T_first_camera is None:
            T_first_camera = None
        else:
            T_camera_before = pose_of_numbers(before, f"{path}, cam{other}, T_cn_cnm1")
            T_first_camera = T_first_camera @ T_camera_before.inverse()
    T_body_camera = _imu_from_camera(table, where)
    return CalibrationFile(
        path, "Kalibr", (camera,), None, T_body_camera, T_first_left=T_first_camera
    )


def _imu_from_camera(table: Mapping[str, Any], where: str) -> Pose | None:
    if table.get("T_imu_cam") is not None:
        return pose_of_numbers(table["T_imu_cam"], f"{where}, T_imu_cam")
    if table.get("T_cam_imu") is not None:
        return pose_of_numbers(table["T_cam_imu"], f"{where}, T_cam_imu").inverse()
    return None


def _listed_camera(
    path: Path, where: str, table: Mapping[str, Any], coefficients: str
) -> OriginalCamera:
    """Return the camera of Kalibr's and EuRoC's lists."""
    return camera_of_numbers(
        where,
        lens_model(path, table.get("distortion_model")),
        numbers_of(needed(table, where, "resolution"), (2,), f"{where}, resolution"),
        numbers_of(needed(table, where, "intrinsics"), (4,), f"{where}, intrinsics"),
        numbers_of(table.get(coefficients) or [], (None,), f"{where}, {coefficients}"),
    )


def _euroc(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    if content.get("camera_model", "pinhole") != "pinhole":
        raise unknown_model(path, str(content["camera_model"]))
    camera = _listed_camera(path, str(path), content, "distortion_coefficients")
    T_body_left = pose_of_numbers(content["T_BS"], f"{path}, T_BS") if "T_BS" in content else None
    return CalibrationFile(path, "EuRoC", (camera,), None, T_body_left)


_INI_NAMES = {
    "width": "width",
    "height": "height",
    "camera matrix": "k",
    "distortion": "d",
    "rectification": "r",
    "projection": "p",
}
_INI_MODELS = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}


def _ini(path: Path) -> dict[str, Any]:
    """Return the values of a ROS .ini, which names no lens model: the count of terms tells it."""
    values: dict[str, list[float]] = {}
    name = ""
    for line in read_text(path).splitlines():
        text = line.strip()
        if text.lower() in _INI_NAMES:
            name = _INI_NAMES[text.lower()]
            if name in values:
                raise SemvizError(f"{path}: several cameras; give one file for each")
            values[name] = []
        elif text and text[0] not in "#;[" and name:
            values[name] += numbers_of(list(text.split()), (None,), f"{path}, {name}").tolist()
    content: dict[str, Any] = {
        key: row[0] if key in ("width", "height") and row else row for key, row in values.items()
    }
    count = len(values.get("d", ()))
    if count not in _INI_MODELS:
        raise SemvizError(f"{path}: {count} distortion terms; only 4, 5 and 8 are read")
    return {**content, "distortion_model": _INI_MODELS[count]}


def camera_info(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    """Return the calibration in a camera_info, with the names of its YAML or its message.

    K and D are of the recorded images, P of ROS's rectified ones. Raise SemvizError with ``path``.
    """
    where = str(path)
    for name in ("binning_x", "binning_y"):
        if content.get(name) not in (None, 0, 1):
            raise SemvizError(f"{path}: {name} {content[name]} is not read; record without binning")
    roi = content.get("roi")
    if isinstance(roi, dict) and (roi.get("x_offset") or roi.get("y_offset")):
        raise SemvizError(f"{path}: a region of interest (roi) is not read; record whole images")
    size = [needed(content, where, f"image_{side}", side) for side in ("width", "height")]
    coefficients = needed(content, where, "distortion_coefficients", "d", "D")
    camera = camera_of_numbers(
        where,
        lens_model(path, content.get("distortion_model")),
        numbers_of(size, (2,), where),
        focal_and_center(needed(content, where, "camera_matrix", "k", "K"), f"{path}, K"),
        numbers_of(coefficients, (None,), f"{path}, D"),
    )
    projection = content.get("projection_matrix", content.get("p", content.get("P")))
    turn = content.get("rectification_matrix", content.get("r", content.get("R")))
    if projection is None or turn is None:
        return CalibrationFile(path, "ROS camera_info", (camera,))
    P = numbers_of(projection, (3, 4), f"{path}, P")
    R = numbers_of(turn, (3, 3), f"{path}, R")
    rotation = pose_of_numbers(np.column_stack([R, np.zeros(3)]).ravel().tolist(), f"{path}, R")
    offset_m = float(P[0, 3] / P[0, 0]) if P[0, 0] else 0.0
    return CalibrationFile(path, "ROS camera_info", (camera,), rectified=(rotation, offset_m))


_OPENCV_K = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "K1", "M1", "cameraMatrix1")
_OPENCV_D = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "dist_coeffs",
    "distCoeffs",
    "D",
    "D1",
    "distCoeffs1",
)
_OPENCV_K2, _OPENCV_D2 = ("K2", "M2", "cameraMatrix2"), ("D2", "distCoeffs2")


def _opencv(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    """Read what OpenCV's samples write; such a file does not name its lens model."""
    where = str(path)
    size = content.get("image_size", content.get("size"))
    if size is None:
        size = [
            needed(content, where, f"image_{side}", f"image_{side.title()}", side)
            for side in ("width", "height")
        ]
    model: LensModel = "fisheye" if content.get("fisheye_model") == 1 else "brown-conrady"
    cameras = [
        camera_of_numbers(
            f"{path}, {names_K[-1]}",
            model,
            numbers_of(size, (2,), f"{path}, image size"),
            focal_and_center(needed(content, where, *names_K), f"{path}, camera matrix"),
            numbers_of(needed(content, where, *names_D), (None,), f"{path}, distortion"),
        )
        for names_K, names_D in ((_OPENCV_K, _OPENCV_D), (_OPENCV_K2, _OPENCV_D2))
        if any(name in content for name in names_K)
    ]
    T_right_left = None
    if len(cameras) == 2:
        R = numbers_of(needed(content, where, "R"), (3, 3), f"{path}, R")
        t = numbers_of(needed(content, where, "T"), (3,), f"{path}, T")
        T_right_left = pose_of_numbers(np.column_stack([R, t]).ravel().tolist(), f"{path}, R and T")
    return CalibrationFile(path, "OpenCV", tuple(cameras), T_right_left)
