"""Robust point-line least squares with priors: Levenberg-Marquardt, analytic Jacobians.

The result carries the Fisher information (6, 6) for left perturbations of T_camera_map.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.frame import Belief, Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.common.linalg import cholesky, rotate_left, solve_cholesky
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.residuals import (
    EXACT_POSE,
    INLIER_CHI2,
    Rows,
    bottom_is_given,
    fill_rows,
    hidden_odds,
    new_rows,
    whiten,
    whiten_by_factor,
)

STEP_TOLERANCE = 1e-6
"""Converged when no part of a step (m or rad) is larger."""
_UNPROJECTED = 1e12  # cost of a pair that does not project


@dataclass(frozen=True, eq=False)
class PairFit:
    """The optimum of ``fit_pairs``."""

    T_camera_map: Pose
    information: FloatArray  # (6, 6) of pairs, prior and belief, by the left perturbation
    trace: FloatArray  # (iterations + 1, 3) as ``fit`` returns it


def fit_pairs(
    problem: PoseProblem,
    prior: Prior | None,
    T_camera_map: Pose,
    pairs: IntArray,
    *,
    belief: Belief | None = None,
    iterations: int = 20,
) -> PairFit:
    """Fit a pose to ``pairs`` (k, 2), rows of observed and mapped, starting at ``T_camera_map``."""
    return fit_record(problem, PriorRecord.of(prior, belief), T_camera_map, pairs, iterations)


def fit_record(
    problem: PoseProblem,
    prior: PriorRecord,
    T_camera_map: Pose,
    pairs: IntArray,
    iterations: int | np.int64 = 20,
) -> PairFit:
    """Return ``fit_pairs`` for a prior and belief given as a record."""
    match = as_match(problem, pairs)
    start = T_camera_map.writable()
    R, t, _, trace = fit(problem, prior, *start, match, iterations)
    # residual covariances change with the pose: fit again with those of the optimum
    R, t, at_optimum, _ = fit(problem, prior, R, t, match, iterations)
    return PairFit(Pose(R, t), at_optimum, trace)


def information(
    problem: PoseProblem,
    prior: Prior | None,
    T_camera_map: Pose,
    pairs: IntArray,
    belief: Belief | None = None,
) -> FloatArray:
    """Return the Fisher information (6, 6) of ``pairs``, prior and belief at a pose, for left
    perturbations of T_camera_map."""
    start = T_camera_map.writable()
    return fit(problem, PriorRecord.of(prior, belief), *start, as_match(problem, pairs), 0)[2]


@compiled
def fit(
    problem: PoseProblem,
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    iterations: int | np.int64,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return rotation, translation, information (6, 6) and the trace of the iterations.

    ``match`` (m,) holds mapped rows, -1 for none. The residual covariances stay those of the
    start, so the cost can only fall. A row of the trace (at most iterations + 1) holds the cost
    after a step, and by how much it moved (m) and turned (rad) the camera, 0 if rejected.
    """
    factors = _factors(problem, R, t, match)
    rows, gradient = new_rows(), np.zeros(6)
    information, trial_information = np.zeros((6, 6)), np.zeros((6, 6))
    trace = np.zeros((iterations + 1, 3))
    trace[0, 0] = cost = _linearize(
        problem, prior, R, t, match, factors, rows, gradient, information
    )
    damping, done = 1e-4, 0
    accepted_gradient = gradient.copy()
    for iteration in range(iterations):
        step = _step(information, accepted_gradient, damping)
        new_R, new_t = rotate_left(R, t, step)
        new = _linearize(
            problem, prior, new_R, new_t, match, factors, rows, gradient, trial_information
        )
        if new <= cost:
            R, t, cost = new_R, new_t, new
            trace[iteration + 1, 1] = np.sqrt((step[:3] ** 2).sum())
            trace[iteration + 1, 2] = np.sqrt((step[3:] ** 2).sum())
            information[:], accepted_gradient[:] = trial_information, gradient
            damping = max(damping * 0.1, 1e-9)
        else:
            damping = min(damping * 10.0, 1e6)
        done = iteration + 1
        trace[done, 0] = cost
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return R, t, information, trace[: done + 1]


@compiled
def _factors(problem: PoseProblem, R: FloatArray, t: FloatArray, match: IntArray) -> FloatArray:
    """Return (m, 5, 4): the Cholesky factor (4, 4) of each pair's residual covariance, and in the
    last row the number of residuals and the odds of a hidden bottom."""
    factors = np.zeros((len(match), 5, 4))
    rows = new_rows()
    for i in range(len(match)):
        j = match[i]
        if j < 0:
            continue
        count = fill_rows(problem, R, t, i, j, rows)
        if count:
            whiten(problem, i, j, count, EXACT_POSE, rows)
            factors[i, :4] = rows.factor
            factors[i, 4, 0] = count
            if bottom_is_given(problem, i, j, count):
                factors[i, 4, 1] = hidden_odds(problem, count, rows)
    return factors


@compiled
def _linearize(
    problem: PoseProblem,
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    factors: FloatArray,
    rows: Rows,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Return the cost at a pose; fill its gradient (6,) and Gauss-Newton information (6, 6)."""
    gradient[:] = 0.0
    information[:] = 0.0
    residual, jacobian = np.empty(MOST_ROWS), np.empty((MOST_ROWS, 6))
    count = prior_rows(prior, R, t, residual, jacobian)
    cost = _add(residual, jacobian, count, 1.0, 1.0, gradient, information)
    for i in range(len(match)):
        if match[i] < 0:
            continue
        count = fill_rows(problem, R, t, i, match[i], rows)
        if count == 0 or count != factors[i, 4, 0]:
            cost += _UNPROJECTED  # fewer or more rows than at the start: the step is too long
            continue
        rows.factor[:] = factors[i, :4]
        whiten_by_factor(count, rows, True)
        cost += _add_pair(problem, rows, count, factors[i, 4, 1], gradient, information)
    return cost


@compiled_leaf
def _add_pair(
    problem: PoseProblem,
    rows: Rows,
    count: int,
    odds: float,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Add a pair and return its cost: Huber beyond the inlier test, the bottom weighted by the
    probability that it is seen."""
    seen, cost = 1.0, 0.0
    last = rows.residual[count - 1]
    if odds > 0.0:
        visible = (1.0 - problem.setting.hidden_bottoms) * np.exp(-0.5 * last * last)
        seen = visible / (visible + odds)
        # -2 log of the mixture, which is 0 at e = 0; the squares below add seen * e^2 again
        mixture = -2.0 * np.log((visible + odds) / (1.0 - problem.setting.hidden_bottoms + odds))
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


@compiled_leaf
def _add(
    residual: FloatArray,
    jacobian: FloatArray,
    count: int,
    weight: float,
    last: float,
    gradient: FloatArray,
    information: FloatArray,
) -> float:
    """Add rows of equal weight, the last times ``last``; return the weighted sum of squares."""
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


def as_match(problem: PoseProblem, pairs: IntArray) -> IntArray:
    """Return the mapped row (m,) of each observed element, -1 for none, from ``pairs`` (k, 2)."""
    match = np.full(len(problem.seen), -1, dtype=np.int64)
    match[pairs[:, 0]] = pairs[:, 1]
    return match
