"""Causes that concern a whole frame: the sigma of its detections, and a map that is out of place.

The errors of the map are known and do not change, so the scale of the residuals is that of the
detections alone.

If the map is shifted or turned as a whole against the true pose, the image fits the map well, at a
pose near the true one but not at it. In one frame, the map, the true pose, its time stamp and the
mounting of the camera are equally suspect.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.fault import EvidenceItem, Fault
from semviz_core.diagnosis.reference import (
    FrameReference,
    PairErrors,
    pair_errors,
    pose_distance,
    whitened_rows,
)
from semviz_core.localization.association import associate
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import Failure, PoseEstimate, refine_pose
from semviz_core.localization.residuals import EXACT_POSE, problem_residuals
from semviz_core.localization.search import Modes, mode_near
from semviz_core.localization.upright import assumed_upright

SCALES: FloatArray = np.geomspace(1.0, 8.0, 25)
LEAST_SCALE = 1.8
"""Smallest factor between true and stated sigma that is a fault."""
LEAST_NATS = 4.0
"""Log-likelihood ratio of the scale, without the pair that it helps most: one moved element is no
fault of the sigma."""
GATE_SCALE = 4.0
"""Pairs are sought with sigmas larger by this."""
LEAST_SIGMA_FIT = 0.8
"""Share of the residuals that must fit with the likeliest scale."""
MOST_CHI2 = 16.0
"""Squared residuals count up to this: a wrong pair is as wrong as it can be."""


def sigma_fault(case: FrameReference, localization: Localization) -> Fault | None:
    """Return the fault of sigmas that are too small, at the pose that the image supports.

    A map that is shifted as a whole is no fault of the sigmas. ``localization`` gives the pose if
    the true one is unknown.
    """
    gain = sigma_gains(case, localization)
    return None if gain is None else likeliest_sigma_fault(gain)


def likeliest_sigma_fault(gain: FloatArray) -> Fault | None:
    """Return the fault of sigmas that ``sigma_gains`` of one or more frames tell."""
    best = int(np.argmax(gain.sum(axis=1)))
    scale, nats = float(SCALES[best]), float(gain[best].sum() - gain[best].max())
    if scale < LEAST_SCALE or nats < LEAST_NATS:
        return None
    return Fault(
        "wrong detection sigma",
        f"The detections are about {scale:.1f} times less accurate than their sigma states.",
        (
            EvidenceItem("true over stated sigma", scale),
            EvidenceItem("log-likelihood ratio", nats, "nats"),
        ),
    )


def sigma_gains(case: FrameReference, localization: Localization) -> FloatArray | None:
    """Return what each of ``SCALES`` adds to the log-likelihood of each pair (s, k).

    None without pairs, or if too few of them fit with the likeliest scale.
    """
    image = misalignment(case)
    pose = image.T_camera_map if image else case.truth or localization.T_camera_map
    if pose is None:
        return None
    free = 0.0 if image is None and case.truth is not None else FREE_PARAMETERS
    mapped = localization.submap if case.truth is None else case.nearby
    pairs = case.same_class if case.ids is not None else _wide_pairs(case, mapped, pose)
    if len(pairs) < 2:
        return None
    table = _log_likelihoods(pair_errors(_problem(case, mapped, 1.0), pose, pairs), free)
    gain = np.asarray(table - table[0])
    best = float(SCALES[np.argmax(gain.sum(axis=1))])
    if _fit_share(case, mapped, pose, pairs, best) < LEAST_SIGMA_FIT:
        return None  # what is off by many sigmas is no pair
    return gain


def _fit_share(
    case: FrameReference, mapped: Elements3D, pose: Pose, pairs: IntArray, scale: float
) -> float:
    """Return the share of the residuals that fit with sigmas larger by ``scale``; 0 without any."""
    residual = whitened_rows(_problem(case, mapped, scale), pose, pairs).residual
    return float((residual**2 < MOST_CHI2).mean()) if len(residual) else 0.0


def _log_likelihoods(errors: PairErrors, free: float) -> FloatArray:
    """Return the log-likelihoods (s, k) of the pairs for each of ``SCALES``.

    ``free`` parameters of the pose were fitted to them.
    """
    count = int(errors.counted.sum())
    left = max(count - free, 1.0) / max(count, 1)
    larger = (SCALES**2 - 1.0)[:, None, None, None]
    factor = np.linalg.cholesky(
        errors.covariance_px2 + larger * errors.variance_px2[:, None] * np.eye(4)
    )
    residual = np.linalg.solve(factor, errors.residual_px[..., None])[..., 0]
    log_sigma = np.log(np.diagonal(factor, axis1=2, axis2=3))
    chi2 = np.minimum(residual**2 / left, MOST_CHI2)
    return np.asarray(-0.5 * chi2.sum(axis=2) - log_sigma.sum(axis=2))


def _wide_pairs(case: FrameReference, mapped: Elements3D, pose: Pose) -> IntArray:
    """Return the pairs (k, 2) that fit within a wide gate."""
    problem = _problem(case, mapped, GATE_SCALE)
    match, _ = associate(problem, pose.rotation, pose.translation, EXACT_POSE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


def _problem(case: FrameReference, mapped: Elements3D, scale: float) -> PoseProblem:
    localization = with_sigma_scaled(case, scale).localization
    return PoseProblem.of(localization.camera, localization.observed, mapped, case.detector)


def with_sigma_scaled(case: FrameReference, scale: float) -> FrameReference:
    """Return the frame with the sigmas of all detections multiplied by ``scale``."""
    observed = case.localization.observed
    observed = replace(observed, sigma_px=scale * observed.sigma_px)
    return replace(case, localization=replace(case.localization, observed=observed))


FREE_PARAMETERS = 4.0
"""Of a pose that the image determines with gravity known."""
MEDIAN_OF_NORMAL = 0.6745
"""Of the absolute value of a normal number."""
NEEDED_PAIRS = 4
LEAST_FIT = 0.7
"""Share of the detections that must fit the map at the shifted pose."""
MOST_FIT = 0.5
"""Share of them that may fit at the true pose as well."""
LEAST_SIGMAS = 6.0
NEAR_M, NEAR_RAD = 8.0, float(np.deg2rad(25.0))
"""A pose further from the true one is another place, not a shift."""


@dataclass(frozen=True, eq=False)
class Misalignment:
    """The pose that the image supports, near the true one but not at it."""

    T_camera_map: Pose
    offset: FloatArray
    """(6,) log of the image's pose times the inverse of the true one: metres, then radians."""
    covariance: FloatArray
    """(6, 6) of ``offset``."""
    pairs: int
    """Number of pairs that fit."""

    @property
    def sigmas(self) -> float:
        return float(np.sqrt(self.offset @ np.linalg.solve(self.covariance, self.offset)))


def image_pose(case: FrameReference) -> Misalignment | None:
    """Return the pose near the true one that most detections support.

    None if the truth is unknown, or if too few of them agree on a pose.
    """
    if case.truth is None:
        return None
    found = [image for image in _candidates(case) if _is_near(image, case.truth)]
    best = max(found, key=lambda estimate: _fitting(estimate), default=None)
    needed = max(NEEDED_PAIRS, LEAST_FIT * len(case.localization.observed))
    if best is None or _fitting(best) < needed:
        return None
    offset = (best.T_camera_map @ case.truth.inverse()).log()
    covariance = _scale(case, best) ** 2 * best.covariance
    return Misalignment(best.T_camera_map, offset, covariance, _fitting(best))


def _scale(case: FrameReference, estimate: PoseEstimate) -> float:
    """Return the size of the residuals in sigmas, 1 or more: stated sigmas may be too small."""
    pairs = case.same_class if case.ids is not None else estimate.refinement.pairs
    residual = whitened_rows(case.problem, estimate.T_camera_map, pairs).residual
    left = max(len(residual) - FREE_PARAMETERS, 1.0) / len(residual)
    size = float(np.median(np.abs(residual))) / (MEDIAN_OF_NORMAL * float(np.sqrt(left)))
    return max(1.0, size)


@lru_cache(maxsize=4)
def misalignment(case: FrameReference) -> Misalignment | None:
    """Return the offset of all elements together; None if they fit at the true pose."""
    if case.truth is None:
        return None
    if case.ids is not None and _fits_at(case.truth, case, case.same_class):
        return None  # without a search
    image = image_pose(case)
    if image is None or image.sigmas < LEAST_SIGMAS:
        return None
    return None if _fits_at(case.truth, case, _pairs_at(case, image.T_camera_map)) else image


def _fits_at(truth: Pose, case: FrameReference, pairs: IntArray) -> bool:
    """Whether pairs fit at the true pose, so that they are not off together."""
    inlier = problem_residuals(case.problem, truth, pairs).inlier
    return len(inlier) > 0 and bool(inlier.mean() > MOST_FIT)


def misalignment_fault(case: FrameReference, image: Misalignment) -> Fault:
    assert case.truth is not None
    away_m, angle = pose_distance(image.T_camera_map, case.truth)
    ahead_m = _ahead_m(case.truth, image.T_camera_map)
    where = f"{abs(ahead_m):.1f} m {'ahead of' if ahead_m > 0.0 else 'behind'} the true pose"
    if abs(ahead_m) < 0.7 * away_m:
        where = f"{away_m:.1f} m beside the true pose"
    angle_deg = float(np.rad2deg(angle))
    return Fault(
        "misaligned map",
        f"{image.pairs} elements are off together: they put the camera {where}, turned by "
        f"{angle_deg:.1f} deg ({image.sigmas:.0f} sigma). The map, the true pose or its time is "
        "off, not the elements.",
        (
            EvidenceItem("off", away_m, "m"), EvidenceItem("turned", angle_deg, "deg"),
            EvidenceItem("strength", image.sigmas, "sigma"),
        ),
    )  # fmt: skip


def _candidates(case: FrameReference) -> Iterator[PoseEstimate]:
    """Yield refined poses: from the true pose, and from the poses that the search found."""
    assert case.truth is not None
    prior = assumed_upright(case.prior)
    search = case.localization.search
    starts = [case.truth, *([] if search is None else search.T_camera_map)]
    for start in starts:
        away_m, angle = pose_distance(start, case.truth)
        if away_m > NEAR_M or angle > NEAR_RAD:
            continue
        mode = mode_near(case.problem, prior, start)
        pose = Pose(mode.rotation[0], mode.translation[0])
        estimate = refine_pose(case.problem, prior, pose, _pairs(case, mode))
        if not isinstance(estimate, Failure):
            yield estimate


def _pairs(case: FrameReference, mode: Modes) -> IntArray:
    """Return the true pairs if they are known, else those of the mode."""
    return mode.pairs(0) if case.ids is None else case.same_class


def _pairs_at(case: FrameReference, pose: Pose) -> IntArray:
    if case.ids is not None:
        return case.same_class
    mode = mode_near(case.problem, assumed_upright(case.prior), pose)
    return mode.pairs(0)


def _fitting(estimate: PoseEstimate) -> int:
    return int(estimate.refinement.inlier.sum())


def _is_near(estimate: PoseEstimate, truth: Pose) -> bool:
    away_m, angle = pose_distance(estimate.T_camera_map, truth)
    return away_m <= NEAR_M and angle <= NEAR_RAD


def _ahead_m(truth: Pose, other: Pose) -> float:
    """Return how far the other camera is ahead of the true one, along its axis."""
    return float(truth.apply(other.inverse().translation[None])[0, 2])
