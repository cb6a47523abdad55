"""Poses of other people's files: every format gives the same, and what is unclear is refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drive_formats import (
    CALIBRATION,
    POSES,
    T_BODY_CAMERA,
    check_poses,
    colmap,
    colmap_binary,
    euroc,
    kitti,
    nerfstudio,
    numbers,
    stamps,
    truth,
    tum,
    without_poses,
    written,
    wxyz,
)

from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.images.image_files import LeftOutImage, list_images
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles, poses_at_times, why_without_pose
from semviz_core.datasets.trajectory import T_MAP_WORLD


@pytest.fixture
def drive(tmp_path: Path) -> DriveFiles:
    return without_poses(tmp_path)


@pytest.mark.parametrize("name", POSES)
def test_all_formats_give_the_same_poses(drive: DriveFiles, tmp_path: Path, name: str) -> None:
    poses = POSES[name](tmp_path)
    check_poses(read_drive(replace(drive, poses=poses, metric=True)))


@pytest.mark.parametrize("name", ["COLMAP", "COLMAP binary", "nerfstudio"])
def test_a_model_brings_its_cameras(drive: DriveFiles, tmp_path: Path, name: str) -> None:
    """Its principal point is half a pixel larger than semviz's."""
    poses = POSES[name](tmp_path)
    read = read_drive(replace(drive, calibration=None, poses=poses, metric=True))
    np.testing.assert_array_equal(read.rectified.rig.left.K[:2, 2], [31.5, 23.5])
    assert read.rectified.left.is_identity


@pytest.mark.parametrize("write", [colmap, colmap_binary])
def test_the_cameras_of_a_model_are_a_calibration_without_its_poses(
    drive: DriveFiles, tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    (file,) = write(tmp_path).glob("cameras.*")
    alone = tmp_path / file.name
    file.rename(alone)
    read = read_drive(replace(drive, calibration=alone, poses=tum(tmp_path)))
    np.testing.assert_array_equal(read.rectified.rig.left.K[:2, 2], [31.5, 23.5])
    alone.write_bytes(alone.read_bytes()[:9])
    with pytest.raises(SemvizError, match="not a model of COLMAP, or cut off"):
        read_drive(replace(drive, calibration=alone))


def test_the_import_states_what_it_took(drive: DriveFiles, tmp_path: Path) -> None:
    told = dict(read_drive(replace(drive, poses=euroc(tmp_path))).statements)
    assert told["poses"] == ("data.csv EuRoC, of a body, moved to the left camera by cam.toml")
    assert told["taken as"] == (
        "camera-to-world, opencv camera axes, quaternions wxyz, times in ns"
    )
    assert told["world"].startswith("up is z")
    assert told["matched"] == "8 of 8 images have a pose (by time)"


def test_conventions_can_be_replaced(drive: DriveFiles, tmp_path: Path) -> None:
    """A file that is inverted, flipped and reordered against its format."""
    flip = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    lines = []
    for index, stamp in enumerate(stamps()):
        T = (truth(index) @ flip).inverse()
        lines.append(f"{stamp // 10**6} " + numbers(*(T.translation / 2.0), *wxyz(T)))
    poses = written(tmp_path / "odd.txt", "\n".join(lines))
    odd = replace(
        drive, poses=poses, direction="world-to-camera", axes="opengl", quaternion="wxyz", scale=2.0
    )
    told = dict(read_drive(odd).statements)
    assert "times in ms" in told["taken as"]
    wrong = [replace(odd, direction=None), replace(odd, axes=None), replace(odd, quaternion=None)]
    for files in wrong:
        with pytest.raises(AssertionError):
            check_poses(read_drive(files))


def test_conventions_that_are_replaced_give_the_poses(drive: DriveFiles, tmp_path: Path) -> None:
    flip = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    lines = []
    for index, stamp in enumerate(stamps()):
        T = truth(index)
        T = (Pose(T.rotation, T.translation / 2.0) @ flip).inverse()
        lines.append(f"{stamp // 10**6} " + numbers(*T.translation, *wxyz(T)))
    poses = written(tmp_path / "odd.txt", "\n".join(lines))
    odd = replace(
        drive, poses=poses, direction="world-to-camera", axes="opengl", quaternion="wxyz", scale=2.0
    )
    check_poses(read_drive(odd))


@pytest.mark.parametrize(("name", "body"), [("flu", T_MAP_WORLD), ("camera", Pose.identity())])
def test_poses_of_a_body_with_a_named_extrinsic(
    drive: DriveFiles, tmp_path: Path, name: str, body: Pose
) -> None:
    lines = []
    for index, stamp in enumerate(stamps()):
        T = truth(index) @ body.inverse()
        lines.append(f"{stamp / 1e9!r} " + numbers(*T.translation, *T.as_quaternion()))
    poses = written(tmp_path / "body.txt", "\n".join(lines))
    check_poses(read_drive(replace(drive, poses=poses, extrinsic=name)))


def test_an_extrinsic_is_read_from_a_matrix_or_the_calibration(
    drive: DriveFiles, tmp_path: Path
) -> None:
    lines = []
    for index, stamp in enumerate(stamps()):
        T = truth(index) @ T_BODY_CAMERA.inverse()
        lines.append(f"{stamp / 1e9!r} " + numbers(*T.translation, *T.as_quaternion()))
    files = replace(drive, poses=written(tmp_path / "body.txt", "\n".join(lines)))
    matrix = written(tmp_path / "T.txt", numbers(*T_BODY_CAMERA.as_matrix().ravel()))
    for extrinsic in (str(matrix), "calibration", str(tmp_path / "cam.toml")):
        check_poses(read_drive(replace(files, extrinsic=extrinsic)))


def test_poses_are_interpolated_and_gaps_left_open() -> None:
    poses = [truth(0), truth(1), truth(2)]
    found = poses_at_times(
        poses, np.array([0.0, 0.1, 1.0]), np.array([-1.0, -0.004, 0.05, 0.1, 0.5, 1.1]), 0.25
    )
    assert [pose is None for pose in found] == [True, False, False, False, True, True]
    middle = found[2]
    assert middle is not None
    np.testing.assert_allclose(
        middle.translation, (poses[0].translation + poses[1].translation) / 2.0
    )
    turned = angle_between(poses[0].rotation, middle.rotation)
    assert turned == pytest.approx(angle_between(poses[0].rotation, poses[1].rotation) / 2.0)


def test_frames_without_a_pose_are_kept_and_counted(drive: DriveFiles, tmp_path: Path) -> None:
    path = tum(tmp_path)
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:6]))
    read = read_drive(replace(drive, poses=path))
    assert [frame.T_map_camera is None for frame in read.frames] == [False] * 5 + [True] * 3
    assert "3 of 8 images have no pose" in read.warnings[0]
    assert [(image.file, image.side) for image in read.left_out] == [
        (f"{stamp}.png", "left") for stamp in stamps()[5:]
    ]
    first = read.left_out[0]
    assert first.time_s == read.frames[5].time_s
    assert first.reason == (
        "no pose, taken 0.100 s after the last pose: kept for labels, left out of maps and runs"
    )
    early = read_drive(replace(drive, poses=path, frames=range(7)))
    assert early.left_out == read.left_out[:2]


def test_the_reason_for_no_pose_tells_a_gap_from_an_end() -> None:
    times_s = np.array([0.0, 0.1, 1.0])
    assert why_without_pose(times_s, -1.0, 0.25) == "taken 1.000 s before the first pose"
    assert why_without_pose(times_s, 1.1, 0.25) == "taken 0.100 s after the last pose"
    between = "taken between poses 0.900 s apart, --most-gap is 0.25 s"
    assert why_without_pose(times_s, 0.5, 0.25) == between


@pytest.mark.parametrize("name", ["COLMAP", "nerfstudio"])
def test_a_frame_that_poses_do_not_name_is_listed(
    drive: DriveFiles, tmp_path: Path, name: str
) -> None:
    poses = POSES[name](tmp_path)
    more = drive.images / "1700000009000000000.png"
    more.write_bytes((drive.images / f"{stamps()[0]}.png").read_bytes())
    read = read_drive(replace(drive, poses=poses, metric=True))
    (image,) = read.left_out
    assert image == LeftOutImage(
        more.name, "left", 1700000009.0, "no pose: kept for labels, left out of maps and runs"
    )


def test_a_drive_without_poses_is_for_labels_only(drive: DriveFiles) -> None:
    read = read_drive(drive)
    assert all(frame.T_map_camera is None for frame in read.frames)
    assert dict(read.statements)["poses"] == "none: images can be labelled, but no map built"
    np.testing.assert_allclose(np.diff([frame.time_s for frame in read.frames]), 0.1, atol=1e-6)


def test_far_coordinates_keep_their_millimetres(drive: DriveFiles, tmp_path: Path) -> None:
    """UTM has seven digits before the point; the map's origin is moved near."""
    lines = []
    for index, stamp in enumerate(stamps()):
        T = truth(index)
        t = T.translation + np.array([458074.604, 5429380.172, 162.9])
        lines.append(f"{stamp / 1e9!r} " + numbers(*t, *T.as_quaternion()))
    read = read_drive(replace(drive, poses=written(tmp_path / "utm.txt", "\n".join(lines))))
    check_poses(read)
    assert read.axes is not None
    assert read.axes.origin_m == (458000.0, 5429000.0, 0.0)
    assert "origin moved to 458000 5429000 0 m" in dict(read.statements)["world"]


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("names behind", [f"{stamp} {stamp}.png" for stamp in stamps()]),
        ("names before", [f"{stamp}.png,{stamp / 1e9!r}" for stamp in reversed(stamps())]),
        ("numbers", ["#timestamp [ns]", *map(str, stamps())]),
    ],
)
def test_times_files(drive: DriveFiles, tmp_path: Path, kind: str, lines: list[str]) -> None:
    times = written(tmp_path / "times.csv", "\n".join(lines))
    read = read_drive(replace(drive, times=times))
    np.testing.assert_allclose([frame.time_s for frame in read.frames], np.array(stamps()) / 1e9)


def _degrees(folder: Path) -> Path:
    lines = [
        f"{stamp / 1e9!r} 49.0112{index}3 8.41{index}71 115.0 0 0 0 1"
        for index, stamp in enumerate(stamps())
    ]
    return written(folder / "gnss.txt", "\n".join(lines))


def _shorter(folder: Path) -> Path:
    path = kitti(folder)
    path.write_text("\n".join(path.read_text().splitlines()[:5]))
    return path


def _of_another_day(folder: Path) -> Path:
    return written(folder / "old.txt", tum(folder).read_text().replace("\n17", "\n16"))


def _of_other_images(folder: Path) -> Path:
    path = nerfstudio(folder)
    path.write_text(path.read_text().replace("cam/17", "cam/16"))
    return path


def _scaled_matrix(folder: Path) -> Path:
    lines = kitti(folder).read_text().splitlines()
    lines[3] = numbers(*(2.0 * float(word) for word in lines[3].split()))
    return written(folder / "scaled.txt", "\n".join(lines))


def _long_quaternion(folder: Path) -> Path:
    return written(folder / "q.txt", "1700000000.0 0 0 0 0 0 0 3\n1700000000.1 0 0 0 0 0 0 1\n")


REFUSED: dict[str, tuple[Callable[[Path], Path], bool, str]] = {
    "fewer poses": (_shorter, True, "5 poses for 8 images, and nothing says which"),
    "another day": (_of_another_day, True, "no pose is at the time of an image"),
    "other images": (_of_other_images, True, "the poses are of other images"),
    "no scale": (colmap, False, "a model of COLMAP has no unit of length; give --scale"),
    "no scale, nerfstudio": (nerfstudio, False, "a model of nerfstudio has no unit of length"),
    "degrees": (_degrees, False, "degrees of latitude and longitude"),
    "scaled": (_scaled_matrix, True, "line 4: matrix is not a rotation: it is scaled"),
    "quaternion": (_long_quaternion, True, "pose 1: the quaternion has length 3, not 1"),
    "table": (
        lambda folder: written(folder / "a.csv", "time,lat,lon,alt\n1,49.0,8.4,115\n"),
        True,
        "holds latitude and longitude",
    ),
    "width": (lambda folder: written(folder / "a.txt", "1 2 3\n"), True, "3 numbers a line"),
    "nan": (
        lambda folder: written(folder / "a.txt", "1 2 3 4 5 6 7 nan\n"),
        True,
        "line 1: 'nan' is not a finite number",
    ),
    "empty": (lambda folder: written(folder / "a.txt", ""), True, "holds no poses"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_known_is_refused_in_one_line(
    drive: DriveFiles, tmp_path: Path, name: str
) -> None:
    make, metric, message = REFUSED[name]
    with pytest.raises(SemvizError, match=message) as refused:
        read_drive(replace(drive, poses=make(tmp_path), metric=metric))
    assert "\n" not in str(refused.value)


def test_images_without_calibration_or_with_that_of_others_are_refused(
    drive: DriveFiles, tmp_path: Path
) -> None:
    with pytest.raises(SemvizError, match=r"no calibration\. A guess would be wrong"):
        read_drive(replace(drive, calibration=None, poses=tum(tmp_path)))
    written(tmp_path / "cam.toml", CALIBRATION.replace("[64, 48]", "[128, 96]"))
    with pytest.raises(SemvizError, match=r"images are 64x48, but cam\.toml is .* 128x96"):
        read_drive(drive)


def test_poses_of_a_body_need_its_extrinsic(drive: DriveFiles, tmp_path: Path) -> None:
    written(tmp_path / "cam.toml", CALIBRATION.partition("\n")[2])
    with pytest.raises(SemvizError, match=r"EuRoC holds poses of a body.*--extrinsic FILE"):
        read_drive(replace(drive, poses=euroc(tmp_path)))


def test_images_without_times_need_them_for_timed_poses(drive: DriveFiles, tmp_path: Path) -> None:
    for number, path in enumerate(sorted(drive.images.iterdir())):
        path.rename(path.with_name(f"image_{number}.png"))
    poses = tum(tmp_path)
    with pytest.raises(SemvizError, match="TUM poses have times, the images none; give --times"):
        read_drive(replace(drive, poses=poses))
    check_poses(read_drive(replace(drive, poses=poses, times=poses)))


def test_cameras_in_one_folder_are_told_apart_by_a_pattern(tmp_path: Path) -> None:
    for name in ("10_left", "9_left", "9_right", "10_right", "11_right"):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4, 3), np.uint8))
    names = list_images(tmp_path / "*_left.png", tmp_path / "*_right.png")
    assert names.left == ("9_left.png", "10_left.png")
    assert names.right == ("9_right.png", "10_right.png")
    assert [(image.file, image.side) for image in names.unpaired] == [("11_right.png", "right")]
    with pytest.raises(SemvizError, match="give one star"):
        list_images(tmp_path / "*_*.png", None)


@pytest.mark.parametrize("write", [colmap, colmap_binary])
def test_a_folder_of_models_stands_for_its_first(
    drive: DriveFiles, tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    (tmp_path / "models").mkdir()
    write(tmp_path).rename(tmp_path / "models" / "0")
    check_poses(read_drive(replace(drive, poses=tmp_path / "models", metric=True)))


def test_poses_of_tum_vi_have_eight_numbers_in_the_order_of_euroc(tmp_path: Path) -> None:
    """Its header tells; those of TUM have the scalar last."""
    path = tmp_path / "data.csv"
    header = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
    path.write_text(f"{header}q_RS_y [], q_RS_z []\n1520530308199447626,1.0,2.0,3.0,1.0,0,0,0\n")
    found = read_poses(path, None, None)
    assert (found.format, found.of_body, found.quaternion) == ("EuRoC", True, "wxyz")
    np.testing.assert_array_equal(found.matrices[0, :, :3], np.eye(3))


def test_what_holds_no_images_says_where_there_are_some(tmp_path: Path) -> None:
    images = tmp_path / "mav0" / "cam0" / "data"
    images.mkdir(parents=True)
    cv2.imwrite(str(images / "1.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(SemvizError, match=r"there are some in .*mav0/cam0/data: name that one"):
        list_images(tmp_path, None)
    film = tmp_path / "drive.mp4"
    film.write_bytes(b"ftyp")
    with pytest.raises(SemvizError, match="a video; write its images first"):
        list_images(film, None)
