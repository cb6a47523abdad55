"""The readers of an own drive that ``fuzz.py`` attacks; ``fuzz_readers`` has the others.

Each file goes on through all of an import: cameras are rectified, images get poses, and what
``drive.json`` would hold is made.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from drive_formats import CALIBRATION, COUNT, stamps

from semviz.workspace.drive_file import DriveFile, open_drive
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.calibration_files import read_calibration
from semviz_core.datasets.own_drive.conventions import read_extrinsic
from semviz_core.datasets.own_drive.lens import OriginalRig
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.own_drive.rectification import rectify_rig

BETWEEN = b"\n%%%%\n"
"""Between the two files of a model of COLMAP, which are one input: cameras, then images."""


def all_of(*reads: Callable[[], object]) -> None:
    """Call each, whatever those before raise. Raise the last SemvizError."""
    last = None
    for read in reads:
        try:
            read()
        except SemvizError as error:
            if "\n" in str(error):
                raise ValueError("more than one line") from error
            last = error
    if last is not None:
        raise last


def calibration(path: Path) -> None:
    """Cameras are rectified, and the file is that of a body, too."""
    found = read_calibration(path)
    right = found.cameras[1] if len(found.cameras) == 2 else None
    T_right_left = found.T_right_left if right is not None else None
    all_of(
        lambda: rectify_rig(OriginalRig(found.cameras[0], right, T_right_left)),
        lambda: read_extrinsic(str(path), found),
        lambda: read_calibration(path, path),
    )


def poses(path: Path) -> None:
    """TUM, KITTI, KITTI-360, EuRoC; and the matrix of an extrinsic calibration."""
    files, table = _files(path.parent), path.with_suffix(".csv")
    table.write_bytes(path.read_bytes())
    all_of(
        lambda: _import(replace(files, poses=path)),
        lambda: _import(replace(files, poses=table, direction="world-to-camera", metric=True)),
        lambda: _import(replace(files, poses=_identities(path.parent), extrinsic=str(path))),
    )


def times(path: Path) -> None:
    _import(replace(_files(path.parent), times=path))


def colmap(path: Path) -> None:
    """The two files of a model as texts and, of the same bytes, as binary ones."""
    cameras, _, images = path.read_bytes().partition(BETWEEN)
    files = _files(path.parent)
    models = []
    for kind in ("txt", "bin"):
        model = path.parent / kind
        model.mkdir(exist_ok=True)
        (model / f"cameras.{kind}").write_bytes(cameras)
        (model / f"images.{kind}").write_bytes(images)
        models.append(replace(files, calibration=None, poses=model, scale=2.0))
    all_of(lambda: _import(models[0]), lambda: _import(models[1]))


def nerfstudio(path: Path) -> None:
    _import(replace(_files(path.parent), calibration=None, poses=path, metric=True))


def drive_file(path: Path) -> None:
    """What is kept in a workspace, up to its first image."""
    images = _files(path.parent).images
    dataset = open_drive(path, images, images, path.parent / "rectified")
    frame = dataset.frames[0]
    all_of(lambda: dataset.image(frame.index, "left"), lambda: dataset.image(frame.index, "right"))


def _import(files: DriveFiles) -> None:
    content = DriveFile.of(read_drive(files), "town").model_dump_json(exclude_none=True)
    DriveFile.model_validate_json(content)


def _files(folder: Path) -> DriveFiles:
    """Images and a calibration that are right."""
    images = folder / "cam"
    if not images.is_dir():
        images.mkdir()
        data = cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
        for stamp in stamps():
            (images / f"{stamp}.png").write_bytes(data)
        (folder / "right.toml").write_text(CALIBRATION)
    return DriveFiles(images, calibration=folder / "right.toml")


def _identities(folder: Path) -> Path:
    path = folder / "identities.txt"
    if not path.is_file():
        path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * COUNT)
    return path
