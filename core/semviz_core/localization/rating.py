"""Rate upright pose candidates by azimuth and slope, before pixels are compared.

Candidates from the position grid are up to two metres and a degree away from the pose they
represent: too far to rank thousands of them by azimuth and slope. The tilt error, common to all
slopes, adds to that. Three least-squares steps over x, y, heading and tilt align the azimuths
and slopes of the likeliest pairs. They take a few microseconds; a fit in pixels takes 50.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.common.linalg import cholesky, solve_cholesky
from semviz_core.localization.problem import (
    PoseProblem,
    PriorRecord,
    Record,
    RecordArray,
    rows_within,
)
from semviz_core.localization.upright import (
    FALSE_SLOPE,
    FALSE_TURN,
    HIDDEN_CHI2,
    UprightView,
    compare_slopes,
    proposing_reach,
    rated_reach,
    tilted_slope,
    upright_elements,
)


class PoseSigmas(NamedTuple):
    """Standard deviations of a candidate pose."""

    position_m: float
    height_m: float
    heading_rad: float
    of_up: float
    """Remaining share of the sigma of up."""


class Direction(NamedTuple):
    """Direction and distance of a mapped element from a candidate pose."""

    ahead: float  # of a unit vector, as left
    left: float
    near: float
    """1 / distance (1/m)"""
    variance: float
    """Of the azimuth (rad^2)."""


VOTED_SIGMAS = PoseSigmas(0.4, 0.15, float(np.deg2rad(1.0)), 1.0)
"""Of candidates from the position grid."""
REFINED_SIGMAS = PoseSigmas(0.3, 0.08, float(np.deg2rad(0.7)), 0.3)
"""Of candidates after ``refine_candidates``."""
GATE_CHI2 = 9.0
"""Largest chi2 of the azimuths of a pair."""
MOST_CHI2 = 20.0
"""Largest chi2 of azimuth and slopes of a pair."""
NEAREST_MISSED_M = 6.0
"""Elements closer ahead may be cut off, and never count as missed."""


@compiled
def rate_poses(
    problem: PoseProblem,
    view: UprightView,
    prior: PriorRecord,
    poses: FloatArray,
    sigmas: PoseSigmas,
) -> FloatArray:
    """Return the approximate scores (h,) of poses (h, 6), in nats over a pose without pairs.

    A score sums the gains of pairs, the missed detections and the prior. Instead of a one-to-one
    association it takes the smaller of two bounds, the best gains of all observed and of all mapped
    elements. So a row of equal poles cannot be matched to one pole.
    """
    elements, candidate = upright_elements(problem)
    half = 0.5 * problem.setting.size_px[0] / problem.setting.K[0, 0]
    widest = max(1.2 * widest_tangent(view) + 0.2, half)
    best_of_seen = np.empty(len(problem.seen))
    rating = np.empty(len(poses))
    for h in range(len(poses)):
        pose = poses[h]
        best_of_seen[:] = 0.0
        total_of_mapped = missed = 0.0
        for j in rows_within(problem, pose[0], pose[1], rated_reach(problem)):
            ahead, left = ahead_and_left(pose, elements[j])
            if abs(left) <= widest * ahead:
                direction = direction_to(ahead, left, sigmas)
                largest = _best_gain(
                    problem.setting,
                    view,
                    elements[j],
                    candidate,
                    direction,
                    pose,
                    sigmas,
                    best_of_seen,
                )
                total_of_mapped += largest
                if largest == 0.0 and abs(left) < half * ahead:
                    missed += _nats_of_miss(problem.setting, ahead)
        dx, dy = pose[0] - prior.value.position_m[0], pose[1] - prior.value.position_m[1]
        chi2 = (dx * dx + dy * dy) / prior.value.position_sigma_m[0] ** 2
        chi2 += (pose[5] / view.up_sigma_rad) ** 2
        rating[h] = min(best_of_seen.sum(), total_of_mapped) + missed - 0.5 * chi2
    return rating


@compiled_leaf
def widest_tangent(view: UprightView) -> float:
    """Return the largest tangent of an observed azimuth."""
    widest = 0.0
    for i in range(len(view.seen)):
        azimuth = view.seen[i].azimuth
        widest = max(widest, abs(azimuth[1]) / max(azimuth[0], 0.1))
    return widest


@compiled_leaf
def _best_gain(
    setting: Record,
    view: UprightView,
    mapped: Record,
    candidate: IntArray,
    direction: Direction,
    pose: FloatArray,
    sigmas: PoseSigmas,
    best_of_seen: FloatArray,
) -> float:
    """Return the largest gain of a mapped element; update ``best_of_seen`` (m,), the largest gain
    of each observed one."""
    largest = 0.0
    for entry in range(mapped.first, mapped.last):
        i = candidate[entry]
        if not _aligned(view.seen[i], direction):
            continue
        gain = approximate_gain(setting, view, view.seen[i], mapped, direction, pose, sigmas)
        largest = max(largest, gain)
        best_of_seen[i] = max(best_of_seen[i], gain)
    return largest


@compiled_leaf
def ahead_and_left(pose: FloatArray, mapped: Record) -> tuple[float, float]:
    """Return how far ahead and to the left of a pose (6,) a mapped element is, in metres."""
    east, north = mapped.position_m[0] - pose[0], mapped.position_m[1] - pose[1]
    return pose[3] * east + pose[4] * north, pose[3] * north - pose[4] * east


@compiled_leaf
def direction_to(ahead: float, left: float, sigmas: PoseSigmas) -> Direction:
    """Return the Direction of an element so many metres ahead and to the left."""
    near = 1.0 / max(np.sqrt(ahead * ahead + left * left), 1.0)
    variance = (sigmas.position_m * near) ** 2 + sigmas.heading_rad**2
    return Direction(ahead * near, left * near, near, variance)


@compiled_leaf
def _aligned(seen: Record, direction: Direction) -> bool:
    """Return whether the azimuths of a pair agree: few do, and the call is short."""
    off = seen.azimuth[0] * direction.left - seen.azimuth[1] * direction.ahead
    return off * off <= GATE_CHI2 * direction.variance


@compiled_leaf
def approximate_gain(
    setting: Record,
    view: UprightView,
    seen: Record,
    mapped: Record,
    direction: Direction,
    pose: FloatArray,
    sigmas: PoseSigmas,
) -> float:
    """Return the gain of a pair in nats over a false detection, 0 if it does not fit."""
    # sine of the angle between the azimuths
    off = seen.azimuth[0] * direction.left - seen.azimuth[1] * direction.ahead
    if off * off > GATE_CHI2 * direction.variance:
        return 0.0
    chi2, product, nats, count = compare_slopes(
        setting, seen, mapped, direction.near, pose[2], sigmas.of_up * view.up_sigma_rad,
        sigmas.position_m, sigmas.height_m, pose[5],
    )  # fmt: skip
    chi2 += off * off / direction.variance
    if chi2 > MOST_CHI2:
        return 0.0
    gain = nats + FALSE_TURN + count * FALSE_SLOPE
    return max(gain - 0.5 * (chi2 + np.log(product * direction.variance)), 0.0)


@compiled_leaf
def _nats_of_miss(setting: Record, ahead: float) -> float:
    """Return the nats of a missed detection ``ahead`` metres away; 0 beyond the reach."""
    if not NEAREST_MISSED_M < ahead < setting.far_m:
        return 0.0
    share = max((ahead - setting.near_m) / (setting.far_m - setting.near_m), 0.0)
    return np.log(1.0 - setting.recall_near - share * (setting.recall_far - setting.recall_near))


ROUNDS = 3
AXES = 4
"""x, y, heading and tilt."""
START_STEPS, START_RAD = 0.45, float(np.deg2rad(2.0))
"""Error of a candidate at first: a share of the grid step, and of the heading."""
LEFT = 0.4
"""Share of this error that remains after the first round."""
HEIGHT_DOUBT_M = 0.15
PAIR_M, PAIR_RAD = 0.15, float(np.deg2rad(0.5))
"""Sigmas of a true pair: of map and height, of detection and gravity."""
CAUCHY_SIGMAS = 3.0
"""Pairs with larger residuals count less (Cauchy weights)."""


class _Pairs(NamedTuple):
    """The best pair of each observed element."""

    mapped: IntArray  # (m,) -1 for none
    gain: FloatArray  # (m,)


@compiled
def refine_candidates(
    problem: PoseProblem, view: UprightView, poses: FloatArray, step_m: float
) -> FloatArray:
    """Return ``poses`` (h, 6), as in PoseCandidates, after ROUNDS steps of least squares over x, y,
    heading and tilt; ``step_m`` is the grid step of their positions."""
    elements, candidate = upright_elements(problem)
    widest = 1.2 * widest_tangent(view) + 0.4
    first = PoseSigmas(START_STEPS * step_m, HEIGHT_DOUBT_M, START_RAD, 1.0)
    later = PoseSigmas(LEFT * first.position_m, HEIGHT_DOUBT_M, LEFT * START_RAD, LEFT)
    sigma = np.array([first.position_m, first.position_m, START_RAD, view.up_sigma_rad])
    m = len(view.seen)
    pairs = _Pairs(np.empty(m, dtype=np.int64), np.empty(m))
    information, gradient, moved = np.empty((AXES, AXES)), np.empty(AXES), np.empty(AXES)
    refined, reach_m = poses.copy(), proposing_reach(problem) + step_m
    for h in range(len(poses)):
        moved[:] = 0.0
        rows = rows_within(problem, poses[h, 0], poses[h, 1], reach_m)
        for k in range(ROUNDS):
            sigmas = first if k == 0 else later
            _fill_pairs(
                problem.setting, view, elements, rows, candidate, refined[h], sigmas, widest, pairs
            )
            _add_start(sigma, moved, information, gradient)
            for i in range(m):
                if pairs.mapped[i] >= 0:
                    mapped = elements[pairs.mapped[i]]
                    _add(
                        problem.setting, view, view.seen[i], mapped, refined[h], sigmas.position_m,
                        information, gradient,
                    )  # fmt: skip
            if cholesky(information, AXES):
                solve_cholesky(information, gradient)
                moved -= gradient
                _move(poses[h], moved, refined[h])
    return refined


@compiled_leaf
def _fill_pairs(
    setting: Record,
    view: UprightView,
    elements: RecordArray,
    rows: IntArray,
    candidate: IntArray,
    pose: FloatArray,
    sigmas: PoseSigmas,
    widest: float,
    pairs: _Pairs,
) -> None:
    """Fill ``pairs``: each of the mapped ``rows`` takes its best observed element, which keeps its
    best."""
    pairs.mapped[:], pairs.gain[:] = -1, 0.0
    for j in rows:
        ahead, left = ahead_and_left(pose, elements[j])
        if abs(left) > widest * ahead + 1.0:
            continue
        direction = direction_to(ahead, left, sigmas)
        best, best_gain = -1, 0.0
        for entry in range(elements[j].first, elements[j].last):
            seen = view.seen[candidate[entry]]
            if not _aligned(seen, direction):
                continue
            gain = approximate_gain(setting, view, seen, elements[j], direction, pose, sigmas)
            if gain > best_gain:
                best, best_gain = candidate[entry], gain
        if best >= 0 and best_gain > pairs.gain[best]:
            pairs.mapped[best], pairs.gain[best] = j, best_gain


@compiled_leaf
def _add_start(
    sigma: FloatArray, moved: FloatArray, information: FloatArray, gradient: FloatArray
) -> None:
    """Set information and gradient to those of the start: the pose is near the candidate."""
    information[:] = 0.0
    for axis in range(AXES):
        information[axis, axis] = 1.0 / sigma[axis] ** 2
        gradient[axis] = moved[axis] / sigma[axis] ** 2


@compiled_leaf
def _add(
    setting: Record,
    view: UprightView,
    seen: Record,
    mapped: Record,
    pose: FloatArray,
    position_m: float,
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the residuals of a pair's azimuth and slopes, by x, y, heading and tilt."""
    east, north = mapped.position_m[0] - pose[0], mapped.position_m[1] - pose[1]
    square = east * east + north * north
    near = 1.0 / np.sqrt(square)
    ahead, left = ahead_and_left(pose, mapped)
    off = (seen.azimuth[0] * left - seen.azimuth[1] * ahead) * near
    variance = PAIR_RAD**2 + (PAIR_M * near) ** 2
    by = north / square, -east / square, -1.0, 0.0
    _add_row(off, variance, by, information, gradient)
    for end in range(2):
        if not (seen.known[end] and mapped.known[end]):
            continue
        rise = mapped.height_m[end] - pose[2]
        off = rise * near - tilted_slope(seen, end, pose[5])
        lean = seen.azimuth[1] * view.up_sigma_rad  # sideways, which is not estimated
        variance = seen.slope_sigma**2 + lean**2 + (PAIR_M * near) ** 2
        doubtful = variance + (position_m * seen.slope[end] * near) ** 2
        may_hide = end == 1 and setting.hidden_bottoms > 0.0
        if may_hide and off < 0.0 and off * off > HIDDEN_CHI2 * doubtful:
            continue
        by_place = rise * near / square
        by_tilt = -seen.azimuth[0] * (1.0 + seen.slope[end] ** 2)
        by = by_place * east, by_place * north, 0.0, by_tilt
        _add_row(off, variance, by, information, gradient)


@compiled_leaf
def _add_row(
    off: float,
    variance: float,
    by: tuple[float, float, float, float],
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    weight = 1.0 / (variance + off * off / CAUCHY_SIGMAS**2)
    for row in range(AXES):
        gradient[row] += weight * by[row] * off
        for column in range(row + 1):
            information[row, column] += weight * by[row] * by[column]


@compiled_leaf
def _move(start: FloatArray, moved: FloatArray, pose: FloatArray) -> None:
    """Fill ``pose`` (6,) with ``start``, moved by x, y, heading and tilt."""
    pose[0], pose[1] = start[0] + moved[0], start[1] + moved[1]
    c, s = np.cos(moved[2]), np.sin(moved[2])
    pose[3], pose[4] = start[3] * c - start[4] * s, start[4] * c + start[3] * s
    pose[5] = start[5] + moved[3]
