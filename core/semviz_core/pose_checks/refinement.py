"""Refine poses by the motions measured in the images.

Pairs of frames whose given motion is far from the measured one cut the drive into segments. Poses
of the longest segment stay; so do those of others of two frames or more that the measured motions
reach again. The rest is chained from the images. Then all poses are adjusted by sparse least
squares on SE(3): measured motions, and robust priors on the given poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.pose_checks.comparison import (
    MAD_TO_SIGMA,
    DrivePoses,
    PoseComparison,
    rotation_vectors,
    rows_of_runs,
)
from semviz_core.pose_checks.image_motions import ImageMotions
from semviz_core.pose_checks.variance_components import variance_components

CUT_CHI2 = 30.0
CUT_M, CUT_RAD = 0.03, float(np.deg2rad(0.03))
"""A pair cuts the drive if its chi2 and one of its innovations are larger."""
CUT_PAIRS = (1, 5)
"""So do so many in a row by their sum: in it, errors of poses between cancel, but a drift grows."""
LONG_FRAMES = 25
"""A segment that is not reached again but is as long as this moves as a whole."""
REACHED_SIGMAS, SPREAD_SIGMAS = 4.0, 3.0
PRIOR_LEAST = np.repeat([0.01, np.deg2rad(0.02)], 3)
PRIOR_MOST = np.repeat([0.08, np.deg2rad(0.1)], 3)
"""Limits of the sigma of a good given pose: m, then rad."""
DRIFT_SHARE, DRIFT_RAD = 0.006, float(np.deg2rad(0.008))
"""Errors of chained motions: share of the length; rad of one, growing with the root of their
number. Those of good poses come on top."""
_ROUNDS = 12
_GEMAN = 1.5


@dataclass(frozen=True, eq=False)
class PoseRefinement:
    """Refined poses of n frames, and what they are worth."""

    poses: DrivePoses
    turn_rad: FloatArray
    """(n, 3) axis-angle of the given poses beyond the refined ones, in camera axes."""
    shift_m: FloatArray
    """(n, 3) given camera centres beyond the refined ones, in refined camera axes."""
    sigma_m: FloatArray
    """(n,) of the refined position, the largest axis."""
    sigma_rad: FloatArray
    """(n,) of the refined rotation, the largest axis."""
    held: BoolArray
    """(n,) whether the given pose counts; else images alone place the frame."""
    good_sigma: FloatArray
    """(6,) of good given poses: m, then rad."""


def refine(poses: DrivePoses, motions: ImageMotions, comparison: PoseComparison) -> PoseRefinement:
    """Return refined poses, near the given ones wherever those agree with the images.

    Frames without a pose stay without.
    """
    measured = _corrected_motions(poses, motions, comparison)
    start, held = _joined(poses, measured, comparison)
    prior = np.sqrt(PRIOR_LEAST * PRIOR_MOST)
    adjusted, weight = start, held.astype(np.float64)
    for round_ in range(_ROUNDS):
        counts = weight > 0.25
        good = comparison.compared & counts[:-1] & counts[1:]
        share = variance_components(comparison, good).motion_share
        told = replace(comparison, information=comparison.information_given(held, share))
        adjusted = _adjusted(adjusted, start, measured, told, prior, weight)
        off = _deviations(start, adjusted)
        prior = _prior_sigma(off[held & start.known])
        chi2 = ((off / prior) ** 2).sum(axis=1)
        softness = _GEMAN * 4.0 ** max(3 - round_, 0)  # first all frames, then those that agree
        weight = held / (1.0 + chi2 / (6.0 * softness)) ** 2
    sigma = _sigmas(adjusted, measured, told, prior, weight)
    off = _deviations(poses, adjusted)
    return PoseRefinement(
        adjusted,
        np.where(adjusted.known[:, None], off[:, 3:], 0.0),
        np.where(adjusted.known[:, None], off[:, :3], 0.0),
        sigma[:, 0],
        sigma[:, 1],
        counts,
        prior,
    )


def _corrected_motions(
    poses: DrivePoses, motions: ImageMotions, comparison: PoseComparison
) -> Sequence[Pose | None]:
    """Return T_now_before of each pair as the images measure it; None where they do not."""
    R, t = poses.motions()
    back = comparison.innovation
    out: list[Pose | None] = []
    for row in range(len(motions)):
        if not comparison.compared[row]:
            out.append(None)
            continue
        turn = so3_exp(-back[row, 3:])
        out.append(Pose(turn, -turn @ back[row, :3]) @ Pose(R[row], t[row]))
    return out


def _joined(
    poses: DrivePoses, measured: Sequence[Pose | None], comparison: PoseComparison
) -> tuple[DrivePoses, BoolArray]:
    """Return poses without cuts, and (n,) which frames keep their given poses."""
    segments = _segments(_cuts(comparison))
    longest = max(range(len(segments)), key=lambda row: segments[row][1] - segments[row][0])
    held = poses.known.copy()
    joined = _Chain(poses, measured, held, comparison.pose_sigma)
    for segment in segments[longest + 1 :]:
        joined.continue_to(segment, 1)
    for segment in segments[:longest][::-1]:
        joined.continue_to(segment, -1)
    return joined.result()


def _cuts(comparison: PoseComparison) -> BoolArray:
    """Return (n,) the pairs that cut the drive, alone or with their neighbours."""
    cut = np.zeros(len(comparison.compared), dtype=bool)
    covariance = np.linalg.pinv(comparison.information, rcond=1e-10, hermitian=True)
    for pairs in CUT_PAIRS:
        if len(cut) < pairs:
            continue
        windows = [
            sliding_window_view(values, pairs, axis=0)
            for values in (comparison.innovation, covariance, comparison.compared & ~cut)
        ]
        off, S = windows[0].sum(axis=-1), windows[1].sum(axis=-1)
        S = S + np.diag(comparison.pose_sigma**2)
        chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(S, off[:, :, None])[:, :, 0])
        large = np.linalg.norm(off[:, :3], axis=1) > CUT_M
        large |= np.linalg.norm(off[:, 3:], axis=1) > CUT_RAD
        found = np.flatnonzero((chi2 > CUT_CHI2) & large & windows[2].all(axis=-1))
        cut[(found[:, None] + np.arange(pairs)).ravel()] = True
    return cut


def _segments(cut: BoolArray) -> list[tuple[int, int]]:
    """Return first and last frame of each stretch between cuts (n - 1,)."""
    edges = np.flatnonzero(cut)
    firsts, lasts = [0, *(edges + 1).tolist()], [*edges.tolist(), len(cut)]
    return list(zip(firsts, lasts, strict=True))


class _Chain:
    """Poses that are chained outwards from the longest segment."""

    def __init__(
        self,
        poses: DrivePoses,
        measured: Sequence[Pose | None],
        held: BoolArray,
        pose_sigma: FloatArray,
    ) -> None:
        self._sigma = pose_sigma
        self._given = poses
        self._measured = measured
        self._R, self._c = poses.rotation.copy(), poses.center_m.copy()
        self._held = held
        self._chained = 0
        self._length_m = 0.0

    def continue_to(self, segment: tuple[int, int], direction: int) -> None:
        """Keep, move or replace the poses of the next segment, forwards (1) or backwards (-1).

        A single frame is replaced: in a drift it agrees with the one before, and so on.
        """
        first, last = segment
        rows = list(range(first, last + 1))[::direction]
        entry, before = rows[0], rows[0] - direction
        reached = self._stepped(before, entry)
        self._chained += 1
        if reached is None or not self._given.known[entry]:
            return
        self._length_m += float(np.linalg.norm(reached.translation - self._c[before]))
        if len(rows) > 1 and self._agrees(reached, entry):
            self._chained, self._length_m = 0, 0.0
            return
        if len(rows) >= LONG_FRAMES:
            moved = reached @ self._given_pose(entry).inverse()
            for row in rows:
                self._set(row, moved @ self._given_pose(row))
            return
        self._set(entry, reached)
        self._held[entry] = False
        for row in rows[1:]:
            previous = row - direction
            there = self._stepped(previous, row)
            if there is not None:
                self._length_m += float(np.linalg.norm(there.translation - self._c[previous]))
                self._set(row, there)
            self._held[row] = False
            self._chained += 1

    def result(self) -> tuple[DrivePoses, BoolArray]:
        joined = replace(self._given, rotation=self._R, center_m=self._c)
        return joined, self._held & self._given.known

    def _given_pose(self, row: int) -> Pose:
        return Pose(self._given.rotation[row], self._given.center_m[row])

    def _set(self, row: int, pose: Pose) -> None:
        self._R[row], self._c[row] = pose.rotation, pose.translation

    def _stepped(self, before: int, now: int) -> Pose | None:
        """Return T_map_camera of ``now``, one frame before or after ``before``."""
        T_map_before = Pose(self._R[before], self._c[before])
        step = self._measured[min(before, now)]
        if step is None:
            return None
        return T_map_before @ (step.inverse() if now > before else step)

    def _agrees(self, reached: Pose, row: int) -> bool:
        """Whether the given pose is where the chain arrives, within the chain's errors."""
        count, length = self._chained, self._length_m
        shift = float(np.linalg.norm(reached.translation - self._given.center_m[row]))
        turn = reached.rotation.T @ self._given.rotation[row]
        angle = float(np.linalg.norm(rotation_vectors(turn[None])[0]))
        drift = DRIFT_RAD * np.sqrt(count)
        sigma_rad = drift + float(self._sigma[3:].max())
        sigma_m = 2.0 * float(self._sigma[:3].max()) + (DRIFT_SHARE + drift / 2.0) * length
        return bool(angle < REACHED_SIGMAS * sigma_rad and shift < REACHED_SIGMAS * sigma_m)


def _deviations(poses: DrivePoses, refined: DrivePoses) -> FloatArray:
    """Return (n, 6) poses beyond refined ones, in refined camera axes: m, then rad."""
    inverse = refined.rotation.transpose(0, 2, 1)
    shift = np.einsum("nij,nj->ni", inverse, poses.center_m - refined.center_m)
    return np.asarray(np.column_stack([shift, rotation_vectors(inverse @ poses.rotation)]))


def _prior_sigma(off: FloatArray) -> FloatArray:
    if not len(off):
        return np.asarray(np.sqrt(PRIOR_LEAST * PRIOR_MOST))
    spread = MAD_TO_SIGMA * np.median(np.abs(off), axis=0)
    return np.asarray(np.clip(spread, PRIOR_LEAST, PRIOR_MOST))


def _normals(
    at: DrivePoses,
    start: DrivePoses,
    measured: Sequence[Pose | None],
    comparison: PoseComparison,
    prior: FloatArray,
    weight: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return diagonal (n, 6, 6), upper blocks (n - 1, 6, 6) and right side (n, 6).

    Unknowns are right perturbations of T_map_camera, in camera axes.
    """
    n = len(at)
    off = _deviations(start, at)
    diagonal = np.zeros((n, 6, 6)) + 1e-6 * np.eye(6)
    diagonal += weight[:, None, None] * np.diag(prior**-2)
    right = weight[:, None] * off / prior**2
    upper = np.zeros((max(n - 1, 0), 6, 6))
    for row, step in enumerate(measured):
        if step is None:
            continue
        before = Pose(at.rotation[row], at.center_m[row])
        now = Pose(at.rotation[row + 1], at.center_m[row + 1])
        T = now.inverse() @ before
        error = (T @ step.inverse()).log()
        A = comparison.information[row]
        J = adjoint(T)  # of ``before``; that of ``now`` is -1
        diagonal[row] += J.T @ A @ J
        diagonal[row + 1] += A
        upper[row] -= J.T @ A
        right[row] -= J.T @ A @ error
        right[row + 1] += A @ error
    return diagonal, upper, right


def block_tridiagonal(diagonal: FloatArray, upper: FloatArray) -> coo_matrix:
    """Return the symmetric (6 n, 6 n) with blocks (n, 6, 6) and, beside them, (n - 1, 6, 6)."""
    n = len(diagonal)
    rows, columns, values = [], [], []
    grid_i, grid_j = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
    for blocks, i, j in (
        (diagonal, np.arange(n), np.arange(n)),
        (upper, np.arange(n - 1), np.arange(1, n)),
        (upper.transpose(0, 2, 1), np.arange(1, n), np.arange(n - 1)),
    ):
        rows.append((6 * i[:, None, None] + grid_i).ravel())
        columns.append((6 * j[:, None, None] + grid_j).ravel())
        values.append(blocks.ravel())
    place = np.concatenate(rows), np.concatenate(columns)
    return coo_matrix((np.concatenate(values), place), shape=(6 * n, 6 * n))


def _adjusted(
    at: DrivePoses,
    start: DrivePoses,
    measured: Sequence[Pose | None],
    comparison: PoseComparison,
    prior: FloatArray,
    weight: FloatArray,
) -> DrivePoses:
    """Return the poses after one step of Gauss and Newton."""
    diagonal, upper, right = _normals(at, start, measured, comparison, prior, weight)
    step = splu(block_tridiagonal(diagonal, upper).tocsc()).solve(right.ravel()).reshape(-1, 6)
    R = at.rotation @ np.array([so3_exp(turn) for turn in step[:, 3:]])
    c = at.center_m + np.einsum("nij,nj->ni", at.rotation, step[:, :3])
    return replace(at, rotation=R, center_m=c)


def _sigmas(
    at: DrivePoses,
    measured: Sequence[Pose | None],
    comparison: PoseComparison,
    prior: FloatArray,
    weight: FloatArray,
) -> FloatArray:
    """Return (n, 2) largest sigma of position (m) and rotation (rad), by block elimination."""
    diagonal, upper, _ = _normals(at, at, measured, comparison, prior, weight)
    n = len(at)
    forward, backward = diagonal.copy(), diagonal.copy()
    for row in range(n - 1):
        forward[row + 1] -= upper[row].T @ np.linalg.solve(forward[row], upper[row])
    for row in range(n - 2, -1, -1):
        backward[row] -= upper[row] @ np.linalg.solve(backward[row + 1], upper[row].T)
    covariance = np.linalg.inv(forward + backward - diagonal)
    position = np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1]
    turn = np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1]
    return np.asarray(np.sqrt(np.maximum(np.column_stack([position, turn]), 0.0)))


def stretches(
    refinement: PoseRefinement, least_m: float, least_rad: float
) -> list[tuple[int, int]]:
    """Return first and last row of each stretch of frames that refining moves by more.

    It moves further than good poses of this drive err. Its neighbours that clearly move too, by a
    quarter of the least moves, belong to it.
    """
    usual_m, usual_rad = (
        SPREAD_SIGMAS * float(np.linalg.norm(part)) for part in np.split(refinement.good_sigma, 2)
    )
    strong = _moved(refinement, max(least_m, usual_m), max(least_rad, usual_rad))
    weak = _moved(refinement, 0.25 * least_m, 0.25 * least_rad)
    runs = rows_of_runs(weak | strong)
    return [(first, last) for first, last in runs if strong[first : last + 1].any()]


def _moved(refinement: PoseRefinement, least_m: float, least_rad: float) -> BoolArray:
    """Return (n,) which frames refining moves by more, and by many sigmas."""
    shift = np.linalg.norm(refinement.shift_m, axis=1)
    turn = np.linalg.norm(refinement.turn_rad, axis=1)
    far = shift > np.maximum(least_m, 4.0 * refinement.sigma_m)
    turned = turn > np.maximum(least_rad, 4.0 * refinement.sigma_rad)
    return np.asarray((far | turned) & refinement.poses.known)
