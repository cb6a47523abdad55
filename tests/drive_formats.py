"""One camera in all formats of calibrations, and one trajectory in all formats of poses."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from semviz_core.base.pose import Pose, angle_between
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.trajectory import T_MAP_WORLD

MATRIX = "rows: 3, cols: 3, data: [831.5, 0, 510.6, 0, 833.6, 391.5, 0, 0, 1]"
CALIBRATIONS = {
    "ros.yaml": f"""image_width: 1024
image_height: 768
camera_matrix: {{{MATRIX}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.35, 0.14, 1e-4, 7.3e-4, 0.0]}}
""",
    "ros2.yaml": """width: 1024
height: 768
distortion_model: plumb_bob
d: [-0.35, 0.14, 0.0001, 0.00073, 0.0]
k: [831.5, 0.0, 510.6, 0.0, 833.6, 391.5, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [700.0, 0.0, 510.6, 0.0, 0.0, 700.0, 391.5, 0.0, 0.0, 0.0, 1.0, 0.0]
""",
    "opencv.yaml": f"""%YAML:1.0
---
image_width: 1024
image_height: 768
camera_matrix: !!opencv-matrix
   {{{MATRIX}, dt: d}}
distortion_coefficients: !!opencv-matrix
   {{rows: 5, cols: 1, dt: d, data: [-0.35, 0.14, 0.0001, 0.00073, 0.0]}}
""",
    "euroc.yaml": """%YAML:1.0
sensor_type: camera
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
resolution: [1024, 768]
camera_model: pinhole
intrinsics: [831.5, 833.6, 510.6, 391.5] # fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.35, 0.14, 0.0001, 0.00073]
""",
    "kalibr.yaml": """cam0:
  camera_model: pinhole
  intrinsics: [831.5, 833.6, 510.6, 391.5]
  distortion_model: radtan
  distortion_coeffs: [-0.35, 0.14, 0.0001, 0.00073]
  resolution: [1024, 768]
""",
    "ros.ini": """# oST version 5.0 parameters
[image]

width
1024

height
768

[narrow_stereo]

camera matrix
831.5 0.0 510.6
0.0 833.6 391.5
0.0 0.0 1.0

distortion
-0.35 0.14 0.0001 0.00073 0.0

rectification
1.0 0.0 0.0
0.0 1.0 0.0
0.0 0.0 1.0

projection
700.0 0.0 510.6 0.0
0.0 700.0 391.5 0.0
0.0 0.0 1.0 0.0
""",
    "own.toml": """[left]
size_px = [1024, 768]
model = "brown-conrady"
focal_px = [831.5, 833.6]
center_px = [510.6, 391.5]
distortion = [-0.35, 0.14, 0.0001, 0.00073]
""",
    "orbslam.yaml": """%YAML:1.0
Camera.type: "PinHole"
Camera1.fx: 831.5
Camera1.fy: 833.6
Camera1.cx: 510.6
Camera1.cy: 391.5
Camera1.k1: -0.35
Camera1.k2: 0.14
Camera1.p1: 1e-4
Camera1.p2: 0.00073
Camera.width: 1024
Camera.height: 768
Viewer.PointSize: 2.0
""",
    "vins.yaml": """%YAML:1.0
---
model_type: PINHOLE
image_width: 1024
image_height: 768
distortion_parameters: {k1: -0.35, k2: 0.14, p1: 0.0001, p2: 0.00073}
projection_parameters: {fx: 831.5, fy: 833.6, cx: 510.6, cy: 391.5}
""",
    "named.json": """{"value0": {"intrinsics": [{"camera_type": "pinhole-radtan", "intrinsics":
{"fx": 831.5, "fy": 833.6, "cx": 510.6, "cy": 391.5,
 "k1": -0.35, "k2": 0.14, "p1": 0.0001, "p2": 0.00073}}], "resolution": [[1024, 768]]}}
""",
    "droid.txt": "831.5 833.6 510.6 391.5 -0.35 0.14 0.0001 0.00073\n",
    "dso.txt": "RadTan 831.5 833.6 510.6 391.5 -0.35 0.14 0.0001 0.00073\n"
    "1024 768\ncrop\n640 480\n",
}


COUNT = 8
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
T_BODY_CAMERA = T_MAP_WORLD @ Pose.from_rotvec([0.02, -0.01, 0.03], [0.3, -0.1, 0.05])
"""Of a body with x ahead."""
CALIBRATION = f"""T_body_left = {T_BODY_CAMERA.as_matrix().tolist()}
[left]
size_px = [64, 48]
model = "pinhole"
focal_px = [50.0, 50.0]
center_px = [31.5, 23.5]
"""


def truth(index: int) -> Pose:
    """T_world_camera on a left-hand bend, z up."""
    heading = 0.1 * index
    turned = Pose(Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix(), np.zeros(3))
    return Pose(np.eye(3), np.array([index * 1.2, 0.06 * index**2, 1.5])) @ turned @ T_MAP_WORLD


def stamps() -> list[int]:
    return [START_NS + index * STEP_NS for index in range(COUNT)]


def numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def wxyz(pose: Pose) -> list[float]:
    return np.roll(pose.as_quaternion(), 1).tolist()


def tum(folder: Path) -> Path:
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} "
        + numbers(*truth(i).translation, *truth(i).as_quaternion())
        for i, stamp in enumerate(stamps())
    ]
    return written(folder / "tum.txt", "# time x y z qx qy qz qw\n" + "\n".join(lines))


def kitti(folder: Path) -> Path:
    """In KITTI's world, y down."""
    poses = [T_MAP_WORLD.inverse() @ truth(index) for index in range(COUNT)]
    text = "\n".join(numbers(*pose.as_matrix()[:3].ravel()) for pose in poses)
    return written(folder / "kitti.txt", text)


def euroc(folder: Path) -> Path:
    """Of the body, with its velocity and biases."""
    lines = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v, v, v, b, b, b, b, b, b"]
    for index, stamp in enumerate(stamps()):
        body = truth(index) @ T_BODY_CAMERA.inverse()
        words = [str(stamp), *map(repr, [*body.translation.tolist(), *wxyz(body)]), *["0.0"] * 9]
        lines.append(",".join(words))
    return written(folder / "data.csv", "\n".join(lines))


def image_name(index: int) -> str:
    return f"cam/{stamps()[index]}.png"


def colmap(folder: Path) -> Path:
    """With a line of points, and an empty one, in COLMAP's manner."""
    lines = ["# Image list with two lines of data per image:"]
    for index in range(COUNT):
        T = truth(index).inverse()
        row = numbers(*wxyz(T), *T.translation)
        lines += [f"{index + 1} {row} 1 {image_name(index)}", "" if index % 2 else "1.0 2.0 -1"]
    (folder / "sparse").mkdir()
    written(folder / "sparse" / "cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n")
    written(folder / "sparse" / "images.txt", "\n".join(lines) + "\n")
    return folder / "sparse"


def colmap_binary(folder: Path) -> Path:
    data = struct.pack("<Q", COUNT)
    for index in range(COUNT):
        T = truth(index).inverse()
        data += struct.pack("<I7dI", index + 1, *wxyz(T), *T.translation.tolist(), 7)
        data += image_name(index).encode() + b"\0" + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    (folder / "bin").mkdir()
    (folder / "bin" / "images.bin").write_bytes(data)
    cameras = struct.pack("<QIiQQ4d", 1, 7, 1, 64, 48, 50.0, 50.0, 32.0, 24.0)
    (folder / "bin" / "cameras.bin").write_bytes(cameras)
    return folder / "bin"


def nerfstudio(folder: Path) -> Path:
    flip = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    frames = [
        {
            "file_path": f"./{image_name(index)}",
            "transform_matrix": (truth(index) @ flip).as_matrix().tolist(),
        }
        for index in range(COUNT)
    ]
    camera = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    return written(folder / "transforms.json", json.dumps({**camera, "frames": frames}))


def without_poses(folder: Path) -> DriveFiles:
    """Images named by their time in ns; no poses yet."""
    (folder / "cam").mkdir()
    for stamp in stamps():
        assert cv2.imwrite(str(folder / "cam" / f"{stamp}.png"), np.zeros((48, 64, 3), np.uint8))
    (folder / "cam.toml").write_text(CALIBRATION)
    return DriveFiles(images=folder / "cam", calibration=folder / "cam.toml")


def check_poses(read: RecordedDrive) -> None:
    """Up to the heading of the map, which no format fixes, they are the true ones.

    Times since 1970 are known to 0.2 us, in which a car moves some micrometres.
    """
    first = read.frames[0].T_map_camera
    assert first is not None
    T_map_truth = first @ truth(0).inverse()
    np.testing.assert_allclose(T_map_truth.rotation[2], [0.0, 0.0, 1.0], atol=1e-7)
    for frame in read.frames:
        assert frame.T_map_camera is not None
        wanted = T_map_truth @ truth(frame.index)
        assert angle_between(frame.T_map_camera.rotation, wanted.rotation) < 1e-5
        np.testing.assert_allclose(frame.T_map_camera.translation, wanted.translation, atol=1e-5)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


POSES: dict[str, Callable[[Path], Path]] = {
    "TUM": tum,
    "KITTI": kitti,
    "EuRoC": euroc,
    "COLMAP": colmap,
    "COLMAP binary": colmap_binary,
    "nerfstudio": nerfstudio,
}
