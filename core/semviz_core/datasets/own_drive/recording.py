"""What a source of a drive holds, before it is put together: a folder of images, or a recording.

The user names the files, and what replaces the conventions of their formats. A plain folder brings
only images; an adapter also brings calibration, times and poses, each of which a file of the user
replaces. Each image gets the pose of its time, its name or its number.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.images import image_files
from semviz_core.datasets.own_drive.images.color_orders import ColorOrder
from semviz_core.datasets.own_drive.images.image_files import SUFFIXES, TimeUnit
from semviz_core.datasets.own_drive.images.rectification import MOST_VIEW_DEG
from semviz_core.datasets.own_drive.poses import conventions

MOST_GAP_S = 0.25
"""Default of the longest time between two poses across which one is interpolated."""
SAME_TIME_S = 0.005
"""A pose and an image so close are of one time; clocks are written with few digits."""


def poses_at_times(
    poses: Sequence[Pose], pose_time_s: FloatArray, time_s: FloatArray, most_gap_s: float
) -> list[Pose | None]:
    """Return the pose at each of the times (n,), interpolated between the two around it.

    Positions linearly, rotations along the shorter arc. None where these two are more than
    ``most_gap_s`` apart, and before the first and behind the last; but a pose within
    ``SAME_TIME_S`` counts always. ``pose_time_s`` is in order.
    """
    from scipy.spatial.transform import Rotation, Slerp

    after = np.searchsorted(pose_time_s, time_s).clip(1, max(len(poses) - 1, 1))
    found: list[Pose | None] = []
    for moment, row in zip(time_s.tolist(), after.tolist(), strict=True):
        rows = [row - 1, row] if len(poses) > 1 else [0, 0]
        before_s, after_s = pose_time_s[rows].tolist()
        nearest = rows[0] if abs(moment - before_s) <= abs(moment - after_s) else rows[1]
        if before_s < moment < after_s and after_s - before_s <= most_gap_s:
            share = (moment - before_s) / (after_s - before_s)
            ends = Rotation.from_matrix(np.array([poses[end].rotation for end in rows]))
            t_before, t_after = (poses[end].translation for end in rows)
            rotation = Slerp([0.0, 1.0], ends)(share).as_matrix()
            found.append(Pose(rotation, t_before + share * (t_after - t_before)))
        elif abs(pose_time_s[nearest] - moment) <= SAME_TIME_S:
            found.append(poses[nearest])
        else:
            found.append(None)
    return found


def why_without_pose(pose_time_s: FloatArray, moment_s: float, most_gap_s: float) -> str:
    """Say why ``poses_at_times`` gives no pose at a time, for people."""
    first_s, last_s = float(pose_time_s[0]), float(pose_time_s[-1])
    if moment_s < first_s:
        return f"taken {first_s - moment_s:.3f} s before the first pose"
    if moment_s > last_s:
        return f"taken {moment_s - last_s:.3f} s after the last pose"
    after = int(np.searchsorted(pose_time_s, moment_s))
    gap_s = float(pose_time_s[after] - pose_time_s[after - 1])
    return f"taken between poses {gap_s:.3f} s apart, --most-gap is {most_gap_s:g} s"


def rows_of_names(images: Sequence[Path], names: Sequence[str]) -> list[int | None]:
    """Return the row of ``names`` that each image has, by as much of its path as is unique.

    ``left/000.jpg`` is the image of that name in a folder ``left``. A name without ending is that
    of an image with any ending. Raise SemvizError if no image is named.
    """
    by_end: dict[tuple[str, ...], list[int]] = {}
    for row, name in enumerate(names):
        parts = _parts(name)
        for start in range(len(parts)):
            by_end.setdefault(parts[start:], []).append(row)
    rows = [_row_of(_parts(str(image)), by_end) for image in images]
    if all(row is None for row in rows):
        raise SemvizError(
            f"the poses are of other images: they name {shown(names[0], 80)}, the images are "
            f"called like {images[0].parent.name}/{images[0].name}"
        )
    return rows


def _row_of(parts: tuple[str, ...], by_end: Mapping[tuple[str, ...], Sequence[int]]) -> int | None:
    """Return the row whose name agrees with most of a path; None if there is none, or several."""
    for start in range(len(parts)):
        rows = by_end.get(parts[start:])
        if rows is not None:
            return rows[0] if len(rows) == 1 else None
    return None


def _parts(name: str) -> tuple[str, ...]:
    path = PurePosixPath(name.replace("\\", "/"))
    if path.suffix.lower() in SUFFIXES:
        path = path.with_suffix("")
    return tuple(part for part in path.parts if part not in (".", "..", "/"))


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
    direction: conventions.Direction | None = None
    axes: conventions.CameraAxes | None = None
    quaternion: conventions.QuaternionOrder | None = None
    time_unit: TimeUnit | None = None
    up: conventions.UpDirection = "auto"
    scale: float | None = None
    """Metres in a unit of length of the poses."""
    metric: bool = False
    """Whether poses of a format without unit are in metres."""
    colors: ColorOrder = "rgb"
    """Of the pixels that are decoded: red first, or red and blue are swapped."""
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


@dataclass(frozen=True, eq=False)
class Recording:
    """Images of one camera or a stereo pair, and what their source says about them."""

    images: Path
    """Folder of the left, or the only, camera."""
    right: Path | None
    names: image_files.ImageNames
    calibration: CalibrationFile | None = None
    times: image_files.ImageTimes | None = None
    """Of each pair; None: not known."""
    poses: conventions.RecordedPoses | None = None


Adapter: TypeAlias = Callable[[DriveFiles], Recording]
"""Reads the recording at ``DriveFiles.images``; raises SemvizError if it is damaged, or lacks a
camera of ``DriveFiles.cameras``."""


def read_image_folders(files: DriveFiles) -> Recording:
    """Return the images of one or two folders. Raise SemvizError if they hold no pairs."""
    names = image_files.list_images(files.images, files.right)
    right = None if files.right is None else image_files.folder_of(files.right)
    return Recording(image_files.folder_of(files.images), right, names)


def chosen_cameras(
    files: DriveFiles, known: Sequence[str], default: Sequence[str]
) -> tuple[str, ...]:
    """Return the chosen cameras, one or two. Raise SemvizError if one is not ``known``.

    ``default`` is taken without a choice; if it is empty, there must be a choice.
    """
    if not known:
        raise SemvizError(f"{files.images}: holds no images that can be read; name another")
    chosen = files.cameras or tuple(default)
    unknown = [camera for camera in chosen if camera not in known]
    if unknown or len(chosen) not in (1, 2) or len(set(chosen)) != len(chosen):
        fault = f"no camera {shown(unknown[0], 60)}" if unknown else "choose one camera or two"
        raise SemvizError(
            f"{files.images}: {fault}; --cameras LEFT[,RIGHT] of {shown(', '.join(known), 600)}"
        )
    return chosen
