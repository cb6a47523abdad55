"""Search upright poses within the prior, and return the modes that explain the image.

Module `heading_votes` proposes candidates; `correspondences` is another source. Module `rating`
rates them, refines the best and rates these again. The best distinct ones are paired one-to-one
and fitted, with gates that narrow as they converge. The distinct results are the modes, best
first.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.common.linalg import inverse
from semviz_core.localization.association import all_gains, associate, log_likelihood
from semviz_core.localization.crowding import chance_explains, pairs_by_chance
from semviz_core.localization.heading_votes import (
    DEFAULT_EFFORT,
    Effort,
    grid_step,
    vote_headings,
)
from semviz_core.localization.least_squares import fit
from semviz_core.localization.problem import PoseProblem, PriorRecord, RecordArray
from semviz_core.localization.rating import (
    REFINED_SIGMAS,
    rate_poses,
    refine_candidates,
)
from semviz_core.localization.residuals import EXACT_POSE
from semviz_core.localization.upright import UprightView, likely_ups, upright_view

BASIN_M, BASIN_RAD = 2.5, float(np.deg2rad(8.0))
"""A candidate closer than both usually converges to the pose."""
TRIED_APART_M, TRIED_APART_RAD = 0.5 * BASIN_M, 0.5 * BASIN_RAD
"""Of candidates closer than both only the best is fitted. Within a basin it may be one that ends a
post off in a row of posts: then its neighbour finds the pose."""
APART_M, APART_RAD = 1.0, float(np.deg2rad(2.0))
"""Poses further apart than either are different modes."""
REFINED_COVARIANCE: FloatArray = np.diag([0.3**2] * 3 + [np.deg2rad(0.7) ** 2] * 3)
"""Assumed covariance of a refined candidate."""
FITTED_COVARIANCE: FloatArray = np.diag([0.1**2] * 3 + [np.deg2rad(0.2) ** 2] * 3)
"""Assumed covariance after the first fit, in addition to that of the fit."""
# Compiled code passes copies: its constants are read-only, for which numba compiles once more.

FIRST_STEPS, STEPS, STEPS_WITHOUT = np.int64(3), np.int64(5), np.int64(4)
"""Most steps of a fit: of a candidate, to new pairs, and without one of the pairs. Plain integers
would have the fit compiled once for each of them."""


@dataclass(frozen=True, eq=False)
class Modes:
    """b distinct poses, best first, with their pairs."""

    evaluated: int
    """Positions and headings that the vote proposed."""
    passed: int
    """Those of them that were rated."""
    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    score: FloatArray  # (b,) nats
    match: IntArray  # (b, m)
    gain: FloatArray  # (b, m, n)
    sigma_scale: float = 1.0
    """Likely sigma of the detections over the stated one; scores, pairs and gains are with it."""

    def pairs(self, row: int) -> IntArray:
        """Return the pairs (k, 2) of a mode, as rows of observed and mapped elements."""
        seen = np.flatnonzero(self.match[row] >= 0)
        return np.column_stack([seen, self.match[row, seen]])


def pose_distances(
    rotation: FloatArray, translation: FloatArray, other_rotation: FloatArray, other: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the distances (b,) of the camera centres in metres, and the angles (b,) in radians,
    from a pose to b others."""
    center = -rotation.T @ translation
    centers = -np.einsum("bji,bj->bi", other_rotation, other)
    trace = np.einsum("ij,bij->b", rotation, other_rotation)
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    return np.linalg.norm(centers - center, axis=1), angle


class Candidates(NamedTuple):
    """b poses with their scores."""

    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    score: FloatArray  # (b,)


class ProposedCandidates(NamedTuple):
    """Upright poses of one view, the likeliest first."""

    pose: FloatArray
    """(h, 6) as in ``heading_votes.PoseCandidates``; at most ``Effort.polished``."""
    evaluated: int
    """Number of poses proposed."""
    rated: int
    """Number of those that were rated."""


class Propose(Protocol):
    """A source of upright poses."""

    def __call__(
        self, problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
    ) -> ProposedCandidates: ...


@compiled
def most_voted(
    problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
) -> ProposedCandidates:
    """Propose the poses of the grid round the fix with the highest votes."""
    voted = vote_headings(problem, view, prior, effort)
    return ProposedCandidates(voted.pose, voted.evaluated, len(voted.pose))


def search(
    problem: PoseProblem,
    prior: Prior,
    effort: Effort = DEFAULT_EFFORT,
    propose: Propose = most_voted,
) -> Modes:
    """Return the modes of the pose, best first; none if no candidate passes the gates."""
    record = PriorRecord.of(prior)
    evaluated = passed = 0
    parts: list[Candidates] = []
    effort = effort._replace(step_m=grid_step(problem, effort.step_m))
    ups, up_sigma_rad = likely_ups(problem, record)
    view_effort = _effort_per_view(effort, len(ups))
    for up in ups:
        view = upright_view(problem, up, up_sigma_rad)
        proposal = propose(problem, view, record, view_effort)
        evaluated, passed = evaluated + proposal.evaluated, passed + proposal.rated
        parts.append(_fitted_candidates(problem, view, record, proposal.pose, view_effort))
    candidates = Candidates(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    modes = Modes(evaluated, passed, *_final_modes(problem, record, candidates, effort))
    if _is_explained_by_chance(problem, modes):  # as larger sigmas would be
        return modes
    scale = likely_sigma_scale(problem, record, modes.rotation, modes.translation, modes.score)
    if scale == 1.0:
        return modes
    candidates = Candidates(modes.rotation, modes.translation, modes.score)
    fitted = _final_modes(with_sigma_scale(problem, scale), record, candidates, effort)
    return Modes(evaluated, passed, *fitted, scale)


def _is_explained_by_chance(problem: PoseProblem, modes: Modes) -> bool:
    """Return whether the best mode, if any, may fit by chance."""
    if not len(modes.score):
        return False
    best = Pose(modes.rotation[0], modes.translation[0])
    return chance_explains(pairs_by_chance(problem, best), len(modes.pairs(0)))


def _effort_per_view(effort: Effort, views: int) -> Effort:
    """Return the effort per view: the candidates of several views are much the same."""
    started = max(effort.started // views, min(effort.started, DEFAULT_EFFORT.started))
    polished = effort.polished * started // effort.started
    return effort._replace(started=started, polished=polished)


def mode_near(problem: PoseProblem, prior: Prior, T_camera_map: Pose) -> Modes:
    """Return the single mode near a pose, fitted and scored as in ``search``."""
    R, t = T_camera_map.rotation.copy(), T_camera_map.translation.copy()
    match, _ = associate(problem, R, t, FITTED_COVARIANCE.copy())
    R, t, match, score = _fit_until_stable(problem, PriorRecord.of(prior), R, t, match)
    gain = all_gains(problem, R, t)
    return Modes(1, 1, R[None], t[None], np.array([score]), match[None], gain[None])


@compiled
def _fitted_candidates(
    problem: PoseProblem, view: UprightView, prior: PriorRecord, poses: FloatArray, effort: Effort
) -> Candidates:
    """Return the best distinct ones of poses (h, 6), paired and fitted once."""
    if len(poses) == 0:
        return Candidates(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0))
    poses = refine_candidates(problem, view, poses, effort.step_m)
    rating = rate_poses(problem, view, prior, poses, REFINED_SIGMAS)
    chosen = _distinct_best(poses, rating, effort)
    b = len(chosen)
    candidates = Candidates(np.empty((b, 3, 3)), np.empty((b, 3)), np.empty(b))
    for row in range(b):
        R, t = camera_pose(view, poses[chosen[row]])
        match, _ = associate(problem, R, t, REFINED_COVARIANCE.copy())
        R, t, information, _ = fit(problem, prior, R, t, match, FIRST_STEPS)
        match, gain = associate(problem, R, t, inverse(information) + FITTED_COVARIANCE)
        candidates.rotation[row], candidates.translation[row] = R, t
        candidates.score[row] = log_likelihood(problem, prior, R, t, match, gain)
    return candidates


@compiled
def camera_pose(view: UprightView, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and translation (3,) of T_camera_map for an upright pose (6,)."""
    c, s = pose[3], pose[4]
    level, raised = np.cos(pose[5]), np.sin(pose[5])
    nominal, left, up = view.R_level_camera[0], view.R_level_camera[1], view.R_level_camera[2]
    R, t = np.empty((3, 3)), np.empty(3)
    for k in range(3):
        ahead = level * nominal[k] - raised * up[k]
        R[k, 0], R[k, 1] = ahead * c - left[k] * s, ahead * s + left[k] * c
        R[k, 2] = level * up[k] + raised * nominal[k]
        t[k] = -(R[k, 0] * pose[0] + R[k, 1] * pose[1] + R[k, 2] * pose[2])
    return R, t


@compiled
def _distinct_best(poses: FloatArray, rating: FloatArray, effort: Effort) -> IntArray:
    """Return the rows of the best ``effort.started`` candidates of which no two are close."""
    likely = np.flatnonzero(rating > rating.max() - effort.hopeful_nats)
    order = likely[np.argsort(-rating[likely], kind="mergesort")]
    kept = np.empty(effort.started, dtype=np.int64)
    count = 0
    for row in order:
        new = True
        for k in range(count):
            dx, dy = poses[row, 0] - poses[kept[k], 0], poses[row, 1] - poses[kept[k], 1]
            if dx * dx + dy * dy < TRIED_APART_M * TRIED_APART_M:
                turn = poses[row, 3] * poses[kept[k], 3] + poses[row, 4] * poses[kept[k], 4]
                if turn > np.cos(TRIED_APART_RAD):
                    new = False
                    break
        if new:
            kept[count] = row
            count += 1
            if count == effort.started:
                break
    return kept[:count]


@compiled
def _final_modes(
    problem: PoseProblem, prior: PriorRecord, candidates: Candidates, effort: Effort
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
    """Fit candidates until they converge; return the distinct results, best first."""
    m, n = problem.compatible.shape
    kept = near_best(candidates, distinct(candidates)[: effort.finished], effort)
    b = len(kept)
    fitted = Candidates(np.empty((b, 3, 3)), np.empty((b, 3)), np.empty(b))
    matches = np.empty((b, m), dtype=np.int64)
    for row in range(b):
        R, t = candidates.rotation[kept[row]].copy(), candidates.translation[kept[row]].copy()
        match, _ = associate(problem, R, t, FITTED_COVARIANCE.copy())
        _store(fitted, matches, row, _fit_until_stable(problem, prior, R, t, match))
    best = distinct(fitted)
    for row in near_best(fitted, best[: effort.improved], effort):
        start = fitted.rotation[row], fitted.translation[row], matches[row], fitted.score[row]
        _store(fitted, matches, row, _without_false_pair(problem, prior, *start))
    best = distinct(fitted)
    gains = np.empty((len(best), m, n))
    for k in range(len(best)):
        gains[k] = all_gains(problem, fitted.rotation[best[k]], fitted.translation[best[k]])
    return (
        fitted.rotation[best],
        fitted.translation[best],
        fitted.score[best],
        matches[best],
        gains,
    )


SIGMA_SCALES = (1.5, 2.2, 3.3, 5.0)
"""Sigmas of the detections that are tried, over the stated one."""
SCALE_NATS = 3.0
"""Nats that a scale has to gain for each factor of e: detectors know their sigma roughly."""
SCALED_MODES = 3
LIKELY_SCALE, HOPELESS_NATS = 2.2, 4.0
"""Scales are tried only if the best mode, without being fitted again, loses less at the first, and
each only if it loses less there."""


@compiled
def likely_sigma_scale(
    problem: PoseProblem,
    prior: PriorRecord,
    rotation: FloatArray,
    translation: FloatArray,
    score: FloatArray,
) -> float:
    """Return the likely sigma of the detections over the stated one: 1, or one of SIGMA_SCALES.

    ``rotation`` (b, 3, 3), ``translation`` (b, 3) and ``score`` (b,) are those of the modes. Scores
    are likelihoods, so they compare sigmas: a larger one fits more pairs, each worth less.
    """
    likely = 1.0
    if not len(score):
        return likely
    best, R, t = score[0], rotation[0].copy(), translation[0].copy()
    seen = problem.seen.copy()
    trial = PoseProblem(
        problem.setting, seen, problem.mapped, problem.candidate, problem.compatible,
        problem.order, problem.anchor_m,
    )  # fmt: skip
    _scale_sigmas(problem, LIKELY_SCALE, seen)
    if _score_at(trial, prior, R, t) < best - HOPELESS_NATS:
        return likely
    for scale in SIGMA_SCALES:
        cost = SCALE_NATS * np.log(scale)
        _scale_sigmas(problem, scale, seen)
        if _score_at(trial, prior, R, t) < best + cost - HOPELESS_NATS:
            continue
        for row in range(min(len(score), SCALED_MODES)):
            start = rotation[row].copy(), translation[row].copy()
            match, _ = associate(trial, *start, FITTED_COVARIANCE.copy())
            fitted = _fit_until_stable(trial, prior, *start, match)[3] - cost
            if fitted > best:
                best, likely = fitted, scale
    return likely


@compiled_leaf
def _scale_sigmas(problem: PoseProblem, scale: float, seen: RecordArray) -> None:
    """Set the sigmas of ``seen``, a copy of the problem's, to multiples of theirs."""
    for i in range(len(seen)):
        for axis in range(2):
            seen[i].variance_px2[axis] = problem.seen[i].variance_px2[axis] * scale * scale


@compiled
def _score_at(problem: PoseProblem, prior: PriorRecord, R: FloatArray, t: FloatArray) -> float:
    """Return the score of a pose as it is."""
    match, gain = associate(problem, R, t, EXACT_POSE.copy())
    return log_likelihood(problem, prior, R, t, match, gain)


def with_sigma_scale(problem: PoseProblem, scale: float) -> PoseProblem:
    """Return ``problem`` with all sigmas of the detections multiplied."""
    if scale == 1.0:
        return problem
    seen = problem.seen.copy()
    seen["variance_px2"] *= scale**2
    return problem._replace(seen=seen)


@compiled
def _store(
    settled: Candidates,
    matches: IntArray,
    row: int,
    fitted: tuple[FloatArray, FloatArray, IntArray, float],
) -> None:
    settled.rotation[row], settled.translation[row] = fitted[0], fitted[1]
    matches[row], settled.score[row] = fitted[2], fitted[3]


@compiled
def _fit_until_stable(
    problem: PoseProblem, prior: PriorRecord, R: FloatArray, t: FloatArray, match: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Fit the pose to its pairs until they stay the same; return it, its pairs and its score."""
    for _ in range(3):
        R, t, information, _ = fit(problem, prior, R, t, match, STEPS)
        before = match
        match, _ = associate(problem, R, t, inverse(information))
        if (match == before).all():
            break
    R, t, _, _ = fit(problem, prior, R, t, match, STEPS)
    match, gain = associate(problem, R, t, EXACT_POSE.copy())
    return R, t, match, log_likelihood(problem, prior, R, t, match, gain)


@compiled
def _without_false_pair(
    problem: PoseProblem,
    prior: PriorRecord,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    score: float,
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Return the best pose fitted without one of its pairs, or the given one if none is better.

    A false pair, for example with a neighbour or a duplicate of the true element, pulls the pose
    until other pairs fail the inlier test.
    """
    best = R, t, match, score
    for i in range(len(match)):
        if match[i] < 0:
            continue
        without = match.copy()
        without[i] = -1
        free_R, free_t, information, _ = fit(problem, prior, R, t, without, STEPS_WITHOUT)
        again, _ = associate(problem, free_R, free_t, inverse(information))
        if (again == match).all():
            continue  # the other pairs confirm this one
        fitted = _fit_until_stable(problem, prior, free_R, free_t, again)
        if fitted[3] > best[3]:
            best = fitted
    return best


@compiled
def distinct(candidates: Candidates) -> IntArray:
    """Return the rows of candidates, best first, without those close to a better one."""
    order = np.argsort(-candidates.score, kind="mergesort")
    kept = np.empty(len(order), dtype=np.int64)
    count = 0
    for row in order:
        new = True
        for k in range(count):
            distance, angle = _distance(candidates, kept[k], row)
            if distance <= APART_M and angle <= APART_RAD:
                new = False
                break
        if new:
            kept[count] = row
            count += 1
    return kept[:count]


@compiled
def near_best(candidates: Candidates, order: IntArray, effort: Effort) -> IntArray:
    """Return the rows of ``order``, best first, that are not far below the best."""
    count = 0
    while count < len(order):
        if candidates.score[order[count]] < candidates.score[order[0]] - effort.hopeful_nats:
            break
        count += 1
    return order[:count]


@compiled_leaf
def _distance(candidates: Candidates, a: int, b: int) -> tuple[float, float]:
    """Return the distance of the camera centres (m) and the angle (rad) between two poses."""
    R, t = candidates.rotation[a], candidates.translation[a]
    other_R, other_t = candidates.rotation[b], candidates.translation[b]
    square, trace = 0.0, 0.0
    for column in range(3):
        off = 0.0
        for row in range(3):
            off += other_R[row, column] * other_t[row] - R[row, column] * t[row]
            trace += other_R[row, column] * R[row, column]
        square += off * off
    return np.sqrt(square), np.arccos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))
