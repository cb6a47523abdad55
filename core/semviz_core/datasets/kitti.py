"""Read sequences in the folder layout of the KITTI odometry benchmark.

    ROOT/sequences/02/calib.txt      P0: ... P3: 3x4 projections of the rectified cameras
    ROOT/sequences/02/times.txt      seconds, one line a frame
    ROOT/sequences/02/image_2/000000.png
    ROOT/poses/02.txt                3x4 poses of camera 0, one line a frame; may be missing

KITTI's world frame is camera 0 of frame 0 (x right, y down, z forward). It is rotated to z up
here.
"""

import re
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common import limits
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.trajectory import (
    T_MAP_WORLD,
    TrajectoryFile,
    load_trajectory,
    parsed_numbers,
    read_numbers,
    read_text,
)

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_HEADER_BYTES = 24
_FRAME_NAME = re.compile(r"[0-9]{6}")


class KittiSequence:
    """A ``Dataset`` that reads one KITTI odometry sequence.

    ``cameras`` are the left and, for stereo, the right camera: (2, 3) colour, (0, 1) grey. The
    frames are those with a left image and, if ``frames`` is given, a number in it. A frame's pose
    is that of its left camera, in the map frame ``kitti-SEQUENCE``. Poses come from KITTI's own
    file, or from ``trajectory``; the map frame is then ``kitti-SEQUENCE-NAME`` of that file.

    Raise SemvizError if the folder, its calibration, times or poses are missing or wrong.
    """

    def __init__(
        self,
        root: Path,
        sequence: str = "02",
        cameras: tuple[int, ...] = (2, 3),
        frames: range | None = None,
        trajectory: Path | None = None,
    ) -> None:
        if len(cameras) not in (1, 2) or len(set(cameras)) != len(cameras):
            raise SemvizError(f"cameras {cameras}: give one camera, or two different ones")
        self._folder = _sequence_folder(root, sequence)
        self._poses_path = root / "poses" / f"{sequence}.txt"
        self._cameras = cameras
        name = f"kitti-{sequence}" + ("" if trajectory is None else f"-{trajectory.stem}")
        self.map_frame = MapFrame(name)
        projections = _read_calibration(self._folder / "calib.txt", cameras)
        self._indices = self._find_indices(frames)
        self.rig = self._read_rig(projections)
        self._T_cam0_left = _extrinsics(projections[0]).inverse()
        self.frames = self._read_frames(None if trajectory is None else load_trajectory(trajectory))

    def with_frames(self, frames: tuple[Frame, ...]) -> "KittiSequence":
        """Return the same images with other poses; ``frames`` have the same numbers."""
        other = copy(self)
        other.frames = frames
        return other

    @cached_property
    def _index_set(self) -> frozenset[int]:
        return frozenset(self._indices)

    def image(self, index: int, side: Side) -> ByteImage:
        """Return (height, width, 3) sRGB of frame ``index``; grey images have equal channels.

        Raise SemvizError if the file is missing, unreadable, truncated or of another size.
        """
        path = self.image_path(index, side)
        data = _read_png(path)
        width, height = _png_size(data, path)
        if not data.endswith(_PNG_END):
            raise SemvizError(f"{path}: the PNG image is cut off; copy it again")
        expected = self.rig.left
        if (width, height) != (expected.width, expected.height):
            raise SemvizError(
                f"{path}: image is {width}x{height}, but the sequence's first image is "
                f"{expected.width}x{expected.height}; all must be of one size"
            )
        image = limits.decode_image(data, path)
        rgb: ByteImage = np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8)
        return rgb

    def image_path(self, index: int, side: Side) -> Path:
        """Return an image's path. Raise SemvizError for a frame or side that is not there."""
        if index not in self._index_set:
            first, last = self._indices[0], self._indices[-1]
            raise SemvizError(f"{self._folder}: no frame {index} among frames {first} to {last}")
        if side == "right" and len(self._cameras) == 1:
            raise SemvizError(f"{self._folder}: opened with one camera; there is no right image")
        camera = self._cameras[0 if side == "left" else 1]
        return self._folder / f"image_{camera}" / f"{index:06d}.png"

    def original_path(self, index: int, side: Side) -> Path:
        """Return an image's path: KITTI's images are rectified."""
        return self.image_path(index, side)

    def _find_indices(self, wanted: range | None) -> tuple[int, ...]:
        for camera in self._cameras:
            images = self._folder / f"image_{camera}"
            if not images.is_dir():
                raise SemvizError(f"{images}: no such folder; copy camera {camera}'s images there")
            if next(images.glob("[0-9]*.png"), None) is None:
                raise SemvizError(f"{images}: a folder without images; expected 000000.png, ...")
        left = self._folder / f"image_{self._cameras[0]}"
        stems = (path.stem for path in left.glob("[0-9]*.png"))
        indices = sorted(int(stem) for stem in stems if _FRAME_NAME.fullmatch(stem))
        if not indices:
            raise SemvizError(f"{left}: a folder without images; expected 000000.png, ...")
        chosen = tuple(index for index in indices if wanted is None or index in wanted)
        if not chosen:
            raise SemvizError(
                f"{left}: no images in the requested frames; "
                f"there are {indices[0]} to {indices[-1]}"
            )
        return chosen

    def _read_rig(self, projections: list[FloatArray]) -> Rig:
        width, height = self._first_image_size()
        try:
            cameras = [Camera(width, height, P[:, :3]) for P in projections]
            if len(cameras) == 1:
                return Rig(cameras[0])
            T_left_cam0, T_right_cam0 = (_extrinsics(P) for P in projections)
            return Rig(cameras[0], cameras[1], T_right_cam0 @ T_left_cam0.inverse())
        except SemvizError as error:
            names = ", ".join(str(camera) for camera in self._cameras)
            raise SemvizError(
                f"{self._folder / 'calib.txt'}, cameras {names}: {error}. Nothing was loaded"
            ) from None

    def _first_image_size(self) -> tuple[int, int]:
        """Return width and height of the first frame's images, from their headers."""
        first = self._indices[0]
        left = _image_size(self.image_path(first, "left"))
        if len(self._cameras) == 2 and (path := self.image_path(first, "right")).exists():
            right = _image_size(path)
            if right != left:
                raise SemvizError(
                    f"{path}: image is {right[0]}x{right[1]}, but the left one is "
                    f"{left[0]}x{left[1]}; both must be of one size"
                )
        return left

    def _read_frames(self, trajectory: TrajectoryFile | None) -> tuple[Frame, ...]:
        times_s = self._rows_of_frames(self._folder / "times.txt", 1)[:, 0]
        T_map_left: Sequence[Pose | None] = [None] * len(times_s)
        if trajectory is not None:
            T_map_left = trajectory.of_frames(self._indices, times_s)
        elif self._poses_path.exists():
            T_map_left = self._left_poses(self._rows_of_frames(self._poses_path, 12))
        return tuple(
            Frame(index, float(time_s), pose)
            for index, time_s, pose in zip(self._indices, times_s, T_map_left, strict=True)
        )

    def _rows_of_frames(self, path: Path, width: int) -> FloatArray:
        """Return (len(self._indices), width): the lines of ``path`` of the chosen frames."""
        table = read_numbers(path, width)
        last = self._indices[-1]
        if len(table) <= last:
            raise SemvizError(
                f"{path}: {len(table)} lines, but frame {last} needs line {last + 1}; "
                "complete the file or choose fewer frames"
            )
        chosen: FloatArray = table[list(self._indices)]
        return chosen

    def _left_poses(self, table: FloatArray) -> list[Pose]:
        """Return ``T_map_left`` of the frames' lines (n, 12), vectorized for speed."""
        T_world_cam0 = table.reshape(-1, 3, 4)
        try:
            R = nearest_rotation(T_world_cam0[:, :, :3])
        except SemvizError:
            self._raise_with_line(T_world_cam0)
            raise
        left = self._T_cam0_left
        t = R @ left.translation + T_world_cam0[:, :, 3]
        R_map = T_MAP_WORLD.rotation @ R @ left.rotation
        return [Pose(*R_and_t) for R_and_t in zip(R_map, T_MAP_WORLD.apply(t), strict=True)]

    def _raise_with_line(self, T_world_cam0: FloatArray) -> None:
        for index, matrix in zip(self._indices, T_world_cam0, strict=True):
            try:
                Pose.from_matrix(matrix)
            except SemvizError as error:
                raise SemvizError(f"{self._poses_path}, line {index + 1}: {error}") from None


def _sequence_folder(root: Path, sequence: str) -> Path:
    if not root.is_dir():
        raise SemvizError(f"{root}: no such folder; give the one that holds 'sequences'")
    folder = root / "sequences" / sequence
    if not folder.is_dir():
        sequences = sorted(path.name for path in (root / "sequences").glob("*") if path.is_dir())
        raise SemvizError(
            f"{folder}: no such sequence; "
            + (f"there are {', '.join(sequences)}" if sequences else f"{root} holds no sequences")
        )
    return folder


def _read_calibration(path: Path, cameras: tuple[int, ...]) -> list[FloatArray]:
    """Return the (3, 4) projection of each of ``cameras``."""
    lines = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
    missing = [camera for camera in cameras if f"P{camera}" not in lines]
    if missing:
        known = ", ".join(sorted(key for key in lines if key.startswith("P"))) or "nothing"
        raise SemvizError(f"{path}: no camera {missing[0]} (P{missing[0]}); it holds {known}")
    return [
        parsed_numbers(lines[f"P{camera}"], 12, f"{path}, P{camera}").reshape(3, 4)
        for camera in cameras
    ]


def _extrinsics(P: FloatArray) -> Pose:
    """Return T_camera_cam0 of a rectified camera: P = K [I | t], with all of P's last column."""
    return Pose(np.eye(3), np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64))


def _image_size(path: Path) -> tuple[int, int]:
    return _png_size(_read_png(path, _HEADER_BYTES), path)


def _read_png(path: Path, count: int = limits.MOST_IMAGE_BYTES) -> bytes:
    """Return the first ``count`` bytes of a PNG file.

    Raise SemvizError if it is missing, too large, or none.
    """
    if not path.exists():
        raise SemvizError(f"{path}: no such image; copy it there or choose other frames")
    data = limits.read_limited(path, limits.MOST_IMAGE_BYTES, count)
    if not data.startswith(_PNG_START):
        raise SemvizError(f"{path}: not a PNG image; copy it again")
    return data


def _png_size(data: bytes, path: Path) -> tuple[int, int]:
    """Return width and height from the header (PNG specification, 11.2.2 IHDR).

    Raise SemvizError if no image of this size is read.
    """
    size = limits.image_size(data)
    if size is None:
        raise SemvizError(f"{path}: the PNG image is cut off; copy it again")
    if 0 in size:
        raise SemvizError(f"{path}: the PNG image is {size[0]}x{size[1]}; copy it again")
    limits.check_pixels(*size, path)
    return size
