"""Pose is SE(3): group laws, exponential and logarithm, the left perturbation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.pose import Pose, nearest_rotation, skew, so3_exp, so3_left_jacobian, so3_log
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

NUMBERS = st.floats(-100.0, 100.0)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)


@st.composite
def directions(draw: st.DrawFn) -> FloatArray:
    x, y, z = (draw(st.floats(-1.0, 1.0)) for _ in range(3))
    vector = np.array([x, y, z])
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


@st.composite
def rotation_vectors(draw: st.DrawFn, largest: float = np.pi - 1e-4) -> FloatArray:
    """Small, ordinary and nearly half-turn rotations alike."""
    angle = draw(
        st.one_of(
            st.floats(0.0, largest),
            st.floats(-12.0, -2.0).map(lambda exponent: 10.0**exponent),
            st.floats(1e-4, 1e-2).map(lambda gap: largest - gap),
        )
    )
    return angle * draw(directions())


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    return Pose.from_rotvec(draw(rotation_vectors()), draw(VECTORS))


def assert_same(a: Pose, b: Pose, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=tolerance, rtol=tolerance)


@given(poses(), poses(), poses())
def test_composition_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(poses())
def test_identity_and_inverse(T: Pose) -> None:
    assert_same(T @ Pose.identity(), T)
    assert_same(Pose.identity() @ T, T)
    assert_same(T @ T.inverse(), Pose.identity())
    assert_same(T.inverse() @ T, Pose.identity())


@given(poses(), poses(), VECTORS)
def test_composition_applies_the_right_one_first(a: Pose, b: Pose, point: FloatArray) -> None:
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)


@given(poses(), VECTORS)
def test_matrix_acts_as_apply(T: Pose, point: FloatArray) -> None:
    homogeneous = T.as_matrix() @ np.append(point, 1.0)
    np.testing.assert_allclose(homogeneous[:3], T.apply(point), atol=1e-9)
    assert_same(Pose.from_matrix(T.as_matrix()), T)
    assert_same(Pose.from_matrix(T.as_matrix()[:3]), T)


def test_apply_takes_any_leading_shape() -> None:
    T = Pose.from_rotvec([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    points = np.arange(24.0).reshape(2, 4, 3)
    moved = T.apply(points)
    assert moved.shape == points.shape
    np.testing.assert_allclose(moved[1, 2], T.apply(points[1, 2]))


@given(rotation_vectors(), VECTORS)
def test_exp_and_log_are_inverse(rotvec: FloatArray, rho: FloatArray) -> None:
    tangent = np.concatenate([rho, rotvec])
    np.testing.assert_allclose(Pose.exp(tangent).log(), tangent, atol=1e-6, rtol=1e-7)


@given(poses())
def test_log_and_exp_are_inverse(T: Pose) -> None:
    assert_same(Pose.exp(T.log()), T, 1e-8)


@given(directions())
def test_half_turn_has_a_logarithm(axis: FloatArray) -> None:
    rotation = so3_exp(np.pi * axis)
    rotvec = so3_log(rotation)
    assert np.linalg.norm(rotvec) == pytest.approx(np.pi, abs=1e-6)
    np.testing.assert_allclose(so3_exp(rotvec), rotation, atol=1e-6)


@given(rotation_vectors())
def test_left_jacobian_is_the_derivative_of_exp(rotvec: FloatArray) -> None:
    # exp(phi + d) = exp(J d) exp(phi) to first order
    step = 1e-6
    numeric = np.stack(
        [(so3_log(so3_exp(rotvec + d) @ so3_exp(rotvec).T)) / step for d in step * np.eye(3)],
        axis=1,
    )
    np.testing.assert_allclose(so3_left_jacobian(rotvec), numeric, atol=1e-4)


@given(poses(), st.floats(-1e-3, 1e-3), st.integers(0, 2), VECTORS)
def test_perturbations_are_left_translation_first(
    T: Pose, size: float, axis: int, point: FloatArray
) -> None:
    shift = np.zeros(6)
    shift[axis] = size
    np.testing.assert_allclose(
        (Pose.exp(shift) @ T).apply(point), T.apply(point) + shift[:3], atol=1e-9
    )
    turn = np.zeros(6)
    turn[3 + axis] = size
    moved = T.apply(point)
    np.testing.assert_allclose(
        (Pose.exp(turn) @ T).apply(point),
        moved + np.cross(turn[3:], moved),
        atol=size**2 * (np.abs(moved).sum() + 1.0) + 1e-9,
    )


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-9)


@given(poses())
def test_quaternion_is_unit_with_positive_w_and_turns_points_alike(T: Pose) -> None:
    quaternion = T.as_quaternion()
    xyz, w = quaternion[:3], quaternion[3]
    assert w >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    point = np.array([1.0, -2.0, 3.0])
    turned = point + 2.0 * np.cross(xyz, np.cross(xyz, point) + w * point)
    np.testing.assert_allclose(turned, T.rotation @ point, atol=1e-9)


@given(poses())
def test_rotation_rounded_in_a_text_file_is_made_orthonormal(T: Pose) -> None:
    rounded = np.round(T.as_matrix(), 6)
    R = Pose.from_matrix(rounded).rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, T.rotation, atol=3e-6)


def test_long_products_stay_rotations() -> None:
    step = Pose.from_rotvec([0.3, -0.2, 0.9], [0.0, 0.0, 0.0])
    T = Pose.identity()
    for _ in range(1000):
        T = T @ step
    np.testing.assert_allclose(T.rotation @ T.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([2.0, 2.0, 2.0]), "scaled"),
        (np.diag([1.0, 1.0, -1.0]), "reflection"),
        (np.full((3, 3), np.nan), "NaN"),
    ],
)
def test_what_is_no_rotation_is_refused(matrix: FloatArray, message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        nearest_rotation(matrix)
    with pytest.raises(SemvizError):
        Pose(matrix, np.zeros(3))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(SemvizError, match="3x4 or 4x4"):
        Pose.from_matrix(np.eye(3))
    with pytest.raises(SemvizError, match="translation has shape"):
        Pose(np.eye(3), np.zeros(2))
    with pytest.raises(SemvizError, match="tangent"):
        Pose.exp(np.zeros(5))


def test_a_pose_cannot_be_changed() -> None:
    T = Pose.identity()
    with pytest.raises(ValueError, match="read-only"):
        T.translation[0] = 1.0
