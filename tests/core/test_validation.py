"""What cannot be right in a sequence is refused by name; what is right never is."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.datasets.trajectory import T_MAP_WORLD
from semviz_core.datasets.validation import (
    Calibration,
    check_poses,
    check_sides,
    check_sizes,
    largest_jump,
)
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

K = np.array([[720.0, 0.0, 607.2], [0.0, 720.0, 185.2], [0.0, 0.0, 1.0]])
RIG = Rig(Camera(1241, 376, K), Camera(1241, 376, K), Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
KITTI_SEQUENCES = ["00", "01", "02", "03", "04", "05", "06", "08", "09", "10"]


def framed(poses: list[Pose]) -> tuple[Frame, ...]:
    return tuple(Frame(i, 0.1 * i, pose) for i, pose in enumerate(poses))


def turned_round(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """T_camera_map in place of T_map_camera."""
    return tuple(
        replace(
            frame, T_map_camera=None if frame.T_map_camera is None else frame.T_map_camera.inverse()
        )
        for frame in frames
    )


def drive(
    curvature: float, axis: FloatArray, count: int = 40, start: Pose | None = None
) -> list[Pose]:
    """1 m a frame along ``axis`` of the camera, which turns about its y axis."""
    step = Pose.from_rotvec([0.0, curvature, 0.0], axis)
    poses = [start or Pose.identity()]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return poses


AHEAD, BACKWARDS, ASIDE = (
    np.array([0.0, 0.0, 1.0]),
    np.array([0.0, 0.0, -1.0]),
    np.array([1.0, 0, 0]),
)
ELSEWHERE = Pose.from_rotvec([0.3, 1.0, -0.2], [200.0, 100.0, -30.0])


# -- poses


@given(
    curvature=st.floats(-0.1, 0.1),
    heading=st.floats(-3.0, 3.0),
    place=st.tuples(*[st.floats(-500.0, 500.0)] * 3),
    noise=st.integers(0, 1000),
)
def test_no_drive_ahead_is_refused(
    curvature: float, heading: float, place: tuple[float, float, float], noise: int
) -> None:
    start = Pose.from_rotvec([0.0, heading, 0.0], place)
    rng = np.random.default_rng(noise)
    poses = [
        pose @ Pose.exp(rng.normal(0.0, 0.01, 6)) for pose in drive(curvature, AHEAD, start=start)
    ]
    check_poses(framed(poses))


@given(
    curvature=st.floats(0.02, 0.1),
    right=st.booleans(),
    axis=st.integers(0, 2),
    start=st.sampled_from([Pose.identity(), ELSEWHERE]),
)
def test_inverted_poses_are_refused_wherever_the_camera_looks_and_the_world_is(
    curvature: float, right: bool, axis: int, start: Pose
) -> None:
    """Where the road winds, whatever the world's origin and axes."""
    axis_camera = [AHEAD, BACKWARDS, ASIDE][axis]
    turn = curvature if right else -curvature
    poses = drive(turn, axis_camera, 30, start=start)
    poses += drive(-turn, axis_camera, 30, start=poses[-1])
    poses += drive(0.0, axis_camera, 20, start=poses[-1])
    check_poses(framed(poses))
    for T_map_world in (Pose.identity(), T_MAP_WORLD):
        inverted = turned_round(framed(poses))
        seen = tuple(
            replace(frame, T_map_camera=T_map_world @ frame.T_map_camera) for frame in inverted
        )
        with pytest.raises(SemvizError, match=r"poses are inverted .*Nothing was loaded"):
            check_poses(seen)


def test_on_a_straight_road_inverted_poses_lead_backwards_or_sideways() -> None:
    for start, where in (
        (Pose.identity(), "backwards in 100% of its steps"),
        (Pose.from_rotvec([0.0, np.pi / 2.0, 0.0], [5.0, 0.0, 5.0]), "sideways in 100%"),
    ):
        frames = framed(drive(0.0, AHEAD, start=start))
        check_poses(frames)
        with pytest.raises(SemvizError, match=f"moves {where}.*poses are inverted"):
            check_poses(turned_round(frames))


def test_standing_few_poses_and_none_tell_nothing() -> None:
    still = [Pose.exp(np.full(6, 1e-3 * np.sin(i))) for i in range(50)]
    check_poses(framed(still))
    check_poses(framed(drive(0.0, BACKWARDS, count=4)))
    check_poses((Frame(0, 0.0), Frame(1, 0.1)))
    check_poses(())


def test_a_car_that_backs_out_and_drives_on_is_fine() -> None:
    back = drive(0.05, BACKWARDS, 15)
    check_poses(framed(back + drive(-0.05, AHEAD, 40, start=back[-1])))


def test_a_frame_aside_or_ahead_of_its_neighbours_is_named() -> None:
    """Also where images cannot tell, as with one camera; a car that brakes hard is none."""
    poses = drive(0.01, AHEAD, 60)
    aside = poses[30] @ Pose(np.eye(3), np.array([3.0, 0.0, 0.0]))
    named = "frame 30 is 2.9 m from where a car could be between frames 29 and 31"
    assert largest_jump(framed([*poses[:30], aside, *poses[31:]])) == named
    assert largest_jump(framed(poses)) == largest_jump(framed(poses[:2])) == ""
    braking = [
        Pose(np.eye(3), np.array([0.0, 0.0, -5.0 * (3.0 - 0.1 * i) ** 2])) for i in range(30)
    ]
    assert largest_jump(framed(braking)) == ""


def test_a_jump_is_named_with_its_frames() -> None:
    poses = drive(0.01, AHEAD, 60)
    aside = Pose(np.eye(3), np.array([60.0, 0.0, 70.0]))
    apart = framed(poses[:30] + [aside @ pose for pose in poses[30:]])
    with pytest.raises(
        SemvizError, match=r"poses jump: frame 30 is 9\d\.\d m from frame 29, 0.10 s"
    ):
        check_poses(apart)
    check_poses(tuple(Frame(50 * i, 5.0 * i, Pose(np.eye(3), AHEAD * 75.0 * i)) for i in range(20)))
    check_poses(framed([Pose(np.eye(3), AHEAD * 20.0 * i) for i in range(20)]))  # a coarse street


@pytest.mark.realdata
@pytest.mark.parametrize("sequence", KITTI_SEQUENCES)
def test_kittis_poses_pass_whole_and_in_parts_and_inverted_ones_do_not(
    kitti_root: Path, sequence: str
) -> None:
    table = np.loadtxt(kitti_root / "poses" / f"{sequence}.txt").reshape(-1, 3, 4)
    T_world_camera = [Pose.from_matrix(row) for row in table]
    frames = framed([T_MAP_WORLD @ pose for pose in T_world_camera])
    inverted = framed([T_MAP_WORLD @ pose.inverse() for pose in T_world_camera])
    check_poses(frames)
    assert largest_jump(frames) == ""
    with pytest.raises(SemvizError, match="poses are inverted"):
        check_poses(inverted)
    noticed = []
    for first in range(0, len(frames) - 100, 100):
        check_poses(frames[first : first + 20])
        check_poses(frames[first : first + 100])
        try:
            check_poses(inverted[first : first + 100])
            noticed.append(False)
        except SemvizError:
            noticed.append(True)
    assert np.mean(noticed) > 0.9  # a straight piece that runs against the first frame's heading


@pytest.mark.parametrize("seed", range(10))
def test_simulated_streets_pass_and_their_faults_do_not(seed: int) -> None:
    street = Street(seed, StreetOptions(30))
    check_poses(street.frames)
    check_sizes(street.rig)
    with pytest.raises(SemvizError, match="poses are inverted"):
        check_poses(turned_round(street.frames))
    if seed < 3:  # painting takes time
        check_sides(street)
        with pytest.raises(SemvizError, match="left and right images are swapped"):
            check_sides(Swapped(street))


# -- sides


@dataclass(frozen=True)
class Swapped:
    """A source with its left and right images exchanged."""

    source: Dataset

    @property
    def map_frame(self) -> MapFrame:
        return self.source.map_frame

    @property
    def rig(self) -> Rig:
        return self.source.rig

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.source.frames

    def image(self, index: int, side: Side) -> ByteImage:
        return self.source.image(index, "right" if side == "left" else "left")


@dataclass(frozen=True)
class Pictures(Swapped):
    """The same pair of pictures in each frame, or none."""

    left: ByteImage | None
    right: ByteImage | None

    def image(self, index: int, side: Side) -> ByteImage:
        picture = self.left if side == "left" else self.right
        if picture is None:
            raise SemvizError("no such image")
        return picture


@pytest.mark.realdata
def test_kittis_pairs_pass_and_swapped_ones_do_not(kitti_root: Path) -> None:
    for cameras in ((2, 3),):
        source = KittiSequence(kitti_root, "02", cameras)
        for first in range(0, 20, 5):
            part = replace_frames(source, source.frames[first : first + 5])
            check_sides(part)
            with pytest.raises(
                SemvizError, match=r"swapped: baseline is -0\.53 m by \d+ of \d+ corn"
            ):
                check_sides(Swapped(part))


def replace_frames(source: Dataset, frames: tuple[Frame, ...]) -> Dataset:
    @dataclass(frozen=True)
    class Part(Swapped):
        @property
        def frames(self) -> tuple[Frame, ...]:
            return frames

        def image(self, index: int, side: Side) -> ByteImage:
            return source.image(index, side)

    return Part(source)


def test_pictures_that_tell_nothing_are_no_fault() -> None:
    street = Street(0, StreetOptions(3))
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (376, 1241, 3), dtype=np.uint8) for _ in range(2)]
    grey = np.full((376, 1241, 3), 127, np.uint8)
    comb = np.zeros((376, 1241, 3), np.uint8)
    comb[:, ::24] = 255  # the same everywhere along the row
    small = np.zeros((20, 30, 3), np.uint8)
    for left, right in (noise, (grey, grey), (comb, comb), (None, None), (noise[0], noise[0])):
        check_sides(Pictures(street, left, right))
    tiny = Camera(30, 20, np.array([[50.0, 0.0, 14.5], [0.0, 50.0, 9.5], [0.0, 0.0, 1.0]]))
    rig = Rig(tiny, tiny, RIG.T_right_left)

    @dataclass(frozen=True)
    class Tiny(Pictures):
        @property
        def rig(self) -> Rig:
            return rig

    check_sides(Tiny(street, small, small))


# -- sizes


@pytest.mark.parametrize(
    ("width", "height", "fine"),
    [
        (1241, 376, True),
        (1241, 300, True),  # the sky was cut off
        (1000, 376, True),
        (620, 188, False),
        (930, 282, False),
        (1600, 485, False),
        (2482, 752, False),
        (500, 376, False),  # the principal point is outside
    ],
)
@pytest.mark.parametrize("side", ["left", "right"])
def test_images_of_another_size_than_the_calibrations(
    width: int, height: int, fine: bool, side: Side
) -> None:
    camera = Camera(width, height, K)
    rig = replace(RIG, left=camera) if side == "left" else replace(RIG, right=camera)
    if fine:
        check_sizes(rig)
        return
    with pytest.raises(SemvizError, match=f"{side} images are {width}x{height}, but .* 1214x370"):
        check_sizes(rig)


# -- calibration


def scaled(K: FloatArray, focal: float) -> FloatArray:
    return K @ np.diag([focal, focal, 1.0])


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        (
            Rig(Camera(1241, 376, scaled(K, 1.01)), RIG.right, RIG.T_right_left),
            "focal length 720 -> 727.2 px",
        ),
        (
            replace(RIG, T_right_left=Pose(np.eye(3), np.array([-0.5, 0.0, 0.0]))),
            "baseline 0.5400 -> 0.5000 m",
        ),
        (
            replace(RIG, T_right_left=Pose.from_rotvec([0.0, 0.01, 0.0], [-0.54, 0.0, 0.0])),
            "rotation of the right camera 0.000 -> 0.573 deg",
        ),
        (replace(RIG, left=Camera(620, 188, K)), "left images 1241x376 -> 620x188 px"),
        (replace(RIG, left=Camera(1241, 376, K, np.full(4, 0.01))), "left distortion none -> 0.01"),
        (Rig(RIG.left), "the right camera is gone"),
    ],
)
def test_another_calibration_is_said_in_numbers(rig: Rig, said: str) -> None:
    known, now = Calibration.of(RIG), Calibration.of(rig)
    assert known.hash != now.hash
    assert said in known.differences(now)


@given(st.floats(-2e-4, 2e-4), st.floats(-2e-5, 2e-5))
def test_what_no_label_can_tell_changes_nothing(focal_px: float, baseline_m: float) -> None:
    K_again = K + np.diag([focal_px, focal_px, 0.0])
    T = Pose(np.eye(3), np.array([-0.54 + baseline_m, 0.0, 0.0]))
    again = Rig(Camera(1241, 376, K_again), RIG.right, T)
    assert Calibration.of(again) == Calibration.of(RIG)
