"""Copy the images of a bag (ROS 1, ROS 2, MCAP) to files, and read its calibration and poses.

Images are those of ``sensor_msgs/Image`` or ``CompressedImage``; the topic ``camera_info`` beside
them calibrates them, ``/tf_static`` says where cameras are in the vehicle. Poses are those of
``nav_msgs/Odometry``, or of ``NavSatFix`` with the orientation of ``Imu``. Times are those in the
headers. Images on topics such as ``image_rect`` are rectified already. The library rosbags, an
extra, parses the messages as plain values.

rosbags unpacks each chunk whole, whatever size it states, and a file of zeros packs a thousandfold.
So a bag is checked before rosbags opens it, and what rosbags may unpack at once is limited.
"""

import re
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from errno import EINVAL
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import (
    MOST_IMAGE_BYTES,
    MOST_SETTINGS_BYTES,
    check_file,
    first_line,
    shown,
)
from semviz_core.datasets.own_drive.adapters.ros_messages import (
    FrameTree,
    NavSat,
    camera_info_values,
    image_file,
    odometry,
    stamp_ns,
)
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.calibration_files import (
    camera_info,
    stereo_calibration,
)
from semviz_core.datasets.own_drive.images.image_files import ImageNames, ImageTimes, pairs_by_time
from semviz_core.datasets.own_drive.poses.conventions import RecordedPoses
from semviz_core.datasets.own_drive.recording import DriveFiles, Recording, chosen_cameras
from semviz_core.datasets.trajectory import MOST_LINES

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


MOST_CHUNK_BYTES = MOST_IMAGE_BYTES + 64 * 2**20
"""An image, and what else its chunk holds."""
_PIECE_BYTES = 2**22


class UnpackingError(SemvizError):
    """A part of a bag unpacks to too much."""


def check_bag_files(path: Path) -> None:
    """Raise SemvizError if a file of a bag is none, is a database of programs, or unpacks to more
    than the disk for temporary files holds."""
    check_file(path / "metadata.yaml" if path.is_dir() else path, sys.maxsize)
    folder = path.parent if path.suffix == ".db3" else path
    if folder.is_dir():
        metadata = folder / "metadata.yaml"
        if metadata.exists():
            check_file(metadata, 4 * MOST_SETTINGS_BYTES)
        for file in sorted(folder.iterdir()):
            if file.suffix in (".db3", ".mcap", ".zstd"):
                check_file(file, sys.maxsize)
            if file.suffix == ".db3":
                _check_tables(file)
            elif file.suffix == ".zstd":
                _check_unpacked(file)


def limit_unpacking() -> None:
    """Give rosbags functions that stop: its own ones have no limit."""
    from rosbags.rosbag1 import reader as bags1
    from rosbags.rosbag2 import reader as bags2
    from rosbags.rosbag2 import storage_mcap

    bags1.decompressors.update({name: _unpack(name) for name in ("bz2", "lz4")})
    storage_mcap.DECOMPRESSORS.update({name: _unpack(name) for name in ("lz4", "zstd")})
    theirs = vars(bags2)["zstd"]
    vars(bags2)["zstd"] = SimpleNamespace(decompress=_unpack("zstd"), open=theirs.open)


def _unpack(codec: str) -> Callable[..., bytes]:
    def unpack(data: bytes, size: int = MOST_CHUNK_BYTES) -> bytes:
        most, total, pieces = min(size, MOST_CHUNK_BYTES), 0, []
        try:
            with pa.CompressedInputStream(pa.py_buffer(data), codec) as stream:
                while piece := stream.read(_PIECE_BYTES):
                    pieces.append(piece)
                    total += len(piece)
                    if total > most:
                        raise UnpackingError(f"a chunk unpacks to more than {most} bytes")
        except OSError as error:  # of Arrow; no file is read here
            raise ValueError(str(error)) from None
        return b"".join(pieces)

    return unpack


def _check_unpacked(file: Path) -> None:
    """Raise SemvizError if a file needs more room than there is: rosbags unpacks it to the disk."""
    room = shutil.disk_usage(tempfile.gettempdir()).free - MOST_CHUNK_BYTES
    try:
        with pa.CompressedInputStream(pa.OSFile(str(file)), "zstd") as stream:
            while piece := stream.read(_PIECE_BYTES):
                room -= len(piece)
                if room < 0:
                    raise SemvizError(
                        f"{file}: unpacks to more than {tempfile.gettempdir()} has room for; set "
                        "TMPDIR to a larger disk"
                    )
    except (OSError, ValueError) as error:
        raise SemvizError(f"{file}: cannot be unpacked ({error})") from None


def _check_tables(file: Path) -> None:
    """Raise SemvizError if a database has a view or trigger: a query of them may never end."""
    uri = f"{file.absolute().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as opened:
            (count,) = opened.execute(
                "SELECT count(*) FROM sqlite_master WHERE type IN ('view', 'trigger')"
                " OR sql LIKE 'create virtual%'"
            ).fetchone()
    except (sqlite3.Error, UnicodeDecodeError):  # the latter: of its schema, or of an error's text
        return  # rosbags says what is wrong with it
    if count:
        raise SemvizError(f"{file}: a database with a view or trigger, which no bag has; not read")


_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO, _ODOMETRY = "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"
_FIX, _IMU, _TF = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage"


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file .bag, .mcap or .db3, or a folder with metadata.yaml."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(
            file.suffix in (".db3", ".mcap") for file in path.iterdir()
        )
    return path.suffix in (".bag", ".mcap", ".db3")


def read_bag(files: DriveFiles) -> Recording:
    """Write the images of one camera or two to ``files.extracted``, and read the rest."""
    if files.extracted is None:
        raise SemvizError(f"{files.images}: a bag needs a folder for its images")
    with _opened(files.images) as reader:
        topics = _camera_topics(files, reader)
        poses_topic, imu_topic = _poses_topics(files, reader)
        content = _Content(files.extracted, topics, poses_topic)
        wanted = {*topics, *map(_info_topic, topics), poses_topic, imu_topic, "/tf_static"}
        kinds = {_IMU} if content.is_navsat(reader) and imu_topic is None else set()
        connections = [
            one for one in reader.connections if one.topic in wanted or one.msgtype in kinds
        ]
        total = sum(one.msgcount for one in connections)
        messages = reader.messages(connections)
        for done, (connection, _, data) in enumerate(messages):
            message = reader.deserialize(data, connection.msgtype)
            content.take(connection.topic, connection.msgtype, message)
            if done % 50 == 0:
                files.show("reading the bag", done, total)
    return content.recording(files)


@contextmanager
def _opened(path: Path) -> Iterator["AnyReader"]:
    """Open a bag. Raise SemvizError if rosbags is missing, or the bag is damaged."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SemvizError(
            f"{path}: bags are read by the library rosbags; run pip install 'semviz[ros]'"
        ) from None
    if not path.exists():
        raise SemvizError(f"{path}: no such bag")
    check_bag_files(path)
    limit_unpacking()
    store = get_typestore(Stores.ROS2_HUMBLE)
    source = path.parent if path.suffix == ".db3" else path
    try:
        with AnyReader([source], default_typestore=store) as reader:
            yield reader
    except UnpackingError as error:
        raise SemvizError(f"{path}: {error}; record or copy it again") from None
    except SemvizError:
        raise
    except OSError as error:
        if error.strerror and error.errno != EINVAL:  # of the system, which names the file
            raise  # EINVAL: the bag says to go on before its start
        raise SemvizError(f"{path}: not a whole bag ({first_line(error)})") from None
    except Exception as error:  # rosbags raises what its parsers raise: KeyError, struct.error, ...
        raise SemvizError(
            f"{path}: a damaged bag ({first_line(repr(error))}); record or copy it again"
        ) from None


def _camera_topics(files: DriveFiles, reader: "AnyReader") -> tuple[str, ...]:
    """Return the chosen topics of images; without a choice, the only one, or a left and right."""
    known = sorted(
        {
            one.topic
            for one in reader.connections
            if one.msgtype in _IMAGES and one.msgcount and "depth" not in one.topic.lower()
        }
    )
    default = known if len(known) == 1 else ()
    sides = [[topic for topic in known if side in topic.lower()] for side in ("left", "right")]
    if len(known) == 2 and all(len(side) == 1 for side in sides):
        default = [side[0] for side in sides]
    return chosen_cameras(files, known, default)


def _poses_topics(files: DriveFiles, reader: "AnyReader") -> tuple[str | None, str | None]:
    """Return the topic of odometry, or else of GNSS, and that of the IMU if one is chosen.

    ``--poses`` of the user may name a topic, or that of GNSS and that of the IMU: ``/fix,/imu``.
    """
    by_kind = {
        kind: sorted({one.topic for one in reader.connections if one.msgtype == kind})
        for kind in (_ODOMETRY, _FIX, _IMU)
    }
    known = [*by_kind[_ODOMETRY], *by_kind[_FIX]]
    if files.poses is not None:
        poses, _, imu = str(files.poses).partition(",")
        is_known = poses in known and (not imu or (poses in by_kind[_FIX] and imu in by_kind[_IMU]))
        return (poses, imu or None) if is_known else (None, None)
    topics = by_kind[_ODOMETRY] or by_kind[_FIX]
    if len(topics) > 1:
        raise SemvizError(
            f"{files.images}: poses on {len(topics)} topics; choose --poses of "
            f"{shown(', '.join(known), 300)}"
        )
    return (topics[0] if topics else None), None


def _info_topic(image_topic: str) -> str:
    return f"{image_topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


def _has_rectified_images(topic: str) -> bool:
    """Whether a topic is named like those of ROS's rectification: ``image_rect``."""
    last = topic.removesuffix("/compressed").rpartition("/")[2]
    return re.search("(?<!di)rect", last.lower()) is not None


def _of_rectified(info: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the camera_info of the images that rectification made, by P alone: without a lens.

    R leads to their axes; nodes that publish no other images may leave it at zero.
    """
    K = np.reshape(info["p"], (3, 4))[:, :3]
    R = info["r"] if np.any(info["r"]) else np.eye(3).ravel().tolist()
    return {**info, "distortion_model": "plumb_bob", "d": [], "k": K.ravel().tolist(), "r": R}


@dataclass
class _Images:
    """The images of a topic as they were written."""

    folder: Path
    times_ns: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    frame: str = ""

    def take(self, topic: str, message: Any) -> None:
        time_ns = stamp_ns(message, topic)
        if self.times_ns and time_ns <= self.times_ns[-1]:
            raise SemvizError(
                f"{topic}: image {len(self.names) + 1} is not later than the one before; its "
                "header has no times of its own"
            )
        if len(self.names) == MOST_LINES:
            raise SemvizError(f"{topic}: more than {MOST_LINES} images; split the bag")
        data, suffix = image_file(message, topic)
        if len(data) > MOST_IMAGE_BYTES:
            raise SemvizError(f"{topic}: an image of {len(data)} bytes; at most {MOST_IMAGE_BYTES}")
        self.folder.mkdir(parents=True, exist_ok=True)
        name = f"{time_ns}{suffix}"
        (self.folder / name).write_bytes(data)
        self.frame = str(message.header.frame_id)
        self.times_ns.append(time_ns)
        self.names.append(name)


class _Content:
    """What is collected from the messages of a bag."""

    def __init__(self, folder: Path, topics: Sequence[str], poses_topic: str | None) -> None:
        sides = ("left", "right")[: len(topics)]
        self.topics, self.poses_topic = topics, poses_topic
        self.images = {
            topic: _Images(folder / side) for topic, side in zip(topics, sides, strict=True)
        }
        self.infos: dict[str, Any] = {}
        self.tree = FrameTree()
        self.odometry: list[tuple[int, Pose]] = []
        self.navsat = NavSat()
        self.body = ""

    def is_navsat(self, reader: "AnyReader") -> bool:
        """Whether the poses are those of GNSS."""
        kinds = {one.msgtype for one in reader.connections if one.topic == self.poses_topic}
        return _FIX in kinds

    def take(self, topic: str, kind: str, message: Any) -> None:
        """Keep what is needed of a message."""
        if topic in self.images:
            self.images[topic].take(topic, message)
        elif kind == _INFO:
            self.infos.setdefault(topic, camera_info_values(message))
        elif kind == _TF:
            self.tree.take(message)
        elif kind == _ODOMETRY:
            self.body = str(message.child_frame_id)
            self.odometry.append((stamp_ns(message, topic), odometry(message, topic)))
        elif kind == _FIX and topic == self.poses_topic:
            self.navsat.take_fix(message, topic)
        elif kind == _IMU:
            self.navsat.take_imu(message, topic)

    def recording(self, files: DriveFiles) -> Recording:
        """Return the recording. Raise SemvizError if it lacks images or calibration."""
        for topic, images in self.images.items():
            if not images.names:
                raise SemvizError(f"{files.images}: no images on {shown(topic, 80)}")
        sides = list(self.images.values())
        times_s = [np.array(side.times_ns) * 1e-9 for side in sides]
        poses = self._poses(files.poses)
        if len(sides) == 1:
            names, rows = ImageNames(tuple(sides[0].names)), list(range(len(sides[0].names)))
        else:
            names, rows = pairs_by_time(sides[0].names, times_s[0], sides[1].names, times_s[1])
        return Recording(
            sides[0].folder,
            sides[1].folder if len(sides) == 2 else None,
            names,
            None if files.calibration is not None else self._calibration(files.images),
            ImageTimes(times_s[0][rows], "headers of the images", "ns"),
            poses,
        )

    def _calibration(self, bag: Path) -> CalibrationFile:
        found = [self._camera(bag, topic) for topic in self.topics]
        if len(found) == 1:
            return found[0]
        left, right = found
        if all(map(_has_rectified_images, self.topics)) and right.rectified[1]:
            right = replace(right, T_body_left=None)  # P is what these images were made with
        return stereo_calibration(left, right)

    def _camera(self, bag: Path, topic: str) -> CalibrationFile:
        info = _info_topic(topic)
        if info not in self.infos:
            raise SemvizError(
                f"{bag}: no {shown(info, 100)} for {shown(topic, 100)}; give --calibration FILE"
            )
        is_rectified = _has_rectified_images(topic)
        path = Path(f"{bag.name}:{info}")
        read = camera_info(
            path, _of_rectified(self.infos[info]) if is_rectified else self.infos[info]
        )
        frame = self.images[topic].frame
        root = self.body or self.tree.root_of(frame)
        T, (R_rectified, offset_m) = self.tree.pose(root, frame), read.rectified
        if is_rectified and R_rectified is not None:
            if T is not None:
                T = T @ R_rectified.inverse()  # the frame is that of the camera as mounted
            read = replace(read, rectified=(Pose.identity(), offset_m))
        what = f"of {shown(topic, 80)}{', rectified images' if is_rectified else ''}"
        return CalibrationFile(read.path, what, read.cameras, None, T, read.rectified)

    def _poses(self, chosen: Path | None) -> RecordedPoses | None:
        if self.poses_topic is None:
            return None
        path = chosen or Path(self.poses_topic)
        if self.odometry:
            rows = sorted(self.odometry, key=lambda row: row[0])
            return RecordedPoses(
                path,
                "Odometry",
                np.array([pose.as_matrix()[:3] for _, pose in rows]),
                of_body=True,
                time_s=np.array([time for time, _ in rows]) * 1e-9,
                time_unit="ns",
                quaternion="xyzw",
            )
        self.body = self.navsat.body
        return self.navsat.poses(path, self.tree)
