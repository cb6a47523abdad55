"""Make a small drive as a car records it: ``python docs/make_example_drive.py FOLDER [--rig]``.

A simulated street seen by two cameras with a distorting lens: images in ``left`` and ``right``, a
Kalibr calibration ``rig.yaml``, poses of the left camera ``poses.txt`` (TUM). With ``--rig`` seen
by four cameras: ``front``, ``left``, ``right`` and ``back``, a calibration ``rig.toml``.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street
from semviz_core.simulation.street_rig import four_cameras, record_rig

FRAMES = 6
START_S = 1_700_000_000
FOCAL_PX, CENTER_PX, SIZE_PX = 600.0, (424.2, 127.8), (860, 260)
DISTORTION = (-0.28, 0.09, 0.0006, -0.0004)
CAMERA = f"""  camera_model: pinhole
  intrinsics: [{FOCAL_PX}, {FOCAL_PX}, {CENTER_PX[0]}, {CENTER_PX[1]}]
  distortion_model: radtan
  distortion_coeffs: {list(DISTORTION)}
  resolution: {list(SIZE_PX)}
"""


def record(folder: Path) -> None:
    """Write the files; images are called by their time in nanoseconds."""
    street = Street(3, StreetOptions(FRAMES))
    poses = []
    for frame in street.frames:
        stamp_ns = START_S * 10**9 + frame.index * 10**8
        assert frame.T_map_camera is not None
        numbers = [*frame.T_map_camera.translation, *frame.T_map_camera.as_quaternion()]
        poses.append(" ".join(f"{number:.9f}" for number in (stamp_ns / 1e9, *numbers)))
        sides: tuple[Side, Side] = ("left", "right")
        for side in sides:
            (folder / side).mkdir(parents=True, exist_ok=True)
            image = through_the_lens(street.image(frame.index, side), street)
            cv2.imwrite(str(folder / side / f"{stamp_ns}.jpg"), image[:, :, ::-1])
    baseline = [[1, 0, 0, -street.rig.baseline_m], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    rig = f"cam0:\n{CAMERA}cam1:\n{CAMERA}  T_cn_cnm1: {baseline}\n"
    (folder / "rig.yaml").write_text(rig)
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")


def through_the_lens(image: ByteImage, street: Street) -> ByteImage:
    """Return what the lens records of a pinhole image of the street."""
    K = np.array([[FOCAL_PX, 0.0, CENTER_PX[0]], [0.0, FOCAL_PX, CENTER_PX[1]], [0.0, 0.0, 1.0]])
    lens = OriginalCamera("brown-conrady", *SIZE_PX, K, np.array(DISTORTION))
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    rays = lens.rays(np.column_stack([u.ravel(), v.ravel()]))
    pixels = street.rig.left.project(np.column_stack([rays, np.ones(len(rays))]))
    x, y = (axis.reshape(lens.height, lens.width).astype(np.float32) for axis in pixels.T)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC), dtype=np.uint8)


if __name__ == "__main__":
    if "--rig" in sys.argv:
        street = Street(3, StreetOptions(FRAMES + 2))
        record_rig(Path(sys.argv[1]), street, four_cameras(), range(FRAMES))
    else:
        record(Path(sys.argv[1]))
