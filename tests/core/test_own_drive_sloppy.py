"""Images, times and calibrations as real drives have them: read right, or refused with a remedy."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drive_formats import CALIBRATION, COUNT, image_name, kitti, tum

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.lens import OriginalRig
from semviz_core.datasets.own_drive.images.image_files import times_from_names
from semviz_core.datasets.own_drive.images.rectification import rectify_rig
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles

GRADIENT = np.tile(np.linspace(0, 255, 64), (48, 1)).astype(np.uint8)


@pytest.fixture
def drive(tmp_path: Path) -> DriveFiles:
    """Eight images that look the same, named by their times, with a calibration."""
    (tmp_path / "cam").mkdir()
    for index in range(COUNT):
        assert cv2.imwrite(str(tmp_path / image_name(index)), GRADIENT)
    (tmp_path / "cam.toml").write_text(CALIBRATION)
    return DriveFiles(images=tmp_path / "cam", calibration=tmp_path / "cam.toml")


def renamed(drive: DriveFiles, names: Sequence[str]) -> None:
    for path, name in zip(sorted(drive.images.iterdir()), names, strict=True):
        path.rename(path.with_name(name))


@pytest.mark.parametrize(
    ("name", "time_s", "unit"),
    [
        ("1403715273262142976.png", 1403715273.262143, "ns"),
        ("left_1403715273262.jpg", 1403715273.262, "ms"),
        ("1403715273_262142976.png", 1403715273.262143, "s"),
        ("n015-2018-07-24__CAM_BACK__1532402927637525.jpg", 1532402927.637525, "us"),
    ],
)
def test_times_stand_behind_any_text_in_names(name: str, time_s: float, unit: str) -> None:
    found = times_from_names([name], None)
    assert found is not None
    assert found.unit == unit
    np.testing.assert_allclose(found.time_s, [time_s], atol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["0000000000.png", "0000000001.png"],  # KITTI raw counts so
        ["20231114221320.png"],  # a date
        ["a_1403715273.png", "b_1403715274.png"],
        ["frame_000001.png"],
    ],
)
def test_numbers_that_are_no_times_are_not_taken_as_such(names: list[str]) -> None:
    assert times_from_names(names, None) is None


@pytest.mark.parametrize("line", ["{name},{time}", "{time} {name}", '"{name}"; {time}'])
def test_names_with_spaces_and_commas_in_a_file_of_times(
    drive: DriveFiles, tmp_path: Path, line: str
) -> None:
    names = [f"Frame {index}, left (1).png" for index in range(COUNT)]
    renamed(drive, names)
    times = tmp_path / "times.csv"
    rows = [line.format(name=name, time=10 + index) for index, name in enumerate(names)]
    times.write_text("\n".join(["name,time", *reversed(rows)]))
    read = read_drive(replace(drive, times=times))
    assert [frame.time_s for frame in read.frames] == [10 + index for index in range(COUNT)]
    assert [read.left[frame.index] for frame in read.frames] == names


def test_images_of_one_time_are_counted(drive: DriveFiles, tmp_path: Path) -> None:
    times = tmp_path / "times.txt"
    times.write_text("\n".join(str(100 + max(index, 1)) for index in range(COUNT)))
    warnings = read_drive(replace(drive, times=times)).warnings
    assert warnings == ("same time for different images, 1 times: repair times.txt",)


def test_poses_at_a_lower_rate_name_the_option_that_bridges_them(
    drive: DriveFiles, tmp_path: Path
) -> None:
    poses = tum(tmp_path)
    rows = [row for row in poses.read_text().splitlines() if not row.startswith("#")]
    poses.write_text("\n".join(rows[::7]))
    (warning,) = read_drive(replace(drive, poses=poses)).warnings
    assert "6 of 8 images have no pose" in warning
    assert "Poses around them are 0.70 s apart: --most-gap 0.77 would" in warning
    assert not read_drive(replace(drive, poses=poses, most_gap_s=0.77)).warnings


def test_a_file_of_poses_with_a_line_an_image_is_offered_as_times(
    drive: DriveFiles, tmp_path: Path
) -> None:
    renamed(drive, [f"{index}.png" for index in range(COUNT)])
    poses = tum(tmp_path)
    with pytest.raises(SemvizError, match=f"lines are those of the 8 images: --times {poses}"):
        read_drive(replace(drive, poses=poses))


def dark(path: Path) -> None:
    cv2.imwrite(str(path), GRADIENT.astype(np.uint16) * 16)


def turned(path: Path) -> None:
    """With the EXIF orientation of a phone that was held upright."""
    data = cv2.imencode(".jpg", GRADIENT)[1].tobytes()
    tiff = (
        b"II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00"
        + bytes(4)
    )
    exif = b"Exif\x00\x00" + tiff
    path.with_suffix(".jpg").write_bytes(
        data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    )
    path.unlink()


def half(path: Path) -> None:
    cv2.imwrite(str(path), GRADIENT[::2, ::2])


def tiff(path: Path) -> None:
    path.rename(path.with_suffix(".tiff"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dark, "16 bits whose brightest value is 4080 of 65535; .*mogrify -normalize -depth 8"),
        (turned, "stored turned, with an EXIF orientation; .*mogrify -auto-orient"),
        (half, r"if they were scaled by 0\.5, multiply focal lengths by that and take 0\.5 \*"),
        (tiff, r"convert its \.tiff files: mogrify -format png \*\.tiff"),
    ],
)
def test_images_that_need_work_first_are_refused_with_it(
    drive: DriveFiles, change: Callable[[Path], None], message: str
) -> None:
    for path in sorted(drive.images.iterdir()):
        change(path)
    with pytest.raises(SemvizError, match=message) as refused:
        read_drive(drive)
    assert "\n" not in str(refused.value)


def test_images_of_16_bits_that_are_bright_are_read(drive: DriveFiles) -> None:
    for path in sorted(drive.images.iterdir()):
        cv2.imwrite(str(path), GRADIENT.astype(np.uint16) * 256)
    assert len(read_drive(drive).frames) == COUNT


def test_as_many_poses_as_images_less_one_are_refused(drive: DriveFiles, tmp_path: Path) -> None:
    sorted(drive.images.iterdir())[3].unlink()
    with pytest.raises(SemvizError, match="8 poses for 7 images"):
        read_drive(replace(drive, poses=kitti(tmp_path)))


@pytest.mark.parametrize(
    ("x_m", "message"),
    [
        (-532.0, "532 m apart: is their distance in the calibration in millimetres"),
        (0.5, "swapped: baseline is -0.50 m; .*or invert the pose of the right camera"),
    ],
)
def test_a_right_camera_that_cannot_be_there_is_refused(
    drive: DriveFiles, x_m: float, message: str
) -> None:
    camera = read_drive(drive).original.left
    with pytest.raises(SemvizError, match=message):
        rectify_rig(OriginalRig(camera, camera, Pose(np.eye(3), np.array([x_m, 0.0, 0.0]))))


@pytest.mark.parametrize(
    ("column", "written", "doubt"),
    [
        ("heading", lambda heading: heading, ""),
        ("heading", lambda heading: heading + 180.0, ""),  # it drives backwards
        ("heading", np.deg2rad, "were in radians; call the column heading_rad"),
        ("heading_deg", lambda heading: 90.0 - heading, "counterclockwise from east"),
        ("heading_deg", lambda heading: -heading, "counterclockwise from north"),
        ("heading_deg", lambda heading: heading + 60.0, ""),  # fits no other meaning
    ],
)
def test_headings_are_compared_with_the_direction_of_travel(
    tmp_path: Path, column: str, written: Callable[[float], float], doubt: str
) -> None:
    lines = [f"time,lat,lon,height,{column}"]
    for index in range(12):
        heading = 20.0 + index
        lat, lon = 48.0 + 1e-5 * index * np.cos(np.deg2rad(22)), 11.0 + 1e-5 * index * 0.56
        lines.append(f"{index},{lat:.9f},{lon:.9f},500,{written(heading):.6f}")
    path = tmp_path / "gnss.csv"
    path.write_text("\n".join(lines))
    found = read_poses(path).doubt
    assert doubt in found
    assert bool(found) == bool(doubt)


@pytest.mark.parametrize(("first_deg", "doubt"), [(20.0, True), (110.0, True), (38.0, False)])
def test_exchanged_latitude_and_longitude_are_told_by_the_direction_of_travel(
    tmp_path: Path, first_deg: float, doubt: bool
) -> None:
    """Not along the one direction that stays the same, 38 deg there; a bend would tell."""
    lines, lat, lon = ["time,lat,lon,height,heading"], 48.0, 11.0
    for index in range(12):
        heading = first_deg + 0.2 * index
        lines.append(f"{index},{lon:.9f},{lat:.9f},500,{heading:.6f}")
        lat += 1e-5 * np.cos(np.deg2rad(heading))
        lon += 1e-5 * np.sin(np.deg2rad(heading)) / np.cos(np.deg2rad(lat))
    path = tmp_path / "gnss.csv"
    path.write_text("\n".join(lines))
    assert ("latitude and longitude were exchanged" in read_poses(path).doubt) == doubt


def test_a_latitude_beyond_the_poles_is_a_longitude(tmp_path: Path) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text("time,lat,lon,height,heading\n0,121.5,31.2,5,0\n1,121.5,31.3,5,0\n")
    with pytest.raises(SemvizError, match="exchange the names of the columns lat and lon"):
        read_poses(path)
