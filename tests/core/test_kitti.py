"""The KITTI reader: geometry against the definition, and every wrong folder named in one line."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.kitti import KittiSequence

WIDTH, HEIGHT, FRAMES = 60, 40, 4
K = np.array([[50.0, 0.0, 29.5], [0.0, 50.0, 19.5], [0.0, 0.0, 1.0]])
CENTERS = np.array([[0, 0, 0], [0.54, 0, 0], [-0.06, 0.001, 0.004], [0.47, -0.003, 0.005]])
"""(4, 3) where cameras 0 to 3 stand in camera 0, as on KITTI's car."""


def numbers(array: FloatArray) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(array))


def pose_of_cam0(index: int) -> Pose:
    return Pose.from_rotvec([0.01 * index, 0.1 * index, 0.0], [0.1 * index, 0.02, 1.5 * index])


def picture(index: int, camera: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """(height, width, 3) red first; red counts frames, blue counts cameras."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = (10 + index, 100, 200 + camera)
    return image


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Sequence 07 with all four cameras."""
    folder = tmp_path / "kitti" / "sequences" / "07"
    for camera in range(4):
        (folder / f"image_{camera}").mkdir(parents=True)
        for index in range(FRAMES):
            image = picture(index, camera)[:, :, ::-1]
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            path = folder / f"image_{camera}" / f"{index:06d}.png"
            assert cv2.imwrite(str(path), image if camera > 1 else grey)
    projections = [K @ np.column_stack([np.eye(3), -center]) for center in CENTERS]
    lines = [f"P{camera}: {numbers(P)}" for camera, P in enumerate(projections)]
    (folder / "calib.txt").write_text("\n".join([*lines, f"Tr: {numbers(np.eye(3, 4))}"]) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(FRAMES)))
    poses = tmp_path / "kitti" / "poses"
    poses.mkdir()
    rows = [numbers(pose_of_cam0(index).as_matrix()[:3]) for index in range(FRAMES)]
    (poses / "07.txt").write_text("\n".join(rows) + "\n")
    return tmp_path / "kitti"


def test_world_is_turned_to_z_up(root: Path) -> None:
    """x forward, y left, z up; a frame's pose is that of its own left camera."""
    source = KittiSequence(root, "07", (2, 3))
    assert source.map_frame.name == "kitti-07"
    for frame in source.frames:
        right, down, forward = pose_of_cam0(frame.index).apply(CENTERS[2])
        assert frame.T_map_camera is not None
        np.testing.assert_allclose(
            frame.T_map_camera.translation, [forward, -right, -down], atol=1e-9
        )
    first = source.frames[0].T_map_camera
    assert first is not None
    np.testing.assert_allclose(first.rotation @ [0, 0, 1], [1, 0, 0], atol=1e-9)  # axis: forward
    np.testing.assert_allclose(first.rotation @ [0, 1, 0], [0, 0, -1], atol=1e-9)  # down


@pytest.mark.parametrize("cameras", [(0, 1), (2, 3), (0, 3), (2, 1)])
def test_a_point_projects_through_frame_and_rig_as_through_kittis_own_matrices(
    root: Path, cameras: tuple[int, int]
) -> None:
    source = KittiSequence(root, "07", cameras)
    point_map = np.array([12.0, 1.0, -0.5])
    point_world = np.array([-point_map[1], -point_map[2], point_map[0]])
    assert source.rig.right is not None
    assert source.rig.T_right_left is not None
    for frame in source.frames:
        assert frame.T_map_camera is not None
        in_left = frame.T_map_camera.inverse().apply(point_map)
        in_right = source.rig.T_right_left.apply(in_left)
        in_cam0 = pose_of_cam0(frame.index).inverse().apply(point_world)
        for camera, model, point in zip(
            cameras, (source.rig.left, source.rig.right), (in_left, in_right), strict=True
        ):
            homogeneous = K @ (in_cam0 - CENTERS[camera])
            np.testing.assert_allclose(
                model.project(point)[0], homogeneous[:2] / homogeneous[2], atol=1e-6
            )


def test_baseline(root: Path) -> None:
    assert KittiSequence(root, "07", (2, 3)).rig.baseline_m == pytest.approx(0.53)
    assert KittiSequence(root, "07", (2,)).rig.right is None


def test_images_are_red_first_and_belong_to_their_side(root: Path) -> None:
    source = KittiSequence(root, "07", (2, 3))
    for index in range(FRAMES):
        np.testing.assert_array_equal(source.image(index, "left"), picture(index, 2))
        np.testing.assert_array_equal(source.image(index, "right"), picture(index, 3))


def test_grey_cameras_give_three_equal_channels(root: Path) -> None:
    image = KittiSequence(root, "07", (0, 1)).image(0, "left")
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert image.dtype == np.uint8
    assert (image == image[:, :, :1]).all()


def test_only_frames_with_a_left_image_are_offered(root: Path) -> None:
    (root / "sequences" / "07" / "image_2" / "000001.png").unlink()
    source = KittiSequence(root, "07")
    assert [frame.index for frame in source.frames] == [0, 2, 3]
    assert [frame.time_s for frame in source.frames] == pytest.approx([0.0, 0.2, 0.3])
    with pytest.raises(SemvizError, match="no frame 1"):
        source.image(1, "left")


def test_frames_are_chosen_by_number(root: Path) -> None:
    source = KittiSequence(root, "07", frames=range(1, 10, 2))
    assert [frame.index for frame in source.frames] == [1, 3]
    assert source.frames[1].T_map_camera is not None
    np.testing.assert_array_equal(source.image(3, "left"), picture(3, 2))


def test_a_sequence_without_poses_is_fine(root: Path) -> None:
    (root / "poses" / "07.txt").unlink()
    assert all(frame.T_map_camera is None for frame in KittiSequence(root, "07").frames)


def test_opening_reads_no_image_but_the_first_header(root: Path) -> None:
    for path in (root / "sequences" / "07").glob("image_[23]/00000[1-9].png"):
        path.write_bytes(b"")
    first = root / "sequences" / "07" / "image_2" / "000000.png"
    first.write_bytes(first.read_bytes()[:30])
    assert KittiSequence(root, "07").rig.left.width == WIDTH


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def line_of(path: Path, number: int, text: str | None) -> None:
    """Put ``text`` in place of a line, or cut the file before it."""
    lines = path.read_text().splitlines()
    lines = lines[: number - 1] if text is None else [*lines[: number - 1], text, *lines[number:]]
    path.write_text("\n".join(lines) + "\n")


SEQUENCE = Path("sequences") / "07"
TWICE = " ".join(["2"] * 12)

WRONG_FOLDERS: list[tuple[str, Callable[[Path], object], str]] = [
    ("root", shutil.rmtree, "kitti: no such folder"),
    ("sequence", lambda r: (r / SEQUENCE).rename(r / "sequences" / "08"), "07.*there are 08"),
    ("no sequences", lambda r: shutil.rmtree(r / "sequences"), "holds no sequences"),
    ("calib", lambda r: (r / SEQUENCE / "calib.txt").unlink(), r"calib\.txt: no such file"),
    ("calib binary", lambda r: (r / SEQUENCE / "calib.txt").write_bytes(b"\xff"), "not a text"),
    ("camera", lambda r: edit(r / SEQUENCE / "calib.txt", "P3:", "Q3:"), r"no camera 3 .*P0, P1"),
    ("calib word", lambda r: edit(r / SEQUENCE / "calib.txt", "P2:", "P2: x"), r"P2: .*'x'"),
    ("calib length", lambda r: edit(r / SEQUENCE / "calib.txt", "P2:", "P2: 1"), "13 numbers"),
    ("folder", lambda r: shutil.rmtree(r / SEQUENCE / "image_3"), "image_3: no such folder"),
    (
        "images",
        lambda r: [path.unlink() for path in (r / SEQUENCE / "image_3").iterdir()],
        "image_3: a folder without images",
    ),
    (
        "numbers",
        lambda r: [
            path.rename(path.with_stem("1")) for path in (r / SEQUENCE / "image_2").iterdir()
        ],
        "image_2: a folder without images",
    ),
    ("times", lambda r: (r / SEQUENCE / "times.txt").unlink(), r"times\.txt: no such file"),
    (
        "times short",
        lambda r: line_of(r / SEQUENCE / "times.txt", 4, None),
        "3 lines.*needs line 4",
    ),
    ("times nan", lambda r: line_of(r / SEQUENCE / "times.txt", 3, "nan"), "line 3: holds NaN"),
    ("times word", lambda r: line_of(r / SEQUENCE / "times.txt", 2, "soon"), "line 2: .*'soon'"),
    ("poses short", lambda r: line_of(r / "poses" / "07.txt", 3, None), "07.txt: 2 lines"),
    ("poses word", lambda r: line_of(r / "poses" / "07.txt", 2, "a " * 12), "line 2: .*'a'"),
    ("poses width", lambda r: line_of(r / "poses" / "07.txt", 2, "1 0 0"), "line 2: 3 numbers"),
    ("poses inf", lambda r: line_of(r / "poses" / "07.txt", 1, "inf " * 12), "line 1: holds NaN"),
    ("poses scaled", lambda r: line_of(r / "poses" / "07.txt", 2, TWICE), "line 2: .*not a rot"),
    (
        "a folder for an image",
        lambda r: [(p := r / SEQUENCE / "image_2" / "000000.png").unlink(), p.mkdir()],
        "000000.png: cannot be read",
    ),
    (
        "no png",
        lambda r: (r / SEQUENCE / "image_2" / "000000.png").write_bytes(b"GIF89a" * 9),
        "not a PNG",
    ),
]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [case[1:] for case in WRONG_FOLDERS],
    ids=[case[0] for case in WRONG_FOLDERS],
)
def test_a_wrong_folder_is_named_in_one_line(
    root: Path, spoil: Callable[[Path], object], message: str
) -> None:
    KittiSequence(root, "07", (2, 3))  # right before it is spoiled
    spoil(root)
    with pytest.raises(SemvizError, match=message) as caught:
        KittiSequence(root, "07", (2, 3))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ((3, 2), r"cameras 3, 2: .*swapped: baseline is -0\.53 m.*Nothing was loaded"),
        ((2, 2), "two different"),
        ((7,), "no camera 7"),
    ],
)
def test_wrong_cameras_are_named(root: Path, cameras: tuple[int, ...], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        KittiSequence(root, "07", cameras)


def test_frames_outside_are_named(root: Path) -> None:
    with pytest.raises(SemvizError, match="there are 0 to 3"):
        KittiSequence(root, "07", frames=range(10, 20))


def test_every_cut_of_an_image_is_noticed(root: Path) -> None:
    path = root / SEQUENCE / "image_2" / "000001.png"
    whole = path.read_bytes()
    source = KittiSequence(root, "07")
    for length in range(0, len(whole), 5):
        path.write_bytes(whole[:length])
        wrong = "not a PNG image" if length < 8 else "the PNG image is cut off"
        with pytest.raises(SemvizError, match=rf"000001\.png: {wrong}"):
            source.image(1, "left")


def test_a_damaged_image_is_noticed(root: Path) -> None:
    path = root / SEQUENCE / "image_2" / "000001.png"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    path.write_bytes(damaged)
    with pytest.raises(SemvizError, match=r"000001\.png: not a readable PNG"):
        KittiSequence(root, "07").image(1, "left")


def test_an_image_of_another_size_is_noticed(root: Path) -> None:
    path = root / SEQUENCE / "image_3" / "000002.png"
    assert cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(SemvizError, match=r"000002\.png: image is 61x40, .*60x40"):
        KittiSequence(root, "07").image(2, "right")


def test_pairs_of_two_sizes_are_noticed_on_opening(root: Path) -> None:
    path = root / SEQUENCE / "image_3" / "000000.png"
    assert cv2.imwrite(str(path), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
    with pytest.raises(SemvizError, match=r"image_3/000000\.png: image is 30x20, .*60x40"):
        KittiSequence(root, "07")
    KittiSequence(root, "07", (2,))


def test_a_missing_right_image_is_named(root: Path) -> None:
    (root / SEQUENCE / "image_3" / "000002.png").unlink()
    with pytest.raises(SemvizError, match=r"image_3/000002\.png: no such image"):
        KittiSequence(root, "07").image(2, "right")
    with pytest.raises(SemvizError, match="one camera"):
        KittiSequence(root, "07", (2,)).image(2, "right")


@pytest.mark.realdata
def test_real_sequence(kitti_root: Path) -> None:
    source = KittiSequence(kitti_root, "02")
    assert [frame.index for frame in source.frames] == list(range(20))
    assert (source.rig.left.width, source.rig.left.height) == (1241, 376)
    assert source.rig.baseline_m == pytest.approx(0.533, abs=0.001)
    assert source.image(19, "right").shape == (376, 1241, 3)
    centers = np.array([pose_of(frame).translation for frame in source.frames])
    assert (np.diff(centers[:, 0]) > 1.0).all()  # drives along +x
    assert np.abs(centers[:, 2]).max() < 0.5  # on a level road


@pytest.mark.realdata
def test_mapped_lamp_posts_stand_where_the_images_show_them(
    kitti_root: Path, kitti_pole_map: Path
) -> None:
    """Poles that others surveyed lie on vertical edges, and on none when moved sideways."""
    poles_velodyne = np.load(kitti_pole_map, allow_pickle=False)["poleparams"][:, :2]
    calibration = (kitti_root / "sequences" / "02" / "calib.txt").read_text()
    Tr = np.array(calibration.split("Tr:")[1].split(), dtype=float).reshape(3, 4)
    heights = np.linspace(-0.5, 2.0, 20)
    stacks = np.array([[x, y, z, 1.0] for x, y in poles_velodyne for z in heights]) @ Tr.T
    points_map = np.stack([stacks[:, 2], -stacks[:, 0], -stacks[:, 1]], axis=1)
    points_map = points_map.reshape(-1, len(heights), 3)

    source = KittiSequence(kitti_root, "02")
    shifts = np.arange(-40, 41)
    edges = [edge_strength(source, frame, points_map, shifts) for frame in source.frames]
    profile = np.concatenate(edges).mean(axis=0)
    assert sum(map(len, edges)) > 50
    assert abs(shifts[profile.argmax()]) <= 1
    assert profile.max() > 2.0 * profile[np.abs(shifts) > 10].max()


def edge_strength(
    source: KittiSequence, frame: Frame, poles_map: FloatArray, shifts: IntArray
) -> FloatArray:
    """(poles in view, shifts) median horizontal gradient along each pole, moved sideways."""
    grey = cv2.cvtColor(source.image(frame.index, "left"), cv2.COLOR_RGB2GRAY)
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_64F, 1, 0, ksize=3))
    poles_camera = pose_of(frame).inverse().apply(poles_map)
    near = ((poles_camera[..., 2] > 5.0) & (poles_camera[..., 2] < 35.0)).all(axis=1)
    pixels = source.rig.left.project(poles_camera[near].reshape(-1, 3))
    u, v = np.rint(pixels).astype(int).reshape(*poles_camera[near].shape[:2], 2).transpose(2, 0, 1)
    inside = (u + shifts.min() >= 0) & (u + shifts.max() < 1241) & (v >= 0) & (v < 376)
    u, v = (values[inside.all(axis=1)][..., None] for values in (u, v))
    strength: FloatArray = np.median(gradient[v, u + shifts], axis=1)
    return strength


def pose_of(frame: Frame) -> Pose:
    assert frame.T_map_camera is not None
    return frame.T_map_camera
