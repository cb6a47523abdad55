"""Camera and rig: projection and its inverse, the pixel convention, the stereo baseline."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.camera import MIN_DEPTH_M, Camera, Rig
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

K = np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
PINHOLE = Camera(1241, 376, K)
SKEWED = Camera(640, 480, np.array([[500.0, 2.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]))
DISTORTED = Camera(1241, 376, K, np.array([-0.12, 0.03, 0.001, -0.0005, 0.002]))
CAMERAS = st.sampled_from([PINHOLE, SKEWED, DISTORTED])


@st.composite
def points_in_view(draw: st.DrawFn) -> FloatArray:
    depth = draw(st.floats(1.0, 200.0))
    x, y = draw(st.floats(-0.6, 0.6)), draw(st.floats(-0.25, 0.25))
    return np.array([[x * depth, y * depth, depth]])


@given(CAMERAS, points_in_view())
def test_normalize_undoes_project(camera: Camera, points: FloatArray) -> None:
    plane = camera.normalize(camera.project(points))
    np.testing.assert_allclose(plane, points[:, :2] / points[:, 2:], atol=1e-6)


@given(CAMERAS, points_in_view())
def test_bearing_points_at_the_point(camera: Camera, points: FloatArray) -> None:
    bearing = camera.bearing(camera.project(points))
    np.testing.assert_allclose(np.linalg.norm(bearing, axis=1), 1.0)
    direction = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(bearing, direction, atol=1e-6)


@given(points_in_view())
def test_projection_is_homogeneous(points: FloatArray) -> None:
    np.testing.assert_allclose(PINHOLE.project(points), PINHOLE.project(3.0 * points), rtol=1e-12)


def test_distortion_follows_brown_conrady() -> None:
    x, y = 0.3, -0.1
    k1, k2, p1, p2, k3 = DISTORTED.distortion
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    expected = [K[0, 0] * xd + K[0, 2], K[1, 1] * yd + K[1, 2]]
    np.testing.assert_allclose(DISTORTED.project(np.array([[x, y, 1.0]]))[0], expected, atol=1e-9)


@given(CAMERAS, st.floats(-100.0, MIN_DEPTH_M))
def test_points_behind_project_to_nothing(camera: Camera, depth: float) -> None:
    pixels = camera.project(np.array([[1.0, 1.0, depth], [0.0, 0.0, 5.0]]))
    assert np.isnan(pixels[0]).all()
    assert np.isfinite(pixels[1]).all()


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_nothing_in_nothing_out(camera: Camera) -> None:
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    assert camera.normalize(np.zeros((0, 2))).shape == (0, 2)
    assert camera.bearing(np.zeros((0, 2))).shape == (0, 3)


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    """A camera that sees a w-wide image symmetrically has its centre at (w - 1) / 2."""
    f, w, h = 100.0, 10, 4
    camera = Camera(w, h, np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1.0]]))
    corners = np.array([[-w, -h, 2 * f], [w, h, 2 * f]]) / 1.0
    np.testing.assert_allclose(camera.project(corners), [[-0.5, -0.5], [w - 0.5, h - 0.5]])


def test_contains_reaches_to_the_outer_edges_of_pixels() -> None:
    inside = [[-0.5, -0.5], [0.0, 0.0], [1240.5, 375.5]]
    outside = [[-0.6, 0.0], [0.0, -0.6], [1240.6, 0.0], [0.0, 375.6], [np.nan, np.nan]]
    assert PINHOLE.contains(np.array(inside)).all()
    assert not PINHOLE.contains(np.array(outside)).any()


@pytest.mark.parametrize(
    ("width", "matrix", "message"),
    [
        (0, K, "not positive"),
        (10, -K, "intrinsic"),
        (10, K.T, "intrinsic"),
        (10, K * np.nan, "NaN"),
        (10, K[:2], "shape"),
    ],
)
def test_impossible_cameras_are_refused(width: int, matrix: FloatArray, message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        Camera(width, 10, matrix)


def test_baseline_is_where_the_right_camera_stands() -> None:
    rig = Rig(PINHOLE, PINHOLE, Pose(np.eye(3), np.array([-0.54, 0.01, 0.02])))
    assert rig.baseline_m == pytest.approx(0.54)
    assert Rig(PINHOLE).baseline_m == 0.0


@given(st.floats(-0.3, 0.3))
def test_baseline_is_measured_in_the_left_camera(angle: float) -> None:
    T_left_right = Pose.from_rotvec([0.0, angle, 0.0], [0.5, 0.0, 0.1])
    assert Rig(PINHOLE, PINHOLE, T_left_right.inverse()).baseline_m == pytest.approx(0.5)


def test_swapped_cameras_are_named() -> None:
    with pytest.raises(SemvizError, match=r"swapped: baseline is -0\.54 m"):
        Rig(PINHOLE, PINHOLE, Pose(np.eye(3), np.array([0.54, 0.0, 0.0])))


def test_half_a_stereo_rig_is_refused() -> None:
    with pytest.raises(SemvizError, match="T_right_left"):
        Rig(PINHOLE, PINHOLE)
    with pytest.raises(SemvizError, match="right camera"):
        Rig(PINHOLE, None, Pose.identity())
