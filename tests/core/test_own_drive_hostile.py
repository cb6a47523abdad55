"""Damaged files of own drives raise SemvizError in one line, and nothing else."""

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drive_formats import CALIBRATIONS, POSES
from recorded_streets import BROWN, kalibr

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.calibration_files import read_calibration
from semviz_core.datasets.own_drive.colmap_model import is_colmap, read_colmap
from semviz_core.datasets.own_drive.conventions import camera_poses, world_axes
from semviz_core.datasets.own_drive.lens import OriginalRig
from semviz_core.datasets.own_drive.nerfstudio import read_nerfstudio
from semviz_core.datasets.own_drive.pose_files import read_poses
from semviz_core.datasets.own_drive.rectification import rectify_rig

ROUNDS = 60
WORDS = [b"", b"nan", b"-1", b"1e308", b"null", b"[]", b"{}", b"\x00", b"\xff", b"0", b'"x"', b": "]


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to three places overwritten, cut out or repeated."""
    for _ in range(rng.randint(1, 3)):
        start = rng.randrange(len(data) + 1)
        end = min(len(data), start + rng.choice([0, 1, 3, 8, 40]))
        data = data[:start] + rng.choice([*WORDS, data[start:end] * 2]) + data[end:]
    return data


def refusal(read: Callable[[Path], None], path: Path) -> str:
    """What a reader says of a file; empty if it is read."""
    try:
        read(path)
    except SemvizError as error:
        return str(error)
    return ""


def read_camera(path: Path) -> None:
    found = read_calibration(path)
    right = found.cameras[1] if found.T_right_left is not None else None
    rectify_rig(OriginalRig(found.cameras[0], right, found.T_right_left))


def read_any_poses(path: Path) -> None:
    if is_colmap(path):
        read = read_colmap(path).poses
    elif path.suffix == ".json":
        read = read_nerfstudio(path).poses
    else:
        read = read_poses(path)
    world_axes(camera_poses(read, None, None))


@pytest.mark.parametrize("name", [*CALIBRATIONS, "stereo.yaml"])
def test_damaged_calibrations(tmp_path: Path, name: str) -> None:
    stereo = kalibr(BROWN, Pose(np.eye(3), np.array([-0.4, 0.01, 0.0])))
    data = CALIBRATIONS.get(name, stereo).encode()
    rng, path = random.Random(1), tmp_path / name
    for _ in range(ROUNDS):
        path.write_bytes(damaged(data, rng))
        assert "\n" not in refusal(read_camera, path)


@pytest.mark.parametrize("name", POSES)
def test_damaged_poses(tmp_path: Path, name: str) -> None:
    path = POSES[name](tmp_path)
    rng = random.Random(2)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        data = file.read_bytes()
        for _ in range(ROUNDS):
            file.write_bytes(damaged(data, rng))
            assert "\n" not in refusal(read_any_poses, path)
        file.write_bytes(data)
