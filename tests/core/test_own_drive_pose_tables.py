"""Poses in tables with named columns, behind times and names, and in files of their own."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_formats import check_poses, numbers, stamps, truth, without_poses, written, wxyz
from scipy.spatial.transform import Rotation

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.poses.conventions import NAMED_EXTRINSICS
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.trajectory import T_MAP_WORLD


@pytest.fixture
def drive(tmp_path: Path) -> DriveFiles:
    return without_poses(tmp_path)


def matrix(T: Pose) -> str:
    return numbers(*T.as_matrix()[:3].ravel())


def position_and_turn(T: Pose) -> str:
    return numbers(*T.translation, *T.as_quaternion())


Line = Callable[[int, Pose], str]
TABLES: dict[str, tuple[str, Line]] = {
    "time, matrix": ("", lambda stamp, T: f"{stamp}," + matrix(T).replace(" ", ",")),
    "time, 4x4": ("", lambda stamp, T: f"{stamp / 1e9!r} " + matrix(T) + " 0 0 0 1"),
    "4x4": ("", lambda stamp, T: matrix(T) + " 0 0 0 1"),
    "TUM without times": ("", lambda stamp, T: position_and_turn(T)),
    "name, TUM": ("", lambda stamp, T: f"{stamp}.png " + position_and_turn(T)),
    "name, KITTI": ("", lambda stamp, T: f"{stamp}.png " + matrix(T)),
    "names, scalar first": (
        "utime,qw,qx,qy,qz,pos_x [m],pos_y [m],pos_z [m]",
        lambda stamp, T: f"{stamp // 1000},{numbers(*wxyz(T), *T.translation)}".replace(" ", ","),
    ),
    "names apart by spaces": (
        "image   tx ty tz   qx qy qz qw",
        lambda stamp, T: f"{stamp}.png   {position_and_turn(T)}".replace(" ", "  "),
    ),
    "export of ROS": (
        "%time\tfield.header.seq\tfield.header.frame_id\t"
        + "\t".join(f"field.pose.pose.position.{axis}" for axis in "xyz")
        + "".join(f"\tfield.pose.pose.orientation.{axis}" for axis in "xyzw")
        + "\tfield.twist.twist.linear.x",
        lambda stamp, T: "\t".join(
            [str(stamp), "7", "map", *position_and_turn(T).split(), "3.0"]
        ),
    ),
    "title, time as the number of a frame": (
        "# GNSSPoses: frame_id, translation_x, translation_y, translation_z, quat_x, quat_y, "
        "quat_z, quat_w, scale, fusion_quality, v3",
        lambda stamp, T: ", ".join([str(stamp), *position_and_turn(T).split(), "1", "1", "1"]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_others_are_read_by_the_names_of_their_columns(
    drive: DriveFiles, tmp_path: Path, name: str
) -> None:
    head, line = TABLES[name]
    lines = [head] * bool(head) + [line(stamp, truth(i)) for i, stamp in enumerate(stamps())]
    check_poses(read_drive(replace(drive, poses=written(tmp_path / "a.txt", "\n".join(lines)))))


def nested(stamp: int, T: Pose) -> dict[str, object]:
    """A record as PandaSet's, with a time."""
    w, x, y, z = wxyz(T)
    position = dict(zip("xyz", T.translation.tolist(), strict=True))
    return {"position": position, "heading": {"w": w, "x": x, "y": y, "z": z}, "time_ns": stamp}


def listed(stamp: int, T: Pose) -> dict[str, object]:
    """A record as those of nuScenes."""
    turn, place = list(wxyz(T)), T.translation.tolist()
    return {"token": "a", "timestamp": stamp // 1000, "rotation": turn, "translation": place}


@pytest.mark.parametrize("record", [nested, listed])
@pytest.mark.parametrize("layout", ["list", "named", "lines"])
def test_records_of_json_are_read_by_their_names(
    drive: DriveFiles, tmp_path: Path, layout: str, record: Callable[[int, Pose], object]
) -> None:
    records = [record(stamp, truth(index)) for index, stamp in enumerate(stamps())]
    text = json.dumps({"poses": records} if layout == "named" else records)
    if layout == "lines":
        text = "\n".join(map(json.dumps, records))
    check_poses(read_drive(replace(drive, poses=written(tmp_path / "a.json", text))))


def test_records_without_times_are_those_of_the_images_in_order(
    drive: DriveFiles, tmp_path: Path
) -> None:
    records = [nested(stamp, truth(index)) for index, stamp in enumerate(stamps())]
    for record in records:
        del record["time_ns"]
    poses = written(tmp_path / "poses.json", json.dumps(records))
    check_poses(read_drive(replace(drive, poses=poses)))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[1, 2]", "no list of records"),
        ("{}", "no list of records"),
        ('{"a": [', "not JSON"),
        ('[{"a": 1}]', "no poses by names that are known"),
        ('[{"x": 1, "y": 2, "z": 3}]', "no poses by names that are known"),
        ('[{"position": [1, 2, 3], "rotation": [1, 0, 0, 0]}, {"position": [1, 2, 3]}]',
         "record 2: no number in rotation.x; delete it"),
        ('[{"position": [1, 2, 3], "rotation": [0, 0, 0, 0]}]', "quaternion"),
        ("[]", "holds no records"),
    ],
)  # fmt: skip
def test_other_json_is_refused_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(SemvizError, match=says):
        read_poses(written(tmp_path / "a.json", text))


def test_a_folder_has_a_matrix_for_each_image(drive: DriveFiles, tmp_path: Path) -> None:
    folder = tmp_path / "poses"
    folder.mkdir()
    for index, stamp in enumerate(stamps()):
        written(folder / f"{stamp}.txt", matrix(truth(index)).replace(" ", "\n") + "\n0 0 0 1")
    check_poses(read_drive(replace(drive, poses=folder)))
    written(folder / "9.txt", "1 2 3")
    with pytest.raises(SemvizError, match=r"9\.txt: numbers: 3 numbers, expected 12; give"):
        read_drive(replace(drive, poses=folder))


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_headings_in_metres_are_those_of_a_body(
    drive: DriveFiles, tmp_path: Path, unit: str
) -> None:
    lines = [f"time_ns,x_m,y_m,z_m,roll_{unit},pitch_{unit},yaw_{unit}"]
    for index, stamp in enumerate(stamps()):
        T = truth(index) @ T_MAP_WORLD.inverse()
        yaw = np.arctan2(T.rotation[1, 0], T.rotation[0, 0]) * (180 / np.pi if unit == "deg" else 1)
        lines.append(",".join([str(stamp), *numbers(*T.translation, 0.0, 0.0, yaw).split()]))
    files = replace(drive, poses=written(tmp_path / "rpy.csv", "\n".join(lines)), extrinsic="flu")
    read = read_drive(files)
    check_poses(read)
    told = dict(read.statements)["taken as"]
    assert f"yaw_{unit} anticlockwise from x, pitch nose up, roll right down" in told


def test_pitch_lifts_the_nose_and_roll_lowers_the_right_side(tmp_path: Path) -> None:
    text = "time_s,x,y,z,roll,pitch,heading\n1,0,0,0,0,10,30\n2,0,0,0,10,0,30\n"
    poses = read_poses(written(tmp_path / "rpy.csv", text))
    assert poses.of_body
    raised, rolled = poses.matrices[:, :, :3]
    np.testing.assert_allclose(raised[2], [np.sin(np.deg2rad(10)), 0.0, np.cos(np.deg2rad(10))])
    np.testing.assert_allclose(rolled[2], [0.0, np.sin(np.deg2rad(10)), np.cos(np.deg2rad(10))])


ROBOTCAR = (
    "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,"
    "velocity_north,roll,pitch,yaw"
)


@pytest.mark.parametrize("is_rad", [True, False])
def test_metres_north_east_and_down_with_headings_from_north(tmp_path: Path, is_rad: bool) -> None:
    """Oxford RobotCar's, whose angles are radians without saying so, or of who says degrees."""
    head = ROBOTCAR if is_rad else ROBOTCAR.replace("roll,pitch,yaw", "roll_deg,pitch_deg,yaw_deg")
    bodies = [(T @ NAMED_EXTRINSICS["flu"].inverse()) for T in map(truth, range(3))]
    lines = [head]
    for stamp, T in zip(stamps(), bodies, strict=False):
        north_east_down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
        ahead_right_down = np.diag([1.0, -1.0, -1.0])
        turn = Rotation.from_matrix(north_east_down @ T.rotation @ ahead_right_down)
        yaw, pitch, roll = turn.as_euler("ZYX", degrees=not is_rad)
        east, north, up = T.translation + np.array([619000.0, 5735000.0, 110.0])
        words = [stamp // 1000, "INS_SOLUTION_GOOD", 51.7, -1.2, 110.0, north, east, -up, "30U"]
        lines.append(",".join(map(str, [*words, 0.0, roll, pitch, yaw])))
    poses = read_poses(written(tmp_path / "ins.csv", "\n".join(lines)))
    assert poses.of_body
    assert poses.time_unit == "us"
    wanted = np.stack([T.as_matrix()[:3] for T in bodies])
    np.testing.assert_allclose(poses.matrices[:, :, :3], wanted[:, :, :3], atol=1e-9)
    moved = poses.matrices[:, :, 3] - [619000.0, 5735000.0, 110.0]
    np.testing.assert_allclose(moved, wanted[:, :, 3], atol=1e-6)


def test_a_cell_that_a_pose_needs_is_not_empty(drive: DriveFiles, tmp_path: Path) -> None:
    table = "time_s,x_m,y_m,z_m,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n2,0,,0,0,0,0,1\n"
    path = written(tmp_path / "a.csv", table)
    with pytest.raises(SemvizError, match=r"a\.csv, line 3: no number in y_m; delete it"):
        read_poses(path)
    path.write_text("0.png\n")
    with pytest.raises(SemvizError, match="0 numbers behind a name"):
        read_poses(path)
    path.write_text("time_s,latitude,longitude,height_m,yaw_deg\n1,49,8,115,3\n")
    with pytest.raises(SemvizError, match="heading_deg, clockwise from north"):
        read_poses(path)


def test_columns_taken_in_another_order_than_their_names_say(tmp_path: Path) -> None:
    head = "time_s,x,y,z,qx,qy,qz,qw"
    path = written(tmp_path / "a.csv", f"{head}\n1,0,0,0,1,0,0,0\n")
    np.testing.assert_array_equal(read_poses(path, "wxyz").matrices[0, :, :3], np.eye(3))
    assert read_poses(path).matrices[0, 1, 1] == -1.0
