"""Fit upright poses that couples propose, and tell which candidate pairs agree with them.

A pose is a camera (complex, local metres) and a turn (complex unit, from the level frame to
the local one). A pair agrees if its azimuth and its distance do.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky, solve_cholesky
from semviz_core.localization.correspondences.candidate_pairs import (
    BINS,
    NEAREST_M,
    USUAL_FIX_SIGMAS,
    CandidatePairs,
    Compass,
    compass_chi2,
)
from semviz_core.localization.correspondences.couples import Couples

POSES = 192
"""Most couples of a frame that become poses: those with the highest score."""
_CELL_M, _CELLS = 2.0, 512
"""Only the best couple per square of the ground and heading becomes a pose."""
_DOUBTS = ((1.2, 0.05), (0.6, 0.02))
"""Sigmas (m, rad) of poses before each fit, which widen the gates."""
_LEFT = (0.3, 0.01)
"""Sigmas (m, rad) of fitted poses."""
_MOST_CHI2 = 12.0
_CAUCHY_CHI2 = 4.0
_NOTHING = 0.05
"""Likelihood that an observed element has no mapped one, relative to a perfect pair."""
_MAP_SIGMA_M = 0.15
_STAY = (0.25, 0.25, 100.0)
"""Information of the start pose, per square metre and square radian."""
_LONGEST_STEP = 2.0


class ProposedPoses(NamedTuple):
    """h fitted poses of one frame, and their k agreements with pairs."""

    couple: IntArray  # (h,) row of the couple that proposed the pose
    prior: FloatArray  # (h, 3) distances from the fix and from the compass
    pose: IntArray  # (k,) row of a pose
    pair: IntArray  # (k,) row of a pair that agrees with it
    feature: FloatArray  # (k, 7)


def proposed_poses(
    pairs: CandidatePairs, compass: Compass, couples: Couples, couple_score: FloatArray
) -> ProposedPoses:
    """Return the fitted poses of the best couples by score (E,)."""
    chosen = _apart(couples, couple_score)[:POSES]
    camera_m, turn = couples.camera_m[chosen], couples.turn[chosen]
    fit_poses(pairs, camera_m, turn)
    pose, pair, feature = _support(pairs, camera_m, turn)
    from_fix = np.abs(camera_m) / pairs.fix_sigma_m
    heading = np.angle(turn).tolist()
    chi2 = np.array([compass_chi2(compass, angle, _LEFT[1] ** 2) for angle in heading])
    prior = [
        np.minimum(np.square(from_fix), 12.0) / 3.0,
        np.minimum(np.abs(from_fix - USUAL_FIX_SIGMAS), 2.0),
        np.minimum(chi2, 16.0) / 5.0,
    ]
    return ProposedPoses(chosen, np.column_stack(prior), pose, pair, feature)


def _apart(couples: Couples, score: FloatArray) -> IntArray:
    """Return the rows of couples, best first, but for those in one square and heading."""
    order = np.argsort(-score, kind="stable")
    place = np.column_stack([couples.camera_m.real, couples.camera_m.imag])[order]
    square = np.clip(np.round(place / _CELL_M), -_CELLS, _CELLS - 1).astype(np.int64) + _CELLS
    cell = (square[:, 0] * 2 * _CELLS + square[:, 1]) * BINS + couples.bin[order, 1]
    _, first = np.unique(cell, return_index=True)
    return order[np.sort(first)]


class _Off(NamedTuple):
    """Residuals of a pair under a pose."""

    angle: float  # rad, of azimuths
    nearness: float  # of 1 / distance
    angle_variance: float
    nearness_variance: float
    sight: complex  # from the camera to the mapped element, in the level frame
    chi2: float  # infinite if they do not agree


@compiled
def _residuals(
    pairs: CandidatePairs, row: int, camera_m: complex, turn: complex, doubt: tuple[float, float]
) -> _Off:
    """Return the residuals of the pair in ``row`` under a pose of these sigmas (m, rad)."""
    sight = (pairs.place_m[row] - camera_m) * np.conj(turn)
    relative = sight * np.conj(pairs.direction[row])
    ahead, beside = relative.real, relative.imag
    own = pairs.azimuth_sigma[row] ** 2 + doubt[1] ** 2
    wide_m2 = _MAP_SIGMA_M**2 + doubt[0] ** 2
    most = _MOST_CHI2 * (own * (ahead * ahead + beside * beside) + wide_m2)
    if not (ahead > 0.0 and beside * beside < most):
        return _Off(0.0, 0.0, 1.0, 1.0, sight, np.inf)
    angle = np.arctan2(beside, ahead)
    distance = max(np.hypot(ahead, beside), NEAREST_M)
    variance = own + wide_m2 / distance**2
    uphill = (np.conj(pairs.rise) * pairs.direction[row] * turn).real
    nearness = 1.0 / distance - pairs.nearness[row] + pairs.by_slope[row] * uphill
    spread = (pairs.sigma_m[row] * pairs.nearness[row] ** 2) ** 2 + (doubt[0] / distance**2) ** 2
    chi2 = angle * angle / variance + nearness * nearness / spread
    if not chi2 < _MOST_CHI2:
        chi2 = np.inf
    return _Off(angle, nearness, variance, spread, sight, chi2)


@compiled
def fit_poses(pairs: CandidatePairs, camera_m: ComplexArray, turn: ComplexArray) -> None:
    """Fit cameras (h,) and turns (h,) in place to the pairs that agree with them."""
    seen = pairs.seen.max() + 1 if len(pairs.seen) else 0
    total = np.empty(seen)
    likelihood = np.empty(len(pairs.seen))
    for h in range(len(turn)):
        for doubt in _DOUBTS:
            total[:] = _NOTHING
            for row in range(len(pairs.seen)):
                off = _residuals(pairs, row, camera_m[h], turn[h], doubt)
                likelihood[row] = np.exp(-0.5 * off.chi2)
                total[pairs.seen[row]] += likelihood[row]
            camera_m[h], turn[h] = _stepped(pairs, camera_m[h], turn[h], doubt, likelihood, total)


@compiled
def _stepped(
    pairs: CandidatePairs,
    camera_m: complex,
    turn: complex,
    doubt: tuple[float, float],
    likelihood: FloatArray,
    total: FloatArray,
) -> tuple[complex, complex]:
    """Return a pose after a Gauss-Newton step of position and heading.

    A pair counts by its share among its observed element's pairs under the pose, and none.
    """
    information, step = np.zeros((3, 3)), np.zeros(3)
    by = np.zeros((2, 3))
    for k in range(3):
        information[k, k] = _STAY[k]
    for row in range(len(pairs.seen)):
        if likelihood[row] == 0.0:
            continue
        off = _residuals(pairs, row, camera_m, turn, doubt)
        distance = max(abs(off.sight), NEAREST_M)
        by_place = -np.conj(turn) / off.sight  # the angle grows by Im(by_place dx)
        toward = off.sight * turn / distance**3
        by[0, 0], by[0, 1], by[0, 2] = by_place.imag, by_place.real, -1.0
        by[1, 0], by[1, 1] = toward.real, toward.imag
        angle_variance = pairs.azimuth_sigma[row] ** 2 + (_MAP_SIGMA_M / distance) ** 2
        nearness_variance = (pairs.sigma_m[row] * pairs.nearness[row] ** 2) ** 2
        chi2 = off.angle**2 / angle_variance + off.nearness**2 / nearness_variance
        share = likelihood[row] / total[pairs.seen[row]] / (1.0 + chi2 / _CAUCHY_CHI2)
        for k in range(2):
            residual = off.angle if k == 0 else off.nearness
            weight = share / (angle_variance if k == 0 else nearness_variance)
            for a in range(3):
                step[a] -= weight * by[k, a] * residual
                for b in range(3):
                    information[a, b] += weight * by[k, a] * by[k, b]
    cholesky(information, 3)
    solve_cholesky(information, step)
    for k in range(3):
        step[k] = min(max(step[k], -_LONGEST_STEP), _LONGEST_STEP)
    return camera_m + complex(step[0], step[1]), turn * np.exp(1j * step[2])


@compiled
def _support(
    pairs: CandidatePairs, camera_m: ComplexArray, turn: ComplexArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return poses (k,) and pairs (k,) that agree, and the features (k, 7) of their residuals."""
    agrees: BoolArray = np.zeros((len(turn), len(pairs.seen)), np.bool_)
    for h in range(len(turn)):
        for row in range(len(pairs.seen)):
            chi2 = _residuals(pairs, row, camera_m[h], turn[h], _LEFT).chi2
            agrees[h, row] = chi2 < np.inf
    pose, pair = np.nonzero(agrees)
    feature = np.empty((len(pose), 7))
    for k in range(len(pose)):
        row = pair[k]
        off = _residuals(pairs, row, camera_m[pose[k]], turn[pose[k]], _LEFT)
        feature[k, 0] = off.angle**2 / off.angle_variance / 3.0
        feature[k, 1] = off.nearness**2 / off.nearness_variance / 3.0
        feature[k, 2] = 0.5 * np.log(off.angle_variance) + 4.0
        feature[k, 3] = 0.5 * np.log(off.nearness_variance) + 5.0
        feature[k, 4] = np.log(abs(off.sight)) - 2.7
        feature[k, 5] = min(pairs.off[row, 0] ** 2, 16.0) / 4.0
        feature[k, 6] = min(max(pairs.off[row, 1], -6.0), 6.0) / 2.0
    return pose, pair, feature
