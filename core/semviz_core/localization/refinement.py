"""Refine a nearby pose to its optimum, with covariance and pairs, or the reason for none.

The leave-one-out support of a pair measures how well the other pairs confirm it. As in
surveying (Baarda 1968), a wrong pair is detected only where other pairs contradict it. Where
they leave the position open, or allow much besides the pair, a wrong pair stays undetected.
Degenerate shapes of the matched elements, which fix no pose at any noise, are recognized too.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.frame import Prior
from semviz_core.base.localization import Refinement
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import inverse
from semviz_core.localization.association import associate, pair_gain
from semviz_core.localization.least_squares import as_match, fit, fit_record
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.residuals import EXACT_POSE, new_rows, problem_residuals

ITERATIONS = np.int64(8)
"""NumPy's, here and below: for plain integers the fit is compiled once more each."""


@compiled
def leave_one_out_support(
    problem: PoseProblem, prior: PriorRecord, R: FloatArray, t: FloatArray, match: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return how well the other pairs confirm each pair, and how much the pose depends on it.

    ``support`` (m,) is the gain of an observed element's pair (nats over a false detection) under
    the pose and covariance of all other pairs, -inf beyond the gate. ``open_m`` (m,) is how far the
    camera moves without the pair, or how uncertain its position then is. NaN without a pair.
    """
    support, open_m = np.full(len(match), np.nan), np.full(len(match), np.nan)
    rows = new_rows()
    for i in range(len(match)):
        if match[i] < 0:
            continue
        without = match.copy()
        without[i] = -1
        free_R, free_t, information, _ = fit(problem, prior, R, t, without, ITERATIONS)
        covariance = inverse(information)
        if not np.trace(covariance) > 0.0:  # the others fix no pose at all
            support[i], open_m[i] = -np.inf, np.inf
            continue
        support[i] = pair_gain(problem, free_R, free_t, i, match[i], covariance, rows)
        shift = free_R.T @ free_t - R.T @ t
        variance_m2 = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
        open_m[i] = np.sqrt(max((shift**2).sum(), variance_m2))
    return support, open_m


ONE_LINE_M = 0.1
"""Points closer to one straight line than this count as collinear."""
PARALLEL_RAD = float(np.deg2rad(2.0))
"""Lines closer to one direction than poles lean count as parallel."""


def degeneracy_reason(anchor_m: FloatArray, end_m: FloatArray, known: BoolArray) -> str:
    """Return why mapped elements (k, 3) fix no pose, in one sentence; empty if they may.

    ``known`` (k, 2) states whether anchor and end are points known on both sides. The end of a
    point is its anchor.
    """
    points = np.concatenate([anchor_m, end_m])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < ONE_LINE_M * np.sqrt(len(points)):
        return (
            "All matched elements lie on one straight line, such as one post: "
            "the camera could be anywhere around it."
        )
    if not known.any() and _parallel(end_m - anchor_m):
        return (
            "All matches are parallel lines without a peak or bottom known on both sides: "
            "the camera's height is not fixed."
        )
    return ""


def _parallel(directions: FloatArray) -> bool:
    unit = unit_vectors(directions)
    return bool((np.abs(unit @ unit[0]) > np.cos(PARALLEL_RAD)).all())


FIXING_PAIRS = 2
"""Two pairs fix an upright pose."""
NEEDED_PAIRS = 3
"""A third pair is the first that can contradict two."""
MOST_SIGMA_M = 3.0
"""A pose with a larger sigma along any direction is rejected."""
MOST_SIGMA_RAD = float(np.deg2rad(5.0))
START_COVARIANCE: FloatArray = np.diag([0.15**2] * 3 + [np.deg2rad(0.3) ** 2] * 3)
"""Assumed covariance of the pose that refinement starts from."""
_ROUNDS = 6
_ITERATIONS = np.int64(20)


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The optimum found by ``refine_pose``."""

    T_camera_map: Pose
    covariance: FloatArray
    """(6, 6) of the left perturbation, from pairs and prior."""
    refinement: Refinement


@dataclass(frozen=True)
class Failure:
    """No pose."""

    reason: str
    """One sentence."""


def refine_pose(
    problem: PoseProblem,
    prior: Prior,
    T_camera_map: Pose,
    pairs: IntArray | None = None,
    needed_pairs: int = NEEDED_PAIRS,
) -> PoseEstimate | Failure:
    """Fit the pose to pairs and prior by robust least squares, starting at ``T_camera_map``.

    Given ``pairs`` (k, 2) are kept (the paper's eq. 8 with a Boolean P). Otherwise fit and
    one-to-one association alternate until the pairs stay the same.
    """
    record = PriorRecord.of(prior)
    if pairs is None:
        pairs = _stable_pairs(problem, record, T_camera_map)
    if len(pairs) < needed_pairs:
        seen = len(problem.seen)
        return Failure(f"{len(pairs)} of {seen} elements fit one pose, {needed_pairs} needed.")
    best = fit_record(problem, record, T_camera_map, pairs, _ITERATIONS)
    covariance = _covariance(best.information)
    if covariance is None:  # no element is ahead of the fitted pose: the prior alone is left
        return Failure("Refinement ended at a pose that the pairs do not fix.")
    if reason := _too_uncertain(covariance):
        return Failure(_degeneracy(problem, pairs) or reason)
    residuals = problem_residuals(problem, best.T_camera_map, pairs)
    R, t = best.T_camera_map.writable()
    support, open_m = leave_one_out_support(problem, record, R, t, as_match(problem, pairs))
    refinement = Refinement(
        pairs, residuals.residual_px, residuals.chi2, residuals.inlier, best.trace[:, 0],
        support[pairs[:, 0]], open_m[pairs[:, 0]], best.trace[1:, 1:],
    )  # fmt: skip
    return PoseEstimate(best.T_camera_map, covariance, refinement)


def _stable_pairs(problem: PoseProblem, prior: PriorRecord, T_camera_map: Pose) -> IntArray:
    """Return one-to-one pairs (k, 2) that do not change when the pose is fitted to them."""
    R, t = T_camera_map.writable()
    match, _ = associate(problem, R, t, START_COVARIANCE)
    for _ in range(_ROUNDS):
        R, t, _, _ = fit(problem, prior, R, t, match, _ITERATIONS)
        before = match
        match, _ = associate(problem, R, t, EXACT_POSE)
        if np.array_equal(match, before):
            break
    seen = np.flatnonzero(match >= 0)
    return np.column_stack([seen, match[seen]])


def _degeneracy(problem: PoseProblem, pairs: IntArray) -> str:
    seen, mapped = problem.seen[pairs[:, 0]], problem.mapped[pairs[:, 1]]
    known = (seen["known"] & mapped["known"]).astype(bool)
    return degeneracy_reason(mapped["anchor_m"], mapped["end_m"], known)


def _covariance(information: FloatArray) -> FloatArray | None:
    """Return the inverse (6, 6); None if it is singular."""
    try:
        return np.asarray(np.linalg.inv(information), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _too_uncertain(covariance: FloatArray) -> str:
    """Return why a pose with this covariance is rejected; empty if it is certain enough."""
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    if sigma_m > MOST_SIGMA_M:
        return f"The pairs fix the position only to {sigma_m:.1f} m, {MOST_SIGMA_M:.0f} m needed."
    if sigma_rad > MOST_SIGMA_RAD:
        sigma_deg, most_deg = np.rad2deg([sigma_rad, MOST_SIGMA_RAD])
        return f"The pairs fix the rotation only to {sigma_deg:.1f} deg, {most_deg:.0f} deg needed."
    return ""
