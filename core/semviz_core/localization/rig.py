"""Localize a rig: one pose from what all of its cameras see, each at its own time.

Each camera is searched on its own. Every mode found by one of them is paired in all images, fitted
to the pairs of all, and rated by all; the best joint mode is refined and judged as that of a
single camera is. A camera pairs an element of the map once, and others may pair it too.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.frame import Prior, adjoint
from semviz_core.base.localization import Localization, Search
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import Stopwatch
from semviz_core.common.linalg import inverse
from semviz_core.localization.association import all_gains
from semviz_core.localization.camera_views import STANDING, BodyMotion, CameraView, prior_of_camera
from semviz_core.localization.crowding import pairs_by_chance
from semviz_core.localization.heading_votes import DEFAULT_EFFORT
from semviz_core.localization.least_squares import fit
from semviz_core.localization.localizer import alternatives_of, nothing_fits, too_few
from semviz_core.localization.match_probabilities import posterior_match
from semviz_core.localization.problem import PriorRecord
from semviz_core.localization.refinement import Failure, PoseEstimate, refine_pose
from semviz_core.localization.request import check_request
from semviz_core.localization.residuals import EXACT_POSE, problem_residuals
from semviz_core.localization.rig_problem import RigPart, RigProblem
from semviz_core.localization.search import (
    FITTED_COVARIANCE,
    HOPELESS_NATS,
    SCALE_NATS,
    SCALED_MODES,
    SIGMA_SCALES,
    STEPS,
    Candidates,
    Modes,
    distinct,
    near_best,
    search,
)
from semviz_core.localization.status import (
    StatusDecision,
    decide_status,
    explicable_elements,
)
from semviz_core.localization.upright import assumed_upright

ROUNDS = 4
"""Most rounds of pairing and fitting until the pairs stay the same."""


def localize_rig(
    views: Sequence[CameraView],
    submap: Elements3D,
    prior: Prior,
    *,
    motion: BodyMotion = STANDING,
    classes: ClassSet = DEFAULT_CLASSES,
    detector: DetectorModel | None = None,
) -> tuple[Localization, ...]:
    """Return the result of each view: one status and reason, and poses that follow from one pose.

    ``prior`` is that of the first view's camera. Poses are those at the time of the frame;
    ``motion`` is that of the body then. Elements in a reason are counted through all views. Raise
    SemvizError if the input is inconsistent, with the number of the view (from 0).
    """
    if not views:
        raise SemvizError("a rig without cameras; give the view of one camera or more")
    first = views[0].T_body_camera
    mounts = [view.T_body_camera.inverse() @ first for view in views]
    priors = [prior_of_camera(prior, mount) for mount in mounts]
    for number, (view, own) in enumerate(zip(views, priors, strict=True)):
        try:
            check_request(view.observed, submap, view.camera, own, classes)
        except SemvizError as error:
            raise SemvizError(f"view {number}: {error}") from error
    watch = Stopwatch()
    works = [
        Localization(
            "search", view.camera, own, view.observed, submap,
            status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=watch.time_ms,
        )
        for view, own in zip(views, (prior, *priors[1:]), strict=True)
    ]  # fmt: skip
    if reason := too_few(joined(*(view.observed for view in views)), submap):
        return tuple(replace(work, reason=reason) for work in works)
    problem = RigProblem.of(views, submap, motion, detector)
    return _estimated(works, problem, submap, assumed_upright(prior), watch)


def _joint_modes(problem: RigProblem, prior: Prior, record: PriorRecord) -> Modes:
    """Return the modes of the rig, best first: those of each camera, fitted to all images."""
    seeds: list[tuple[FloatArray, FloatArray, IntArray]] = []
    evaluated = passed = 0
    for part in problem.parts:
        if not len(part.problem.seen):
            continue
        own = search(part.problem, prior_of_camera(prior, part.T_camera_first))
        evaluated, passed = evaluated + own.evaluated, passed + own.passed
        T_first_camera = part.T_camera_first.inverse()
        for R, t, match in zip(own.rotation, own.translation, own.match, strict=True):
            all_match = np.full(len(problem.whole.seen), -1)
            all_match[part.rows] = match
            T = T_first_camera @ Pose(R, t)
            seeds.append((*T.writable(), all_match))
    modes = Modes(evaluated, passed, *_settled(problem, record, seeds))
    scale = _likely_scale(problem, record, modes)
    if scale == 1.0:
        return modes
    seeds = list(zip(modes.rotation, modes.translation, modes.match, strict=True))
    scaled = _settled(problem.with_sigma_scale(scale), record, seeds)
    return Modes(evaluated, passed, *scaled, scale)


def _settled(
    problem: RigProblem,
    prior: PriorRecord,
    seeds: Sequence[tuple[FloatArray, FloatArray, IntArray]],
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
    """Return the distinct poses (rotation, translation, score, match, gain) that seeds end at."""
    b, (M, n) = len(seeds), problem.whole.compatible.shape
    fitted = Candidates(np.empty((b, 3, 3)), np.empty((b, 3)), np.empty(b))
    matches = np.empty((b, M), dtype=np.int64)
    for row, seed in enumerate(seeds):
        R, t, matches[row], fitted.score[row] = _fit_until_stable(problem, prior, *seed)
        fitted.rotation[row], fitted.translation[row] = R, t
    best = near_best(fitted, distinct(fitted), DEFAULT_EFFORT) if b else np.empty(0, dtype=np.int64)
    gains = np.empty((len(best), M, n))
    for k, row in enumerate(best):
        for part in problem.parts:
            pose = part.pose(fitted.rotation[row], fitted.translation[row])
            gains[k, part.rows] = all_gains(part.problem, *pose)
    return (
        fitted.rotation[best],
        fitted.translation[best],
        fitted.score[best],
        matches[best],
        gains,
    )


def _fit_until_stable(
    problem: RigProblem, prior: PriorRecord, R: FloatArray, t: FloatArray, match: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Fit a pose to its pairs until they stay the same; return it, its pairs and its score.

    Other cameras look elsewhere, so the pairs of one leave much open there: gates are as wide as
    the fit says, and narrow as more cameras have pairs.
    """
    wider = FITTED_COVARIANCE
    for _ in range(ROUNDS):
        R, t, information, _ = fit(problem.whole, prior, R, t, match, STEPS)
        before = match
        match, _ = problem.associated(R, t, inverse(information) + wider)
        wider = EXACT_POSE
        if (match == before).all():
            break
    R, t, _, _ = fit(problem.whole, prior, R, t, match, STEPS)
    match, gain = problem.associated(R, t, EXACT_POSE)
    return R, t, match, problem.score(prior, R, t, match, gain)


def _likely_scale(problem: RigProblem, prior: PriorRecord, modes: Modes) -> float:
    """Return ``search.likely_sigma_scale`` for all cameras."""
    likely, best = 1.0, modes.score[0] if len(modes.score) else np.inf
    for scale in SIGMA_SCALES:
        scaled, cost = problem.with_sigma_scale(scale), SCALE_NATS * np.log(scale)
        for row in range(min(len(modes.score), SCALED_MODES)):
            R, t = modes.rotation[row].copy(), modes.translation[row].copy()
            match, gain = scaled.associated(R, t, EXACT_POSE)
            if scaled.score(prior, R, t, match, gain) < best + cost - HOPELESS_NATS:
                continue
            fitted = _fit_until_stable(scaled, prior, R, t, match)[3] - cost
            if fitted > best:
                best, likely = fitted, scale
    return likely


def _estimated(
    works: Sequence[Localization],
    problem: RigProblem,
    submap: Elements3D,
    prior: Prior,
    watch: Stopwatch,
) -> tuple[Localization, ...]:
    """Complete ``works``, one a view: search, association, refinement, status."""
    record = PriorRecord.of(prior)
    modes = watch.time("search", lambda: _joint_modes(problem, prior, record))
    problem = problem.with_sigma_scale(modes.sigma_scale)
    if not len(modes.score):
        return tuple(replace(work, reason=nothing_fits(prior)) for work in works)
    works = [_searched(*each, modes) for each in zip(works, problem.parts, strict=True)]
    best = Pose(modes.rotation[0], modes.translation[0])
    estimate = watch.time("refine", lambda: refine_pose(problem.whole, prior, best, modes.pairs(0)))
    if isinstance(estimate, Failure):
        return tuple(replace(work, reason=estimate.reason) for work in works)
    by_chance = sum(
        pairs_by_chance(part.problem, part.T_camera_first @ estimate.T_camera_map)
        for part in problem.parts
    )
    images = [view.observed for view in problem.views]
    explicable = sum(explicable_elements(observed, submap) for observed in images)
    decision = decide_status(
        modes, estimate, joined(*images), submap, prior, by_chance=by_chance, explicable=explicable
    )
    if len(works) > 1:
        decision = replace(decision, reason=f"{len(works)} cameras: {decision.reason}")
    return tuple(
        _completed(work, part, estimate, decision)
        for work, part in zip(works, problem.parts, strict=True)
    )


def _searched(work: Localization, part: RigPart, modes: Modes) -> Localization:
    """Return ``work`` with the poses of its camera, and its correspondences."""
    poses = (Pose(R, t) for R, t in zip(modes.rotation, modes.translation, strict=True))
    of_camera = tuple(part.mount @ pose for pose in poses)
    mapped, gain = modes.match[:, part.rows], np.ascontiguousarray(modes.gain[:, part.rows])
    match = posterior_match(modes.score, gain, part.problem.compatible)
    found = Search(modes.evaluated, of_camera, modes.score, modes.passed, mapped)
    return replace(work, search=found, match=match)


def _completed(
    work: Localization, part: RigPart, estimate: PoseEstimate, decision: StatusDecision
) -> Localization:
    """Return ``work`` with the pose of its camera, and its pairs."""
    has_pose, fit, A = decision.status != "cannot", estimate.refinement, adjoint(part.mount)
    own = (fit.pairs[:, 0] >= part.rows.start) & (fit.pairs[:, 0] < part.rows.stop)
    assert fit.support is not None
    assert fit.open_m is not None
    assert work.search is not None
    pairs = fit.pairs[own] - [part.rows.start, 0]
    T = part.T_camera_first @ estimate.T_camera_map
    refined = replace(
        fit,
        pairs=pairs,
        residual_px=problem_residuals(part.problem, T, pairs).residual_px,
        chi2=fit.chi2[own],
        inlier=fit.inlier[own],
        support=fit.support[own],
        open_m=fit.open_m[own],
    )
    return replace(
        work,
        status=decision.status,
        reason=decision.reason,
        T_camera_map=part.mount @ estimate.T_camera_map if has_pose else None,
        covariance=A @ estimate.covariance @ A.T if has_pose else None,
        refinement=refined,
        alternatives=alternatives_of(work.search),
    )
