"""Poses of cameras or bodies as their source holds them, with the conventions of its format."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.image_files import TimeUnit
from semviz_core.datasets.own_drive.lens import OriginalCamera

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
