"""The files of a drive as a user names them, and what replaces the conventions of formats."""

from dataclasses import dataclass
from pathlib import Path

from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.conventions import UpDirection
from semviz_core.datasets.own_drive.image_files import TimeUnit
from semviz_core.datasets.own_drive.pose_files import CameraAxes, Direction, QuaternionOrder
from semviz_core.datasets.own_drive.rectification import MOST_VIEW_DEG
from semviz_core.datasets.own_drive.time_matching import MOST_GAP_S

RATE_HZ = 10.0
"""Of images whose times nobody knows."""


@dataclass(frozen=True)
class DriveFiles:
    """The files of a drive, and what replaces the conventions of their formats."""

    images: Path
    right: Path | None = None
    calibration: Path | None = None
    """None: the cameras of ``poses``, if that is a model of COLMAP or nerfstudio."""
    right_calibration: Path | None = None
    poses: Path | None = None
    times: Path | None = None
    extrinsic: str | None = None
    """As for ``read_extrinsic``; None: the poses are those of the camera, if their format does not
    say that they are a body's."""
    direction: Direction | None = None
    axes: CameraAxes | None = None
    quaternion: QuaternionOrder | None = None
    time_unit: TimeUnit | None = None
    up: UpDirection = "auto"
    scale: float | None = None
    """Metres in a unit of length of the poses."""
    metric: bool = False
    """Whether poses of a format without unit are in metres."""
    most_gap_s: float = MOST_GAP_S
    rate_hz: float = RATE_HZ
    most_view_deg: float = MOST_VIEW_DEG
    frames: range | None = None

    def __post_init__(self) -> None:
        for name in ("scale", "most_gap_s", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < 1e6:
                raise SemvizError(f"{name} {value:g}: give a positive number")
