"""Recognize the layout of a recording and read it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.adapters import (
    argoverse2,
    boreas,
    euroc,
    kitti,
    nuscenes,
    rosbag,
)
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.recording import Adapter, Recording, read_image_folders

ADAPTERS: dict[str, tuple[Callable[[Path], bool], Adapter]] = {
    "bag": (rosbag.is_bag, rosbag.read_bag),
    "nuScenes": (nuscenes.is_nuscenes, nuscenes.read_nuscenes),
    "KITTI-360": (kitti.is_kitti360, kitti.read_kitti360),
    "KITTI raw": (kitti.is_kitti_raw, kitti.read_kitti_raw),
    "EuRoC": (euroc.is_euroc, euroc.read_euroc),
    "Argoverse 2": (argoverse2.is_argoverse2, argoverse2.read_argoverse2),
    "Boreas": (boreas.is_boreas, boreas.read_boreas),
}
"""By the name of a layout: whether a path has it, and its adapter."""


def read_recording(files: DriveFiles) -> Recording:
    """Return the recording at ``files.images``: one of a known layout, or folders of images.

    Raise SemvizError if it is damaged, or an option is not for such a source.
    """
    for is_layout, read in ADAPTERS.values():
        if is_layout(files.images):
            if files.right is not None:
                raise SemvizError(
                    f"{files.images}: a recording of several cameras; choose the right one with "
                    "--cameras LEFT,RIGHT instead of --right"
                )
            return read(files)
    if files.rig and files.sequence is None:
        return read_image_folders(replace(files, images=_folder_of_camera(files)))
    if files.cameras or files.sequence is not None:
        option = "--cameras" if files.cameras else "--sequence"
        raise SemvizError(f"{files.images}: a folder of images, where {option} has no meaning")
    return read_image_folders(files)


def _folder_of_camera(files: DriveFiles) -> Path:
    """Return the folder of the one camera of a rig that ``files`` are of."""
    (name,) = files.cameras
    folder = files.images / name
    if Path(name).name != name or not folder.is_dir():
        known = sorted(path.name for path in files.images.glob("*") if path.is_dir())
        raise SemvizError(
            f"{files.images}: no folder {shown(name, 60)} of a camera; --cameras FIRST,SECOND,... "
            f"of {shown(', '.join(known) or 'none', 300)}"
        )
    return folder
