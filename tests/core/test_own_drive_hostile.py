"""Damaged files of own drives raise SemvizError in one line, and nothing else."""

import json
import random
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drive_formats import CALIBRATION, CALIBRATIONS, POSES, colmap, colmap_binary, nerfstudio
from drive_layouts import (
    argoverse2,
    boreas,
    comma,
    euroc_layout,
    gnss,
    kitti_360,
    kitti_raw,
    nuscenes,
)
from recorded_streets import BROWN, kalibr

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.colmap_model import is_colmap, read_colmap
from semviz_core.datasets.own_drive.cameras.lens import OriginalRig
from semviz_core.datasets.own_drive.cameras.recorded_cameras import read_nerfstudio
from semviz_core.datasets.own_drive.images.rectification import rectify_rig
from semviz_core.datasets.own_drive.poses.conventions import camera_poses, world_axes
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles

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


@pytest.mark.parametrize(
    "text",
    [
        "a: !!bool neither",
        'a: !!int ""',
        "a: !!timestamp never",
        "a: !%0Ax y",
        f"? 0x{'f' * 9000}\n: 1",
        f"a: {'1:' * 3000}1.5",
        f"distortion_model: 0x{'f' * 9000}",
        f"a: {'1' * 5001}",
    ],
)
def test_what_pyyaml_itself_does_not_survive_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    said = refusal(read_camera, path)
    assert str(path) in said
    assert "\n" not in said
    assert len(said) < 500


HUGE = f"0x{'f' * 9000}"


@pytest.mark.parametrize(
    ("before", "after"), [("[50.0, 50.0]", f"[{HUGE}, 50.0]"), ('"pinhole"', HUGE)]
)
def test_a_number_too_large_for_python_to_print_is_refused(
    tmp_path: Path, before: str, after: str
) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(CALIBRATION)
    assert not refusal(read_camera, path)
    path.write_text(CALIBRATION.replace(before, after))
    assert str(path) in refusal(read_camera, path)


@pytest.mark.parametrize("field", ["w", "fl_x", "cx", "k1", "transform_matrix"])
@pytest.mark.parametrize("value", [10**400, float("inf"), 1e999, None, [[10**400] * 4] * 4])
def test_numbers_beyond_all_limits_in_nerfstudio_are_one_line(
    tmp_path: Path, field: str, value: object
) -> None:
    """Found by fuzzing: OverflowError."""
    path = nerfstudio(tmp_path)
    content = json.loads(path.read_text())
    assert not refusal(read_any_poses, path)
    (content["frames"][1] if field == "transform_matrix" else content)[field] = value
    path.write_text(json.dumps(content))
    said = refusal(read_any_poses, path)
    assert str(path) in said
    assert "\n" not in said


def test_a_model_of_lines_or_images_without_end_takes_little_memory(tmp_path: Path) -> None:
    """A line of one byte takes 60 in memory, so 200 MB would take 12 GB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    text, binary = colmap(tmp_path), colmap_binary(tmp_path)
    (text / "images.txt").write_bytes(b"\n" * 200_000_000)
    assert "more than 1000000 images" in refusal(read_any_poses, text)
    for name in ("images.bin", "cameras.bin"):
        content = (binary / name).read_bytes()
        (binary / name).write_bytes(struct.pack("<Q", 2**63) + content[8:])
        assert "more than 1000000 images" in refusal(read_any_poses, binary)
        (binary / name).write_bytes(content)
    assert not refusal(read_any_poses, binary)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000


def test_line_ends_of_other_systems_in_a_model(tmp_path: Path) -> None:
    path = colmap(tmp_path)
    same = read_colmap(path).poses
    for name in ("images.txt", "cameras.txt"):
        (path / name).write_bytes((path / name).read_bytes().replace(b"\n", b"\r\n"))
    again = read_colmap(path).poses
    assert again.names == same.names
    np.testing.assert_array_equal(again.matrices, same.matrices)


LAYOUTS: dict[str, Callable[[Path], DriveFiles]] = {
    "KITTI raw": kitti_raw,
    "KITTI-360": kitti_360,
    "nuScenes": nuscenes,
    "EuRoC": euroc_layout,
    "Argoverse 2": argoverse2,
    "Boreas": boreas,
    "GNSS": gnss,
    "comma2k19": comma,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_damaged_recordings(tmp_path: Path, name: str) -> None:
    """Each file but the images, whose damage is seen when they are shown."""
    drive = LAYOUTS[name](tmp_path / "drive")
    rng = random.Random(3)
    paths = [path for path in sorted((tmp_path / "drive").rglob("*")) if path.is_file()]
    files = [path for path in paths if path.suffix not in (".png", ".jpg")]
    refused = 0
    for file in files[-12:]:
        data = file.read_bytes()
        for _ in range(ROUNDS // 6):
            file.write_bytes(damaged(data, rng))
            said = refusal(lambda _: _read(drive), file)
            refused += bool(said)
            assert "\n" not in said
        file.write_bytes(data)
    assert refused


def _read(files: DriveFiles) -> None:
    read_drive(files)
