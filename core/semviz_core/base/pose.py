"""Rigid transforms (SE(3)) and rotations.

Transforms are named T_target_source: they take source coordinates to target coordinates.
Tangents are left perturbations exp(xi) @ T, translation (m) before rotation (rad). Formulas
cite Barfoot 2017.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True, eq=False)  # eq=False: arrays have no single truth value
class Pose:
    """An element of SE(3): ``x_target = rotation @ x_source + translation``.

    Tangent vectors are (6,): translation (m) first, then rotation (rad). Updates and
    covariances are left perturbations ``exp(tangent) @ T``, so for ``T_camera_map`` they are
    expressed in the camera frame.
    """

    rotation: FloatArray
    """(3, 3) orthonormal, determinant +1."""
    translation: FloatArray
    """(3,) m."""

    def __post_init__(self) -> None:
        rotation = float_array(self.rotation, (3, 3), "rotation")
        if not _is_rotation(rotation):
            raise SemvizError("rotation is not a rotation matrix (R R^T = I, det R = +1)")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", float_array(self.translation, (3,), "translation"))

    @classmethod
    def identity(cls) -> "Pose":
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> "Pose":
        """Return the pose of a (3, 4) or (4, 4) matrix; a rounded rotation is orthonormalized."""
        array = float_array(matrix, (None, None), "pose matrix")
        if array.shape not in ((3, 4), (4, 4)):
            raise SemvizError(f"pose matrix has shape {array.shape}; give 3x4 or 4x4")
        if not (array[3:] == [0.0, 0.0, 0.0, 1.0]).all():
            raise SemvizError("the last row of a 4x4 pose matrix is 0 0 0 1: is it transposed?")
        return cls(nearest_rotation(array[:3, :3]), array[:3, 3])

    @classmethod
    def from_rotvec(cls, rotvec_rad: ArrayLike, translation_m: ArrayLike) -> "Pose":
        """Return the pose of an axis-angle vector (3,) in radians and a translation (3,) in m."""
        rotvec = float_array(rotvec_rad, (3,), "rotvec_rad")
        return cls(so3_exp(rotvec), np.asarray(translation_m))

    @classmethod
    def exp(cls, tangent: ArrayLike) -> "Pose":
        """Return the SE(3) exponential of a (6,) tangent (Barfoot 2017, eq. 7.86)."""
        xi = float_array(tangent, (6,), "tangent")
        return cls(so3_exp(xi[3:]), so3_left_jacobian(xi[3:]) @ xi[:3])

    def log(self) -> FloatArray:
        """Return the (6,) tangent with ``Pose.exp(T.log()) == T``; rotation angle in [0, pi]."""
        rotvec = so3_log(self.rotation)
        return np.concatenate(
            [np.linalg.solve(so3_left_jacobian(rotvec), self.translation), rotvec]
        )

    def __matmul__(self, other: "Pose") -> "Pose":
        """``T_a_b @ T_b_c`` is ``T_a_c``."""
        return Pose(nearest_rotation(self.rotation @ other.rotation), self.apply(other.translation))

    def inverse(self) -> "Pose":
        return self._inverse

    @cached_property
    def _inverse(self) -> "Pose":
        """Cached, since the poses of frames are inverted often."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points_m: FloatArray) -> FloatArray:
        """Return points (..., 3) of the source frame in the target frame."""
        return points_m @ self.rotation.T + self.translation

    def writable(self) -> tuple[FloatArray, FloatArray]:
        """Return copies of rotation and translation for compiled code.

        Read-only arrays are another type to numba: it would compile each function once more.
        """
        return self.rotation.copy(), self.translation.copy()

    def as_matrix(self) -> FloatArray:
        """Return the (4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def as_quaternion(self) -> FloatArray:
        """Return the rotation as (4,) x, y, z, w with w >= 0."""
        from scipy.spatial.transform import Rotation

        quaternion: FloatArray = Rotation.from_matrix(self.rotation).as_quat(canonical=True)
        return quaternion


def heading_rad(T_map_camera: Pose) -> float:
    """Return the heading of a camera's optical axis about the map's z, from x towards y."""
    x, y, _ = T_map_camera.rotation[:, 2]
    return float(np.arctan2(y, x))


def _is_rotation(matrix: FloatArray) -> bool:
    """Whether rows are of length 1, perpendicular, right-handed; in plain Python for speed."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    off = (a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0)
    across = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return bool(max(map(abs, off + across)) <= 1e-6 and determinant > 0.0)


def skew(vector: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix with ``skew(a) @ b == cross(a, b)``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotvec_rad: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation of an axis-angle vector (Rodrigues)."""
    angle = float(np.linalg.norm(rotvec_rad))
    K = skew(rotvec_rad)
    if angle < 1e-6:  # Taylor series; the closed form divides by the angle
        return nearest_rotation(np.eye(3) + K + 0.5 * K @ K)
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + a * K + b * K @ K)


def so3_log(rotation: FloatArray) -> FloatArray:
    """Return the (3,) axis-angle vector in radians, angle in [0, pi]."""
    from scipy.spatial.transform import Rotation

    rotvec: FloatArray = Rotation.from_matrix(rotation).as_rotvec()
    return rotvec


def angle_between(first: FloatArray, second: FloatArray) -> float:
    """Return the angle (rad) between two rotations (3, 3).

    Rotations by an angle a apart have the Frobenius distance sqrt(8) sin(a / 2).
    """
    chord = float(np.linalg.norm(first - second))
    return 2.0 * math.asin(min(chord / math.sqrt(8.0), 1.0))


def so3_left_jacobian(rotvec_rad: FloatArray) -> FloatArray:
    """Return the (3, 3) left Jacobian of SO(3) (Barfoot 2017, eq. 7.77b)."""
    angle = float(np.linalg.norm(rotvec_rad))
    K = skew(rotvec_rad)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * K + K @ K / 6.0
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * K + b * K @ K)


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotation nearest (Frobenius norm, by SVD) to each matrix (..., 3, 3).

    Raise SemvizError if an entry of a matrix is more than 1e-2 from that rotation.
    """
    if not np.isfinite(matrix).all():
        raise SemvizError("rotation holds NaN or infinite numbers")
    U, _, Vt = np.linalg.svd(matrix)
    rotation: FloatArray = U @ Vt
    if np.abs(rotation - matrix).max() > 1e-2:
        raise SemvizError("matrix is not a rotation: it is scaled or sheared")
    if (np.linalg.det(rotation) < 0).any():
        raise SemvizError("matrix is a reflection, not a rotation: left-handed axes?")
    return rotation
