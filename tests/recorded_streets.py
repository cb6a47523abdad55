"""Simulated streets as other people record drives: distorted images, a calibration, poses."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.simulation.street import Street

START_S = 1_700_000_000
T_CAM_IMU = Pose.from_rotvec([1.2, -1.2, 1.2], [0.1, -0.3, -1.5])
"""Of an imagined IMU."""


def intrinsics(f: float, cx: float, cy: float) -> FloatArray:
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


PINHOLE = OriginalCamera("pinhole", 1241, 376, intrinsics(718.856, 607.1928, 185.2157), np.zeros(0))
"""That of the street itself."""
BROWN = OriginalCamera(
    "brown-conrady",
    860,
    260,
    intrinsics(600.0, 424.2, 127.8),
    np.array([-0.28, 0.09, 0.0006, -0.0004]),
)
FISHEYE = OriginalCamera(
    "fisheye", 760, 250, intrinsics(520.0, 371.1, 122.4), np.array([0.02, -0.011, 0.004, -0.001])
)
LENSES = {"pinhole": PINHOLE, "brown": BROWN, "fisheye": FISHEYE}
_KALIBR_NAMES = {"pinhole": "none", "brown-conrady": "radtan", "fisheye": "equidistant"}


@dataclass(frozen=True)
class Recording:
    """The files of a recorded street."""

    left: Path
    right: Path
    kalibr: Path
    poses: Path
    """TUM, of the left camera."""
    body_poses: Path
    """TUM, of the IMU in the Kalibr file."""


def record(
    folder: Path,
    street: Street,
    lens: OriginalCamera,
    frames: range,
    R_right_turned: FloatArray | None = None,
    suffix: str = ".png",
) -> Recording:
    """Record ``frames``; the right camera is turned by a rotation (3, 3) from its own axes."""
    turn = np.eye(3) if R_right_turned is None else R_right_turned
    recording = Recording(
        folder / "left", folder / "right", folder / "rig.yaml", folder / "tum.txt", folder / "b.txt"
    )
    sides: tuple[tuple[Side, FloatArray], ...] = (("left", np.eye(3)), ("right", turn))
    for side, turned in sides:
        (folder / side).mkdir(parents=True)
        for index in frames:
            image = seen_through(street.image(index, side), street.rig.left, lens, turned)
            name = f"{(START_S * 10 + index) * 10**8}{suffix}"
            assert cv2.imwrite(str(folder / side / name), image[:, :, ::-1])
    T_right_left = street.rig.T_right_left
    assert T_right_left is not None
    T_turned = Pose(turn.T, np.zeros(3)) @ T_right_left
    recording.kalibr.write_text(kalibr(lens, T_turned))
    poses = [(index, street.frames[index].T_map_camera) for index in frames]
    recording.poses.write_text("".join(tum_line(i, T) for i, T in poses if T is not None))
    bodies = [(index, T @ T_CAM_IMU) for index, T in poses if T is not None]
    recording.body_poses.write_text("".join(tum_line(index, T) for index, T in bodies))
    return recording


def seen_through(
    image: ByteImage, camera: Camera, lens: OriginalCamera, turn: FloatArray | None = None
) -> ByteImage:
    """Return what ``lens``, with axes turned by (3, 3), records of what ``camera`` shows."""
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    rays = lens.rays(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([rays, np.ones(len(rays))]) @ (np.eye(3) if turn is None else turn).T
    pixels = camera.project(rays).astype(np.float32)
    shape = (lens.height, lens.width)
    x, y = (np.nan_to_num(axis, nan=-1e4).reshape(shape) for axis in pixels.T)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC), np.uint8)


def kalibr(lens: OriginalCamera, T_right_left: Pose) -> str:
    """A camchain of two cameras with one lens."""
    K = lens.K
    camera = (
        "  camera_model: pinhole\n"
        f"  intrinsics: {[K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()]}\n"
        f"  distortion_model: {_KALIBR_NAMES[lens.model]}\n"
        f"  distortion_coeffs: {lens.distortion.tolist()}\n"
        f"  resolution: [{lens.width}, {lens.height}]\n"
    )
    return (
        f"cam0:\n{camera}  T_cam_imu: {T_CAM_IMU.as_matrix().tolist()}\n"
        f"cam1:\n{camera}  T_cn_cnm1: {T_right_left.as_matrix().tolist()}\n"
    )


def tum_line(index: int, T: Pose) -> str:
    numbers = [*T.translation.tolist(), *T.as_quaternion().tolist()]
    return f"{START_S + index // 10}.{index % 10} " + " ".join(map(repr, numbers)) + "\n"
