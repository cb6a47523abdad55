"""Decide which observation is which map element under a pose, and score the pose.

The score is a log-likelihood in nats. It weighs each pair against a false positive, each mapped
element in view without a pair against a missed detection, and adds the prior. The association is
one-to-one. Pair constraints force or forbid pairs and leave all others free.
"""

from dataclasses import dataclass, field

import numpy as np

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.localization import Refinement
from semviz_core.common.arrays import FloatArray, IntArray, int_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.localization.prior_residuals import prior_chi2
from semviz_core.localization.problem import PoseProblem, PriorRecord, Record, rows_in_sight
from semviz_core.localization.residuals import (
    EXACT_POSE,
    INLIER_CHI2,
    Rows,
    bottom_is_given,
    fill_rows,
    hidden_odds,
    largest_shift_m2,
    new_rows,
    rows_that_count,
    transform_point,
    whiten,
)

NEAREST_M = 3.0
"""Elements closer to the camera count as out of view."""
BEYOND_REACH = 0.02
"""Chance of detection beyond the detector's reach."""
NEAR_COSINE = 0.5
"""Elements further apart in angle (cosine) are never a pair."""
WIDER_GATE = 1.5 * float(INLIER_CHI2[4])
"""Gate of angles (chi2), wider than the test that follows."""
LEAST_CHANCE = 1e-200
"""Products below this go into the logarithm, before they underflow."""
_NONE = -np.inf
_LOG_2PI = np.log(2.0 * np.pi)


@compiled
def associate(
    problem: PoseProblem, R: FloatArray, t: FloatArray, pose_covariance: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Pair observed and mapped elements one-to-one under a pose.

    Return the mapped row (m,) of each observed element, -1 for none, and the gain (m,) of its pair:
    its log-likelihood over that of a false detection (nats), 0 without a pair. The gates widen with
    ``pose_covariance`` (6, 6).
    """
    seen, mapped, gain = gated_pairs(problem, R, t, pose_covariance)
    return one_to_one(seen, mapped, gain, problem.compatible.shape)


@compiled
def all_gains(problem: PoseProblem, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the gains (m, n) of every pair under an exact pose, -inf beyond the gate."""
    dense = np.full(problem.compatible.shape, _NONE)
    seen, mapped, gain = gated_pairs(problem, R, t, EXACT_POSE.copy())
    for k in range(len(gain)):
        dense[seen[k], mapped[k]] = gain[k]
    return dense


@compiled
def gated_pairs(
    problem: PoseProblem, R: FloatArray, t: FloatArray, pose_covariance: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the pairs within the gate: observed rows (k,), mapped rows (k,) and gains (k,)."""
    row, variance, direction = _directions(problem, R, t, pose_covariance)
    seen, mapped = np.empty(16, dtype=np.int64), np.empty(16, dtype=np.int64)
    gain, count, rows = np.empty(16), 0, new_rows()
    beyond, near = np.empty(len(row)), np.empty(len(row), dtype=np.int64)
    for i in range(len(problem.seen)):
        _fill_beyond(problem.seen[i], problem.setting.K[0, 0], variance, direction, beyond)
        for k in range(_fill_near(problem, i, row, direction, beyond, near)):
            j = near[k]
            value = pair_gain(problem, R, t, i, j, pose_covariance, rows)
            if value == _NONE:
                continue
            if count == len(gain):
                seen, mapped = np.concatenate((seen, seen)), np.concatenate((mapped, mapped))
                gain = np.concatenate((gain, gain))
            seen[count], mapped[count], gain[count] = i, j, value
            count += 1
    return seen[:count], mapped[:count], gain[:count]


@compiled
def one_to_one(
    seen: IntArray, mapped: IntArray, gain: FloatArray, shape: tuple[int, int]
) -> tuple[IntArray, FloatArray]:
    """Pair greedily by positive gain; return the mapped row (m,), -1 for none, and the gains (m,).

    ``seen``, ``mapped`` and ``gain`` (k,) are possible pairs of (m, n) = ``shape`` elements.
    """
    match, own = np.full(shape[0], -1), np.zeros(shape[0])
    taken = np.zeros(shape[1], dtype=np.bool_)
    for k in np.argsort(-gain, kind="mergesort"):
        i, j = seen[k], mapped[k]
        if gain[k] > 0.0 and match[i] < 0 and not taken[j]:
            match[i], own[i], taken[j] = j, gain[k], True
    return match, own


@compiled
def log_likelihood(
    problem: PoseProblem,
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    gain: FloatArray,
) -> float:
    """Return the score of a pose in nats: gains (m,) of its pairs, missed detections, prior."""
    total = gain.sum() - 0.5 * prior_chi2(prior, R, t)
    paired = np.zeros(len(problem.mapped), dtype=np.bool_)
    for j in match:
        if j >= 0:
            paired[j] = True
    chance = 1.0  # product over all mapped elements; one logarithm in the end
    for j in rows_in_sight(problem, *_center(R, t)):
        recall = _recall(problem, R, t, j)
        # a pair beyond the stated reach of detection is unlikely, not impossible
        chance *= max(recall, BEYOND_REACH) if paired[j] else 1.0 - recall
        if chance < LEAST_CHANCE:
            total += np.log(chance)
            chance = 1.0
    return total + np.log(chance)


@compiled_leaf
def _center(R: FloatArray, t: FloatArray) -> tuple[float, float]:
    """Return x and y of the camera, in map coordinates."""
    x = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
    return x, -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])


@compiled
def _directions(
    problem: PoseProblem, R: FloatArray, t: FloatArray, pose_covariance: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the rows (k,) of the mapped elements that may be near an observed one in angle, the
    variance (k,) in rad^2 and the unit direction of each one's anchor: (3, k), with room for more,
    since a part of it would not be contiguous."""
    in_sight, least = rows_in_sight(problem, *_center(R, t)), _least_cosine(problem)
    row, count = np.empty(len(in_sight), dtype=np.int64), 0
    variance, direction = np.empty(len(in_sight)), np.empty((3, len(in_sight)))
    position_variance = _largest(pose_covariance, 0) + largest_shift_m2(problem)
    rotation_variance = _largest(pose_covariance, 3)
    for j in in_sight:
        x, y, z = transform_point(R, t, problem.mapped[j].anchor_m)
        square = x * x + y * y + z * z
        reach = max(np.sqrt(square), 1e-6)
        if z < least * reach:
            continue
        row[count] = j
        direction[0, count], direction[1, count] = x / reach, y / reach
        direction[2, count] = z / reach
        spread = position_variance + problem.mapped[j].largest_m2
        variance[count] = spread / max(square, 1.0) + rotation_variance
        count += 1
    return row[:count], variance[:count], direction


@compiled_leaf
def _least_cosine(problem: PoseProblem) -> float:
    """Return the least cosine to the optical axis of a direction near an observed element."""
    widest = 1.0
    for i in range(len(problem.seen)):
        widest = min(widest, problem.seen[i].anchor_ray[2])
    return np.cos(min(np.arccos(widest) + np.arccos(NEAR_COSINE), np.pi))


@compiled_leaf
def _largest(covariance: FloatArray, first: int) -> float:
    """Return an upper bound of the variance in any direction of three axes (Gershgorin)."""
    largest = 0.0
    for row in range(first, first + 3):
        total = 0.0
        for column in range(first, first + 3):
            total += abs(covariance[row, column])
        largest = max(largest, total)
    return largest


@compiled_leaf
def _fill_beyond(
    seen: Record, focal: float, variance: FloatArray, direction: FloatArray, beyond: FloatArray
) -> None:
    """Fill in by how much (rad^2) each of k mapped directions is too far from an observed element
    for residuals to be worth computing: from a pole's plane, or a point's ray."""
    own = max(seen.variance_px2[0], seen.variance_px2[1]) / (focal * focal)
    normal = seen.plane if seen.is_line else seen.anchor_ray
    a, b, c = normal[0], normal[1], normal[2]
    by_square, by_cosine, start = (1.0, 0.0, 0.0) if seen.is_line else (0.0, -2.0, 2.0)
    for k in range(len(beyond)):  # compiles to vector instructions
        along = a * direction[0, k] + b * direction[1, k] + c * direction[2, k]
        gate = WIDER_GATE * (own + variance[k])
        beyond[k] = start + along * (by_cosine + by_square * along) - gate


@compiled_leaf
def _fill_near(
    problem: PoseProblem,
    i: int,
    row: IntArray,
    direction: FloatArray,
    beyond: FloatArray,
    near: IntArray,
) -> int:
    """Fill in the mapped rows so close to observed i in angle that residuals are worth computing;
    return how many there are."""
    passed = 0
    for k in range(len(row)):
        near[passed] = k
        passed += int(beyond[k] < 0.0)
    seen, count = problem.seen[i], 0
    ray, plane = seen.anchor_ray, seen.plane
    for k in near[:passed]:
        x, y, z = direction[0, k], direction[1, k], direction[2, k]
        cosine = ray[0] * x + ray[1] * y + ray[2] * z
        if cosine < NEAR_COSINE or not problem.compatible[i, row[k]]:
            continue
        if seen.is_line and seen.known[0] and problem.mapped[row[k]].known[0]:
            # peaks known on both sides are near each other; else one may be anywhere on the pole
            distance = plane[0] * x + plane[1] * y + plane[2] * z
            if beyond[k] - distance * distance + 2.0 - 2.0 * cosine >= 0.0:
                continue
        near[count] = row[k]
        count += 1
    return count


@compiled_leaf
def pair_gain(
    problem: PoseProblem,
    R: FloatArray,
    t: FloatArray,
    i: int,
    j: int,
    pose_covariance: FloatArray,
    rows: Rows,
) -> float:
    """Return the log-likelihood of a pair over that of a false detection; -inf if no inlier."""
    count = fill_rows(problem, R, t, i, j, rows)
    if count == 0:
        return _NONE
    whiten(problem, i, j, count, pose_covariance, rows)
    used = rows_that_count(problem, i, j, count, rows)
    chi2, gain = 0.0, -problem.setting.log_false_detections
    for row in range(used):
        chi2 += rows.residual[row] ** 2
        gain -= (
            np.log(rows.factor[row, row]) + 0.5 * _LOG_2PI + problem.seen[i].clutter[min(row, 2)]
        )
    if not chi2 <= INLIER_CHI2[used]:
        return _NONE
    gain -= 0.5 * chi2
    if problem.setting.hidden_bottoms > 0.0 and bottom_is_given(problem, i, j, count):
        gain += _bottom_gain(problem, i, count, used, rows)
    return gain


@compiled_leaf
def _bottom_gain(problem: PoseProblem, i: int, count: int, used: int, rows: Rows) -> float:
    """Return what a bottom that may be hidden adds to the gain of the rows already counted."""
    e = rows.residual[count - 1]
    seen = 1.0 - problem.setting.hidden_bottoms
    hidden = hidden_odds(problem, count, rows)
    if used == count:  # counted as if surely seen
        return np.log(seen + hidden * np.exp(0.5 * e * e))
    density = np.log(rows.factor[count - 1, count - 1]) + 0.5 * _LOG_2PI
    return np.log(seen * np.exp(-0.5 * e * e) + hidden) - density - problem.seen[i].clutter[2]


@compiled_leaf
def _recall(problem: PoseProblem, R: FloatArray, t: FloatArray, j: int) -> float:
    """Return the chance that a mapped element is detected, 0 out of view."""
    a, e = problem.mapped[j].anchor_m, problem.mapped[j].end_m
    middle = 0.5 * (a[0] + e[0]), 0.5 * (a[1] + e[1]), 0.5 * (a[2] + e[2])
    x, y, z = transform_point(R, t, middle)
    if z <= NEAREST_M:
        return 0.0
    u = (problem.setting.K[0, 0] * x + problem.setting.K[0, 1] * y) / z + problem.setting.K[0, 2]
    v = problem.setting.K[1, 1] * y / z + problem.setting.K[1, 2]
    if not (0.0 < u < problem.setting.size_px[0] and 0.0 < v < problem.setting.size_px[1]):
        return 0.0
    model = problem.setting
    if z > model.reach_m:
        return BEYOND_REACH
    share = min(max((z - model.near_m) / (model.far_m - model.near_m), 0.0), 1.0)
    return model.recall_near + share * (model.recall_far - model.recall_near)


SURELY_REAL_NATS = 200.0
"""Added to the gain of a forced pair, so that no pose without it can win."""


def _no_pairs() -> IntArray:
    return np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class PairConstraints:
    """Forced and forbidden pairs, (k, 2) rows of (observed, submap); all others stay free."""

    forced: IntArray = field(default_factory=_no_pairs)
    """Correspondences, whatever their classes. Neither element can pair with another, and a pose
    under which a forced pair does not fit is rejected."""
    forbidden: IntArray = field(default_factory=_no_pairs)
    """Pairs that are no correspondences."""

    def __post_init__(self) -> None:
        for name in ("forced", "forbidden"):
            rows = int_array(getattr(self, name), (None, 2), f"pairing: {name}")
            object.__setattr__(self, name, rows)
        for column, side in enumerate(("observed", "submap")):
            if len(np.unique(self.forced[:, column])) < len(self.forced):
                raise SemvizError(f"pairing: forced names one row of {side} twice; give it once")
        if (self.forced[:, None] == self.forbidden).all(axis=2).any():
            raise SemvizError("pairing: one pair is both forced and forbidden; choose")

    def check(self, observed: Elements2D, submap: Elements3D) -> None:
        """Raise SemvizError if a row does not exist, or a forced pair joins a pole and a sign."""
        pairs = np.concatenate([self.forced, self.forbidden])
        sides = (("observed", len(observed)), ("submap", len(submap)))
        for (name, count), rows in zip(sides, pairs.T, strict=True):
            if ((rows < 0) | (rows >= count)).any():
                raise SemvizError(f"pairing names rows that {name} with {count} elements lacks")
        i, j = self.forced.T
        mixed = np.flatnonzero(observed.is_line[i] != submap.is_line[j])
        if len(mixed):
            pair = tuple(self.forced[mixed[0]].tolist())
            raise SemvizError(f"pairing: forced pair {pair} joins a pole and a sign; leave it out")

    def applied(self, problem: PoseProblem) -> PoseProblem:
        """Return ``problem`` with these constraints."""
        (i, j), possible = self.forced.T, problem.compatible.copy()
        possible[i], possible[:, j] = False, False
        possible[i, j] = True
        possible[tuple(self.forbidden.T)] = False
        constrained = problem.only(possible)
        constrained.seen["clutter"][i, 0] -= SURELY_REAL_NATS
        return constrained

    def violated(self, fit: Refinement, submap: Elements3D) -> str:
        """Return which forced pairs do not fit, in one sentence; empty if all of them do."""
        fitting = {(int(i), int(j)) for i, j in fit.pairs[fit.inlier]}
        missing = [(i, j) for i, j in self.forced.tolist() if (i, j) not in fitting]
        if not missing:
            return ""
        i, j = missing[0]
        return (
            f"{len(missing)} of {len(self.forced)} forced pairs fit no pose that enough others do, "
            f"first element {i} seen with {submap.id[j]} mapped."
        )
