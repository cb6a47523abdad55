"""Lenses, their calibration files, and images made without distortion."""

import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from drive_formats import CALIBRATIONS
from recorded_streets import BROWN, FISHEYE, LENSES, intrinsics, kalibr, seen_through
from streets import street

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.checks.color_checks import check_colors
from semviz_core.datasets.own_drive.images import rectification
from semviz_core.datasets.own_drive.images.rectification import rectify_rig

RATIONAL = OriginalCamera(
    "brown-conrady",
    1280,
    720,
    intrinsics(700.0, 640.3, 355.1),
    np.array([2.1, 0.6, 0.0004, -0.0002, 0.02, 2.4, 1.1, 0.1]),
)
EQUIDISTANT_190 = OriginalCamera(
    "fisheye",
    512,
    512,
    intrinsics(190.98, 254.93, 256.9),
    np.array([0.00348, 0.000715, -0.00205, 0.000203]),
)
"""A fisheye of 160 deg and more."""


@pytest.mark.parametrize("lens", [BROWN, FISHEYE, RATIONAL, EQUIDISTANT_190])
def test_lenses_project_as_opencv_does_and_back(lens: OriginalCamera) -> None:
    pixels = np.random.default_rng(0).uniform(0.15, 0.85, (500, 2)) * [lens.width, lens.height]
    plane = lens.rays(pixels)
    rays = np.column_stack([plane, np.ones(len(plane))])
    np.testing.assert_allclose(lens.project(3.0 * rays), pixels, atol=1e-5)
    project = cv2.fisheye.projectPoints if lens.model == "fisheye" else cv2.projectPoints
    theirs, _ = project(rays[:, None], np.zeros(3), np.zeros(3), lens.K, lens.distortion)
    np.testing.assert_allclose(lens.project(rays), theirs.reshape(-1, 2), atol=1e-9)


def test_a_lens_shows_nothing_where_its_model_folds_back() -> None:
    """k1 = -0.36 alone turns back at a radius of 0.96: farther points would land inside."""
    lens = OriginalCamera(
        "brown-conrady", 1000, 700, intrinsics(500.0, 500.0, 350.0), np.array([-0.36, 0, 0, 0])
    )
    near, far, behind = lens.project(np.array([[0.9, 0, 1.0], [1.3, 0, 1.0], [0.1, 0, -1.0]]))
    assert np.isfinite(near).all()
    assert np.isnan(far).all()
    assert np.isnan(behind).all()


@pytest.mark.parametrize("lens", [BROWN, FISHEYE, RATIONAL, EQUIDISTANT_190])
def test_every_rectified_pixel_has_a_recorded_one_and_leads_back(lens: OriginalCamera) -> None:
    rectification = rectify_rig(OriginalRig(lens)).left
    camera = rectification.camera
    u = np.linspace(0.0, camera.width - 1.0, 60)
    v = np.linspace(0.0, camera.height - 1.0, 40)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    original = rectification.to_original(pixels)
    assert (original >= -0.51).all()
    assert (original <= [lens.width - 0.49, lens.height - 0.49]).all()
    np.testing.assert_allclose(rectification.to_rectified(original), pixels, atol=1e-4)
    assert camera.K[0, 0] == camera.K[1, 1] == pytest.approx(lens.focal_px)


def test_the_view_is_limited_as_asked() -> None:
    across, down = rectify_rig(OriginalRig(EQUIDISTANT_190), 90.0).left.view_deg
    assert across == pytest.approx(90.0, abs=0.5)
    assert down == pytest.approx(90.0, abs=0.5)
    with pytest.raises(SemvizError, match="field of view 170 deg"):
        rectify_rig(OriginalRig(EQUIDISTANT_190), 170.0)


def _shift_px(first: ByteImage, second: ByteImage) -> FloatArray:
    """How far the middle of two images is shifted against each other (Lucas and Kanade)."""
    height, width = first.shape[:2]
    window = np.s_[height // 5 : -height // 5, width // 5 : -width // 5]
    a, b = (
        cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64), (0, 0), 2.0)
        for image in (first, second)
    )
    down, across = (slope[window].ravel() for slope in np.gradient((a + b) / 2.0))
    shift, *_ = np.linalg.lstsq(
        np.column_stack([across, down]), (b - a)[window].ravel(), rcond=None
    )
    return np.asarray(shift)


@pytest.mark.parametrize("name", ["brown", "fisheye"])
@pytest.mark.parametrize("off_px", [0.0, 0.5])
def test_a_rectified_image_is_what_a_pinhole_would_show(name: str, off_px: float) -> None:
    """Half a pixel of principal point, as between COLMAP and OpenCV, is seen.

    Undistortion widens the sides of an image, and that half pixel with them.
    """
    source, lens = street(7, 8), LENSES[name]
    recorded = seen_through(source.image(2, "left"), source.rig.left, lens)
    K = lens.K + np.array([[0.0, 0.0, off_px], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    known = OriginalCamera(lens.model, lens.width, lens.height, K, lens.distortion)
    rectification = rectify_rig(OriginalRig(known)).left
    camera = rectification.camera
    pinhole = OriginalCamera("pinhole", camera.width, camera.height, camera.K, np.zeros(0))
    wanted = seen_through(source.image(2, "left"), source.rig.left, pinhole)
    across, down = np.abs(_shift_px(rectification.rectify(recorded), wanted))
    assert across < 0.06 if not off_px else 0.45 < across < 0.65
    assert down < 0.06


@pytest.mark.parametrize("name", ["pinhole", "brown", "fisheye"])
def test_rows_of_a_turned_pair_agree_after_rectification(name: str) -> None:
    """The right camera is turned by 2 deg about all axes, and sits 3 cm too high."""
    lens = LENSES[name]
    T_right_left = Pose(so3_exp(np.deg2rad([1.5, -1.0, 0.9])), np.array([-0.5, 0.03, 0.02]))
    rectified = rectify_rig(OriginalRig(lens, lens, T_right_left))
    assert rectified.right is not None
    points = np.random.default_rng(0).uniform([-3, -1, 8], [3, 1, 30], (200, 3))
    left = rectified.left.to_rectified(lens.project(points))
    right = rectified.right.to_rectified(lens.project(T_right_left.apply(points)))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    assert seen.sum() > 100
    assert np.abs(left - right)[seen, 1].max() < 1e-4
    np.testing.assert_allclose(  # and the rig tells the same depth
        left[seen, 0] - right[seen, 0],
        rectified.rig.left.K[0, 0]
        * rectified.rig.baseline_m
        / (points[seen] @ rectified.left.R_original_rectified)[:, 2],
        rtol=1e-6,
    )


def test_swapped_cameras_are_told() -> None:
    T_right_left = Pose(so3_exp(np.array([0.0, 0.01, 0.0])), np.array([0.5, 0.0, 0.0]))
    with pytest.raises(SemvizError, match=r"left and right are swapped: baseline is -0\.50 m"):
        rectify_rig(OriginalRig(BROWN, BROWN, T_right_left))


def test_a_rectified_pair_is_left_as_it_is() -> None:
    lens = LENSES["pinhole"]
    pair = OriginalRig(lens, lens, Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
    rectified = rectify_rig(pair)
    assert rectified.left.is_identity
    assert rectified.rig.baseline_m == 0.54


def test_a_matrix_alone_is_a_camera_of_the_size_of_its_images(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    path.write_text("831.5 0 510.6\n0 833.6 391.5\n0 0 1\n")
    (camera,) = read_calibration(path, size=(1024, 768)).cameras
    assert (camera.model, camera.width, camera.height) == ("pinhole", 1024, 768)
    with pytest.raises(SemvizError, match="no size of images"):
        read_calibration(path)
    with pytest.raises(SemvizError, match="far from the middle of images of 512x384: calibrated"):
        read_calibration(path, size=(512, 384))


def test_the_named_coefficients_of_a_fisheye_are_its_own(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    text = CALIBRATIONS["orbslam.yaml"].replace("PinHole", "KannalaBrandt8")
    path.write_text(text.replace("p1:", "k3:").replace("p2:", "k4:"))
    (camera,) = read_calibration(path).cameras
    assert camera.model == "fisheye"
    np.testing.assert_array_equal(camera.distortion, [-0.35, 0.14, 0.0001, 0.00073])
    path.write_text(path.read_text().replace("Camera.type", "Camera.kind"))
    with pytest.raises(SemvizError, match="k1 without p1 and p2, and no lens model"):
        read_calibration(path)


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_all_formats_give_one_camera(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(CALIBRATIONS[name])
    (camera,) = read_calibration(tmp_path / name, size=(1024, 768)).cameras
    assert (camera.model, camera.width, camera.height) == ("brown-conrady", 1024, 768)
    np.testing.assert_array_equal(
        camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], [831.5, 833.6, 510.6, 391.5]
    )
    np.testing.assert_array_equal(camera.distortion, [-0.35, 0.14, 0.0001, 0.00073])


def test_the_name_of_a_kalibr_key_says_the_direction(tmp_path: Path) -> None:
    text = kalibr(BROWN, Pose(np.eye(3), np.array([-0.4, 0.0, 0.0])))
    (tmp_path / "a.yaml").write_text(text)
    (tmp_path / "b.yaml").write_text(text.replace("T_cam_imu", "T_imu_cam"))
    a, b = (read_calibration(tmp_path / f"{name}.yaml").T_body_left for name in "ab")
    assert a is not None
    assert b is not None
    np.testing.assert_allclose((a @ b).as_matrix(), np.eye(4), atol=1e-9)


def test_a_stereo_pair_of_ros_files_has_the_baseline_of_its_projection(tmp_path: Path) -> None:
    text = CALIBRATIONS["ros2.yaml"]
    (tmp_path / "left.yaml").write_text(text)
    (tmp_path / "right.yaml").write_text(text.replace("510.6, 0.0, 0.0, 700", "510.6, -84, 0, 700"))
    found = read_calibration(tmp_path / "left.yaml", tmp_path / "right.yaml").T_right_left
    assert found is not None
    np.testing.assert_allclose(found.translation, [-0.12, 0.0, 0.0])
    with pytest.raises(SemvizError, match="does not say where the right camera is"):
        read_calibration(tmp_path / "left.yaml", tmp_path / "left.yaml")


ROS2, KALIBR = CALIBRATIONS["ros2.yaml"], CALIBRATIONS["kalibr.yaml"]
REFUSED = {
    "MEI": ("a.yaml", "%YAML:1.0\nmodel_type: MEI\nmirror_parameters: {xi: 2.2}\n", "MEI"),
    "seven terms": (
        "a.ini",
        CALIBRATIONS["ros.ini"].replace("0.00073 0.0", "0.00073 0.0 1 1"),
        "7 distortion terms; only 4, 5 and 8",
    ),
    "two cameras": ("a.ini", 2 * CALIBRATIONS["ros.ini"], "several cameras"),
    "two named cameras": (
        "a.yaml",
        CALIBRATIONS["orbslam.yaml"]
        + "".join(f"Camera2.{name}: 500\n" for name in ("fx", "fy", "cx", "cy")),
        "the numbers of several cameras \\(Camera1, Camera2\\)",
    ),
    "rectified and recorded": (
        "a.yaml",
        CALIBRATIONS["orbslam.yaml"] + "LEFT.width: 752\n",
        "the numbers of several cameras",
    ),
    "double sphere": (
        "a.json",
        CALIBRATIONS["named.json"].replace("pinhole-radtan", "ds"),
        "the lens model ds is not read",
    ),
    "FOV": ("a.txt", "Pinhole 800 800 510 390 0.9\n1024 768\n", "the lens model FOV"),
    "relative": ("a.txt", "Pinhole 0.8 1.1 0.5 0.5 0\n1024 768\n", "relative to the size"),
    "omni": (
        "a.yaml",
        CALIBRATIONS["kalibr.yaml"].replace("camera_model: pinhole", "camera_model: omni"),
        "the lens model omni is not read",
    ),
    "polynomial": (
        "a.yaml",
        CALIBRATIONS["ros2.yaml"].replace("plumb_bob", "thin_prism"),
        "the lens model thin_prism is not read",
    ),
    "uncalibrated": (
        "a.yaml",
        CALIBRATIONS["ros2.yaml"].replace("831.5", "0.0"),
        "never calibrated",
    ),
    "short": (
        "a.yaml",
        CALIBRATIONS["kalibr.yaml"].replace("831.5, ", ""),
        "3 numbers, expected 4",
    ),
    "text": ("a.yaml", CALIBRATIONS["kalibr.yaml"].replace("831.5", "fx"), "not numbers"),
    "alias": ("a.yaml", "a: &a [1, 2]\nb: *a\n", "an alias"),
    "python": ("a.yaml", "a: !!python/object/apply:os.system ['true']\n", "not readable as YAML"),
    "deep": ("a.yaml", "a: " + "[" * 60 + "]" * 60, "more than 40 levels"),
    "long": ("a.yaml", "a: [" + "1, " * 200_000 + "]", "more than 0.25 MB"),
    "other": ("a.yaml", "name: somebody\n", "no calibration that is read"),
    "own key": ("a.toml", "sides = 2\n" + CALIBRATIONS["own.toml"], "unknown sides"),
    "half a pair": ("a.toml", CALIBRATIONS["own.toml"] + "[right]\n", "no focal_px"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_named_in_one_line(tmp_path: Path, name: str) -> None:
    file, text, message = REFUSED[name]
    (tmp_path / file).write_text(text)
    with pytest.raises(SemvizError, match=message) as refused:
        read_calibration(tmp_path / file)
    assert "\n" not in str(refused.value)
    assert file in str(refused.value)


def test_a_large_image_is_rectified_in_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, these 4 million pixels took 1 GB, and the largest image that is read 15 GB."""
    K = np.array([[1200.0, 0.0, 999.5], [0.0, 1200.0, 999.5], [0.0, 0.0, 1.0]])
    lens = OriginalCamera("fisheye", 2000, 2000, K, np.array([0.01, 0.0, 0.0, 0.0]))
    image = np.random.default_rng(0).integers(0, 255, (2000, 2000, 3), dtype=np.uint8)
    monkeypatch.setattr(rectification, "_BLOCK_PIXELS", 2**18)
    tracemalloc.start()
    made = rectify_rig(OriginalRig(lens)).left.rectify(image)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 250e6
    monkeypatch.setattr(rectification, "_BLOCK_PIXELS", 2**30)
    np.testing.assert_array_equal(rectify_rig(OriginalRig(lens)).left.rectify(image), made)


SKY, EVENING, CLOUDS = (110, 160, 230), (250, 190, 120), (200, 200, 200)
LEAVES, SUNLIT_LEAVES = (70, 100, 55), (120, 130, 60)


@dataclass(frozen=True)
class Painted:
    """Images with a sky above and leaves below."""

    sky: tuple[int, int, int]
    leaves: tuple[int, int, int]
    rig = Rig(Camera(320, 180, np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 90.0], [0, 0, 1]])))
    map_frame = MapFrame("painted")
    frames = (Frame(0, 0.0, None), Frame(1, 1.0, None))

    def image(self, index: int, side: Side) -> ByteImage:
        image = np.full((180, 320, 3), self.leaves, dtype=np.uint8)
        image[:90] = self.sky
        return image


@pytest.mark.parametrize(
    ("sky", "leaves", "usual", "swapped"),
    [
        (SKY, LEAVES, False, True),
        (EVENING, SUNLIT_LEAVES, None, None),
        (CLOUDS, LEAVES, None, None),
        (SKY, CLOUDS, False, None),
    ],
)
def test_a_blue_sky_and_leaves_tell_swapped_colors(
    sky: tuple[int, int, int],
    leaves: tuple[int, int, int],
    usual: bool | None,
    swapped: bool | None,
) -> None:
    """An orange sky alone may be an evening's."""
    assert check_colors(Painted(sky, leaves)).is_swapped is usual
    assert check_colors(Painted(sky[::-1], leaves[::-1])).is_swapped is swapped
