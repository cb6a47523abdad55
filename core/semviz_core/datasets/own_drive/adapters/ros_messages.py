"""What the messages of ROS say: times, images, camera_info, frames, odometry and GNSS."""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import check_pixels, shown
from semviz_core.datasets.own_drive.images.color_orders import BAYER_PATTERNS, demosaiced
from semviz_core.datasets.own_drive.poses.conventions import (
    RecordedPoses,
    local_poses,
    rotations_of,
)

_MOST_APART_NS = 50_000_000
"""Between a fix and the orientation used with it."""
_CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
_BAYER = {f"bayer_{pattern}8": pattern for pattern in BAYER_PATTERNS}
_PNG, _JPEG = b"\x89PNG", b"\xff\xd8\xff"


def stamp_ns(message: Any, topic: str) -> int:
    """Return the time in a header. Raise SemvizError if it is not set."""
    stamp = message.header.stamp
    time_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    if time_ns <= 0:
        raise SemvizError(f"{topic}: a header without a time; record with a driver that sets it")
    return time_ns


def image_file(message: Any, topic: str) -> tuple[bytes, str]:
    """Return an image as the bytes of a PNG or JPEG file, and its ending.

    Compressed images stay as they are. Raise SemvizError for an encoding that is not read.
    """
    data = bytes(message.data)
    if hasattr(message, "format"):
        if data.startswith(_JPEG) or data.startswith(_PNG):
            return data, ".jpg" if data.startswith(_JPEG) else ".png"
        raise SemvizError(
            f"{topic}: compressed images of format {shown(message.format, 40)!r} are not read, "
            "only JPEG and PNG"
        )
    import cv2

    image = _bgr(message, topic, np.frombuffer(data, np.uint8))
    done, file = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise SemvizError(f"{topic}: an image that cannot be written as PNG")
    return file.tobytes(), ".png"


def _bgr(message: Any, topic: str, data: NDArray[np.uint8]) -> NDArray[np.uint8]:

    width, height, step = int(message.width), int(message.height), int(message.step)
    check_pixels(width, height, topic)
    encoding = str(message.encoding)
    channels = 1 if encoding in _BAYER else _CHANNELS.get(encoding)
    if channels is None:
        known = ", ".join([*_CHANNELS, *_BAYER])
        raise SemvizError(
            f"{topic}: images of encoding {shown(encoding, 40)!r} are not read, only {known}"
        )
    if step < width * channels or len(data) != step * height:
        raise SemvizError(
            f"{topic}: an image of {len(data)} bytes, expected {step} x {height}: cut off"
        )
    rows = data.reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    if (pattern := _BAYER.get(encoding)) is not None:
        return np.ascontiguousarray(demosaiced(rows[:, :, 0], pattern)[:, :, ::-1])
    colours = rows[:, :, [2, 1, 0]] if encoding.startswith("rgb") else rows[:, :, :3]
    return np.ascontiguousarray(colours)


def camera_info_values(message: Any) -> dict[str, Any]:
    """Return a CameraInfo with the names of its YAML; ROS 1 writes D, K, R, P."""

    def listed(*names: str) -> list[float]:
        found = next(getattr(message, name) for name in names if hasattr(message, name))
        return [float(number) for number in found]

    return {
        "width": int(message.width),
        "height": int(message.height),
        "distortion_model": str(message.distortion_model),
        "d": listed("d", "D"),
        "k": listed("k", "K"),
        "r": listed("r", "R"),
        "p": listed("p", "P"),
        "binning_x": int(message.binning_x),
        "binning_y": int(message.binning_y),
        "roi": {"x_offset": int(message.roi.x_offset), "y_offset": int(message.roi.y_offset)},
    }


def pose_of(position: Any, orientation: Any, where: str) -> Pose:
    """Return the pose of a point and a quaternion. Raise SemvizError if they are none."""
    q = np.array([[orientation.x, orientation.y, orientation.z, orientation.w]])
    t = np.array([position.x, position.y, position.z])
    if not np.isfinite(t).all():
        raise SemvizError(f"{where}: a position that is not finite")
    return Pose(rotations_of(q, "xyzw", Path(where))[0], t)


def odometry(message: Any, topic: str) -> Pose:
    """Return the pose of the body (``child_frame_id``) in the odometry's frame."""
    pose = message.pose.pose
    return pose_of(pose.position, pose.orientation, topic)


class FrameTree:
    """The fixed transforms of ``/tf_static``; each is parent from child."""

    def __init__(self) -> None:
        self._near: dict[str, dict[str, Pose]] = {}
        self._parent: dict[str, str] = {}

    def take(self, message: Any) -> None:
        """Add the transforms of a message."""
        for one in message.transforms:
            parent, child = _name(one.header.frame_id), _name(one.child_frame_id)
            T = pose_of(one.transform.translation, one.transform.rotation, "/tf_static")
            self._near.setdefault(parent, {})[child] = T
            self._near.setdefault(child, {})[parent] = T.inverse()
            self._parent[child] = parent

    def root_of(self, frame: str) -> str:
        """Return the topmost frame above ``frame``; empty if nothing is above it."""
        seen = {name := _name(frame)}
        if name not in self._parent:
            return ""
        while name in self._parent and self._parent[name] not in seen:
            seen.add(name := self._parent[name])
        return name

    def pose(self, target: str, source: str) -> Pose | None:
        """Return T_target_source; None if nothing connects both, or a name is empty."""
        start, end = _name(target), _name(source)
        if not start or not end:
            return None
        found, queue = {start: Pose.identity()}, deque([start])
        while queue:
            here = queue.popleft()
            for name, T in self._near.get(here, {}).items():
                if name not in found:
                    found[name] = found[here] @ T
                    queue.append(name)
        return found.get(end)


def _name(frame: str) -> str:
    return str(frame).strip("/")


@dataclass
class NavSat:
    """Fixes of GNSS, and the orientations of an IMU, which are to east, north and up."""

    fixes: list[tuple[int, float, float, float]] = field(default_factory=list)
    turns: dict[str, list[tuple[int, FloatArray]]] = field(default_factory=dict)
    """By topic."""
    antenna: str = ""
    body: str = ""
    """Frame of the IMU."""

    def take_fix(self, message: Any, topic: str) -> None:
        """Keep a NavSatFix; those without a fix (negative status) are left out."""
        place = (float(message.latitude), float(message.longitude), float(message.altitude))
        if int(message.status.status) >= 0 and np.isfinite(place).all():
            self.antenna = str(message.header.frame_id)
            self.fixes.append((stamp_ns(message, topic), *place))

    def take_imu(self, message: Any, topic: str) -> None:
        """Keep the orientation of an Imu; -1 as first covariance says that it has none."""
        if float(message.orientation_covariance[0]) != -1.0:
            q = message.orientation
            self.body = str(message.header.frame_id)
            turn = (stamp_ns(message, topic), np.array([q.x, q.y, q.z, q.w]))
            self.turns.setdefault(topic, []).append(turn)

    def poses(self, path: Path, tree: FrameTree) -> RecordedPoses | None:
        """Return the poses of the IMU. Raise SemvizError if fixes have no orientation, or the
        orientations are those of several IMUs."""
        if len(self.turns) > 1:
            raise SemvizError(
                f"{path}: orientations of {len(self.turns)} IMUs; choose one: --poses {path},IMU "
                f"with IMU of {shown(', '.join(sorted(self.turns)), 300)}"
            )
        turns = next(iter(self.turns.values()), [])
        if not self.fixes or not turns:
            raise SemvizError(
                f"{path}: {len(self.fixes)} GNSS fixes and {len(turns)} orientations of an "
                "IMU; both are needed for poses: give --poses FILE"
            )
        T_body_antenna = tree.pose(self.body, self.antenna)
        if T_body_antenna is None:
            raise SemvizError(
                f"{path}: /tf_static does not connect the antenna {shown(self.antenna, 40)!r} with "
                f"the IMU {shown(self.body, 40)!r}; give --poses FILE"
            )
        turn_ns = np.array([time for time, _ in turns])
        nearest = [int(np.abs(turn_ns - fix[0]).argmin()) for fix in self.fixes]
        used = [
            (fix, turns[row][1])
            for fix, row in zip(self.fixes, nearest, strict=True)
            if abs(turn_ns[row] - fix[0]) <= _MOST_APART_NS
        ]
        if not used:
            raise SemvizError(f"{path}: no orientation within 50 ms of a fix: other clocks")
        times, latitude, longitude, height = np.array([fix for fix, _ in used], float).T
        R = rotations_of(np.array([q for _, q in used]), "xyzw", path)
        matrices = local_poses(latitude, longitude, height, R)
        matrices[:, :, 3] -= matrices[:, :, :3] @ T_body_antenna.translation
        order = np.argsort(times, kind="stable")
        return RecordedPoses(
            path,
            "NavSatFix and Imu",
            matrices[order],
            of_body=True,
            time_s=np.array([fix[0] for fix, _ in used])[order] * 1e-9,
            time_unit="ns",
            quaternion="xyzw",
            note=f"metres east and north of {latitude[0]:.7f}, {longitude[0]:.7f}",
        )
