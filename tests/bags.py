"""One drive written as a bag of each kind: ROS 1, ROS 2 (db3) and MCAP."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera

Kind = Literal["ROS 1", "ROS 2", "MCAP"]
KINDS: tuple[Kind, ...] = ("ROS 1", "ROS 2", "MCAP")
Put = Callable[[str, str, int, Any], None]
"""Writes a message: topic, type, time (ns), message."""


@dataclass(frozen=True)
class Types:
    """The classes of messages, in the version of ROS of a bag."""

    store: Any
    is_ros1: bool

    def __call__(self, name: str, **values: Any) -> Any:
        return self.store.types[name](**values)

    def header(self, time_ns: int, frame: str) -> Any:
        stamp = self("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        number = {"seq": 0} if self.is_ros1 else {}
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **number)

    def quaternion(self, pose: Pose) -> Any:
        x, y, z, w = pose.as_quaternion().tolist()
        return self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def vector(self, kind: str, pose: Pose) -> Any:
        x, y, z = pose.translation.tolist()
        return self(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


@contextmanager
def bag(path: Path, kind: Kind, packed: str = "") -> Iterator[tuple[Put, Types]]:
    """Open a new bag at ``path``; ``packed``: by bz2 or lz4 (ROS 1), or what of it by zstd."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1 = kind == "ROS 1"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:  # it lacks this one
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    plugin = rosbag2.StoragePlugin.MCAP if kind == "MCAP" else rosbag2.StoragePlugin.SQLITE3
    writer: Any = (
        rosbag1.Writer(path) if is_ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    )
    if packed and is_ros1:
        writer.set_compression(writer.CompressionFormat[packed.upper()])
    elif packed:
        mode = rosbag2.CompressionMode[packed.upper()]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}

        def put(topic: str, type_name: str, time_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            data = (
                store.serialize_ros1(message, type_name)
                if is_ros1
                else store.serialize_cdr(message, type_name)
            )
            writer.write(connections[topic], time_ns, data)

        yield put, Types(store, is_ros1)


def put_camera(
    put: Put,
    types: Types,
    topic: str,
    frame: str,
    images: Sequence[tuple[int, Path]],
    camera: OriginalCamera,
    encoding: str | None = None,
    name: str = "image_raw",
    P: np.ndarray | None = None,
    R: np.ndarray | None = None,
) -> None:
    """Write images, compressed as in their files, or raw in an ``encoding``, and camera_info."""
    models = {"brown-conrady": "plumb_bob", "fisheye": "equidistant", "pinhole": "plumb_bob"}
    upper = str.upper if types.is_ros1 else str
    K = camera.K
    values = {
        "d": np.resize(camera.distortion, 5) * [1, 1, 1, 1, 0],
        "k": K.ravel(),
        "r": (np.eye(3) if R is None else R).ravel(),
        "p": (np.column_stack([K, np.zeros(3)]) if P is None else P).ravel(),
    }
    if camera.model == "fisheye":
        values["d"] = camera.distortion
    roi = types(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
    )  # fmt: skip
    for time_ns, path in images:
        header = types.header(time_ns, frame)
        info = types(
            "sensor_msgs/msg/CameraInfo", header=header, height=camera.height, width=camera.width,
            distortion_model=models[camera.model], binning_x=0, binning_y=0, roi=roi,
            **{upper(name): value for name, value in values.items()},
        )  # fmt: skip
        put(f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", time_ns, info)
        if encoding is None:
            data = np.frombuffer(path.read_bytes(), np.uint8)
            kind, ending = "sensor_msgs/msg/CompressedImage", "/compressed"
            message = types(kind, header=header, format=path.suffix[1:], data=data)
        else:
            kind, ending = "sensor_msgs/msg/Image", ""
            message = raw_image(types, header, path, encoding)
        put(f"{topic}/{name}{ending}", kind, time_ns, message)


def raw_image(types: Types, header: Any, path: Path, encoding: str) -> Any:
    """An image with four bytes of padding behind each row."""
    image = cv2.imread(str(path))
    assert image is not None
    channels = {"bgr8": image, "rgb8": image[:, :, ::-1], "mono8": image[:, :, :1]}[encoding]
    height, width, count = channels.shape
    rows = np.zeros((height, width * count + 4), np.uint8)
    rows[:, : width * count] = channels.reshape(height, -1)
    return types(
        "sensor_msgs/msg/Image", header=header, height=height, width=width, encoding=encoding,
        is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip


def put_odometry(
    put: Put, types: Types, poses: Sequence[tuple[int, Pose]], child: str, topic: str = "/odom"
) -> None:
    """Write T_odom_body of the frame ``child``."""
    zero = types("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    none = np.zeros(36)
    twist = types(
        "geometry_msgs/msg/TwistWithCovariance", covariance=none,
        twist=types("geometry_msgs/msg/Twist", linear=zero, angular=zero),
    )  # fmt: skip
    for time_ns, T in poses:
        pose = types(
            "geometry_msgs/msg/Pose",
            position=types.vector("Point", T),
            orientation=types.quaternion(T),
        )
        message = types(
            "nav_msgs/msg/Odometry", header=types.header(time_ns, "odom"), child_frame_id=child,
            pose=types("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=none),
            twist=twist,
        )  # fmt: skip
        put(topic, "nav_msgs/msg/Odometry", time_ns, message)


def put_static(
    put: Put, types: Types, time_ns: int, transforms: Sequence[tuple[str, str, Pose]]
) -> None:
    """Write T_parent_child of frames: parent, child, pose."""
    listed = [
        types(
            "geometry_msgs/msg/TransformStamped",
            header=types.header(time_ns, parent),
            child_frame_id=child,
            transform=types(
                "geometry_msgs/msg/Transform",
                translation=types.vector("Vector3", T),
                rotation=types.quaternion(T),
            ),
        )
        for parent, child, T in transforms
    ]
    message = types("tf2_msgs/msg/TFMessage", transforms=listed)
    put("/tf_static", "tf2_msgs/msg/TFMessage", time_ns, message)


def put_navsat(
    put: Put, types: Types, time_ns: int, place: tuple[float, float, float], R_enu_imu: Pose,
    other: Pose | None = None,
) -> None:  # fmt: skip
    """Write a fix (latitude, longitude in deg, height) of ``gps`` and an orientation of ``imu``.

    ``other`` is that of a second IMU, of the frame ``imu`` too; a third one has no orientation.
    """
    latitude, longitude, height = place
    fix = types(
        "sensor_msgs/msg/NavSatFix", header=types.header(time_ns, "gps"),
        status=types("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=latitude, longitude=longitude, altitude=height,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
    put("/fix", "sensor_msgs/msg/NavSatFix", time_ns, fix)
    zero = types("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    none, absent = np.zeros(9), np.array([-1.0] + [0.0] * 8)
    oriented = [("/imu", "imu", R_enu_imu, none), ("/raw_imu", "raw", Pose.identity(), absent)]
    if other is not None:
        oriented.append(("/other_imu", "imu", other, none))
    for topic, frame, turn, covariance in oriented:
        imu = types(
            "sensor_msgs/msg/Imu", header=types.header(time_ns + 10**6, frame),
            orientation=types.quaternion(turn), orientation_covariance=covariance,
            angular_velocity=zero, angular_velocity_covariance=none,
            linear_acceleration=zero, linear_acceleration_covariance=none,
        )  # fmt: skip
        put(topic, "sensor_msgs/msg/Imu", time_ns + 10**6, imu)
