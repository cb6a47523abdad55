"""What a calibration file says, made of the numbers in it, which are checked here.

All count pixels as semviz does. What a reader cannot know is refused, never guessed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.cameras.lens import COEFFICIENTS, LensModel, OriginalCamera
from semviz_core.datasets.own_drive.cameras.yaml_files import numbers_of

_MODELS: dict[str, LensModel] = {
    "pinhole": "pinhole",
    "none": "pinhole",
    "": "pinhole",
    "radtan": "brown-conrady",
    "radial-tangential": "brown-conrady",
    "plumb_bob": "brown-conrady",
    "rational_polynomial": "brown-conrady",
    "brown-conrady": "brown-conrady",
    "opencv": "brown-conrady",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "opencv_fisheye": "fisheye",
    "kannalabrandt8": "fisheye",
    "kb4": "fisheye",
    "perspective": "pinhole",
    "pinhole-radtan": "brown-conrady",
    "pinhole-radtan8": "brown-conrady",
    "pinhole-equi": "fisheye",
    "rectified": "pinhole",
}
READ_MODELS = "pinhole, Brown-Conrady (radtan, plumb_bob) and fisheye (equidistant)"


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """What a calibration file says, and how it was read."""

    path: Path
    format: str
    """For people: ``Kalibr``."""
    cameras: tuple[OriginalCamera, ...]
    """One, or left and right."""
    T_right_left: Pose | None = None
    T_body_left: Pose | None = None
    """From the left camera to the body (IMU) that the file knows; None if it knows none."""
    rectified: tuple[Pose | None, float] = (None, 0.0)
    """Of ROS: rotation to the rectified axes, and the offset along x (m) in its projection."""
    T_first_left: Pose | None = None
    """Of a rig: from this camera to its first one; None: their poses in the body say it, if any."""


def unknown_model(path: Path, name: str) -> SemvizError:
    return SemvizError(
        f"{path}: the lens model {shown(name, 60)} is not read, only {READ_MODELS}; calibrate the "
        "camera with one of them"
    )


def lens_model(path: Path, name: Any) -> LensModel:
    text = name if isinstance(name, str) else "" if name is None else type(name).__name__
    model = _MODELS.get(text.lower())
    if model is None:
        raise unknown_model(path, text)
    return model


def camera_of_numbers(
    where: str, model: LensModel, size: FloatArray, numbers: FloatArray, distortion: FloatArray
) -> OriginalCamera:
    """Return the camera with fx, fy, cx, cy. Zeros after the last coefficient are left out."""
    fx, fy, cx, cy = numbers.tolist()
    if not fx:
        raise SemvizError(f"{where}: focal length 0: this camera was never calibrated")
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not distortion.any() and model != "fisheye":
        model, distortion = "pinhole", distortion[:0]
    if model == "pinhole" and distortion.size:
        raise SemvizError(f"{where}: a pinhole has no distortion; give its lens model")
    counts = COEFFICIENTS[model]
    fitting = [count for count in counts if not distortion[count:].any()]
    if fitting and len(distortion) > fitting[0]:
        distortion = distortion[: fitting[0]]
    try:
        width, height = (int(side) for side in size.tolist())
        return OriginalCamera(model, width, height, K, distortion)
    except SemvizError as error:
        raise SemvizError(f"{where}: {error}") from None


def needed(table: Mapping[str, Any], where: str, *names: str) -> Any:
    """Return the first of ``names`` that a table has. Raise SemvizError if it has none."""
    for name in names:
        if table.get(name) is not None:
            return table[name]
    raise SemvizError(f"{where}: no {' or '.join(names)}; not a whole calibration")


def pose_of_numbers(value: Any, where: str) -> Pose:
    matrix = numbers_of(value, (None,), where)
    if matrix.size not in (12, 16):
        raise SemvizError(f"{where}: {matrix.size} numbers, expected those of a 3x4 or 4x4 matrix")
    try:
        return Pose.from_matrix(matrix.reshape(-1, 4))
    except SemvizError as error:
        raise SemvizError(f"{where}: {error}") from None


def focal_and_center(value: Any, where: str) -> FloatArray:
    """Return fx, fy, cx, cy of a 3x3 matrix. Raise SemvizError if it has skew."""
    K = numbers_of(value, (3, 3), where)
    if K[0, 1]:
        raise SemvizError(f"{where}: skew {K[0, 1]:g} is not read; calibrate without skew")
    return K[[0, 1, 0, 1], [0, 1, 2, 2]]
