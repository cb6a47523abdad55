"""What a source of a drive holds, before it is put together: a folder of images, or a recording.

A plain folder brings only images; an adapter also brings calibration, times and poses, each of
which a file of the user replaces.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive import image_files
from semviz_core.datasets.own_drive.calibration_files import CalibrationFile
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.recorded_poses import RecordedPoses


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
    poses: RecordedPoses | None = None


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
    chosen = files.cameras or tuple(default)
    unknown = [camera for camera in chosen if camera not in known]
    if unknown or len(chosen) not in (1, 2) or len(set(chosen)) != len(chosen):
        fault = f"no camera {shown(unknown[0], 60)}" if unknown else "choose one camera or two"
        raise SemvizError(
            f"{files.images}: {fault}; --cameras LEFT[,RIGHT] of "
            f"{shown(', '.join(known) or 'none that can be read', 600)}"
        )
    return chosen
