"""Compare the motions of given poses with those measured in the images.

The innovation of a pair of frames is the motion of the given poses beyond that of the images. Its
sigma has two parts: that of the measurement, and that of good poses of this drive, a robust
estimate within limits, so that a drive with many faults does not excuse them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from semviz_core.base.frame import Frame
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.pose_checks.image_motions import ImageMotions
from semviz_core.pose_checks.motion import MOTION, RIG
from semviz_core.pose_checks.one_camera import with_lengths

SIGMA_LEAST = np.repeat([0.002, np.deg2rad(0.005)], 3)
SIGMA_MOST = np.repeat([0.03, np.deg2rad(0.05)], 3)
"""Limits of the error of good poses from frame to frame: m, then rad."""
MAD_TO_SIGMA = 1.4826
_ROUNDS = 20
LIMIT = 25.0
"""chi2 of a pair from which it counts less."""


@dataclass(frozen=True, eq=False)
class DrivePoses:
    """Poses T_map_camera of n frames, as arrays."""

    rotation: FloatArray
    """(n, 3, 3)"""
    center_m: FloatArray
    """(n, 3)"""
    known: BoolArray
    """(n,)"""
    time_s: FloatArray
    """(n,)"""

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> "DrivePoses":
        n = len(frames)
        R, c = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        known = np.array([frame.T_map_camera is not None for frame in frames], dtype=bool)
        for row, frame in enumerate(frames):
            if frame.T_map_camera is not None:
                R[row], c[row] = frame.T_map_camera.rotation, frame.T_map_camera.translation
        return cls(R, c, known, np.array([frame.time_s for frame in frames], dtype=np.float64))

    def __len__(self) -> int:
        return len(self.known)

    @property
    def pair_known(self) -> BoolArray:
        """(n - 1,)"""
        return np.asarray(self.known[:-1] & self.known[1:])

    def motions(self) -> tuple[FloatArray, FloatArray]:
        """Return rotations (n - 1, 3, 3) and translations (n - 1, 3) of T_now_before."""
        inverse = self.rotation.transpose(0, 2, 1)
        R = inverse[1:] @ self.rotation[:-1]
        t = np.einsum("nij,nj->ni", inverse[1:], self.center_m[:-1] - self.center_m[1:])
        return R, t

    def step_m(self) -> FloatArray:
        """(n - 1,) distances from frame to frame."""
        return np.asarray(np.linalg.norm(np.diff(self.center_m, axis=0), axis=1))


BASELINE, RIGHT_U, RIGHT_V = 0, 1, 2
"""Positions of the rig's errors in ``RigErrors.values``."""
LEAST_SYSTEMATIC_PX = 0.01
MIN_IN_PART, LEAST_PARTS, MOST_PARTS = 3, 6, 12
"""Pairs in a part of a drive, and parts, for the spread of the rig's errors."""


@dataclass(frozen=True, eq=False)
class RigErrors:
    """Errors of the stereo calibration, as the whole drive shows them: estimate and covariance."""

    values: FloatArray
    """(3,) logarithm of the true over the calibrated baseline; shift of the right image, px."""
    covariance: FloatArray
    """(3, 3)"""

    right_u_by_half_px: tuple[float, float] = (0.0, 0.0)
    """Shift of the right image along u by the images of each half of the drive alone. A calibration
    has one; their difference is what a simple shift does not explain."""
    by_right_u: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) by how much each value changes with an error of 1 px in the shift along u."""

    @classmethod
    def none(cls) -> "RigErrors":
        return cls(np.zeros(3), np.zeros((3, 3)))

    @property
    def sigma(self) -> FloatArray:
        """(3,) with the systematic part that the two halves of the drive show."""
        first, second = self.right_u_by_half_px
        systematic = max(0.5 * abs(first - second), LEAST_SYSTEMATIC_PX)
        variance = np.diag(self.covariance).copy()
        variance += (self.by_right_u * systematic) ** 2
        return np.asarray(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class PoseComparison:
    """Given poses against images, for the n pairs of consecutive frames."""

    innovation: FloatArray
    """(n, 6) left perturbation of T_now_before, m and rad; 0 where not compared."""
    chi2: FloatArray
    """(n,) of 6 degrees of freedom, 5 with one camera; 0 where not compared."""
    compared: BoolArray
    """(n,)"""
    pose_sigma: FloatArray
    """(6,) of good poses, from frame to frame."""
    rig: RigErrors
    information: FloatArray
    """(n, 6, 6) of the images' motion alone, given the rig."""
    length_information: FloatArray
    """(n, 3, 3) of a translation by the speed around it, where one camera measures and the length
    is that of the given poses; else 0."""

    def information_given(self, held: BoolArray, motion_share: float) -> FloatArray:
        """Return (n, 6, 6) the information of motions if only frames ``held`` keep given poses.

        Between others, one camera's steps are as long as the speed around them tells.
        ``motion_share`` is the variance of the images' motions over the stated one.
        """
        information = self.information / motion_share
        others = ~(held[:-1] & held[1:])
        information[others, :3, :3] += self.length_information[others]
        return information

    @property
    def cost(self) -> float:
        """Twice the negative log-likelihood of the pairs: explanations are compared by it.

        A pair counts up to a limit, so that a few wrong poses are no reason to change all. Good
        poses of another spread are another explanation, so their sigma counts as well.
        """
        chi2 = self.chi2[self.compared]
        spread = 2.0 * np.log(self.pose_sigma / SIGMA_LEAST).sum()
        return float((LIMIT * -np.expm1(-chi2 / LIMIT)).sum() + len(chi2) * spread)


def compare(poses: DrivePoses, motions: ImageMotions) -> PoseComparison:
    """Return the innovations of ``poses``, with the errors of a stereo rig estimated beside them.

    Raise SemvizError if the numbers of frames differ.
    """
    if len(poses) != len(motions) + 1:
        raise SemvizError(f"{len(poses)} poses for {len(motions)} motions; give one more")
    scaled, length_information = motions, np.zeros((len(motions), 3, 3))
    if not motions.has_stereo:
        step_m = poses.motions()[1]
        scaled, length_information = with_lengths(motions, step_m, poses.pair_known, poses.time_s)
    error = _errors(poses, scaled)
    used = poses.pair_known & scaled.is_measured
    sigma = np.sqrt(SIGMA_LEAST * SIGMA_MOST)
    rig, free = RigErrors.none(), motions.has_stereo and bool(used.any())
    weight = used.astype(np.float64)
    alone = _ImagesAlone.of(scaled)
    for _ in range(_ROUNDS):
        if free:
            rig = _rig_errors(scaled, alone, error, sigma, weight)
        innovation, chi2 = _innovations(scaled, alone, error, sigma, rig)
        sigma = _pose_sigma(innovation[used], scaled.has_stereo)
        weight = used / (1.0 + chi2 / LIMIT) ** 2
    innovation, chi2 = _innovations(scaled, alone, error, sigma, rig)
    return PoseComparison(
        np.where(used[:, None], innovation, 0.0),
        np.where(used, chi2, 0.0),
        used,
        sigma,
        rig,
        scaled.information[:, MOTION, MOTION],
        length_information,
    )


def _errors(poses: DrivePoses, motions: ImageMotions) -> FloatArray:
    """Return (n, 6) the poses' motions beyond those about which the images' are linearized."""
    R, t = poses.motions()
    E = R @ motions.rotation.transpose(0, 2, 1)
    return np.column_stack(
        [t - np.einsum("nij,nj->ni", E, motions.translation_m), rotation_vectors(E)]
    )


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return (n, 3) axis-angle vectors of rotations (n, 3, 3), rad."""
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return np.zeros((0, 3))
    vectors: FloatArray = Rotation.from_matrix(rotations).as_rotvec()
    return vectors


@dataclass(frozen=True, eq=False)
class _ImagesAlone:
    """What the images say without poses: the same in each round."""

    rig_information: FloatArray
    """(n, 3, 3) normal equations of the rig, the motions eliminated."""
    rig_linear: FloatArray
    """(n, 3)"""
    motion_covariance: FloatArray
    """(n, 6, 6) given the rig."""

    @classmethod
    def of(cls, motions: ImageMotions) -> "_ImagesAlone":
        H, linear = motions.information, motions.linear
        A, b = _without_motion(H, linear[:, MOTION], linear[:, RIG], np.zeros((6, 6)))
        covariance = np.linalg.pinv(H[:, MOTION, MOTION], rcond=1e-10, hermitian=True)
        return cls(A, b, np.asarray(covariance, dtype=np.float64))

    def right_u_px(self, rows: IntArray, weight: FloatArray) -> float:
        """Return the shift of the right image along u by some pairs."""
        A, b = self.rig_information[rows, RIGHT_U, RIGHT_U], self.rig_linear[rows, RIGHT_U]
        return float((weight[rows] @ b) / max(weight[rows] @ A, 1e-6))


def _rig_errors(
    motions: ImageMotions,
    alone: _ImagesAlone,
    error: FloatArray,
    sigma: FloatArray,
    weight: FloatArray,
) -> RigErrors:
    """Return the rig's errors by weighted least squares over all pairs, motions eliminated."""
    H, linear, S = motions.information, motions.linear, np.diag(sigma**-2)
    A, b = _without_motion(H, linear[:, MOTION] + error @ S, linear[:, RIG], S)
    weak = 1e-2 * np.eye(3)  # where nothing is measured
    covariance = np.linalg.inv(np.einsum("n,nij->ij", weight, A) + weak)
    values = covariance @ (weight @ b)
    by_right_u = covariance[:, RIGHT_U] / covariance[RIGHT_U, RIGHT_U]
    covariance = _with_spread(covariance, weight[:, None] * (b - A @ values))
    first, second = np.array_split(np.arange(len(H)), 2)
    halves = alone.right_u_px(first, weight), alone.right_u_px(second, weight)
    return RigErrors(values, covariance, halves, by_right_u)


def _with_spread(covariance: FloatArray, scores: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) that the drive itself shows, by sums over its parts.

    Errors of poses are not independent from pair to pair: what one pair has too much, the next has
    too little, or they drift. Without enough parts ``covariance`` stays.
    """
    parts = min(len(scores) // MIN_IN_PART, MOST_PARTS)
    if parts < LEAST_PARTS:
        return covariance
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, parts)])
    spread: FloatArray = covariance @ (sums.T @ sums) @ covariance * (parts / (parts - 1.0))
    return spread


def _without_motion(
    H: FloatArray, motion: FloatArray, rig: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return normal equations (n, 3, 3), (n, 3) of the rig with the motions eliminated."""
    across = H[:, MOTION, RIG]
    K = np.linalg.pinv(H[:, MOTION, MOTION] + prior, rcond=1e-12, hermitian=True)
    pull = across.transpose(0, 2, 1) @ K
    return H[:, RIG, RIG] - pull @ across, rig - (pull @ motion[:, :, None])[:, :, 0]


def _innovations(
    motions: ImageMotions,
    alone: _ImagesAlone,
    error: FloatArray,
    sigma: FloatArray,
    rig: RigErrors,
) -> tuple[FloatArray, FloatArray]:
    """Return innovations (n, 6), and their chi2 (n,), given the errors of the rig."""
    A = motions.information[:, MOTION, MOTION]
    pull = motions.linear[:, MOTION] - motions.information[:, MOTION, RIG] @ rig.values
    innovation = error - np.einsum("nij,nj->ni", alone.motion_covariance, pull)
    K = np.linalg.inv(A + np.diag(sigma**-2))
    g = np.einsum("nij,nj->ni", A, innovation)
    own = np.einsum("ni,ni->n", innovation, g)
    chi2 = own - np.einsum("ni,ni->n", g, np.einsum("nij,nj->ni", K, g))
    return innovation, np.maximum(chi2, 0.0)


def _pose_sigma(innovation: FloatArray, has_length: bool) -> FloatArray:
    """Return (6,) the robust spread of innovations (k, 6), one for each kind, within limits."""
    if not len(innovation):
        return SIGMA_LEAST.copy()
    spread = MAD_TO_SIGMA * np.median(np.abs(innovation), axis=0)
    if not has_length:
        spread[:3] = np.min(spread[:3])
    return np.clip(spread, SIGMA_LEAST, SIGMA_MOST)


def rows_of_runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Return first and last row of each run of consecutive True."""
    rows: IntArray = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(first), int(end) - 1) for first, end in zip(rows[::2], rows[1::2], strict=True)]
