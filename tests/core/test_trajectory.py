"""TUM's and KITTI's formats: exact round trips, axes stated and checked, wrong files named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.trajectory import (
    T_MAP_WORLD,
    TrajectoryFormat,
    load_trajectory,
    save_trajectory,
)

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A level camera that looks along x of a map with z up."""


def frames(*places: FloatArray | None) -> list[Frame]:
    return [
        Frame(index, 0.1 * index, None if place is None else Pose(AHEAD, place))
        for index, place in enumerate(places)
    ]


THREE = frames(np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.25, 1.5]), np.array([2.0, 1.0, 1.75]))


@st.composite
def drives(draw: st.DrawFn) -> list[Frame]:
    """Cameras that lean by less than half a radian, whichever way they look."""
    small, metres = st.floats(-0.4, 0.4), st.floats(-1e4, 1e4)
    made = []
    for index in range(draw(st.integers(1, 5))):
        heading = Pose.from_rotvec([0.0, 0.0, draw(st.floats(-3.0, 3.0))], np.zeros(3))
        lean = Pose.from_rotvec([draw(small), 0.0, draw(small)], np.zeros(3))
        place = np.array([draw(metres) for _ in range(3)])
        pose = Pose(heading.rotation @ AHEAD @ lean.rotation, place)
        made.append(Frame(index, 0.1 * index + draw(st.floats(0.0, 1e-3)), pose))
    return made


@given(drives(), st.sampled_from(["tum", "kitti"]))
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip(tmp_path: Path, drive: list[Frame], format_: TrajectoryFormat) -> None:
    path = tmp_path / "poses.txt"
    save_trajectory(drive, path, format_)
    times_s = np.array([frame.time_s for frame in drive])
    read = load_trajectory(path).of_frames([frame.index for frame in drive], times_s)
    for frame, pose in zip(drive, read, strict=True):
        assert frame.T_map_camera is not None
        assert pose is not None
        np.testing.assert_allclose(
            pose.as_matrix(), frame.T_map_camera.as_matrix(), atol=1e-9, rtol=1e-12
        )


def test_tum_is_the_map_frame_as_it_is(tmp_path: Path) -> None:
    save_trajectory(THREE, tmp_path / "poses.txt", "tum")
    row = np.loadtxt(tmp_path / "poses.txt")[1]
    np.testing.assert_allclose(row[:4], [0.1, 1.0, 0.25, 1.5])
    np.testing.assert_allclose(Rotation.from_quat(row[4:]).as_matrix(), AHEAD, atol=1e-12)


def test_kitti_is_in_kittis_axes(tmp_path: Path) -> None:
    """A level camera that looks ahead is turned by nothing; 1.5 m up is -1.5 m down."""
    save_trajectory(THREE, tmp_path / "poses.txt", "kitti")
    rows = np.loadtxt(tmp_path / "poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows[:, :, :3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(rows[1, :, 3], [-0.25, -1.5, 1.0], atol=1e-12)


def test_frames_without_a_pose(tmp_path: Path) -> None:
    """TUM leaves them out, and they come back without one; KITTI's format cannot."""
    path = tmp_path / "poses.txt"
    holed = frames(np.zeros(3), None, np.ones(3))
    save_trajectory(holed, path, "tum")
    read = load_trajectory(path).of_frames([0, 1, 2], np.array([0.004, 0.1, 0.2]))
    assert [pose is None for pose in read] == [False, True, False]
    before = path.read_bytes()
    with pytest.raises(
        SemvizError, match=r"frame 1 has no pose \(1 of 3 frames have none\), and KITTI"
    ):
        save_trajectory(holed, path, "kitti")
    with pytest.raises(SemvizError, match="no frame has a pose"):
        save_trajectory(frames(None), path, "tum")
    assert path.read_bytes() == before


def test_comments_and_rounded_numbers_are_read(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("# time x y z qx qy qz qw\n\n0.5 1 2 3 -0.4999 0.5 -0.5 0.5001\n")
    (pose,) = load_trajectory(path).T_map_camera
    np.testing.assert_allclose(pose.rotation, AHEAD, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "neither TUM's 8 numbers a line nor KITTI's 12"),
        ("1 2 3\n", "neither TUM's 8 numbers"),
        ("0 1 2 3 -0.5 0.5 -0.5 0.5\n1 2 3\n", "line 2: 3 numbers, expected 8"),
        ("0 1 2 x -0.5 0.5 -0.5 0.5\n", "line 1: could not convert"),
        ("0 1 2 nan -0.5 0.5 -0.5 0.5\n", "line 1: holds NaN"),
        ("0 1 2 3 0 0 0 0\n", "line 1: the last four numbers are not a quaternion"),
        ("0 1 2 3 0 0 0 1\n", "the cameras are not upright"),
        ("1 0 0 0 0 0 1 0 0 -1 0 0\n", "the cameras are not upright"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "line 1: matrix is not a rotation"),
    ],
)
def test_wrong_files_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(SemvizError, match=words) as refused:
        load_trajectory(path)
    assert str(refused.value).startswith(str(path))


def test_files_that_do_not_fit_the_frames(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    with pytest.raises(SemvizError, match="no such file of poses"):
        load_trajectory(path)
    save_trajectory(THREE, path, "kitti")
    read = load_trajectory(path)
    assert read.of_frames([2], np.array([9.0])) == [read.T_map_camera[2]]
    with pytest.raises(SemvizError, match="3 lines, but frame 3 needs line 4"):
        read.of_frames([1, 3], np.array([0.1, 0.3]))
    save_trajectory(THREE, path, "tum")
    with pytest.raises(SemvizError, match=r"no pose is within 0.01 s of a frame: its times are 0"):
        load_trajectory(path).of_frames([0, 1], np.array([1e9, 1e9 + 1]))
    turned = [Frame(0, 0.0, T_MAP_WORLD.inverse() @ Pose(AHEAD, np.zeros(3)))]
    save_trajectory(turned, path, "tum")  # as one who took KITTI's axes for the map's
    with pytest.raises(SemvizError, match="In TUM's format the world's z is up, in KITTI's its y"):
        load_trajectory(path)
