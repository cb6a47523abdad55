"""Recordings in the layouts of others: all give the poses that were written."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from drive_formats import check_poses, tum, written
from drive_layouts import (
    CAMERA,
    T_RIGHT_LEFT,
    K,
    argoverse2,
    boreas,
    comma,
    euroc_layout,
    gnss,
    kitti_360,
    kitti_raw,
    nuscenes,
)
from pyarrow import feather

from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive, read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles


@dataclass(frozen=True)
class Layout:
    write: Callable[[Path], DriveFiles]
    is_stereo: bool = False
    posed: int = 8
    frames: int = 8
    warnings: int = 0


LAYOUTS = {
    "KITTI raw": Layout(kitti_raw, True, 7, 7, 1),
    "KITTI-360": Layout(kitti_360, True, posed=7, warnings=1),
    "nuScenes": Layout(nuscenes, True),
    "EuRoC": Layout(euroc_layout, True),
    "Argoverse 2": Layout(argoverse2, True),
    "Boreas": Layout(boreas),
    "GNSS": Layout(gnss),
    "comma2k19": Layout(comma),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_give_the_poses_that_were_written(tmp_path: Path, name: str) -> None:
    layout = LAYOUTS[name]
    read = read_drive(layout.write(tmp_path / "drive"))
    assert len(read.frames) == layout.frames
    assert len(read.warnings) == layout.warnings, read.warnings
    assert len(read.left_out) == layout.warnings  # each of one image
    posed = [frame for frame in read.frames if frame.T_map_camera is not None]
    assert len(posed) == layout.posed
    check_poses(only(read, [frame.index for frame in posed], missing=name == "KITTI raw"))
    np.testing.assert_allclose(read.rectified.rig.left.K.ravel(), K)
    assert read.rectified.left.is_identity
    T_right_left = read.rectified.rig.T_right_left
    assert (T_right_left is not None) == layout.is_stereo
    if T_right_left is not None:
        np.testing.assert_allclose(T_right_left.as_matrix(), T_RIGHT_LEFT.as_matrix(), atol=1e-9)


def only(read: RecordedDrive, indices: list[int], missing: bool) -> RecordedDrive:
    """Frames with a pose; a missing image moves the number of later frames by one."""
    frames = [frame for frame in read.frames if frame.index in indices]
    if missing:
        frames = [replace(f, index=f.index + (f.index >= 2)) for f in frames]
    return replace(read, frames=tuple(frames))


def test_a_missing_image_and_the_one_that_it_leaves_alone_are_listed(tmp_path: Path) -> None:
    files = nuscenes(tmp_path)
    gone = sorted((tmp_path / "samples" / "CAM_FRONT_LEFT").iterdir())[2]
    gone.unlink()
    read = read_drive(files)
    assert [text.partition(" ")[0] for text in read.warnings] == ["1", "1"]
    alone, missing = read.left_out
    assert (alone.side, alone.file) == ("right", gone.name.replace("CAM_FRONT_LEFT", "CAM_FRONT"))
    assert alone.reason == "no match in the other camera within 2 ms"
    assert (missing.side, missing.file) == ("left", gone.name)
    assert missing.reason == "listed by the recording, but there is no such file"
    assert missing.time_s == alone.time_s == float(gone.stem.rpartition("_")[2]) * 1e-6


def test_unpaired_images_named_by_their_time_are_listed_with_it(tmp_path: Path) -> None:
    files = LAYOUTS["EuRoC"].write(tmp_path)
    gone = sorted((tmp_path / "mav0" / "cam1" / "data").iterdir())[2]
    gone.unlink()
    (image,) = read_drive(files).left_out
    assert (image.file, image.side) == (gone.name, "left")
    assert image.time_s == pytest.approx(int(gone.stem) / 1e9)


def test_far_origins_are_stated(tmp_path: Path) -> None:
    told = dict(read_drive(comma(tmp_path / "a")).statements)
    assert told["world"].startswith("up is the earth's (cameras tilted 0 deg), origin moved to -27")
    told = dict(read_drive(boreas(tmp_path / "b")).statements)
    assert told["world"].endswith("origin moved to 623000 4849000 0 m")
    told = dict(read_drive(gnss(tmp_path / "c")).statements)
    assert "heading clockwise from north, pitch nose up, roll right down" in told["taken as"]


def test_gnss_in_radians_is_that_in_degrees_and_the_columns_used_are_stated(
    tmp_path: Path,
) -> None:
    files = gnss(tmp_path / "drive")
    assert files.poses is not None
    head, *rows = files.poses.read_text().splitlines()
    lines = [head.replace("lat_deg;lon_deg", "lat_rad;lon_rad")]
    for row in rows:
        name, latitude, longitude, *rest = row.split(";")
        turned = [repr(float(np.deg2rad(float(word)))) for word in (latitude, longitude)]
        lines.append(";".join([name, *turned, *rest]))
    files.poses.write_text("\n".join(lines))
    check_poses(read_drive(files))
    for unused, says in (
        ("roll_deg", "north, pitch nose up, roll 0, metres"),
        ("pitch_deg", "north, level, metres"),
    ):
        files.poses.write_text(files.poses.read_text().replace(unused, "c"))
        assert says in dict(read_drive(files).statements)["taken as"]


def test_a_blank_line_among_kitti_times_is_no_time_and_moves_none(tmp_path: Path) -> None:
    """Image 2 is missing on the left, so its time is not needed; that of image 1 is."""
    files = kitti_raw(tmp_path / "drive")
    path = files.images / "image_02" / "timestamps.txt"
    lines = path.read_text().splitlines()
    wanted = [frame.time_s for frame in read_drive(files).frames]
    path.write_text("\n".join([*lines[:2], "", *lines[3:]]))
    assert [frame.time_s for frame in read_drive(files).frames] == wanted
    path.write_text("\n".join([lines[0], "", *lines[2:]]))
    with pytest.raises(SemvizError, match=r"timestamps\.txt, line 2: blank, but there is a file"):
        read_drive(files)


def _without(name: str) -> Callable[[Path], None]:
    def remove(root: Path) -> None:
        next(root.rglob(name)).unlink()

    return remove


def _changed(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        path = next(root.rglob(name))
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return change


def _pickled(root: Path) -> None:
    """An array of objects, which NumPy would unpickle."""
    with (root / "global_pose" / "frame_positions").open("wb") as file:
        np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)


def _doubled(root: Path) -> None:
    path = root / "calibration" / "intrinsics.feather"
    table = feather.read_table(path)
    names = [*table.column_names, "sensor_name"]
    feather.write_feather(pa.Table.from_arrays([*table.columns, table.columns[0]], names), path)


def _timed(root: Path) -> None:
    path = root / "calibration" / "intrinsics.feather"
    table = feather.read_table(path)
    times = pa.array([1] * len(table), pa.timestamp("ns"))
    feather.write_feather(table.set_column(0, "sensor_name", times), path)


REFUSED: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "no calibration": ("KITTI raw", _without("calib_cam_to_cam.txt"), "calib_cam_to_cam.txt"),
    "other size": ("KITTI raw", _changed("calib_cam_to_cam.txt", "S_rect_02: 64", "S_rect_02: 65"),
                   "no line S_02 with 2 numbers"),
    "stamps": ("KITTI raw", _changed("image_02/timestamps.txt", "-11-", "/11/"),
               "is not a date and time"),
    "oxts": ("KITTI raw", _changed("0000000001.txt", " 0.0", ""), "expected 30"),
    "tables": ("nuScenes", _changed("ego_pose.json", '"rotation"', '"r"'), "'rotation'"),
    "cut table": ("nuScenes", _changed("sample.json", "]", ""), "not nuScenes' tables"),
    "absolute": ("nuScenes", _changed("sample_data.json", '"samples/CAM', '"/samples/CAM'),
                 "lie outside of the data set"),
    "infinite size": ("nuScenes", _changed("sample_data.json", '"width": 64', '"width": Infinity'),
                      "not nuScenes' tables"),
    "time beyond floats": (
        "nuScenes",
        _changed("sample_data.json", '"timestamp": 1', '"timestamp": 1' + "0" * 400),
        "not nuScenes' tables",
    ),
    "infinite time": (
        "nuScenes",
        _changed("sample_data.json", '"timestamp": ', '"timestamp": 1e999, "t": '),
        "sample_data.json, timestamp holds NaN or infinite",
    ),
    "no text": ("nuScenes", _changed("sample_data.json", "samples/CAM", "\\ud800/CAM"), "images"),
    "a long name": ("nuScenes", _changed("sample_data.json", "samples/CAM", "s" * 5000 + "/CAM"),
                    "File name too long"),
    "two columns of one name": ("Argoverse 2", _doubled, "two columns of one name"),
    "names that are times": ("Argoverse 2", _timed, "no sensor ring_front_left"),
    "T_BS": ("EuRoC", _changed("sensor.yaml", "T_BS", "T_X"), "does not say where"),
    "MEI": ("EuRoC", _changed("sensor.yaml", "camera_model: pinhole", "camera_model: omni"),
            "lens model omni is not read"),
    "columns": ("Boreas", _changed("camera_poses.csv", "pitch", "p"), "no column pitch"),
    "heading": ("GNSS", _changed("gnss.csv", "heading_deg", "h1"), "no orientation of a camera"),
    "height": ("GNSS", _changed("gnss.csv", "alt_m", "h1"), "no column height_m"),
    "pickle": ("comma2k19", _pickled, "not an array of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_recordings_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    layout, damage, message = REFUSED[name]
    files = LAYOUTS[layout].write(tmp_path / "drive")
    damage(tmp_path / "drive")
    with pytest.raises(SemvizError, match=message) as refused:
        read_drive(files)
    assert "\n" not in str(refused.value)


def test_options_that_a_recording_does_not_have_are_refused(tmp_path: Path) -> None:
    files = nuscenes(tmp_path / "n")
    with pytest.raises(SemvizError, match="choose --sequence of its scenes scene-1, scene-2"):
        read_drive(replace(files, sequence=None))
    with pytest.raises(SemvizError, match="no camera CAM_TOP; --cameras LEFT"):
        read_drive(replace(files, cameras=("CAM_TOP",)))
    with pytest.raises(SemvizError, match="within 2 ms of each other: no stereo pair"):
        read_drive(replace(files, cameras=("CAM_FRONT_LEFT", "CAM_BACK")))
    with pytest.raises(SemvizError, match="with --cameras LEFT,RIGHT instead of --right"):
        read_drive(replace(files, right=tmp_path))
    folder = gnss(tmp_path / "g")
    with pytest.raises(SemvizError, match="a folder of images, where --cameras has no meaning"):
        read_drive(replace(folder, cameras=("a",)))


def test_poses_and_calibration_of_the_user_replace_those_of_a_recording(tmp_path: Path) -> None:
    files = euroc_layout(tmp_path / "drive")
    read = read_drive(replace(files, poses=tum(tmp_path)))
    assert dict(read.statements)["poses"] == "tum.txt TUM, of the left camera"
    check_poses(read)
    own = written(tmp_path / "own.toml", CAMERA.replace("[50, 50]", "[60, 60]"))
    read = read_drive(replace(files, calibration=own, cameras=("cam0",), poses=tum(tmp_path)))
    assert read.rectified.rig.left.K[0, 0] == 60.0
