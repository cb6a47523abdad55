"""A backdrop lies on the surfaces that the images show, and says what it was made from."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from streets import street

from semviz_annotation.map_formats.mesh import CloudFormat, cloud_format, export_backdrop
from semviz_annotation.mapping import depth_fusion
from semviz_annotation.mapping.backdrop import (
    Backdrop,
    BackdropSource,
    load_backdrop,
    save_backdrop,
)
from semviz_annotation.mapping.depth_fusion import (
    Cloud,
    FusionOptions,
    StereoDepth,
    chosen_frames,
    fuse,
)
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.simulation.street import camera_axes

# A street canyon of planes, whose surfaces are known

HEIGHT_M, WALL_M, END_M = 1.65, 6.0, 40.0
BASELINE_M, LENGTH_PX = 0.5, 240.0
PLANES = (  # normal and distance from the origin: ground, left and right wall, end of the street
    (np.array([0.0, 0.0, 1.0]), 0.0),
    (np.array([0.0, 1.0, 0.0]), WALL_M),
    (np.array([0.0, 1.0, 0.0]), -WALL_M),
    (np.array([1.0, 0.0, 0.0]), END_M),
)
FOCUS = np.array([[LENGTH_PX, 0.0, 199.5], [0.0, LENGTH_PX, 79.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(400, 160, FOCUS)
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0])))


def off_surface_m(points_m: FloatArray) -> FloatArray:
    """(n,) distances from the nearest plane."""
    return np.min([np.abs(points_m @ normal - at) for normal, at in PLANES], axis=0)


def canyon_poses(count: int, step_m: float = 1.0) -> list[Pose]:
    """``T_map_camera`` along x, with small turns."""
    turns = 0.03 * np.sin(np.arange(count))
    places = [np.array([step_m * i, 0.1 * np.sin(i), HEIGHT_M]) for i in range(count)]
    return [Pose(camera_axes(float(a)), at) for a, at in zip(turns, places, strict=True)]


@dataclass(frozen=True, eq=False)
class Canyon:
    """A Dataset of textured planes, rendered exactly; ``screens`` are extra walls, by frame: their
    distance ahead, seen in that frame alone."""

    frames: tuple[Frame, ...]
    screens: dict[int, float]
    rig: Rig = RIG
    map_frame: MapFrame = MapFrame("canyon")  # noqa: RUF009

    def image(self, index: int, side: Side) -> ByteImage:
        frame = next(one for one in self.frames if one.index == index)
        assert frame.T_map_camera is not None
        pose = frame.T_map_camera
        if side == "right":
            pose = pose @ Pose(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
        planes = list(PLANES)
        if index in self.screens:
            planes.append((np.array([1.0, 0.0, 0.0]), pose.translation[0] + self.screens[index]))
        return rendered(pose, planes)


def rendered(pose: Pose, planes: list[tuple[FloatArray, float]]) -> ByteImage:
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    rays = np.column_stack([CAMERA.normalize(pixels), np.ones(len(pixels))]) @ pose.rotation.T
    depth = np.full(len(rays), np.inf)
    color = np.zeros((len(rays), 3))
    for number, (normal, at) in enumerate(planes):
        with np.errstate(divide="ignore"):
            z = (at - pose.translation @ normal) / (rays @ normal)
        hit = (z > 0.1) & (z < depth)
        where = pose.translation + z[hit, None] * rays[hit]
        depth[hit] = z[hit]
        color[hit] = texture(number, where[:, np.abs(normal) < 0.5])
    return color.reshape(CAMERA.height, CAMERA.width, 3).round().astype(np.uint8)


def texture(number: int, at_m: FloatArray) -> FloatArray:
    """(n, 3) smooth noise at places (n, 2) of a plane: grains of about 25 cm."""
    rng = np.random.default_rng(number)
    grains = rng.uniform(20.0, 235.0, (256, 256, 3))
    places = at_m.T / 0.25
    channels = [map_coordinates(one, places, order=1, mode="grid-wrap") for one in grains.T]
    return np.stack(channels, axis=1)


def canyon(count: int = 5, screens: dict[int, float] | None = None) -> Canyon:
    poses = canyon_poses(count)
    frames = tuple(Frame(i, 0.1 * i, pose) for i, pose in enumerate(poses))
    return Canyon(frames, screens or {})


OPTIONS = FusionOptions(farthest_m=15.0)


@pytest.fixture(scope="module")
def cloud(open3d: None) -> Cloud:
    drive = canyon()
    return fuse(drive, chosen_frames(drive.frames), OPTIONS)


def test_points_lie_on_the_surfaces(cloud: Cloud) -> None:
    """Half a pixel of disparity is 0.9 m at 15 m along the ray, and less across surfaces."""
    off_m = off_surface_m(cloud.points_m)
    assert len(off_m) > 10_000
    assert np.median(off_m) < 0.03
    assert np.quantile(off_m, 0.95) < 0.15
    assert off_m.max() < 0.6


def test_points_cover_ground_and_both_walls(cloud: Cloud) -> None:
    x, y, z = cloud.points_m.T
    near = (x > 6.0) & (x < 12.0)
    for on in (np.abs(z) < 0.1, np.abs(y - WALL_M) < 0.1, np.abs(y + WALL_M) < 0.1):
        assert (on & near).sum() > 500


def test_points_have_the_colours_of_their_surfaces(cloud: Cloud) -> None:
    """Averaging over voxels blurs the texture; what is left resembles it."""
    on = np.abs(cloud.points_m[:, 2]) < 0.02
    expected = texture(0, cloud.points_m[on, :2]) / 255.0
    likeness = np.corrcoef(expected.ravel(), cloud.colors[on].ravel())[0, 1]
    assert likeness > 0.8


def test_what_other_frames_look_through_is_left_out(open3d: None) -> None:
    """A screen that stands before the camera in one frame only, such as a passing lorry."""
    drive = canyon(screens={2: 7.0})
    screen_x = canyon_poses(5)[2].translation[0] + 7.0
    depth = StereoDepth(RIG, 15.0).depth_m(drive.image(2, "left"), drive.image(2, "right"))
    assert np.isclose(depth, 7.0, atol=0.3).mean() > 0.5  # the stereo pair does see it
    points = fuse(drive, chosen_frames(drive.frames), OPTIONS).points_m
    floating = (np.abs(points[:, 0] - screen_x) < 0.5) & (off_surface_m(points) > 0.5)
    assert floating.sum() == 0


def test_a_simulated_street_s_points_lie_on_its_ground(open3d: None) -> None:
    """Nothing is below the ground, and the driven lane lies on it."""
    drive = street(7)
    frames = chosen_frames(drive.frames[:4])
    points = fuse(drive, frames, FusionOptions()).points_m
    nearest = drive.layout.road
    along = np.arange(0.0, 60.0, 0.05)
    middle = nearest.at(along, np.zeros(len(along)), np.zeros(len(along)))
    apart = np.linalg.norm(points[:, None, :2] - middle[None, ::20, :2], axis=2)
    row = 20 * apart.argmin(axis=1)
    above_m = points[:, 2] - middle[row, 2]
    lane = (apart.min(axis=1) < 2.0) & (above_m < 1.0)
    assert lane.sum() > 5_000
    assert np.quantile(np.abs(above_m[lane]), 0.95) < 0.12
    assert (above_m < -0.4).mean() < 0.002


def test_the_same_drive_gives_the_same_bytes(open3d: None, tmp_path: Path) -> None:
    drive, files = canyon(3), []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        made = backdrop_of(drive)
        save_backdrop(made, tmp_path / f"{threads}")
        files.append((tmp_path / f"{threads}").read_bytes())
    cv2.setNumThreads(-1)
    assert files[0] == files[1]


def backdrop_of(drive: Canyon, options: FusionOptions = OPTIONS) -> Backdrop:
    frames = chosen_frames(drive.frames)
    source = BackdropSource.of(drive.map_frame, drive.rig, frames, options)
    return Backdrop.of(fuse(drive, frames, options), source)


@pytest.mark.parametrize("most", [1000, 5000])
def test_points_are_capped_by_larger_voxels(open3d: None, most: int) -> None:
    made = backdrop_of(canyon(3), replace(OPTIONS, max_points=most))
    assert 0.5 * most < len(made) <= most
    assert made.spacing_m > OPTIONS.voxel_m


def test_long_drives_are_thinned_on_the_way(
    open3d: None, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With hardly any memory the points are fewer, and lie on the surfaces as before."""
    monkeypatch.setattr(depth_fusion, "BUFFER", 5_000)
    monkeypatch.setattr(depth_fusion, "KEPT", 8_000)
    drive = canyon()
    options = replace(OPTIONS, max_points=8_000)
    points = fuse(drive, chosen_frames(drive.frames), options).points_m
    assert 3_000 < len(points) <= 8_000
    assert np.quantile(off_surface_m(points), 0.95) < 0.2


def test_progress_can_stop_it(open3d: None) -> None:
    seen: list[tuple[str, int, int]] = []

    def stop_at_two(what: str, done: int, of: int) -> None:
        seen.append((what, done, of))
        if done == 2:
            raise KeyboardInterrupt

    drive = canyon()
    with pytest.raises(KeyboardInterrupt):
        fuse(drive, chosen_frames(drive.frames), OPTIONS, stop_at_two)
    assert seen == [("matching", done, 5) for done in range(3)]


# Which frames, which rigs


def test_frames_without_a_pose_and_at_rest_are_left_out() -> None:
    poses = canyon_poses(4)
    kept = [Frame(3 * i, 0.1 * i, pose) for i, pose in enumerate(poses)]
    more = [Frame(1, 0.02), Frame(4, 0.12, poses[1]), Frame(5, 0.13)]
    frames = sorted([*kept, *more], key=lambda one: one.index)
    assert [one.index for one in chosen_frames(frames)] == [0, 3, 6, 9]


def test_one_place_is_not_enough() -> None:
    pose = canyon_poses(1)[0]
    with pytest.raises(SemvizError, match="needs 2 or more"):
        chosen_frames([Frame(0, 0.0, pose), Frame(1, 0.1, pose), Frame(2, 0.2)])


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        (Rig(CAMERA), "one camera"),
        (Rig(CAMERA, CAMERA, Pose.from_rotvec([0, 0.02, 0], [-0.5, 0, 0])), "not rectified"),
        (Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.5, 0.1, 0]))), "not rectified"),
        (Rig(replace(CAMERA, distortion=[0.1, 0, 0, 0]), CAMERA, RIG.T_right_left), "rectified"),
        (Rig(CAMERA, replace(CAMERA, K=FOCUS * [[2], [2], [1]]), RIG.T_right_left), "rectified"),
    ],
)
def test_a_rig_that_cannot_be_matched_is_refused(rig: Rig, said: str) -> None:
    with pytest.raises(SemvizError, match=said):
        StereoDepth(rig, 25.0)


def test_another_principal_point_on_the_right_shifts_no_depth() -> None:
    """The disparity at infinity is then that of the principal points."""
    drive = canyon(1)
    left, right = drive.image(0, "left"), drive.image(0, "right")
    plain = StereoDepth(RIG, 15.0).depth_m(left, right)
    K = FOCUS.copy()
    K[0, 2] -= 6.0  # the same image, cut 6 px further to the right
    moved = np.roll(right, -6, axis=1)
    shifted = StereoDepth(Rig(CAMERA, replace(CAMERA, K=K), RIG.T_right_left), 15.0)
    other = shifted.depth_m(left, moved)
    both = np.isfinite(plain) & np.isfinite(other)
    assert both.mean() > 0.3
    apart_px = LENGTH_PX * BASELINE_M * np.abs(1.0 / plain[both] - 1.0 / other[both])
    assert np.quantile(apart_px, 0.98) < 0.2


# The file


def small(options: FusionOptions = OPTIONS) -> Backdrop:
    rng = np.random.default_rng(5)
    drive = canyon(3)
    source = BackdropSource.of(drive.map_frame, drive.rig, drive.frames, options)
    points = rng.normal(0.0, 10.0, (50, 3))
    return Backdrop.of(Cloud(points, rng.uniform(0.0, 1.0, (50, 3)), 0.06), source)


def test_a_file_gives_back_what_was_written(tmp_path: Path) -> None:
    made, file = small(), tmp_path / "backdrop"
    save_backdrop(made, file)
    back = load_backdrop(file)
    np.testing.assert_array_equal(back.points_m, made.points_m)
    np.testing.assert_array_equal(back.colors, made.colors)
    assert back.spacing_m == made.spacing_m
    assert back.source.is_same(made.source)
    assert made.source.is_same(back.source)


def test_a_flipped_bit_never_gives_another_backdrop(tmp_path: Path) -> None:
    made, file, rng = small(), tmp_path / "backdrop", np.random.default_rng(5)
    save_backdrop(made, file)
    whole, refused = file.read_bytes(), 0
    for _ in range(200):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        file.write_bytes(changed)
        try:
            back = load_backdrop(file)
        except SemvizError:
            refused += 1
            continue
        np.testing.assert_array_equal(back.points_m, made.points_m)
        np.testing.assert_array_equal(back.colors, made.colors)
        assert (back.spacing_m, back.source.is_same(made.source)) == (made.spacing_m, True)
    assert refused > 150


def another(change: Callable[[BackdropSource], BackdropSource]) -> BackdropSource:
    return change(small().source)


@pytest.mark.parametrize(
    "other",
    [
        small(replace(OPTIONS, max_points=5000)).source,
        another(lambda one: replace(one, frames=one.frames + 1)),
        another(lambda one: replace(one, frames=one.frames[:2], poses=one.poses[:2])),
        another(lambda one: replace(one, poses=one.poses + 0.01)),
        another(lambda one: replace(one, method=one.method + 1)),
        another(lambda one: replace(one, calibration="another")),
    ],
)
def test_what_gives_another_backdrop_is_not_the_same(other: BackdropSource) -> None:
    assert not small().source.is_same(other)


def test_a_drive_that_has_not_changed_needs_no_new_backdrop() -> None:
    drive = canyon(3)
    assert small().source.change(drive.map_frame, drive.rig, drive.frames) == ""
    fewer = [drive.frames[1], Frame(9, 0.9, Pose.identity()), Frame(0, 0.0)]
    assert small().source.change(drive.map_frame, drive.rig, fewer) == ""


def test_what_has_changed_is_named() -> None:
    drive, source = canyon(3), small().source
    place = drive.map_frame, drive.rig
    moved = Pose.exp([0.002, 0, 0, 0, 0, 0]) @ canyon_poses(3)[1]
    frames = (drive.frames[0], replace(drive.frames[1], T_map_camera=moved))
    assert source.change(*place, frames) == "the pose of frame 1 has changed"
    turned = Pose.exp([0, 0, 0, 0, 0, 1e-4]) @ canyon_poses(3)[1]
    frames = (drive.frames[0], replace(drive.frames[1], T_map_camera=turned))
    assert "frame 1" in source.change(*place, frames)
    there = source.change(MapFrame("canyon-slam"), drive.rig, drive.frames)
    assert there == "it is in the map frame canyon, not canyon-slam"
    wider = replace(RIG, T_right_left=Pose(np.eye(3), np.array([-0.6, 0.0, 0.0])))
    assert "calibration" in source.change(drive.map_frame, wider, drive.frames)
    old = replace(source, method=source.method - 1)
    assert "another version" in old.change(*place, drive.frames)


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "missing"])
def test_a_damaged_file_is_refused(tmp_path: Path, damage: str) -> None:
    file = tmp_path / "backdrop"
    save_backdrop(small(), file)
    content = file.read_bytes()
    spoiled = {"cut": content[: len(content) // 2], "empty": b"", "text": b"points: 3"}
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(spoiled[damage])
    with pytest.raises(SemvizError, match="make it again"):
        load_backdrop(file)


# Other tools


@pytest.mark.parametrize("form", ["ply", "pcd"])
def test_open3d_reads_what_is_exported(open3d: None, tmp_path: Path, form: CloudFormat) -> None:
    made, file = small(), tmp_path / f"cloud.{form}"
    export_backdrop(made, file, cloud_format(file, None))
    import open3d as library

    found = library.io.read_point_cloud(str(file))
    np.testing.assert_array_equal(np.asarray(found.points, dtype=np.float32), made.points_m)
    np.testing.assert_array_equal(np.rint(255.0 * np.asarray(found.colors)), made.colors)


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match="--format"):
        cloud_format(tmp_path / "cloud.xyz", None)
    assert cloud_format(tmp_path / "cloud.xyz", "pcd") == "pcd"
