"""Three small workspaces, made by commands and filled with labels of fixtures.

town: a street labelled with care in both images. lane: a street as a detector with a short memory
labels it, some elements wrongly. mono: a KITTI sequence of one camera.
"""

from pathlib import Path

import cv2
import numpy as np

from golden.command import call
from golden.files import FIXTURES, unpacked
from semviz import Workspace

NAMES = ("town", "lane", "mono")
STREETS = {"town": (7, 24), "lane": (11, 16)}
"""Seed and number of frames."""
MONO_STREET = (3, 12)
SEQUENCE = "07"


def make(folder: Path, name: str, *, labelled: bool = True) -> Path:
    """Make the workspace ``name`` (of NAMES) in ``folder``, with its labels."""
    if name == "mono":
        write_kitti(folder)
        call(folder, "new", name, "--kitti", "kitti", "--sequence", SEQUENCE, "--cameras", "2")
    else:
        seed, frames = STREETS[name]
        call(folder, "new", name, "--simulate", seed, "--frames", f"0:{frames}")
    if labelled:
        log = unpacked(FIXTURES / f"{name}.jsonl.gz", folder)
        call(folder, "labels", "import", name, log.name)
    return folder / name


def write_kitti(folder: Path) -> None:
    """Write the folder ``kitti``: the left camera of a street, with black images."""
    seed, frames = MONO_STREET
    call(folder, "new", "street", "--simulate", seed, "--frames", f"0:{frames}")
    (folder / "kitti" / "poses").mkdir(parents=True)
    poses = Path("kitti", "poses", f"{SEQUENCE}.txt")
    call(folder, "trajectory", "street", poses, "--format", "kitti")
    source = Workspace.open(folder / "street").source
    images = folder / "kitti" / "sequences" / SEQUENCE / "image_2"
    images.mkdir(parents=True)
    camera = source.rig.left
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    for index in range(frames):
        cv2.imwrite(str(images / f"{index:06d}.png"), black)
    projection = np.column_stack([camera.K, np.zeros(3)]).ravel().tolist()
    (images.parent / "calib.txt").write_text("P2: " + " ".join(map(repr, projection)) + "\n")
    times = "".join(f"{frame.time_s}\n" for frame in source.frames)
    (images.parent / "times.txt").write_text(times)
