"""Poses of other people's files: every format gives the same, and what is unclear is refused."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive, read_drive
from semviz_core.datasets.own_drive.time_matching import poses_at_times
from semviz_core.datasets.trajectory import T_MAP_WORLD

COUNT = 8
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
T_BODY_CAMERA = T_MAP_WORLD @ Pose.from_rotvec([0.02, -0.01, 0.03], [0.3, -0.1, 0.05])
"""Of a body with x ahead."""
CALIBRATION = f"""T_body_left = {T_BODY_CAMERA.as_matrix().tolist()}
[left]
size_px = [64, 48]
model = "pinhole"
focal_px = [50.0, 50.0]
center_px = [31.5, 23.5]
"""


def truth(index: int) -> Pose:
    """T_world_camera on a left-hand bend, z up."""
    heading = 0.1 * index
    turned = Pose(Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix(), np.zeros(3))
    return Pose(np.eye(3), np.array([index * 1.2, 0.06 * index**2, 1.5])) @ turned @ T_MAP_WORLD


def stamps() -> list[int]:
    return [START_NS + index * STEP_NS for index in range(COUNT)]


@pytest.fixture
def drive(tmp_path: Path) -> DriveFiles:
    """Images named by their time in ns; no poses yet."""
    (tmp_path / "cam").mkdir()
    for stamp in stamps():
        assert cv2.imwrite(str(tmp_path / "cam" / f"{stamp}.png"), np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "cam.toml").write_text(CALIBRATION)
    return DriveFiles(images=tmp_path / "cam", calibration=tmp_path / "cam.toml")


def numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def wxyz(pose: Pose) -> list[float]:
    return np.roll(pose.as_quaternion(), 1).tolist()


def tum(folder: Path) -> Path:
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} "
        + numbers(*truth(i).translation, *truth(i).as_quaternion())
        for i, stamp in enumerate(stamps())
    ]
    return written(folder / "tum.txt", "# time x y z qx qy qz qw\n" + "\n".join(lines))


def kitti(folder: Path) -> Path:
    """In KITTI's world, y down."""
    poses = [T_MAP_WORLD.inverse() @ truth(index) for index in range(COUNT)]
    text = "\n".join(numbers(*pose.as_matrix()[:3].ravel()) for pose in poses)
    return written(folder / "kitti.txt", text)


def euroc(folder: Path) -> Path:
    """Of the body, with its velocity and biases."""
    lines = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v, v, v, b, b, b, b, b, b"]
    for index, stamp in enumerate(stamps()):
        body = truth(index) @ T_BODY_CAMERA.inverse()
        words = [str(stamp), *map(repr, [*body.translation.tolist(), *wxyz(body)]), *["0.0"] * 9]
        lines.append(",".join(words))
    return written(folder / "data.csv", "\n".join(lines))


def image_name(index: int) -> str:
    return f"cam/{stamps()[index]}.png"


def colmap(folder: Path) -> Path:
    """With a line of points, and an empty one, in COLMAP's manner."""
    lines = ["# Image list with two lines of data per image:"]
    for index in range(COUNT):
        T = truth(index).inverse()
        row = numbers(*wxyz(T), *T.translation)
        lines += [f"{index + 1} {row} 1 {image_name(index)}", "" if index % 2 else "1.0 2.0 -1"]
    (folder / "sparse").mkdir()
    written(folder / "sparse" / "cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n")
    written(folder / "sparse" / "images.txt", "\n".join(lines) + "\n")
    return folder / "sparse"


def colmap_binary(folder: Path) -> Path:
    data = struct.pack("<Q", COUNT)
    for index in range(COUNT):
        T = truth(index).inverse()
        data += struct.pack("<I7dI", index + 1, *wxyz(T), *T.translation.tolist(), 7)
        data += image_name(index).encode() + b"\0" + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    (folder / "bin").mkdir()
    (folder / "bin" / "images.bin").write_bytes(data)
    cameras = struct.pack("<QIiQQ4d", 1, 7, 1, 64, 48, 50.0, 50.0, 32.0, 24.0)
    (folder / "bin" / "cameras.bin").write_bytes(cameras)
    return folder / "bin"


def nerfstudio(folder: Path) -> Path:
    flip = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    frames = [
        {
            "file_path": f"./{image_name(index)}",
            "transform_matrix": (truth(index) @ flip).as_matrix().tolist(),
        }
        for index in range(COUNT)
    ]
    camera = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    return written(folder / "transforms.json", json.dumps({**camera, "frames": frames}))


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


FORMATS: dict[str, Callable[[Path], Path]] = {
    "TUM": tum,
    "KITTI": kitti,
    "EuRoC": euroc,
    "COLMAP": colmap,
    "COLMAP binary": colmap_binary,
    "nerfstudio": nerfstudio,
}


def check_poses(read: RecordedDrive) -> None:
    """Up to the heading of the map, which no format fixes, they are the true ones.

    Times since 1970 are known to 0.2 us, in which a car moves some micrometres.
    """
    first = read.frames[0].T_map_camera
    assert first is not None
    T_map_truth = first @ truth(0).inverse()
    np.testing.assert_allclose(T_map_truth.rotation[2], [0.0, 0.0, 1.0], atol=1e-7)
    for frame in read.frames:
        assert frame.T_map_camera is not None
        wanted = T_map_truth @ truth(frame.index)
        assert angle_between(frame.T_map_camera.rotation, wanted.rotation) < 1e-5
        np.testing.assert_allclose(frame.T_map_camera.translation, wanted.translation, atol=1e-5)


@pytest.mark.parametrize("name", FORMATS)
def test_all_formats_give_the_same_poses(drive: DriveFiles, tmp_path: Path, name: str) -> None:
    poses = FORMATS[name](tmp_path)
    check_poses(read_drive(replace(drive, poses=poses, metric=True)))


@pytest.mark.parametrize("name", ["COLMAP", "COLMAP binary", "nerfstudio"])
def test_a_model_brings_its_cameras(drive: DriveFiles, tmp_path: Path, name: str) -> None:
    """Its principal point is half a pixel larger than semviz's."""
    poses = FORMATS[name](tmp_path)
    read = read_drive(replace(drive, calibration=None, poses=poses, metric=True))
    np.testing.assert_array_equal(read.rectified.rig.left.K[:2, 2], [31.5, 23.5])
    assert read.rectified.left.is_identity


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
