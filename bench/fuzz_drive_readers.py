"""The readers of an own drive that ``fuzz.py`` attacks; ``fuzz_readers`` has the others.

Each file goes on through all of an import: cameras are rectified, images get poses, and what
``drive.json`` would hold is made.
"""

import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bags
import cv2
import numpy as np
from drive_formats import CALIBRATION, COUNT, stamps
from drive_layouts import argoverse2, boreas, comma, euroc_layout, kitti_360, kitti_raw, nuscenes

from semviz.workspace.drive.drive_file import DriveFile, ImageFolders, open_drive
from semviz_core.base.frame import Frame, OdometryNoise
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.measured_poses import Surroundings
from semviz_core.datasets.measured_priors import PriorSigmas, read_odometry, read_priors
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.images.rectification import rectify_rig
from semviz_core.datasets.own_drive.poses.conventions import map_on_earth, read_extrinsic
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles

SMALL_K = np.array([[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]])
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
    found = read_calibration(path, size=(64, 48))
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
    dataset = open_drive(path, ImageFolders(images, images), path.parent / "rectified")
    frame = dataset.frames[0]
    all_of(lambda: dataset.image(frame.index, "left"), lambda: dataset.image(frame.index, "right"))


def measured(path: Path) -> None:
    """Priors, and odometry, of three frames."""
    around = Surroundings(T_map_ecef=map_on_earth((49.0, 8.4, 115.0), 30.0))
    frames = [Frame(index, 0.1 * index, None) for index in range(3)]

    def priors() -> None:
        read = read_priors(path, around, PriorSigmas(), np.zeros((0, 3)))
        _ = [read.prior_of(frame) for frame in frames]

    def odometry() -> None:
        read = read_odometry(path, around, OdometryNoise(), 0.25)
        _ = [read.of_step(frames[0], frame) for frame in frames[1:]]

    all_of(priors, odometry)


LAYOUTS = (kitti_raw, kitti_360, nuscenes, euroc_layout, argoverse2, boreas, comma)
"""Each writes a small recording in the layout of others."""


def recording(path: Path) -> None:
    """``path`` is the name of a file of one of the layouts, a line end, and its content."""
    name, _, content = path.read_bytes().partition(b"\n")
    folder = path.parent / "layouts"
    if not folder.is_dir():
        for write in LAYOUTS:
            write(folder / write.__name__)
    tables = recorded_tables(folder)
    table = (
        tables.get(name.decode(errors="replace"))
        or [*tables.values()][zlib.crc32(name) % len(tables)]
    )
    right = table.read_bytes()
    try:
        table.write_bytes(content)
        _import(_described(table.relative_to(folder).parts[0], folder))
    finally:
        table.write_bytes(right)


def recorded_tables(folder: Path) -> dict[str, Path]:
    """Return all files but images, by their path in ``folder``."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path for path in files if path.suffix not in (".png", ".jpg")
    }


def _described(layout: str, folder: Path) -> DriveFiles:
    """Return a written recording as its user names it."""
    root = folder / layout
    match layout:
        case "kitti_raw":
            return DriveFiles(root / "2011_09_26" / "2011_09_26_drive_0001_sync")
        case "nuscenes":
            cameras = ("CAM_FRONT_LEFT", "CAM_FRONT")
            return DriveFiles(root, cameras=cameras, sequence="scene-1")
        case "argoverse2":
            return DriveFiles(root, cameras=("ring_front_left", "ring_front_right"))
        case "comma":
            return DriveFiles(
                root / "cam", calibration=root / "cam.toml", poses=root / "global_pose"
            )
    return DriveFiles(root)


def bag(path: Path) -> None:
    """A bag in one file: of ROS 1 or 2 by its first bytes, else MCAP."""
    data = path.read_bytes()
    kinds = {b"#ROSBAG": "ros1.bag", b"SQLite ": "ros2/ros2.db3"}
    file = path.parent / kinds.get(data[:7], "ros2.mcap")
    if not file.parent.is_dir():
        write_bag(file.parent, "ROS 2")  # for its metadata.yaml
    file.write_bytes(data)
    extracted = path.parent / "extracted"
    shutil.rmtree(extracted, ignore_errors=True)
    _import(DriveFiles(file, extracted=extracted))


def write_bag(path: Path, kind: bags.Kind) -> Path:
    """Write two images, their calibration and odometry, and return the file that has them."""
    camera = OriginalCamera("pinhole", 64, 48, SMALL_K, np.zeros(0))
    image = path.with_name("image.png")
    image.write_bytes(cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1].tobytes())
    images = [(10**18 + late_ns, image) for late_ns in (0, 10**8)]
    with bags.bag(path, kind) as (put, types):
        bags.put_camera(put, types, "/a", "a", images, camera)
        bags.put_static(put, types, images[0][0], [("base", "a", Pose.identity())])
        bags.put_odometry(put, types, [(t, Pose.identity()) for t, _ in images], "base")
    return path if path.is_file() else next(path.glob("*.[dm]*[3p]"))


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
