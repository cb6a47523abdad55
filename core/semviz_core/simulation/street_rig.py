"""Record a simulated street as a car with several cameras would, with lenses and clocks apart.

The body is the street's own camera, which looks ahead. Every camera has its lens, its place on the
body and its time within a frame; where it is then lies between the poses of two frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray
from semviz_core.datasets.own_drive.cameras.lens import LensModel, OriginalCamera
from semviz_core.datasets.own_drive.recording import poses_at_times
from semviz_core.simulation.drawing import PinholeView
from semviz_core.simulation.street import (
    BASELINE_M,
    Painter,
    Street,
    elements_in_view,
    paint_ranks,
)

START_S: Final = 1_700_000_000
CALIBRATION: Final = "rig.toml"
POSES: Final = "poses.txt"


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera of the rig."""

    lens: OriginalCamera
    T_body_camera: Pose
    late_s: float = 0.0
    """Its images are taken so long after the time of a frame."""


def mounted(
    model: LensModel, yaw_deg: float, offset_m: Sequence[float], late_s: float
) -> MountedCamera:
    """Return a camera of the default rig: turned to the right by ``yaw_deg``, seen from above."""
    distortion = {
        "pinhole": (),
        "brown-conrady": (-0.28, 0.09, 0.0006, -0.0004),
        "fisheye": (0.02, -0.011, 0.004, -0.001),
    }[model]
    K = np.array([[520.0, 0.0, 421.3], [0.0, 520.0, 172.6], [0.0, 0.0, 1.0]])
    lens = OriginalCamera(model, 860, 350, K, np.array(distortion))
    turn = so3_exp(np.array([0.0, np.deg2rad(yaw_deg), 0.0]))
    return MountedCamera(lens, Pose(turn, np.array(offset_m, dtype=np.float64)), late_s)


def four_cameras() -> dict[str, MountedCamera]:
    """Return a rig that looks ahead, to both sides and back, one camera after the other."""
    return {
        "front": mounted("brown-conrady", 0.0, (0.0, 0.0, 0.0), 0.0),
        "left": mounted("fisheye", -65.0, (-0.4, 0.1, -0.3), 0.013),
        "right": mounted("fisheye", 65.0, (0.4, 0.1, -0.3), 0.027),
        "back": mounted("brown-conrady", 180.0, (0.0, -0.2, -2.1), 0.041),
    }


def stereo_pair(model: LensModel) -> dict[str, MountedCamera]:
    """Return two cameras of one lens that look ahead at one time."""
    return {
        "left": mounted(model, 0.0, (0.0, 0.0, 0.0), 0.0),
        "right": mounted(model, 0.0, (BASELINE_M, 0.0, 0.0), 0.0),
    }


def record_rig(
    folder: Path, street: Street, cameras: Mapping[str, MountedCamera], frames: range
) -> None:
    """Write ``folder/NAME/TIME_NS.jpg``, the calibration and the poses of the body (TUM).

    Images of cameras that are late need a pose after the last frame, so frames end before it.
    """
    painter = Painter(street.layout, street.seed)
    for name, camera in cameras.items():
        (folder / name).mkdir(parents=True)
        for frame in frames:
            time_s = street.frames[frame].time_s + camera.late_s
            pose = body_pose(street, time_s) @ camera.T_body_camera
            image = seen_by(painter, camera.lens, pose)
            path = folder / name / f"{round((START_S + time_s) * 1e9)}.jpg"
            data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            path.write_bytes(data.tobytes())
    (folder / CALIBRATION).write_text("".join(_table(*item) for item in cameras.items()))
    lines = []
    for one in street.frames:
        assert one.T_map_camera is not None
        numbers = [*one.T_map_camera.translation, *one.T_map_camera.as_quaternion()]
        stamp = f"{START_S + one.time_s:.6f}"
        lines.append(" ".join([stamp, *(f"{number:.9f}" for number in numbers)]))
    (folder / POSES).write_text("\n".join(lines) + "\n")


def body_pose(street: Street, time_s: float) -> Pose:
    """Return ``T_map_body`` between two frames of the street."""
    poses = [frame.T_map_camera for frame in street.frames if frame.T_map_camera is not None]
    times = np.array([frame.time_s for frame in street.frames])
    (pose,) = poses_at_times(poses, times, np.array([time_s]), 1.0)
    assert pose is not None  # the street has frames around it
    return pose


def seen_by(painter: Painter, lens: OriginalCamera, T_map_camera: Pose) -> ByteImage:
    """Return what a camera with this lens records at a pose: (height, width, 3) sRGB."""
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    rays = lens.rays(np.column_stack([u.ravel(), v.ravel()]))
    camera = _covering(rays, lens.focal_px)
    image = painter.paint(PinholeView(camera, T_map_camera))
    pixels = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    x, y = (axis.reshape(lens.height, lens.width).astype(np.float32) for axis in pixels.T)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC), dtype=np.uint8)


def visible_at(street: Street, camera: Camera, T_map_camera: Pose) -> tuple[Elements2D, IntArray]:
    """Return the elements that a pinhole camera sees at a pose, and their ids in ``truth_map``."""
    view = PinholeView(camera, T_map_camera)
    return elements_in_view(paint_ranks(street.layout, view), street.truth_map.elements, view)


def _covering(rays: FloatArray, focal_px: float) -> Camera:
    """Return a pinhole camera that sees all rays (n, 2), at depth 1."""
    low, high = rays.min(axis=0), rays.max(axis=0)
    width, height = (np.ceil((high - low) * focal_px).astype(int) + 4).tolist()
    cx, cy = (2.0 - low * focal_px).tolist()
    return Camera(width, height, np.array([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1.0]]))


def _table(name: str, camera: MountedCamera) -> str:
    lens, K = camera.lens, camera.lens.K
    return (
        f"[cameras.{name}]\n"
        f"size_px = [{lens.width}, {lens.height}]\n"
        f'model = "{lens.model}"\n'
        f"focal_px = [{K[0, 0]}, {K[1, 1]}]\n"
        f"center_px = [{K[0, 2]}, {K[1, 2]}]\n"
        f"distortion = {lens.distortion.tolist()}\n"
        f"T_body_camera = {camera.T_body_camera.as_matrix()[:3].tolist()}\n\n"
    )
