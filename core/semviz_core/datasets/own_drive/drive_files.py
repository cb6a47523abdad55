"""The files of a drive as a user names them, and what replaces the conventions of formats."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.conventions import UpDirection
from semviz_core.datasets.own_drive.image_files import TimeUnit
from semviz_core.datasets.own_drive.recorded_poses import CameraAxes, Direction, QuaternionOrder
from semviz_core.datasets.own_drive.rectification import MOST_VIEW_DEG
from semviz_core.datasets.own_drive.time_matching import MOST_GAP_S

RATE_HZ = 10.0
"""Of images whose times nobody knows."""


def _silent(what: str, done: int, of: int) -> None:
    """Show nothing."""


@dataclass(frozen=True)
class DriveFiles:
    """The files of a drive, and what replaces the conventions of their formats."""

    images: Path
    """Folder of images, or a recording that an adapter reads."""
    right: Path | None = None
    cameras: tuple[str, ...] = ()
    """Of a recording, as it names them: the left or only one, and the right one; empty: its own
    choice."""
    rig: tuple[str, ...] = ()
    """Cameras of a rig, each on its own: as a recording names them, or folders in ``images``. Poses
    are those of the first one's images; empty: one camera or a stereo pair."""
    sequence: str | None = None
    """Of a recording of several; None: the only one."""
    extracted: Path | None = None
    """Folder for the images of a recording that is one file."""
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
    show: Callable[[str, int, int], None] = _silent
    """Told what is read, how much of it is done, and of how much."""

    def __post_init__(self) -> None:
        for name in ("scale", "most_gap_s", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < 1e6:
                raise SemvizError(f"{name} {value:g}: give a positive number")
        if self.rig and (len(set(self.rig)) < max(2, len(self.rig)) or self.right is not None):
            raise SemvizError(
                "a rig has at least two cameras, each named once: --cameras FIRST,SECOND,... "
                "without --right"
            )
