"""Recorded poses, what they mean, and their conversion to poses of the left camera in a map, z up.

A format states the direction of its poses, the axes of its cameras and the order of quaternions;
each can be replaced. The body whose poses they are, the unit of length and the upward direction of
the world are stated by no file, so they are options, or found and reported. Positions on the WGS84
ellipsoid become metres: earth-centred, or local east, north and up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.datasets.own_drive.images.image_files import TimeUnit
from semviz_core.datasets.trajectory import T_MAP_WORLD, parsed_numbers, read_text

if TYPE_CHECKING:
    from pyproj import Transformer


Direction: TypeAlias = Literal["camera-to-world", "world-to-camera"]
QuaternionOrder: TypeAlias = Literal["xyzw", "wxyz"]
CameraAxes: TypeAlias = Literal["opencv", "opengl"]


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses as a file holds them, and what its format says about them."""

    path: Path
    format: str
    """For people: ``TUM``."""
    matrices: FloatArray
    """(n, 3, 4), of ``direction``."""
    direction: Direction = "camera-to-world"
    axes: CameraAxes = "opencv"
    """Of the cameras: y down and z ahead, or y up and z back."""
    of_body: bool = False
    """Whether the format holds poses of a body, as EuRoC's does, and not of a camera."""
    metric: bool = True
    """Whether lengths are metres by the format's definition."""
    time_s: FloatArray | None = None
    """(n,) or None."""
    time_unit: TimeUnit | None = None
    names: tuple[str, ...] | None = None
    """(n,) images, as the file names them, or None."""
    indices: IntArray | None = None
    """(n,) numbers of frames, or None. Without times, names and numbers, rows follow the images."""
    quaternion: QuaternionOrder | None = None
    note: str = ""
    """What else was taken for granted, for people."""
    doubt: str = ""
    """What contradicts that in the file itself, for people."""

    @property
    def order(self) -> str:
        """How rows are assigned to images, for people."""
        if self.names is not None:
            return "by name"
        if self.time_s is not None:
            return "by time"
        return "in order" if self.indices is None else "by number"


@dataclass(frozen=True, eq=False)
class PosedCameras:
    """Poses of a model, and the camera of each of its images."""

    poses: RecordedPoses
    cameras: Mapping[str, OriginalCamera]
    """By the names of the poses."""


def rotations_of(quaternions: FloatArray, order: QuaternionOrder, path: Path) -> FloatArray:
    """Return rotations (n, 3, 3). Raise SemvizError if rows (n, 4) are not of length 1."""
    from scipy.spatial.transform import Rotation

    lengths = np.linalg.norm(quaternions.clip(-1e3, 1e3), axis=1)
    wrong = np.flatnonzero((lengths < 0.99) | (lengths > 1.01))
    if len(wrong):
        raise SemvizError(
            f"{path}, pose {wrong[0] + 1}: the quaternion has length {lengths[wrong[0]]:.3g}, not 1"
        )
    xyzw = quaternions if order == "xyzw" else np.roll(quaternions, -1, axis=1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix()).reshape(-1, 3, 3)


def matrices_of(
    positions: FloatArray, quaternions: FloatArray, order: QuaternionOrder, path: Path
) -> FloatArray:
    """Return poses (n, 3, 4) from positions (n, 3) and quaternions (n, 4), as ``rotations_of``."""
    return np.concatenate([rotations_of(quaternions, order, path), positions[:, :, None]], axis=2)


def body_axes(yaw_rad: FloatArray, pitch_rad: FloatArray, roll_rad: FloatArray) -> FloatArray:
    """Return R_enu_body (n, 3, 3) of bodies with x ahead, y left, z up.

    Yaw is counterclockwise from east; positive pitch is nose down; the order is Rz Ry Rx.
    """
    from scipy.spatial.transform import Rotation

    angles = np.column_stack([yaw_rad, pitch_rad, roll_rad])
    return np.asarray(Rotation.from_euler("ZYX", angles).as_matrix()).reshape(-1, 3, 3)


UpDirection: TypeAlias = Literal["auto", "cameras", "x", "-x", "y", "-y", "z", "-z"]

FLIPPED = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""Between OpenGL's camera axes and OpenCV's."""
NAMED_EXTRINSICS = {
    "camera": Pose.identity(),
    "flu": T_MAP_WORLD,
    "frd": Pose(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3)),
}
"""T_body_camera of a body in the camera's place: with the camera's axes; x ahead, y left, z up; and
x ahead, y right, z down. The camera looks ahead."""
CALIBRATION_EXTRINSIC = "calibration"
_AXES: dict[str, FloatArray] = {
    name: sign * np.eye(3)[axis]
    for axis, letter in enumerate("xyz")
    for name, sign in ((letter, 1.0), (f"-{letter}", -1.0))
}
_NEAR_AXIS_DEG = 20.0
_FAR_M = 10_000.0
"""Worlds farther from their origin are moved: screens draw in float32."""
_DEGREES = 0.2
"""A drive whose positions span less in both directions may be in degrees."""
_MOST_LISTED_DEG = 180.0


@dataclass(frozen=True, eq=False)
class PoseConventions:
    """What recorded poses are taken as."""

    direction: Direction
    axes: CameraAxes
    quaternion: QuaternionOrder | None = None
    """None: the poses are matrices."""
    T_body_camera: Pose = field(default_factory=Pose.identity)
    """Identity if they are those of the camera."""

    def camera_pose(self, recorded: Pose) -> Pose:
        """Return ``T_world_camera``, with OpenCV's axes, of a pose as recorded."""
        T = recorded.inverse() if self.direction == "world-to-camera" else recorded
        return (T @ FLIPPED if self.axes == "opengl" else T) @ self.T_body_camera

    def of_camera(self, T_first_camera: Pose) -> "PoseConventions":
        """Return those of another camera of a rig."""
        return replace(self, T_body_camera=self.T_body_camera @ T_first_camera)

    def recorded_pose(self, T_world_camera: Pose) -> Pose:
        """Return the pose as recorded; the inverse of ``camera_pose``."""
        T = T_world_camera @ self.T_body_camera.inverse()
        T = T @ FLIPPED if self.axes == "opengl" else T
        return T.inverse() if self.direction == "world-to-camera" else T


def camera_poses(
    poses: RecordedPoses, direction: Direction | None, axes: CameraAxes | None
) -> list[Pose]:
    """Return world_from_camera or world_from_body, with OpenCV's camera axes."""
    taken = PoseConventions(direction or poses.direction, axes or poses.axes)
    return [taken.camera_pose(Pose(matrix[:, :3], matrix[:, 3])) for matrix in poses.matrices]


def read_extrinsic(name: str, calibration: CalibrationFile) -> tuple[Pose, str]:
    """Return T_body_camera of the left camera and where it is from, for people.

    ``name`` is one of ``NAMED_EXTRINSICS``, ``calibration``, or a file: a calibration with a body,
    or the 12 or 16 numbers of a matrix. Raise SemvizError for others.
    """
    if name in NAMED_EXTRINSICS:
        return NAMED_EXTRINSICS[name], name
    if name == CALIBRATION_EXTRINSIC:
        if calibration.T_body_left is None:
            raise SemvizError(
                f"{calibration.path}: holds no pose of a body (T_cam_imu, T_BS, T_body_left); "
                "give --extrinsic FILE with the 4x4 matrix T_body_camera"
            )
        return calibration.T_body_left, calibration.path.name
    path = Path(name)
    if not path.is_file():
        raise SemvizError(
            f"--extrinsic {shown(name)}: no such file; give one, 'calibration', "
            + ", ".join(f"'{known}'" for known in NAMED_EXTRINSICS)
        )
    if path.suffix in (".yaml", ".yml", ".toml"):
        return read_extrinsic(CALIBRATION_EXTRINSIC, read_calibration(path))[0], path.name
    return read_matrix(path), path.name


def read_matrix(path: Path) -> Pose:
    """Return T_body_camera from a file with the 12 or 16 numbers of a matrix."""
    if not path.is_file():
        raise SemvizError(
            f"--extrinsic {shown(path)}: no such file; give one, "
            + ", ".join(f"'{known}'" for known in NAMED_EXTRINSICS)
        )
    return pose_in(path, "T_body_camera")


def pose_in(path: Path, name: str) -> Pose:
    """Return the pose, called ``name``, in a file of 12 or 16 numbers. Raise SemvizError."""
    text = " ".join(read_text(path).replace(",", " ").split())
    count = 16 if len(text.split()) == 16 else 12
    try:
        return Pose.from_matrix(parsed_numbers(text, count, "numbers").reshape(-1, 4))
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}; give {name} as a 3x4 or 4x4 matrix") from None


def refuse_degrees(path: Path, positions: FloatArray) -> None:
    """Raise SemvizError if positions (n, 3) look like latitude and longitude."""
    span, middle = np.ptp(positions[:, :2], axis=0), np.abs(positions[:, :2]).mean(axis=0)
    if (
        len(positions) > 1
        and 0.0 < span.max() < _DEGREES
        and (middle < _MOST_LISTED_DEG).all()
        and middle.min() > 5.0 * _DEGREES
    ):
        first = ", ".join(f"{value:.5f}" for value in positions[0, :2])
        raise SemvizError(
            f"{path}: positions such as {first} span less than {_DEGREES:g}: degrees of latitude "
            "and longitude? Metres are needed; convert them, or give --metric if these are metres"
        )


@dataclass(frozen=True, eq=False)
class WorldAxes:
    """How the recorded world becomes the map's: z up, with an origin near the drive."""

    T_map_world: Pose
    up: str
    """For people: the axis of the recorded world that is up, or that it is the cameras'."""
    tilt_deg: float
    """Between the cameras' mean upward direction and that one."""
    origin_m: tuple[float, float, float]
    """The map's origin in the recorded world."""


def world_axes(T_world_camera: Sequence[Pose], up: UpDirection = "auto") -> WorldAxes:
    """Return the map's axes. ``auto`` takes the axis nearest to the cameras' upward direction.

    If none is within 20 deg, the cameras' own upward direction is taken. ``T_world_camera`` has
    at least one pose. Earth-centred positions get axes east, north and up at the first one.
    """
    upward = -np.mean([pose.rotation[:, 1] for pose in T_world_camera], axis=0)
    upward /= max(float(np.linalg.norm(upward)), 1e-9)
    t = np.array([pose.translation for pose in T_world_camera])
    if up == "auto" and is_earth_centred(t):
        local = east_north_up(t[0])
        tilt_deg = _angle_deg(local.rotation[2], upward)
        if tilt_deg <= _NEAR_AXIS_DEG:
            x_m, y_m, z_m = t[0].tolist()
            return WorldAxes(local, "the earth's", tilt_deg, (x_m, y_m, z_m))
    nearest = max(_AXES, key=lambda name: float(_AXES[name] @ upward))
    chosen: str = up
    if up == "auto":
        near = _angle_deg(_AXES[nearest], upward) <= _NEAR_AXIS_DEG
        chosen = nearest if near else "cameras"
    z = upward if chosen == "cameras" else _AXES[chosen]
    x = np.eye(3)[0 if abs(z[2]) > 0.9 else 2]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    R = np.array([x, np.cross(z, x), z])
    origin = np.zeros(3)
    if np.abs(t).max() > _FAR_M:
        origin = np.round(t[0] / 1000.0) * 1000.0
    east, north, height = origin.tolist()
    return WorldAxes(Pose(R, -R @ origin), chosen, _angle_deg(z, upward), (east, north, height))


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1.0, 1.0))))


_RADII_M = (6.33e6, 6.41e6)
"""From the earth's centre to its surface, with a margin."""


@cache
def _to_ecef() -> "Transformer":
    """Return the transformation of longitude, latitude and height to ECEF, on WGS84."""
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def earth_centred(
    latitude_rad: FloatArray, longitude_rad: FloatArray, h_m: FloatArray
) -> FloatArray:
    """Return ECEF positions (n, 3), m, of geodetic ones (n,); ``h_m`` is above the ellipsoid."""
    return np.column_stack(_to_ecef().transform(longitude_rad, latitude_rad, h_m, radians=True))


def is_earth_centred(positions_m: FloatArray) -> bool:
    """Whether positions (n, 3) are as far from their origin as the earth's surface."""
    radii = np.linalg.norm(positions_m, axis=1)
    return bool(((radii > _RADII_M[0]) & (radii < _RADII_M[1])).all())


def geodetic(position_m: FloatArray) -> tuple[float, float, float]:
    """Return latitude, longitude (deg) and height above the ellipsoid (m) of an ECEF position."""
    x, y, z = position_m.tolist()
    longitude, latitude, height_m = _to_ecef().transform(x, y, z, direction="INVERSE")
    return float(latitude), float(longitude), float(height_m)


def east_north_up(position_m: FloatArray) -> Pose:
    """Return T_enu_ecef of the local frame whose origin is an ECEF position (3,)."""
    x, y, z = position_m.tolist()
    longitude, latitude, _ = _to_ecef().transform(x, y, z, radians=True, direction="INVERSE")
    R = axes_at(latitude, longitude)
    return Pose(R, -R @ position_m)


def map_on_earth(origin: tuple[float, float, float], x_heading_deg: float) -> Pose:
    """Return T_map_ecef of a map, by latitude, longitude (deg) and height (m) of its origin.

    ``x_heading_deg`` is the compass direction of the map's x axis; its z axis is up.
    """
    latitude, longitude, height_m = (np.array([value]) for value in origin)
    place = earth_centred(np.deg2rad(latitude), np.deg2rad(longitude), height_m)[0]
    turn = np.deg2rad(x_heading_deg - 90.0)  # clockwise from east
    R_map_enu = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    return Pose(R_map_enu, np.zeros(3)) @ east_north_up(place)


def axes_at(latitude_rad: float, longitude_rad: float) -> FloatArray:
    """Return (3, 3) from ECEF axes to east, north and up at a place."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_lon, cos_lon = np.sin(longitude_rad), np.cos(longitude_rad)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def local_poses(
    latitude_deg: FloatArray, longitude_deg: FloatArray, h_m: FloatArray, R_enu_body: FloatArray
) -> FloatArray:
    """Return (n, 3, 4) poses in east-north-up at the first place, of bodies there.

    ``R_enu_body`` (n, 3, 3) are to east, north and up at each own place.
    """
    latitude, longitude = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    positions = earth_centred(latitude, longitude, h_m)
    R_first = axes_at(float(latitude[0]), float(longitude[0]))
    R_own = np.array([axes_at(*place) for place in zip(latitude, longitude, strict=True)])
    t = (positions - positions[0]) @ R_first.T
    return np.concatenate([R_first @ R_own.transpose(0, 2, 1) @ R_enu_body, t[:, :, None]], axis=2)
