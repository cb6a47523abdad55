"""Explanations of wrong poses that hold for a whole drive: axes, time, heights.

Each explanation is a set of corrected poses. One is accepted if the corrected poses fit the images
much better than the given ones.
"""

from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.pose_checks.comparison import (
    LIMIT,
    DrivePoses,
    PoseComparison,
    compare,
    rotation_vectors,
)
from semviz_core.pose_checks.image_motions import ImageMotions

GAIN, TIME_GAIN = 40.0, 15.0
"""Least drop of twice the negative log-likelihood by other axes, and by another time."""
TIME_GAIN_HALVES = 3.6
"""The same of both halves, each with a spread of good poses of its own, over the root of the number
of pairs: by so much noise that a turned stretch happens to suit passes for another time."""
TIME_LOSS = 0.1
"""Largest share of that by which one half of the drive may fit worse: a turned stretch, which one
offset seems to explain, is in one of them."""
MOST_LATE, LEAST_LATE = 3.0, 0.3
"""Time offsets that are tried and named, in frames."""
MIN_PAIRS = 8
"""Shorter drives show no fault of a whole drive."""
FLAT_M = 1e-5
"""Heights that differ less are constant: no vehicle drives like that."""
LEAST_RISE_M = 0.015
_MEDIAN_CHI2 = 1.386
"""Of two degrees of freedom."""
_TURN_PRIOR_RAD, _TURN_ROUNDS = float(np.deg2rad(10.0)), 10
_QUICK_M, _QUICK_RAD = 0.02, float(np.deg2rad(0.1))


@dataclass(frozen=True, eq=False)
class Correction:
    """Poses corrected by an explanation, and what it is."""

    poses: DrivePoses
    value: float
    """Frames that the poses are late; metres that the images rise; 0 for axes."""
    text: str = ""
    """Of axes: which of the given ones are the right x, y and z."""


def corrected_axes(poses: DrivePoses, motions: ImageMotions) -> Correction | None:
    """Return poses with axes exchanged or reversed, if those fit; None if the given do.

    Either the positions' axes are wrong, or those of the poses as a whole.
    """
    candidates = [
        (matrix, whole) for whole in (False, True) for matrix in _axes() if not _is_same(matrix)
    ]
    if _too_short(poses, motions):
        return None
    given = _quick_cost(poses, motions)
    costs = [_quick_cost(_with_axes(poses, *candidate), motions) for candidate in candidates]
    best = int(np.argmin(costs))
    if costs[best] > given - GAIN:
        return None
    corrected = _with_axes(poses, *candidates[best])
    if compare(corrected, motions).cost > compare(poses, motions).cost - GAIN:
        return None
    return Correction(corrected, 0.0, _axes_text(*candidates[best]))


@cache
def _axes() -> tuple[FloatArray, ...]:
    """Return the 48 ways to exchange and reverse axes."""
    return tuple(
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    )


def _is_same(matrix: FloatArray) -> bool:
    return bool((matrix == np.eye(3)).all())


def _with_axes(poses: DrivePoses, matrix: FloatArray, whole: bool) -> DrivePoses:
    centers = poses.center_m @ matrix.T
    if not whole:
        return replace(poses, center_m=centers)
    return replace(poses, center_m=centers, rotation=matrix @ poses.rotation @ matrix.T)


def _axes_text(matrix: FloatArray, whole: bool) -> str:
    names = [("-" if row.sum() < 0.0 else "") + "xyz"[int(np.abs(row).argmax())] for row in matrix]
    what = "poses" if whole else "positions"
    return f"the axes of the {what} are exchanged: the right x, y, z are {', '.join(names)}"


def _quick_cost(poses: DrivePoses, motions: ImageMotions) -> float:
    """Return a cost of the poses' motions against the images', without covariances."""
    R, t = poses.motions()
    scale = np.ones(len(t)) if motions.has_stereo else np.linalg.norm(t, axis=1)
    t_error = np.linalg.norm(t - motions.translation_m * scale[:, None], axis=1)
    turn = rotation_vectors(R @ motions.rotation.transpose(0, 2, 1))
    r_error = np.linalg.norm(turn, axis=1)
    used = poses.pair_known & motions.is_measured
    chi2 = (t_error / _QUICK_M) ** 2 + (r_error / _QUICK_RAD) ** 2
    return float(10.0 * np.log1p(chi2[used] / 10.0).sum())


def corrected_time(poses: DrivePoses, motions: ImageMotions) -> Correction | None:
    """Return poses of another time, if those fit; ``value`` is how many frames they are late.

    To compare offsets, the images' motions are shifted, not the poses: between two frames poses
    are means of both, which hides the errors of noisy ones.
    """
    if _too_short(poses, motions):
        return None
    shared = np.zeros(len(motions), dtype=bool)
    shared[int(MOST_LATE) : len(motions) - int(MOST_LATE)] = True  # the same for all offsets
    driven = _chained(motions)

    def cost(late: float, part: BoolArray = shared) -> float:
        there = shifted_in_time(driven, -late)
        R, t = there.motions()
        points = np.where(part & there.pair_known, motions.points, 0.0)
        return compare(poses, replace(motions, rotation=R, translation_m=t, points=points)).cost

    offsets = np.arange(-MOST_LATE, MOST_LATE + 0.1, 0.5)
    costs = [cost(float(offset)) for offset in offsets]
    late = float(offsets[int(np.argmin(costs))])
    if min(costs) > costs[len(costs) // 2] - TIME_GAIN:
        return None
    for step in (0.25, 0.1, 0.05):
        late = min((late - step, late, late + step), key=cost)
    middle = np.arange(len(shared)) < len(shared) // 2
    gains = [cost(0.0, half) - cost(late, half) for half in (shared & middle, shared & ~middle)]
    least = TIME_GAIN_HALVES * np.sqrt(np.count_nonzero(shared))
    if abs(late) < LEAST_LATE or sum(gains) < least or min(gains) < -TIME_LOSS * sum(gains):
        return None
    return Correction(_completed(shifted_in_time(poses, late), poses, motions), late)


def _chained(motions: ImageMotions) -> DrivePoses:
    """Return the poses that the motions make, one after another, from the first frame on."""
    n = len(motions) + 1
    R, c, known = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.ones(n, dtype=bool)
    for row in range(n - 1):
        R[row + 1] = R[row] @ motions.rotation[row].T
        c[row + 1] = c[row] - R[row + 1] @ motions.translation_m[row]
    return DrivePoses(R, c, known, np.arange(n, dtype=np.float64))


def _completed(shifted: DrivePoses, given: DrivePoses, motions: ImageMotions) -> DrivePoses:
    """Return the shifted poses with those beyond the first and last chained from the images."""
    R, c, known = shifted.rotation.copy(), shifted.center_m.copy(), shifted.known.copy()
    n, step_m = len(known), float(np.median(given.step_m()))
    for row in range(1, n):  # forwards
        if given.known[row] and known[row - 1] and not known[row] and motions.is_measured[row - 1]:
            turn, t = motions.rotation[row - 1], motions.translation_m[row - 1]
            t = t if motions.has_stereo else t * step_m
            R[row] = R[row - 1] @ turn.T
            c[row], known[row] = c[row - 1] - R[row] @ t, True
    for row in range(n - 2, -1, -1):  # and backwards
        if given.known[row] and known[row + 1] and not known[row] and motions.is_measured[row]:
            turn, t = motions.rotation[row], motions.translation_m[row]
            t = t if motions.has_stereo else t * step_m
            R[row] = R[row + 1] @ turn
            c[row], known[row] = c[row + 1] + R[row + 1] @ t, True
    return replace(shifted, rotation=R, center_m=c, known=known)


def shifted_in_time(poses: DrivePoses, late: float) -> DrivePoses:
    """Return the poses ``late`` frames later; unknown beyond the first and last.

    Positions follow a cubic spline, rotations the shortest turn.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    rows = np.arange(len(poses), dtype=np.float64)
    known = np.flatnonzero(poses.known)
    if late == 0.0 or len(known) < 2:
        return poses
    at = rows + late
    inside = (at >= known[0]) & (at <= known[-1])
    nearest = np.clip(np.floor(at), 0, len(poses) - 2).astype(int)
    inside &= poses.known[nearest] & (poses.known[nearest + 1] | (at == nearest))
    clipped = np.clip(at, known[0], known[-1])
    centers = CubicSpline(known, poses.center_m[known])(clipped)
    turns = Slerp(known, Rotation.from_matrix(poses.rotation[known]))(clipped)
    return replace(poses, rotation=turns.as_matrix(), center_m=centers, known=inside)


def corrected_heights(poses: DrivePoses, motions: ImageMotions) -> Correction | None:
    """Return poses with the heights of the images, if the given ones are constant.

    ``value`` is how far apart the lowest and the highest are in the images.
    """
    heights = poses.center_m[poses.known, 2]
    if _too_short(poses, motions) or not motions.has_stereo or np.ptp(heights) > FLAT_M:
        return None
    if poses.step_m()[poses.pair_known].max(initial=0.0) < 10.0 * FLAT_M:
        return None
    back = -np.einsum("nji,nj->ni", motions.rotation, motions.translation_m)  # T_before_now
    rises = np.einsum("nj,nj->n", poses.rotation[:-1, 2], back)
    rises = np.where(motions.is_measured & poses.pair_known, rises, 0.0)
    z = heights[0] + np.concatenate([[0.0], np.cumsum(rises)])
    rise = float(np.ptp(z[poses.known]))
    if rise < LEAST_RISE_M:
        return None
    centers = np.column_stack([poses.center_m[:, :2], z])
    return Correction(replace(poses, center_m=centers), rise)


def shows_time(poses: DrivePoses, motions: ImageMotions) -> bool:
    """Whether the drive would show poses that are one frame late: a steady one does not."""
    return corrected_time(shifted_in_time(poses, -1.0), motions) is not None


def turned_camera(poses: DrivePoses, comparison: PoseComparison) -> tuple[FloatArray, float]:
    """Return how far the camera is turned about its x and y against its poses (2,) rad, and one
    sigma. About the viewing direction a straight drive tells nothing.

    If all poses are turned by d and their places are right, the motion R, t gets an innovation of
    t x R d, turned by (R - 1) d: by robust least squares over all pairs.
    """
    rows = np.flatnonzero(comparison.compared)
    R, t = (values[rows] for values in poses.motions())
    weight = 1.0 / comparison.pose_sigma
    across = np.cross(t[:, None], R.transpose(0, 2, 1)).transpose(0, 2, 1)
    A = np.concatenate([across, R - np.eye(3)], axis=1) * weight[:, None]
    b = comparison.innovation[rows] * weight
    used, prior = np.ones(len(rows)), np.eye(3) / _TURN_PRIOR_RAD**2
    for _ in range(_TURN_ROUNDS):
        inverse = np.linalg.inv(np.einsum("n,nij,nik->jk", used, A, A) + prior)
        turn = inverse @ np.einsum("n,nij,ni->j", used, A, b)
        left = (b - A @ turn) ** 2
        used = 1.0 / (1.0 + left.sum(axis=1) / LIMIT) ** 2
    # The sigma of poses holds what the turn moves them to the side; what is left is their own.
    spread = float(np.median(left[:, :2].sum(axis=1))) / _MEDIAN_CHI2
    return turn[:2], float(np.sqrt(spread * np.linalg.eigvalsh(inverse[:2, :2])[-1]))


def _too_short(poses: DrivePoses, motions: ImageMotions) -> bool:
    return int((poses.pair_known & motions.is_measured).sum()) < MIN_PAIRS
