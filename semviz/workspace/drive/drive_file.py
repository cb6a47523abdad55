"""The file ``drive.json`` of a workspace: what was read of an own drive when it was imported.

The recorded cameras, the time and pose of each image, and what was taken for granted. Images are
named; they stay where they are. Opening a workspace needs none of the imported files again.
A table beside it, ``left-out.csv``, has a line for each image that is not in the workspace, and
for each frame without a pose.
"""

import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import csv_text, replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, first_line, read_limited, shown
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.images.color_orders import ColorOrder
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.images.rectification import rectify_cameras, rectify_rig
from semviz_core.datasets.own_drive.poses.conventions import geodetic, is_earth_centred

if TYPE_CHECKING:
    from semviz_core.datasets.own_drive.images.image_files import LeftOutImage
    from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive

DRIVE_FILE = "drive.json"
LEFT_OUT = "left-out.csv"
RECTIFIED = "rectified"
"""Folder of rectified images; it can be deleted at any time."""
RECORDED = Path("recorded")
"""Folder of images that were copied from a bag."""

Matrix = Annotated[tuple[float, ...], Field(min_length=12, max_length=12)]
"""A pose: the 12 numbers of a 3x4 matrix, row by row."""
_MOST_NAME = 1000
"""File systems allow 255."""
_CONTROLS = r"\x00-\x1f\x7f-\x9f\u2028\u2029"
ImageName = Annotated[str, Field(pattern=rf"^[^/\\{_CONTROLS}]+$")]
"""Of a file in the folder of images, and nowhere else."""


@dataclass(frozen=True)
class ImageFolders:
    """Where the recorded images of a drive are."""

    left: Path
    right: Path | None = None
    cameras: Mapping[str, Path] = field(default_factory=dict)
    """Of a rig, by name of the camera."""

    @classmethod
    def of_drive(cls, drive: "RecordedDrive") -> "ImageFolders":
        cameras = {name: camera.folder for name, camera in drive.cameras.items()}
        return cls(drive.left_folder, drive.right_folder, cameras)

    def of(self, camera: str) -> Path:
        """Return a camera's folder. Raise SemvizError if there is none."""
        if camera not in self.cameras:
            raise SemvizError(f"no folder of camera {shown(camera, 60)} in the settings")
        return self.cameras[camera]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CameraEntry(_Model):
    """A camera as recorded."""

    model: LensModel
    size_px: tuple[int, int]
    intrinsics_px: tuple[float, float, float, float]
    """fx, fy, cx, cy; (0, 0) is the centre of the top-left pixel."""
    distortion: tuple[float, ...]

    @classmethod
    def of(cls, camera: OriginalCamera) -> "CameraEntry":
        K = camera.K
        return cls(
            model=camera.model,
            size_px=(camera.width, camera.height),
            intrinsics_px=(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])),
            distortion=tuple(camera.distortion.tolist()),
        )

    def camera(self) -> OriginalCamera:
        fx, fy, cx, cy = self.intrinsics_px
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return OriginalCamera(self.model, *self.size_px, K, np.array(self.distortion))


class RigCameraEntry(_Model):
    """A camera of a rig of several."""

    recorded: CameraEntry
    T_first_camera: Matrix | None = None
    """From this camera to the rig's first one, if that is known."""


class FrameEntry(_Model):
    """An image, or a pair."""

    index: int = Field(ge=0, lt=2**31)
    time_s: float
    left: ImageName
    right: ImageName | None = None
    T_map_camera: Matrix | None = None
    """Of the rectified left camera."""
    camera: str | None = None
    """Of a rig: the camera of the image ``left``."""


class DriveFile(_Model):
    """The content of the file."""

    crc32: int | None = None
    """Of what follows it in the file; None in files of earlier versions of semviz."""
    version: Literal[1, 2] = 1
    """2 for a rig of several cameras."""
    map_frame: str
    left: CameraEntry
    right: CameraEntry | None = None
    T_right_left: Matrix | None = None
    cameras: dict[str, RigCameraEntry] | None = None
    """Of a rig: all its cameras, ``left`` is the first one again."""
    most_view_deg: float
    """Largest field of view of the rectified images."""
    origin_m: tuple[float, float, float] | None = None
    """The map's origin in the world of the poses; None without poses."""
    T_map_world: Matrix | None = None
    """From the world of the poses; None without poses, and in files of earlier versions."""
    colors: ColorOrder | None = None
    """Of the recorded images; None is red first."""
    statements: tuple[tuple[str, str], ...] = ()
    """What was read and taken for granted: topic and text."""
    warnings: tuple[str, ...] = ()
    frames: Annotated[tuple[FrameEntry, ...], Field(min_length=1)]

    def model_post_init(self, _: Any) -> None:
        if any(row.index >= after.index for row, after in pairwise(self.frames)):
            raise ValueError("frames are not in the order of their numbers")
        if re.search(f"[{_CONTROLS}]", self.map_frame):
            raise ValueError("the map frame's name has a control character")
        known: set[str | None] = {None} if self.cameras is None else set(self.cameras)
        if {row.camera for row in self.frames} - known:
            raise ValueError("a frame is of a camera that is not there")

    @classmethod
    def of(cls, drive: "RecordedDrive", map_frame: str) -> "DriveFile":
        original = drive.original
        return cls(
            version=2 if drive.cameras else 1,
            map_frame=map_frame,
            left=CameraEntry.of(original.left),
            right=None if original.right is None else CameraEntry.of(original.right),
            T_right_left=_numbers(original.T_right_left),
            cameras={
                name: RigCameraEntry(
                    recorded=CameraEntry.of(camera.original),
                    T_first_camera=_numbers(camera.T_first_camera),
                )
                for name, camera in drive.cameras.items()
            }
            or None,
            most_view_deg=drive.most_view_deg,
            origin_m=None if drive.axes is None else drive.axes.origin_m,
            T_map_world=None if drive.axes is None else _numbers(drive.axes.T_map_world),
            colors=None if drive.colors == "rgb" else drive.colors,
            statements=drive.statements,
            warnings=drive.warnings,
            frames=tuple(
                FrameEntry(
                    index=frame.index,
                    time_s=frame.time_s,
                    left=drive.left[frame.index],
                    right=drive.right.get(frame.index),
                    T_map_camera=_numbers(frame.T_map_camera),
                    camera=drive.camera_of.get(frame.index),
                )
                for frame in drive.frames
            ),
        )

    def dataset(self, folders: ImageFolders, cache: Path) -> ImageFolder:
        """Return the images of these folders as a dataset; rectified ones are kept in ``cache``."""
        if self.cameras is not None:
            return self._rig_dataset(self.cameras, folders, cache)
        original = OriginalRig(
            self.left.camera(),
            None if self.right is None else self.right.camera(),
            _pose(self.T_right_left),
        )
        return ImageFolder(
            self.frame,
            tuple(Frame(row.index, row.time_s, _pose(row.T_map_camera)) for row in self.frames),
            {row.index: folders.left / row.left for row in self.frames},
            {}
            if folders.right is None
            else {
                row.index: folders.right / row.right for row in self.frames if row.right is not None
            },
            rectify_rig(original, self.most_view_deg),
            cache,
            colors=self.colors or "rgb",
        )

    @property
    def frame(self) -> MapFrame:
        """The map frame; it knows its place on Earth if the poses were earth-centred."""
        if self.origin_m is None or not is_earth_centred(np.array([self.origin_m])):
            return MapFrame(self.map_frame)
        return MapFrame(self.map_frame, geodetic(np.array(self.origin_m)))

    @property
    def world(self) -> Pose | None:
        """T_map_world, from the world of the poses; None if it is not known."""
        return _pose(self.T_map_world)

    def _rig_dataset(
        self, cameras: Mapping[str, RigCameraEntry], folders: ImageFolders, cache: Path
    ) -> ImageFolder:
        originals = [camera.recorded.camera() for camera in cameras.values()]
        rectified = rectify_cameras(originals, self.most_view_deg)
        camera_of = {row.index: row.camera for row in self.frames if row.camera is not None}
        mounts = {name: _pose(camera.T_first_camera) for name, camera in cameras.items()}
        return ImageFolder(
            self.frame,
            tuple(Frame(row.index, row.time_s, _pose(row.T_map_camera)) for row in self.frames),
            {row.index: folders.of(camera_of[row.index]) / row.left for row in self.frames},
            {},
            rectified[0],
            cache,
            camera_of,
            {name: mount for name, mount in mounts.items() if mount is not None},
            dict(zip(cameras, rectified, strict=True)),
            self.colors or "rgb",
        )

    def save(self, path: Path) -> None:
        """Write the file, its checksum first. Raise SemvizError if it cannot be written."""
        content = self.model_dump_json(exclude_none=True, exclude={"crc32"}).encode()[1:]
        with replacing(path) as temporary:
            temporary.write_bytes(b'{"crc32":%d,' % zlib.crc32(content) + content)


def read_drive_file(path: Path) -> DriveFile:
    """Return the content of the file. Raise SemvizError if it is missing or damaged."""
    data = read_limited(path, MOST_TEXT_BYTES)
    try:
        content = DriveFile.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        fault = first_line(f"{where}: {first['msg']}")
        raise SemvizError(f"{path}: damaged ({fault}); run 'semviz new' again") from None
    if content.crc32 is not None and content.crc32 != zlib.crc32(data.partition(b",")[2]):
        raise SemvizError(
            f"{path}: not as it was written (its checksum differs); restore it from a copy, or run "
            "'semviz new' again. If you edited it, delete its crc32"
        )
    return content


def open_drive(path: Path, folders: ImageFolders, cache: Path) -> ImageFolder:
    """Return the dataset of the file ``path``; see ``DriveFile.dataset``.

    Raise SemvizError if the file is missing, damaged, or its cameras are impossible.
    """
    content = read_drive_file(path)
    try:
        return content.dataset(folders, cache)
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}; run 'semviz new' again") from None


def calibration_toml(rig: OriginalRig) -> str:
    """Return the cameras as recorded in semviz's own format of calibrations."""
    cameras = {"left": rig.left} if rig.right is None else {"left": rig.left, "right": rig.right}
    content: dict[str, object] = {}
    if rig.T_right_left is not None:
        content["T_right_left"] = rig.T_right_left.as_matrix()[:3].tolist()
    for side, camera in cameras.items():
        fx, fy, cx, cy = CameraEntry.of(camera).intrinsics_px
        content[side] = {
            "size_px": [camera.width, camera.height],
            "model": camera.model,
            "focal_px": [fx, fy],
            "center_px": [cx, cy],
            "distortion": camera.distortion.tolist(),
        }
    return tomli_w.dumps(content)


def write_left_out(path: Path, images: Sequence["LeftOutImage"]) -> None:
    """Write the table, if there are images; the cell of a time that is not known is empty."""
    if not images:
        return
    rows = [
        [
            shown(image.file, _MOST_NAME),
            shown(image.camera, _MOST_NAME) if image.camera else image.side,
            image.time_s,
            image.reason,
        ]
        for image in images
    ]
    with replacing(path) as temporary:
        table = csv_text([["file", "side", "time_s", "reason"], *rows])
        temporary.write_text(table, encoding="utf-8", newline="")


def _numbers(pose: Pose | None) -> tuple[float, ...] | None:
    return None if pose is None else tuple(pose.as_matrix()[:3].ravel().tolist())


def _pose(numbers: tuple[float, ...] | None) -> Pose | None:
    return None if numbers is None else Pose.from_matrix(np.reshape(numbers, (3, 4)))
