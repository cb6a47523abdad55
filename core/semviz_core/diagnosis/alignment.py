"""Find a map that is shifted or turned as a whole against the true poses.

The image then fits the map well, at a pose near the true one but not at it. In one frame, the
map, the true pose, its time stamp and the mounting of the camera are equally suspect.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.fault import EvidenceItem, Fault
from semviz_core.diagnosis.reference import FrameReference, pose_distance, whitened_rows
from semviz_core.localization.refinement import Failure, PoseEstimate, refine_pose
from semviz_core.localization.residuals import problem_residuals
from semviz_core.localization.search import Modes, mode_near
from semviz_core.localization.upright import assumed_upright

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


def misalignment(case: FrameReference) -> Misalignment | None:
    """Return the offset of all elements together; None if they fit at the true pose."""
    image = image_pose(case)
    if image is None or image.sigmas < LEAST_SIGMAS:
        return None
    assert case.truth is not None
    at_truth = problem_residuals(case.problem, case.truth, _pairs_at(case, image.T_camera_map))
    return None if at_truth.inlier.mean() > MOST_FIT else image


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
