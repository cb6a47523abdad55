"""Robust point-line least squares with priors: Levenberg-Marquardt with analytic Jacobians."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.frame import Belief, Prior
from semviz_core.pose import Pose
from semviz_core.solving.known import MOST_ROWS, known_rows
from semviz_core.solving.linear import cholesky, rotate_left, solve_cholesky
from semviz_core.solving.residuals import (
    INLIER_CHI2,
    SURE,
    bottom_is_given,
    fill_rows,
    hidden_odds,
    new_rows,
    whiten,
    whiten_by_factor,
)
from semviz_core.solving.scene import Known, Record, Scene

STEP_TOLERANCE = 1e-6
"""Converged when no part of a step (m or rad) is larger."""
_MISSED = 1e12  # cost of a pair that doesn't project


@dataclass(frozen=True, eq=False)
class PairFit:
    """A pose at its optimum."""

    T_camera_map: Pose
    information: FloatArray  # (6, 6) of the left perturbation, pairs, prior and belief
    trace: FloatArray  # (iterations + 1, 3) as of ``fit``


def fit_pairs(
    scene: Scene,
    prior: Prior | None,
    T_camera_map: Pose,
    pairs: IntArray,
    *,
    belief: Belief | None = None,
    iterations: int = 20,
) -> PairFit:
    """Fit one pose to ``pairs`` (k, 2) of rows observed and mapped, from ``T_camera_map``."""
    return fit_known(scene, Known.of(prior, belief), T_camera_map, pairs, iterations)


def fit_known(
    scene: Scene, known: Known, T_camera_map: Pose, pairs: IntArray, iterations: int = 20
) -> PairFit:
    """As ``fit_pairs``, with prior and belief as records."""
    match = as_match(scene, pairs)
    start = T_camera_map.rotation, T_camera_map.translation
    R, t, _, trace = fit(scene, known, *start, match, iterations)
    # covariances of residuals change with the pose: once more with those of the optimum
    R, t, at_optimum, _ = fit(scene, known, R, t, match, iterations)
    return PairFit(Pose(R, t), at_optimum, trace)


def information(
    scene: Scene,
    prior: Prior | None,
    T_camera_map: Pose,
    pairs: IntArray,
    belief: Belief | None = None,
) -> FloatArray:
    """(6, 6) Fisher information of ``pairs``, prior and belief at a pose (left perturbation)."""
    start = T_camera_map.rotation, T_camera_map.translation
    return fit(scene, Known.of(prior, belief), *start, as_match(scene, pairs), 0)[2]


@compiled
def fit(
    scene: Scene,
    known: Known,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    iterations: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rotation, translation, information (6, 6) and the way there (iterations + 1 rows at most).

    ``match`` (m,) holds mapped rows, -1 for none. The covariance of residuals is that of the
    start and kept, so the cost can only fall. A row of the way is the cost after a step and how
    far it moved (m) and turned (rad) the camera, 0 where it was not taken.
    """
    factors = _factors(scene, R, t, match)
    rows, gradient = new_rows(), np.zeros(6)
    here, there = np.zeros((6, 6)), np.zeros((6, 6))
    trace = np.zeros((iterations + 1, 3))
    trace[0, 0] = cost = _linearize(scene, known, R, t, match, factors, rows, gradient, here)
    damping, done = 1e-4, 0
    slope = gradient.copy()
    for iteration in range(iterations):
        step = _step(here, slope, damping)
        new_R, new_t = rotate_left(R, t, step)
        new = _linearize(scene, known, new_R, new_t, match, factors, rows, gradient, there)
        if new <= cost:
            R, t, cost = new_R, new_t, new
            trace[iteration + 1, 1] = np.sqrt((step[:3] ** 2).sum())
            trace[iteration + 1, 2] = np.sqrt((step[3:] ** 2).sum())
            here[:], slope[:] = there, gradient
            damping = max(damping * 0.1, 1e-9)
        else:
            damping = min(damping * 10.0, 1e6)
        done = iteration + 1
        trace[done, 0] = cost
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return R, t, here, trace[: done + 1]


@compiled
def _factors(scene: Scene, R: FloatArray, t: FloatArray, match: IntArray) -> FloatArray:
    """(m, 5, 4) Cholesky factors of the covariances of the pairs' rows; in the last row the number
    of rows, and the odds of a hidden bottom."""
    factors = np.zeros((len(match), 5, 4))
    rows = new_rows()
    for i in range(len(match)):
        j = match[i]
        if j < 0:
            continue
        count = fill_rows(scene, R, t, i, j, rows)
        if count:
            whiten(scene, i, j, count, SURE, rows)
            factors[i, :4] = rows.factor
            factors[i, 4, 0] = count
            if bottom_is_given(scene, i, j, count):
                factors[i, 4, 1] = hidden_odds(scene, count, rows)
    return factors


@compiled
def _linearize(
    scene: Scene,
    known: Known,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    factors: FloatArray,
    rows: Record,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Cost at a pose; fills its gradient (6,) and Gauss-Newton information (6, 6)."""
    gradient[:] = 0.0
    information[:] = 0.0
    residual, jacobian = np.empty(MOST_ROWS), np.empty((MOST_ROWS, 6))
    count = known_rows(known, R, t, residual, jacobian)
    cost = _add(residual, jacobian, count, 1.0, 1.0, gradient, information)
    for i in range(len(match)):
        if match[i] < 0:
            continue
        count = fill_rows(scene, R, t, i, match[i], rows)
        if count == 0 or count != factors[i, 4, 0]:
            cost += _MISSED  # fewer or more of it project than at the start: too far a step
            continue
        rows.factor[:] = factors[i, :4]
        whiten_by_factor(count, rows, True)
        cost += _add_pair(scene, rows, count, factors[i, 4, 1], gradient, information)
    return cost


@compiled
def _add_pair(
    scene: Scene,
    rows: Record,
    count: int,
    odds: float,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Add one pair: Huber beyond the inlier test, its bottom weighed by how likely it is seen."""
    seen, cost = 1.0, 0.0
    last = rows.residual[count - 1]
    if odds > 0.0:
        visible = (1.0 - scene.setting.hidden_bottoms) * np.exp(-0.5 * last * last)
        seen = visible / (visible + odds)
        # -2 log of the mixture, 0 where e is; the squares below add seen * e^2 again
        mixture = -2.0 * np.log((visible + odds) / (1.0 - scene.setting.hidden_bottoms + odds))
        cost = mixture - seen * last * last
    chi2 = seen * last * last
    for row in range(count - 1):
        chi2 += rows.residual[row] ** 2
    limit = INLIER_CHI2[count]
    if chi2 > limit:
        cost += 2.0 * np.sqrt(limit * chi2) - limit - chi2
        weight = np.sqrt(limit / chi2)
        _add(rows.residual, rows.jacobian, count, weight, seen, gradient, information)
        return cost + chi2
    return cost + _add(rows.residual, rows.jacobian, count, 1.0, seen, gradient, information)


@compiled
def _add(
    residual: FloatArray,
    jacobian: FloatArray,
    count: int,
    weight: float,
    last: float,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Add rows of one weight, the last times ``last``; the weighted sum of squares."""
    cost = 0.0
    for row in range(count):
        w = weight * last if row == count - 1 else weight
        cost += w * residual[row] ** 2
        for a in range(6):
            scaled = w * jacobian[row, a]
            gradient[a] += scaled * residual[row]
            for b in range(6):
                information[a, b] += scaled * jacobian[row, b]
    return cost


@compiled
def _step(information: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    damped = information.copy()
    for k in range(6):
        damped[k, k] = damped[k, k] * (1.0 + damping) + 1e-9
    step = -gradient
    if cholesky(damped, 6):
        solve_cholesky(damped, step)
        return step
    return np.zeros(6)


def as_match(scene: Scene, pairs: IntArray) -> IntArray:
    """Mapped row (m,) of each observed element, -1 for none, of ``pairs`` (k, 2)."""
    match = np.full(len(scene.seen), -1, dtype=np.int64)
    match[pairs[:, 0]] = pairs[:, 1]
    return match
