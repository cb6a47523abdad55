"""Read the JSON tables of nuScenes, and of data in its schema (TIER IV's T4, Lyft).

Quaternions are w first, poses are to the parent: sensor to ego, ego to global; times are in us.
Each image has its own ego pose, as cameras are triggered up to 50 ms apart. Key frames are read.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np

from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, parsed_json, read_limited, shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera
from semviz_core.datasets.own_drive.images import image_files
from semviz_core.datasets.own_drive.poses.conventions import RecordedPoses, rotations_of
from semviz_core.datasets.own_drive.recording import DriveFiles, Recording, chosen_cameras

_MOST_BYTES = 2**30
"""Of a table: ``sample_data.json`` of all of nuScenes has 0.8 GB."""
_FRONT = "CAM_FRONT"
_Row: TypeAlias = Mapping[str, Any]


def is_nuscenes(path: Path) -> bool:
    """Whether a path is a folder of tables, or the root of nuScenes with one."""
    return _tables_folder(path) is not None


def read_nuscenes(files: DriveFiles) -> Recording:
    """Return the key frames of a scene, of one camera or two; default: CAM_FRONT."""
    folder = _tables_folder(files.images)
    assert folder is not None
    try:
        return _read(files, folder)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError) as error:
        raise SemvizError(
            f"{folder}: not nuScenes' tables, or incomplete ({first_line(repr(error))}); copy them "
            "again"
        ) from None


def _read(files: DriveFiles, folder: Path) -> Recording:
    scene = _scene(files, folder)
    samples = {row["token"] for row in _rows(folder, "sample") if row["scene_token"] == scene}
    sensors = {
        row["token"]: row["channel"]
        for row in _rows(folder, "sensor")
        if row.get("modality") == "camera"
    }
    mounted = {row["token"]: row for row in _rows(folder, "calibrated_sensor")}
    cameras = sorted(set(sensors.values()))
    chosen = chosen_cameras(files, cameras, [_FRONT] if _FRONT in cameras else [])
    by_camera: dict[str, list[_Row]] = {camera: [] for camera in chosen}
    for row in _rows(folder, "sample_data"):
        if row["sample_token"] in samples and row["is_key_frame"]:
            camera = sensors.get(mounted[row["calibrated_sensor_token"]]["sensor_token"])
            if camera in by_camera:
                by_camera[camera].append(row)
    ego = {row["token"]: row for row in _rows(folder, "ego_pose")}
    sides = [_Side(folder, camera, by_camera[camera], mounted) for camera in chosen]
    names, rows = _paired(sides)
    left = sides[0]
    T_right_left = None
    if len(sides) == 2:
        T_right_left = sides[1].T_ego_camera.inverse() @ left.T_ego_camera
    poses = [ego[left.rows[row]["ego_pose_token"]] for row in rows]
    path = folder / "ego_pose.json"
    rotations = rotations_of(np.array([row["rotation"] for row in poses], float), "wxyz", path)
    positions = float_array([row["translation"] for row in poses], (None, 3), str(path))
    matrices = np.concatenate([rotations, positions[:, :, None]], axis=2)
    return Recording(
        left.images,
        sides[1].images if len(sides) == 2 else None,
        names,
        CalibrationFile(
            folder / "calibrated_sensor.json",
            f"nuScenes, {' and '.join(chosen)}",
            tuple(side.camera for side in sides),
            T_right_left,
            left.T_ego_camera,
        ),
        image_files.ImageTimes(left.time_s[rows], "sample_data.json", "us"),
        RecordedPoses(path, "nuScenes", matrices, of_body=True, quaternion="wxyz"),
    )


class _Side:
    """The images of one camera that are there, in order of time."""

    def __init__(
        self, folder: Path, name: str, rows: Sequence[_Row], mounted: Mapping[str, _Row]
    ) -> None:
        if not rows:
            raise SemvizError(f"{folder}: the scene has no key frames of {shown(name, 60)}")
        paths = [PurePosixPath(row["filename"]) for row in rows]
        if paths[0].is_absolute() or ".." in paths[0].parts:
            raise SemvizError(
                f"{folder}: images of {shown(name, 60)} lie outside of the data set; name them "
                "relative to its root"
            )
        if {path.parent for path in paths} != {paths[0].parent}:
            raise SemvizError(f"{folder}: the images of {shown(name, 60)} are in several folders")
        self.images = _root(folder, paths[0]) / paths[0].parent
        ordered = sorted(zip(rows, paths, strict=True), key=lambda pair: pair[0]["timestamp"])
        found = [(row, path.name) for row, path in ordered if (self.images / path.name).is_file()]
        if not found:
            raise SemvizError(f"{shown(self.images)}: none of its {len(rows)} images is there")
        self._listed = [(path.name, float(row["timestamp"]) * 1e-6) for row, path in ordered]
        self.rows = [row for row, _ in found]
        self.names = [name for _, name in found]
        times_s = [float(row["timestamp"]) * 1e-6 for row in self.rows]
        self.time_s = float_array(times_s, (None,), f"{folder / 'sample_data.json'}, timestamp")
        tokens = {row["calibrated_sensor_token"] for row in rows}
        if len(tokens) != 1:
            raise SemvizError(f"{folder}: {shown(name, 60)} has {len(tokens)} calibrations")
        sensor = mounted[tokens.pop()]
        self.camera = _camera(folder, name, sensor, self.rows[0])
        path = folder / "calibrated_sensor.json"
        R = rotations_of(np.array([sensor["rotation"]], dtype=np.float64), "wxyz", path)[0]
        self.T_ego_camera = Pose(R, float_array(sensor["translation"], (3,), str(path)))

    def missing(self, side: Side) -> list[image_files.LeftOutImage]:
        """Return the images that are listed, and not there."""
        found = set(self.names)
        reason = "listed by the recording, but there is no such file"
        return [
            image_files.LeftOutImage(name, side, time_s, reason)
            for name, time_s in self._listed
            if name not in found
        ]


def _paired(sides: Sequence[_Side]) -> tuple[image_files.ImageNames, list[int]]:
    """Return the names of one camera's images, or of pairs, and their rows on the left."""
    left = sides[0]
    missing = left.missing("left")
    if len(sides) == 1:
        return image_files.ImageNames(tuple(left.names), missing=tuple(missing)), list(
            range(len(left.names))
        )
    right = sides[1]
    missing += right.missing("right")
    return image_files.pairs_by_time(left.names, left.time_s, right.names, right.time_s, missing)


def _camera(folder: Path, name: str, sensor: _Row, row: _Row) -> OriginalCamera:
    """Return the camera; T4 adds ``camera_distortion`` to nuScenes' undistorted images."""
    where = f"{folder / 'calibrated_sensor.json'}, {shown(name, 60)}"
    K = float_array(sensor["camera_intrinsic"], (3, 3), where)
    distortion: FloatArray = float_array(sensor.get("camera_distortion") or [], (None,), where)
    model: LensModel = "brown-conrady" if distortion.any() else "pinhole"
    used = distortion if distortion.any() else np.zeros(0)
    try:
        return OriginalCamera(model, int(row["width"]), int(row["height"]), K, used)
    except SemvizError as error:
        raise SemvizError(f"{where}: {error}") from None


def _scene(files: DriveFiles, folder: Path) -> str:
    """Return the token of the chosen scene, or of the only one."""
    scenes = {str(row["name"]): str(row["token"]) for row in _rows(folder, "scene")}
    name = files.sequence or (next(iter(scenes)) if len(scenes) == 1 else "")
    if name not in scenes:
        raise SemvizError(
            f"{folder}: choose --sequence of its scenes {shown(', '.join(scenes), 300)}, not "
            f"{shown(name or 'none', 60)}"
        )
    return scenes[name]


def _rows(folder: Path, table: str) -> Sequence[_Row]:
    content = parsed_json(read_limited(folder / f"{table}.json", _MOST_BYTES))
    if not isinstance(content, list):
        raise SemvizError(f"{folder / table}.json: not a table; copy it again")
    return content


def _tables_folder(path: Path) -> Path | None:
    folders = [path, path / "annotation", *sorted(path.glob("v1.0-*"))]
    return next((one for one in folders if (one / "sample_data.json").is_file()), None)


def _root(folder: Path, image: PurePosixPath) -> Path:
    """Return the folder to which names of images are relative: that of the tables, or above."""
    return folder if folder.joinpath(*image.parts[:1]).is_dir() else folder.parent
