"""Sequences in the folder layout of the KITTI odometry benchmark.

    ROOT/sequences/02/calib.txt      P0: ... P3: 3x4 projections of the rectified cameras
    ROOT/sequences/02/times.txt      seconds, one line a frame
    ROOT/sequences/02/image_2/000000.png
    ROOT/poses/02.txt                3x4 poses of camera 0, one line a frame; may be missing

KITTI's world is camera 0 of frame 0 (x right, y down, z forward); here it is turned to z up.
"""

import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from struct import unpack

import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.camera import Camera, Rig
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.semantic_map import MapFrame
from semviz_core.sources.source import Side
from semviz_core.sources.trajectory import (
    T_MAP_WORLD,
    Trajectory,
    load_trajectory,
    parsed_numbers,
    read_numbers,
    read_text,
)

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_FRAME_NAME = re.compile(r"[0-9]{6}")


class KittiSequence:
    """A ``Source`` that reads one KITTI odometry sequence.

    ``cameras`` are the left one and, for stereo, the right one: (2, 3) colour, (0, 1) grey. Only
    frames with a left image are offered, and of those the numbers in ``frames``. A frame's pose
    is that of its left camera, in the map frame ``kitti-SEQUENCE``. Poses come from KITTI's own
    file, or from ``trajectory``; the map frame is then ``kitti-SEQUENCE-NAME`` of that file.

    Raises SemvizError where the folder, its calibration, times or poses are missing or wrong.
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
        self._indices = self._find_frames(frames)
        self.rig = self._make_rig(projections)
        self._T_cam0_left = _extrinsics(projections[0]).inverse()
        self.frames = self._make_frames(None if trajectory is None else load_trajectory(trajectory))

    @cached_property
    def _index_set(self) -> frozenset[int]:
        return frozenset(self._indices)

    def image(self, index: int, side: Side) -> ByteImage:
        """(height, width, 3) sRGB of frame ``index``; grey cameras give grey in all channels.

        Raises SemvizError where the file is missing, unreadable, cut off or of another size.
        """
        import cv2

        path = self.image_path(index, side)
        data = _read_png(path)
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise SemvizError(f"{path}: not a readable PNG image; copy it again")
        height, width = image.shape[:2]
        expected = self.rig.left
        if (width, height) != (expected.width, expected.height):
            raise SemvizError(
                f"{path}: image is {width}x{height}, but the first one of the sequence is "
                f"{expected.width}x{expected.height}; all must be of one size"
            )
        rgb: ByteImage = np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8)
        return rgb

    def image_path(self, index: int, side: Side) -> Path:
        """The file of an image; SemvizError for a frame or side that the sequence lacks."""
        if index not in self._index_set:
            first, last = self._indices[0], self._indices[-1]
            raise SemvizError(f"{self._folder}: no frame {index} among frames {first} to {last}")
        if side == "right" and len(self._cameras) == 1:
            raise SemvizError(f"{self._folder}: opened with one camera, there is no right image")
        camera = self._cameras[0 if side == "left" else 1]
        return self._folder / f"image_{camera}" / f"{index:06d}.png"

    def _find_frames(self, wanted: range | None) -> tuple[int, ...]:
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
                f"{left}: no images in the frames asked for; "
                f"there are {indices[0]} to {indices[-1]}"
            )
        return chosen

    def _make_rig(self, projections: list[FloatArray]) -> Rig:
        width, height = self._size_of_first()
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

    def _size_of_first(self) -> tuple[int, int]:
        """Width and height of the first frame's images, by their headers."""
        first = self._indices[0]
        left = _png_size(self.image_path(first, "left"))
        if len(self._cameras) == 2 and (path := self.image_path(first, "right")).exists():
            right = _png_size(path)
            if right != left:
                raise SemvizError(
                    f"{path}: image is {right[0]}x{right[1]}, but the left one is "
                    f"{left[0]}x{left[1]}; both must be of one size"
                )
        return left

    def _make_frames(self, trajectory: Trajectory | None) -> tuple[Frame, ...]:
        times_s = self._of_each_frame(self._folder / "times.txt", 1)[:, 0]
        T_map_left: Sequence[Pose | None] = [None] * len(times_s)
        if trajectory is not None:
            T_map_left = trajectory.of_frames(self._indices, times_s)
        elif self._poses_path.exists():
            T_map_left = self._poses_of_left(self._of_each_frame(self._poses_path, 12))
        return tuple(
            Frame(index, float(time_s), pose)
            for index, time_s, pose in zip(self._indices, times_s, T_map_left, strict=True)
        )

    def _of_each_frame(self, path: Path, width: int) -> FloatArray:
        """(len(self._indices), width) the lines of ``path`` that belong to our frames."""
        table = read_numbers(path, width)
        last = self._indices[-1]
        if len(table) <= last:
            raise SemvizError(
                f"{path}: {len(table)} lines, but frame {last} needs line {last + 1}; "
                "complete the file or choose fewer frames"
            )
        chosen: FloatArray = table[list(self._indices)]
        return chosen

    def _poses_of_left(self, table: FloatArray) -> list[Pose]:
        """``T_map_left`` of our frames by their lines (n, 12), all at once: there are thousands."""
        T_world_cam0 = table.reshape(-1, 3, 4)
        try:
            R = nearest_rotation(T_world_cam0[:, :, :3])
        except SemvizError:
            self._name_the_line(T_world_cam0)
            raise
        left = self._T_cam0_left
        t = R @ left.translation + T_world_cam0[:, :, 3]
        R_map = T_MAP_WORLD.rotation @ R @ left.rotation
        return [Pose(*one) for one in zip(R_map, T_MAP_WORLD.apply(t), strict=True)]

    def _name_the_line(self, T_world_cam0: FloatArray) -> None:
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
        there = sorted(path.name for path in (root / "sequences").glob("*") if path.is_dir())
        raise SemvizError(
            f"{folder}: no such sequence; "
            + (f"there are {', '.join(there)}" if there else f"{root} holds no sequences")
        )
    return folder


def _read_calibration(path: Path, cameras: tuple[int, ...]) -> list[FloatArray]:
    """The (3, 4) projection of each of ``cameras``."""
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
    """T_camera_cam0 of a rectified camera: P = K [I | t], all of P's last column counts."""
    return Pose(np.eye(3), np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64))


def _read_png(path: Path) -> bytes:
    """A PNG file that is there and whole."""
    data = _start_of_png(path)
    if not data.endswith(_PNG_END):
        raise SemvizError(f"{path}: the PNG image is cut off; copy it again")
    return data


def _png_size(path: Path) -> tuple[int, int]:
    """Width and height from the header (PNG specification, 11.2.2 IHDR), nothing decoded."""
    header = _start_of_png(path, 24)
    if len(header) < 24:
        raise SemvizError(f"{path}: the PNG image is cut off; copy it again")
    width, height = unpack(">II", header[16:])
    if not width or not height:
        raise SemvizError(f"{path}: the PNG image is {width}x{height}; copy it again")
    return width, height


def _start_of_png(path: Path, count: int = -1) -> bytes:
    """The first ``count`` bytes (-1: all) of a file that starts like a PNG image."""
    try:
        with path.open("rb") as file:
            data = file.read(count)
    except FileNotFoundError:
        raise SemvizError(f"{path}: no such image; copy it there or choose other frames") from None
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    if not data.startswith(_PNG_START):
        raise SemvizError(f"{path}: not a PNG image; copy it again")
    return data
