"""A recorded street comes in from bags of ROS as it does from its files."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import KINDS, Kind, bag, put_camera, put_navsat, put_odometry, put_static
from command_line import call
from conftest import skip_or_fail
from recorded_streets import LENSES, START_S, Recording, record
from street_places import geodetic

from semviz.workspace.workspace import Workspace
from semviz_core.base.pose import Pose, angle_between, so3_exp
from semviz_core.datasets.trajectory import T_MAP_WORLD
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = 4
TURNED = so3_exp(np.deg2rad([0.4, -0.7, 0.3]))
T_BASE_LEFT = T_MAP_WORLD @ Pose.from_rotvec([0.02, -0.01, 0.03], [0.3, -0.1, 0.05])


@pytest.fixture(autouse=True)
def _rosbags() -> None:
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        skip_or_fail("rosbags is missing; pip install '.[ros]' brings it")


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(3, StreetOptions(FRAMES))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, street: Street) -> Recording:
    folder = tmp_path_factory.mktemp("recording")
    return record(folder, street, LENSES["brown"], range(FRAMES), TURNED)


def stamped(folder: Path) -> list[tuple[int, Path]]:
    return [(int(path.stem), path) for path in sorted(folder.iterdir())]


def bodies(street: Street) -> list[tuple[int, Pose]]:
    """T_world_base of each frame."""
    found = []
    for frame in street.frames:
        assert frame.T_map_camera is not None
        time_ns = (START_S * 10 + frame.index) * 10**8
        found.append((time_ns, frame.T_map_camera @ T_BASE_LEFT.inverse()))
    return found


def right_in_base(street: Street) -> Pose:
    assert street.rig.T_right_left is not None
    T_left_right = street.rig.T_right_left.inverse() @ Pose(TURNED, np.zeros(3))
    return T_BASE_LEFT @ T_left_right


def write_drive(
    path: Path, kind: Kind, recording: Recording, street: Street, encoding: str | None = None
) -> Path:
    """Both cameras, odometry of ``base_link``, and the cameras' places through a bracket."""
    lens = LENSES["brown"]
    bracket = Pose.from_rotvec([0.1, 0.2, 0.0], [1.0, 0.0, 1.2])
    first_ns = START_S * 10**9
    with bag(path, kind) as (put, types):
        put_camera(put, types, "/left", "left", stamped(recording.left), lens, encoding)
        put_camera(put, types, "/right", "right", stamped(recording.right), lens, encoding)
        put_odometry(put, types, bodies(street), "base_link")
        put_static(
            put, types, first_ns,
            [
                ("base_link", "bracket", bracket),
                ("bracket", "left", bracket.inverse() @ T_BASE_LEFT),
                ("base_link", "right", right_in_base(street)),
            ],
        )  # fmt: skip
    return path


def same_poses(found: Workspace, wanted: Workspace) -> None:
    pairs = zip(found.source.frames, wanted.source.frames, strict=True)
    for frame, other in pairs:
        assert frame.T_map_camera is not None
        assert other.T_map_camera is not None
        turned = angle_between(frame.T_map_camera.rotation, other.T_map_camera.rotation)
        assert turned < 1e-6
        np.testing.assert_allclose(
            frame.T_map_camera.translation, other.T_map_camera.translation, atol=1e-5
        )


@pytest.fixture(scope="module")
def from_files(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Workspace:
    from semviz_core.datasets.own_drive.recorded_drive import read_drive
    from semviz_core.datasets.own_drive.recording import DriveFiles

    drive = read_drive(
        DriveFiles(
            images=recording.left,
            right=recording.right,
            calibration=recording.kalibr,
            poses=recording.poses,
        )
    )
    return Workspace.create_images(tmp_path_factory.mktemp("w") / "files", drive)


@pytest.mark.parametrize(
    ("kind", "encoding"), [*((kind, None) for kind in KINDS), ("ROS 1", "bgr8"), ("MCAP", "rgb8")]
)
def test_a_bag_gives_the_drive_of_its_files(
    tmp_path: Path,
    kind: Kind,
    encoding: str | None,
    recording: Recording,
    street: Street,
    from_files: Workspace,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / ("drive.bag" if kind == "ROS 1" else "drive")
    write_drive(path, kind, recording, street, encoding)
    source = next(path.glob("*.mcap")) if kind == "MCAP" else path
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", source, "--strict")
    assert (code, err) == (0, "")
    assert f"{FRAMES} pairs, by time" in out
    assert "odom Odometry, of a body" in out
    town = Workspace.open(tmp_path / "town")
    same_poses(town, from_files)
    np.testing.assert_allclose(town.source.rig.left.K, from_files.source.rig.left.K, atol=0.01)
    for side in ("left", "right"):
        assert len(list((town.path / "recorded" / side).iterdir())) == FRAMES
    shown = town.source.image(2, "right").astype(int)
    assert np.abs(shown - from_files.source.image(2, "right")).mean() < 1.0
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".town")]


def test_one_camera_of_a_bag_with_the_poses_of_another_topic(
    tmp_path: Path,
    recording: Recording,
    street: Street,
    from_files: Workspace,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A second odometry is refused until one is chosen; a grey image stays grey."""
    path = tmp_path / "drive"
    with bag(path, "MCAP") as (put, types):
        images = stamped(recording.left)
        put_camera(put, types, "/front", "left", images, LENSES["brown"], "mono8")
        put_odometry(put, types, bodies(street), "base_link", "/good")
        put_odometry(put, types, [(images[0][0], Pose.identity())], "base_link", "/other")
        put_static(put, types, images[0][0], [("base_link", "left", T_BASE_LEFT)])
    arguments = ("new", tmp_path / "town", "--images", path)
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert "poses on 2 topics; choose --poses of /good, /other" in err
    code, _, err = call(capsys, *arguments, "--poses", "/good", "--strict")
    assert (code, err) == (0, "")
    town = Workspace.open(tmp_path / "town")
    first = town.source.frames[0].T_map_camera
    assert first is not None
    wanted = street.frames[0].T_map_camera
    assert wanted is not None
    np.testing.assert_allclose(first.as_matrix(), wanted.as_matrix(), atol=1e-6)
    grey = town.source.image(0, "left")
    np.testing.assert_array_equal(grey[:, :, 0], grey[:, :, 2])


@pytest.mark.parametrize("second", [False, True], ids=["one IMU", "two IMUs"])
def test_gnss_and_imu_of_a_bag(
    tmp_path: Path,
    recording: Recording,
    street: Street,
    capsys: pytest.CaptureFixture[str],
    second: bool,
) -> None:
    """The antenna is 0.4 m ahead of and 1 m above the IMU; a second IMU is not mixed with it."""
    T_imu_gps = Pose(np.eye(3), np.array([0.4, 0.0, 1.0]))
    path = tmp_path / "drive.bag"
    other = Pose.from_rotvec([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    with bag(path, "ROS 1") as (put, types):
        put_camera(put, types, "/front", "left", stamped(recording.left), LENSES["brown"])
        for time_ns, T in bodies(street):
            antenna = (T @ T_imu_gps).translation
            put_navsat(put, types, time_ns, geodetic(antenna), T, T @ other if second else None)
        put_static(
            put, types, START_S * 10**9,
            [("imu", "gps", T_imu_gps), ("imu", "left", T_BASE_LEFT)],
        )  # fmt: skip
    options: tuple[str, ...] = ()
    if second:
        said = refusal(capsys, tmp_path, path)
        assert "orientations of 2 IMUs" in said
        assert "--poses /fix,IMU with IMU of /imu, /other_imu" in said
        options = ("--poses", "/fix,/imu")
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", path, "--strict", *options)
    assert (code, err) == (0, "")
    assert "NavSatFix and Imu" in out
    found = [frame.T_map_camera for frame in Workspace.open(tmp_path / "town").source.frames]
    apart = []
    for frame, T in zip(street.frames, found, strict=True):
        assert T is not None
        assert frame.T_map_camera is not None
        apart.append(T.translation - frame.T_map_camera.translation)
    np.testing.assert_allclose(apart - apart[0], 0.0, atol=2e-3)


def test_rectified_images_of_a_bag_are_not_undistorted_again(
    tmp_path: Path, recording: Recording, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    """P is of the images on ``image_rect``, K and D of those on ``image_raw``, of the same node."""
    lens, path = LENSES["brown"], tmp_path / "drive"
    P = np.array([[410.0, 0, lens.K[0, 2], 0], [0, 410.0, lens.K[1, 2], 0], [0, 0, 1, 0]])
    images = stamped(recording.left)
    with bag(path, "MCAP") as (put, types):
        put_camera(put, types, "/front", "left", images, lens, None, "image_raw", P)
        put_camera(put, types, "/front", "left", images, lens, None, "image_rect_color", P)
        put_odometry(put, types, bodies(street), "base_link")
        put_static(put, types, images[0][0], [("base_link", "left", T_BASE_LEFT)])
    for name, says in (("image_rect_color", ", rectified images, pinhole"), ("image_raw", "brown")):
        topic = f"/front/{name}/compressed"
        town = tmp_path / name
        code, out, err = call(capsys, "new", town, "--images", path, "--cameras", topic)
        assert code == 0
        assert ("straight edges bend" in err) == (name == "image_rect_color")  # it does not know
        assert says in out
        K = Workspace.open(town).source.rig.left.K
        assert np.allclose(K, P[:, :3]) == (name == "image_rect_color")


def test_a_node_of_rectified_images_alone_may_leave_the_rotation_at_zero(
    tmp_path: Path, recording: Recording, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, path, images = LENSES["brown"], tmp_path / "drive", stamped(recording.left)
    with bag(path, "MCAP") as (put, types):
        R = np.zeros((3, 3))
        put_camera(put, types, "/front", "left", images, lens, None, "image_rect", R=R)
        put_odometry(put, types, bodies(street), "base_link")
        put_static(put, types, images[0][0], [("base_link", "left", T_BASE_LEFT)])
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", path)
    assert (code, err) == (0, "")
    assert ", rectified images, pinhole" in out


def test_a_rectified_pair_of_a_bag_lies_as_its_projection_matrices_say(
    tmp_path: Path, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    """/tf_static is of the cameras as mounted; R turns these to the axes of rectified images."""
    lens, T_right_left = LENSES["pinhole"], street.rig.T_right_left
    assert T_right_left is not None
    recording = record(tmp_path / "rectified", street, lens, range(2))
    mounted = [so3_exp(np.deg2rad(turn)) for turn in ([0.5, 1.0, -0.4], [-0.3, -2.0, 0.8])]
    places = [T_BASE_LEFT, T_BASE_LEFT @ T_right_left.inverse()]
    path = tmp_path / "drive"
    with bag(path, "MCAP") as (put, types):
        for side, R, T in zip(("left", "right"), mounted, places, strict=True):
            P = np.column_stack([lens.K, np.zeros(3)])
            P[0, 3] = 0.0 if side == "left" else lens.K[0, 0] * T_right_left.translation[0]
            images = stamped(tmp_path / "rectified" / side)
            put_camera(put, types, f"/{side}", side, images, lens, None, "image_rect_color", P, R)
            put_static(put, types, images[0][0], [("base_link", side, T @ Pose(R, np.zeros(3)))])
        put_odometry(put, types, bodies(street), "base_link")
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", path, "--strict")
    assert (code, err) == (0, "")
    assert "rectified    not needed" in out
    town = Workspace.open(tmp_path / "town")
    found = town.source.rig.T_right_left
    assert found is not None
    np.testing.assert_allclose(found.as_matrix(), T_right_left.as_matrix(), atol=1e-9)
    np.testing.assert_array_equal(
        town.source.image(1, "right"), cv2.imread(str(stamped(recording.right)[1][1]))[:, :, ::-1]
    )
    for frame, wanted in zip(town.source.frames, street.frames[:2], strict=True):
        assert frame.T_map_camera is not None
        assert wanted.T_map_camera is not None
        T = frame.T_map_camera.as_matrix()
        np.testing.assert_allclose(T, wanted.T_map_camera.as_matrix(), atol=1e-6)


def refusal(
    capsys: pytest.CaptureFixture[str], folder: Path, source: Path, *options: object
) -> str:
    code, _, err = call(capsys, "new", folder / "town", "--images", source, *options)
    assert code == 2
    assert err.count("\n") == 1
    assert [path.name for path in folder.iterdir() if "town" in path.name] == []
    return err


def test_bags_that_cannot_be_read_are_refused(
    tmp_path: Path, recording: Recording, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, images = LENSES["brown"], stamped(recording.left)
    path = tmp_path / "three"
    with bag(path, "MCAP") as (put, types):
        for name in ("a", "b", "c"):
            put_camera(put, types, f"/{name}", name, images[:1], lens)
    assert "choose one camera or two; --cameras LEFT[,RIGHT] of /a/image" in refusal(
        capsys, tmp_path, path
    )
    assert "no camera /d" in refusal(capsys, tmp_path, path, "--cameras", "/d")
    pair = ("--cameras", "/a/image_raw/compressed,/b/image_raw/compressed")
    assert "does not say where the right camera is" in refusal(capsys, tmp_path, path, *pair)

    path = tmp_path / "bare"
    with bag(path, "MCAP") as (put, types):
        put_camera(put, types, "/a", "a", images[:1], lens)
        put_odometry(put, types, bodies(street), "base_link")
    assert "holds poses of a body" in refusal(capsys, tmp_path, path)

    path = tmp_path / "fix"
    with bag(path, "ROS 2") as (put, types):
        put_camera(put, types, "/a", "a", images[:1], lens)
        put_navsat(put, types, images[0][0], (49.0, 8.4, 115.0), Pose.identity())
    assert "does not connect the antenna 'gps' with the IMU 'imu'" in refusal(
        capsys, tmp_path, path
    )
    assert "no such bag" in refusal(capsys, tmp_path, tmp_path / "missing.mcap")


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags_are_refused(
    tmp_path: Path,
    kind: Kind,
    recording: Recording,
    street: Street,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / ("drive.bag" if kind == "ROS 1" else "drive")
    write_drive(path, kind, recording, street)
    file = path if path.is_file() else next(path.glob("*.[dm]*[3p]"))
    data = file.read_bytes()
    before = data.replace(b"index_pos=" + data.partition(b"index_pos=")[2][:8], BEFORE_START)
    for part in (*cuts(data), *([before] if kind == "ROS 1" else [])):
        file.write_bytes(part)
        refusal(capsys, tmp_path, path)


BEFORE_START = b"index_pos=" + b"\xff" * 8
"""In a bag of ROS 1: its index is before its start."""


def cuts(data: bytes) -> Sequence[bytes]:
    """Nothing, a start, and one with its middle overwritten."""
    third = len(data) // 3
    return b"", data[:third], data[:third] + b"\xff" * third


def test_encodings_that_are_not_read_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = tmp_path / "1700000000000000000.png"
    assert cv2.imwrite(str(image), np.zeros((LENSES["brown"].height, 860, 3), np.uint8))
    path = tmp_path / "drive"
    with bag(path, "MCAP") as (put, types):
        header = types.header(int(image.stem), "a")
        put_camera(put, types, "/b", "b", [(int(image.stem), image)], LENSES["brown"])
        depth = types(
            "sensor_msgs/msg/Image", header=header, height=1, width=1, encoding="32FC1",
            is_bigendian=0, step=4, data=np.zeros(4, np.uint8),
        )  # fmt: skip
        put("/a/image_raw", "sensor_msgs/msg/Image", int(image.stem), depth)
    message = refusal(capsys, tmp_path, path, "--cameras", "/a/image_raw")
    assert "images of encoding '32FC1' are not read, only mono8" in message
