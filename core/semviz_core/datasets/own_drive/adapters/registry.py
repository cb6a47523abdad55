"""Recognize the layout of a recording and read it."""

from collections.abc import Callable
from pathlib import Path

from semviz_core.common.errors import SemvizError
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
    if files.cameras or files.sequence is not None:
        option = "--cameras" if files.cameras else "--sequence"
        raise SemvizError(f"{files.images}: a folder of images, where {option} has no meaning")
    return read_image_folders(files)
