"""An own drive with hostile names, links and replaced images: one line, and nothing is lost."""

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from drive_formats import CALIBRATION, COUNT, image_name, tum

from semviz.workspace.drive.drive_file import DRIVE_FILE, LEFT_OUT, read_drive_file
from semviz.workspace.poses.pose_review import source_key
from semviz.workspace.workspace import Workspace
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.images.image_files import size_of_whole_image

FISHEYE = CALIBRATION.replace('"pinhole"', '"fisheye"') + "distortion = [0.01, 0.0, 0.0, 0.0]\n"
NO_TEXT = os.fsdecode(b"\xff")
Run = Callable[..., tuple[int, str]]


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Eight images, a calibration and poses."""
    folder = tmp_path / "drive"
    (folder / "cam").mkdir(parents=True)
    for index in range(COUNT):
        write_image(folder / image_name(index), index)
    (folder / "camera.toml").write_text(FISHEYE)
    tum(folder)
    return folder


def write_image(path: Path, seed: int) -> None:
    """Of the same size, whatever the seed."""
    pixels = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(path), pixels)


@pytest.fixture
def new(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    def run(name: str = "W", images: Path = files / "cam", **other: Path) -> tuple[int, str]:
        options = {"calibration": files / "camera.toml"} | other
        words = [word for name, path in options.items() for word in (f"--{name}", path)]
        status, _, error = call(capsys, "new", tmp_path / name, "--images", images, *words)
        return status, error

    return run


@pytest.mark.parametrize("name", [NO_TEXT, "a\nb", "a\\b", "a\x1b[2Jb"])
def test_an_image_with_an_impossible_name_is_named(
    name: str, files: Path, tmp_path: Path, new: Run
) -> None:
    os.link(files / image_name(0), files / "cam" / f"{name}.png")
    status, error = new()
    assert status == 2
    (line,) = error.splitlines()
    assert "rename it" in line
    assert line.isprintable()
    assert not (tmp_path / "W").exists()


def test_names_in_any_language_are_fine(files: Path, tmp_path: Path, new: Run) -> None:
    for path in sorted((files / "cam").iterdir()):
        path.rename(path.with_name(f"Bild\u202f\u00e4\u732b <b>'\"{path.name}"))
    assert new() == (0, "")
    assert Workspace.open(tmp_path / "W").source.image(0, "left").shape[2] == 3


def test_folders_and_files_whose_names_are_no_text(files: Path, tmp_path: Path, new: Run) -> None:
    status, error = new(f"W{NO_TEXT}")
    assert (status, len(error.splitlines())) == (2, 1)
    assert not (tmp_path / f"W{NO_TEXT}").exists()
    for name in ("camera.toml", "tum.txt"):
        (files / name).rename(files / f"{NO_TEXT}{name}")
    assert new("V", calibration=files / f"{NO_TEXT}camera.toml")[0] == 0
    Workspace.open(tmp_path / "V").source.image(0, "left")
    (files / "cam").rename(files / f"cam{NO_TEXT}")
    files_of_cam = files / f"cam{NO_TEXT}"
    status, error = new("U", files_of_cam, calibration=files / f"{NO_TEXT}camera.toml")
    assert (status, len(error.splitlines())) == (2, 1)
    assert not (tmp_path / "U").exists()


@pytest.mark.parametrize("option", ["calibration", "poses", "times", "extrinsic"])
@pytest.mark.parametrize("trick", ["pipe", "endless", "link to itself", "folder"])
@pytest.mark.timeout(30)
def test_what_is_no_file_is_no_file_of_a_drive(
    option: str, trick: str, files: Path, tmp_path: Path, new: Run
) -> None:
    path = files / "trick"
    match trick:
        case "pipe":
            os.mkfifo(path)
        case "endless":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(path)
    status, error = new(**{"poses": files / "tum.txt", option: path})
    assert status == 2
    assert len(error.splitlines()) == 1
    assert str(path) in error
    assert not (tmp_path / "W").exists()


def test_unusable_images_are_counted_named_and_left_out(
    files: Path, tmp_path: Path, new: Run
) -> None:
    """Cut off, of another size, and no image; a preview's end is not the image's."""
    cut, other, text = (files / image_name(index) for index in (1, 3, 7))
    cut.write_bytes(cut.read_bytes()[:-20])
    cv2.imwrite(str(other), np.zeros((30, 40, 3), np.uint8))
    text.write_text("<html>404</html>")
    status, error = new(poses=files / "tum.txt")
    assert status == 0
    named = f"3 images unusable, such as {cut.name} (damaged or cut off): left out"
    assert error.splitlines()[0] == f"warning: {named}"
    rows = list(csv.DictReader((tmp_path / "W" / LEFT_OUT).open()))
    assert [(row["file"], row["reason"]) for row in rows] == [
        (cut.name, "damaged or cut off"),
        (other.name, "40x30, not 64x48"),
        (text.name, "damaged or cut off"),
    ]
    assert all(row["time_s"] for row in rows)
    workspace = Workspace.open(tmp_path / "W")
    assert [frame.index for frame in workspace.source.frames] == [0, 2, 4, 5, 6]
    for index in (0, 2):
        (files / image_name(index)).write_bytes(b"")
    status, error = new("V")
    assert (status, len(error.splitlines())) == (2, 1)
    assert "5 of 8 images cannot be used" in error
    assert not (tmp_path / "V").exists()


def test_the_end_of_a_jpeg_is_told_from_that_of_its_preview(tmp_path: Path) -> None:
    """And found before what cameras write behind it."""
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    _, encoded = cv2.imencode(".jpg", pixels)
    data, path = encoded.tobytes(), tmp_path / "a.jpg"
    preview = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
    for content, size in (
        (data, (64, 48)),
        (data[:2] + preview + data[2:], (64, 48)),
        (data[:2] + preview + data[2:-2], None),
        (data + bytes(5000), (64, 48)),
        (data[:-2] + bytes(5000), None),
    ):
        path.write_bytes(content)
        assert size_of_whole_image(path) == size


def test_red_and_blue_are_swapped_back_on_demand(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With and without a lens to rectify; recorded images stay as they are."""
    pinhole = files / "pinhole.toml"
    pinhole.write_text(CALIBRATION)
    recorded = (files / image_name(0)).read_bytes()
    for calibration in (files / "camera.toml", pinhole):
        found = []
        for colors in ("rgb", "bgr"):
            town = tmp_path / f"{calibration.stem}-{colors}"
            words = ("--images", files / "cam", "--calibration", calibration, "--colors", colors)
            assert call(capsys, "new", town, *words)[0] == 0
            found.append(Workspace.open(town).source.image(0, "left"))
        np.testing.assert_array_equal(found[0], found[1][:, :, ::-1])
    assert (files / image_name(0)).read_bytes() == recorded


def test_an_image_replaced_by_an_older_one_is_rectified_again(
    files: Path, tmp_path: Path, new: Run
) -> None:
    """As by cp -p; comparing which of the two is newer would show the first image for ever."""
    assert new() == (0, "")
    source = Workspace.open(tmp_path / "W").source
    before = source.image(0, "left")
    np.testing.assert_array_equal(source.image(0, "left"), before)
    recorded = files / image_name(0)
    write_image(recorded, 99)
    os.utime(recorded, ns=(0, 0))
    after = source.image(0, "left")
    assert (after != before).any()
    write_image(recorded, 0)
    os.utime(recorded, ns=(0, 7))
    np.testing.assert_array_equal(source.image(0, "left"), before)


def test_kept_motions_are_not_those_of_images_that_were_replaced(
    files: Path, tmp_path: Path, new: Run
) -> None:
    assert new(poses=files / "tum.txt")[0] == 0
    workspace = Workspace.open(tmp_path / "W")
    frames = workspace.source.frames
    measured = source_key(workspace, frames)
    assert source_key(Workspace.open(tmp_path / "W"), frames) == measured
    write_image(files / image_name(3), 99)
    os.utime(files / image_name(3), ns=(0, 0))
    assert source_key(workspace, frames) != measured


def test_no_image_outside_is_replaced_through_a_link_in_a_workspace(
    files: Path, tmp_path: Path, new: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """A workspace may come from anybody, and its links may lead to anybody's pictures."""
    assert new() == (0, "")
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    write_image(pictures / "000000.png", 5)
    mine = (pictures / "000000.png").read_bytes()
    (tmp_path / "W" / "rectified").mkdir()
    (tmp_path / "W" / "rectified" / "left").symlink_to(pictures)
    status, _, error = call(capsys, "detect", tmp_path / "W", "--frames", "0:1")
    assert status == 2
    assert "not replaced, because a link leads there" in error
    assert (pictures / "000000.png").read_bytes() == mine
    (pictures / "000000.png").unlink()  # a link to a larger disk is fine
    Workspace.open(tmp_path / "W").source.image(0, "left")
    assert (pictures / "000000.png").is_file()


def test_no_flipped_bit_of_the_drive_s_file_is_read_as_something_else(
    files: Path, tmp_path: Path, new: Run
) -> None:
    """Without a checksum about a third would be: another digit of a pose or of a time."""
    assert new(poses=files / "tum.txt")[0] == 0
    path = tmp_path / "W" / DRIVE_FILE
    content, whole = path.read_bytes(), read_drive_file(path)
    for place in range(0, len(content), 3):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(SemvizError, match=r"drive\.json") as refused:
            read_drive_file(path)
        assert "\n" not in str(refused.value)
    before_checksums = content.replace(b'"crc32":%d,' % (whole.crc32 or 0), b"")
    path.write_bytes(before_checksums)
    assert read_drive_file(path).frames == whole.frames


@pytest.mark.parametrize(
    "name", ["a\n.png", "a\u2028.png", "a\x1b[2J.png", "../a.png", "a\x85.png"]
)
def test_names_in_the_drive_s_file_are_names_on_one_line(
    name: str, files: Path, tmp_path: Path, new: Run
) -> None:
    """Found by fuzzing: a missing image was named on two lines."""
    assert new() == (0, "")
    path = tmp_path / "W" / DRIVE_FILE
    content = json.loads(path.read_text())
    del content["crc32"]
    for key, place in (("left", content["frames"][1]), ("map_frame", content)):
        if not (key == "map_frame" and "/" in name):
            changed = place | {key: name}
            whole = changed if place is content else content | {"frames": [changed]}
            path.write_text(json.dumps(whole))
            with pytest.raises(SemvizError, match="damaged") as refused:
                read_drive_file(path)
            assert str(refused.value).isprintable()


def test_frames_of_the_drive_s_file_have_each_number_once(
    files: Path, tmp_path: Path, new: Run
) -> None:
    """The later one of two would be shown with the pose of the other."""
    assert new() == (0, "")
    path = tmp_path / "W" / DRIVE_FILE
    content = json.loads(path.read_text())
    del content["crc32"]
    content["frames"][1]["index"] = 0
    path.write_text(json.dumps(content))
    with pytest.raises(SemvizError, match="order of their numbers"):
        read_drive_file(path)
