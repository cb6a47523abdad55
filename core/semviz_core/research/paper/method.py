"""The paper's pipeline for one frame: measurement, P, coarse pose, weighted PnPL.

Section III-A measures an element in a region by edges in a box. The box is grown by 10 % and the
mask's outside blanked. Canny edges are dilated and eroded. A sign is the centre of the area they
cover, a pole the line through them, given by peak and direction.

Sections IV and V: eq. 6 runs over all of P. In a simple scene, where classes alone fix the
correspondences, P is Boolean and eq. 6 becomes eq. 8. The paper returns a pose whenever P3P-RANSAC
finds one. Here its status is ``ok`` only if enough elements fit it and the prior does not
contradict it, and ``ambiguous`` otherwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE, ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Match, Refinement, Search, Status
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray
from semviz_core.common.jit import Stopwatch
from semviz_core.detection.regions import PAPER, MeasuredElement, Region
from semviz_core.detection.sign_centers import class_by_mask, turn_of_mask
from semviz_core.localization.association import PairConstraints, associate
from semviz_core.localization.least_squares import information
from semviz_core.localization.matched.p3p_ransac import SAMPLE, Points, most_inliers
from semviz_core.localization.matched.ransac import LEAST_INFORMATION
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import Failure, PoseEstimate
from semviz_core.localization.residuals import EXACT_POSE, problem_residuals
from semviz_core.localization.search import mode_near
from semviz_core.localization.status import decide_status
from semviz_core.research.paper import weighted_pnpl
from semviz_core.research.paper.matcher import SoftMatches, load_matcher
from semviz_core.subpixel.sampling import SampledImage

_GROWN = 0.1
_CANNY = (50, 150)
_KERNEL_PX = 3
_FEWEST = 4


def measure_as_in_paper(
    picture: SampledImage, region: Region, _signs: Sequence[Region] = ()
) -> MeasuredElement | None:
    """Return the element of a region; None if it has no edges."""
    points = edge_points(picture, region)
    if len(points) < _FEWEST:
        return None
    if region.class_id == POLE:
        ends = peak_and_bottom(points)
        known = region.ends_known or (True, True)
        return (
            None if ends is None else MeasuredElement(POLE, region.score, ends, PAPER, known, 1.0)
        )
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    size = float(np.ptp(points, axis=0).min()) / 2.0
    class_id = class_by_mask(region) if region.class_id is None else region.class_id
    sigma = (PAPER[0], PAPER[0])
    sixth = float(np.ptp(points[:, 1])) / 6.0 * (turn_of_mask(region) or 1)
    return MeasuredElement(
        class_id, region.score, middle[None], sigma, (True, False), size, to_centroid_px=sixth
    )


def edge_points(picture: SampledImage, region: Region) -> FloatArray:
    """Return the pixels (n, 2) on closed edges within a region."""
    import cv2

    height, width = picture.image.shape[:2]
    low, high = region.box_px[:2], region.box_px[2:]
    grown = _GROWN / 2.0 * (high - low)
    last = np.array([width - 1, height - 1])
    left, top = np.clip(np.floor(low - grown), 0, last).astype(int)
    right, bottom = np.clip(np.ceil(high + grown), 0, last).astype(int)
    window = picture.image[top : bottom + 1, left : right + 1]
    edges = cv2.Canny(_blanked(window, region, left, top), *_CANNY)
    kernel = np.ones((_KERNEL_PX, _KERNEL_PX), np.uint8)
    closed = cv2.erode(cv2.dilate(edges, kernel), kernel)
    rows, columns = np.nonzero(closed)
    return np.stack([columns + left, rows + top], axis=1).astype(np.float64)


def _blanked(window: ByteImage, region: Region, left: int, top: int) -> ByteImage:
    """Return a window in grey, black outside the region's mask."""
    import cv2

    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(window), cv2.COLOR_RGB2GRAY), np.uint8)
    if region.mask is None:
        return gray
    shown = np.zeros(gray.shape, bool)
    x, y = region.corner_px[0] - left, region.corner_px[1] - top
    rows = slice(max(0, -y), max(0, gray.shape[0] - y))
    piece = region.mask[rows, max(0, -x) : max(0, gray.shape[1] - x)]
    x, y = max(0, x), max(0, y)
    shown[y : y + piece.shape[0], x : x + piece.shape[1]] = piece
    return np.asarray(np.where(shown, gray, 0), np.uint8)


def peak_and_bottom(points: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2) of the line through points (n, 2), upper first; None for a spot."""
    import cv2

    fitted = cv2.fitLine(points.astype(np.float32), cv2.DIST_L2, 0, 0.01, 0.01).reshape(4)
    along, middle = fitted[:2].astype(np.float64), fitted[2:].astype(np.float64)
    along = along if along[1] > 0.0 else -along
    positions = (points - middle) @ along
    if np.ptp(positions) < 1.0:
        return None
    return np.asarray(middle + np.outer([positions.min(), positions.max()], along))


class SoftMatcher(Protocol):
    """What gives P of a frame: a trained ``Matcher``, or a reference."""

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> SoftMatches: ...


@dataclass(frozen=True)
class PaperPipeline:
    """The paper's method with a matcher, such as one of ``MODELS``."""

    matcher: SoftMatcher
    seed: int

    def localize(
        self,
        work: Localization,
        problem: PoseProblem,
        pairing: PairConstraints,
        start: Pose | None,
        watch: Stopwatch,
    ) -> Localization:
        """Return ``work`` completed: match, search, refinement, pose and status.

        ``problem`` has the constraints of ``pairing`` applied. ``start`` (T_camera_map) replaces
        RANSAC.
        """
        frame = work.observed, work.submap, work.camera, work.given_prior
        soft = watch.time("match", lambda: _constrained(self.matcher.match(*frame), pairing))
        work = replace(work, match=_match(soft, len(work.observed), len(work.submap)))
        coarse = _Coarse(start, 1)
        if start is None:
            coarse = watch.time("search", lambda: _ransac(soft, self.seed))
        work = replace(work, search=_search_of(work, problem, coarse))
        if (coarse_pose := coarse.T_camera_map) is None:
            return replace(work, reason=coarse.reason)
        pose = watch.time("refine", lambda: _pnpl_pose(soft, coarse_pose))
        if isinstance(pose, Failure):
            return replace(work, reason=pose.reason)
        fit = _refinement(problem, pose)
        work = replace(work, refinement=fit)
        if violated := pairing.violated(fit, work.submap):
            return replace(work, reason=violated)
        return _completed(work, problem, pose, fit)


def load_chain(name: str, weights: Path | None, classes: ClassSet, seed: int) -> PaperPipeline:
    """Load a method of the paper: an entry point, as LoadMethod of the localizer."""
    return PaperPipeline(load_matcher(name, weights, classes), seed)


@dataclass(frozen=True)
class _Coarse:
    """The pose of RANSAC, or the reason for none."""

    T_camera_map: Pose | None
    hypotheses: int
    reason: str = ""


def _search_of(work: Localization, problem: PoseProblem, coarse: _Coarse) -> Search:
    """Return the coarse pose as the only mode, scored as in ``search``."""
    if coarse.T_camera_map is None:
        no_match = np.zeros((0, len(work.observed)), np.int64)
        return Search(coarse.hypotheses, (), np.zeros(0), None, no_match)
    mode = mode_near(problem, work.given_prior, coarse.T_camera_map)
    return Search(coarse.hypotheses, (coarse.T_camera_map,), mode.score, None, mode.match)


def _constrained(soft: SoftMatches, pairing: PairConstraints) -> SoftMatches:
    """Return the matches with P of forced pairs at its maximum, and of forbidden pairs at 0."""
    P, (i, j) = soft.probability.copy(), pairing.forced.T
    P[i], P[:, j] = 0.0, 0.0
    P[i, j] = 1.0 / np.maximum(_smaller_side(soft)[i, j], 1)
    P[tuple(pairing.forbidden.T)] = 0.0
    return replace(soft, probability=P)


def _match(soft: SoftMatches, m: int, n: int) -> Match:
    """Return P of the frame's elements for display, as shares of what uniform priors allow.

    Its entries are multiplied by the smaller side of their block, so that rows or columns,
    whichever are fewer, sum to 1. The remainder is in the dustbins, which the paper does not have,
    and so is the mass of the bottoms of split lines.
    """
    share = np.minimum(soft.probability * _smaller_side(soft), 1.0)[:m, :n]
    probability = np.zeros((m + 1, n + 1))
    probability[:m, :n] = share
    probability[:m, n] = np.maximum(1.0 - share.sum(axis=1), 0.0)
    probability[m, :n] = np.maximum(1.0 - share.sum(axis=0), 0.0)
    cost = np.where(soft.probability > 0.0, soft.cost, np.inf)[:m, :n]
    return Match(cost, probability, weighted_pnpl.most_probable_pairs(soft.probability[:m, :n], m))


def _smaller_side(soft: SoftMatches) -> IntArray:
    """Return (m, n) the smaller number of observed or mapped elements in each pair's block."""
    seen, mapped = soft.possible.sum(axis=0), soft.possible.sum(axis=1)
    return np.asarray(np.minimum(seen, mapped[:, None]))


def _ransac(soft: SoftMatches, seed: int) -> _Coarse:
    """Return the coarse pose from the most probable pairs (eq. 5)."""
    sample = soft.sample
    i, j = weighted_pnpl.most_probable_pairs(soft.probability, len(sample.ray)).T
    known = sample.seen_known[i] & sample.mapped_known[j]
    if (count := int(known.sum())) < SAMPLE:
        return _Coarse(
            None, 0, f"{count} points of the likeliest pairs are known, {SAMPLE} needed."
        )
    rays = np.stack([sample.ray[i], sample.bottom_ray[i]])
    points_m = np.stack([sample.point_m[j], sample.bottom_m[j]])
    R, t, inliers, hypotheses = most_inliers(Points.of(i, known, rays, points_m), seed)
    if inliers < SAMPLE:
        reason = f"No pose brings {SAMPLE} of the {len(i)} likeliest pairs within the threshold."
        return _Coarse(None, hypotheses, reason)
    return _Coarse(_in_map(soft, R, t), hypotheses)


def _pnpl_pose(soft: SoftMatches, T_camera_map: Pose) -> Pose | Failure:
    """Refine the pose by weighted PnPL over all of P (eq. 6)."""
    sample, R = soft.sample, T_camera_map.rotation.copy()
    ends = sample.ray, sample.bottom_ray, sample.point_m, sample.bottom_m
    points, lines = weighted_pnpl.points_and_lines(*ends, sample.seen_known, sample.mapped_known)
    sums = weighted_pnpl.weighted_sums(*(np.ascontiguousarray(end)[None] for end in ends))
    sums = sums._replace(
        point_weight=(soft.probability * points)[None], line_weight=(soft.probability * lines)[None]
    )
    optimum = weighted_pnpl.minimize_weighted(
        sums, R[None], T_camera_map.apply(sample.origin_m)[None]
    )
    if not optimum.ok[0]:
        return Failure("Weighted PnPL comes to no minimum: P does not fix the pose.")
    return _in_map(soft, optimum.rotation[0], optimum.translation[0])


def _in_map(soft: SoftMatches, rotation: FloatArray, translation: FloatArray) -> Pose:
    """Return T_camera_map, given T_camera_local."""
    R = nearest_rotation(rotation)
    return Pose(R, translation - R @ soft.sample.origin_m)


def _refinement(problem: PoseProblem, T_camera_map: Pose) -> Refinement:
    """Return the one-to-one pairs under the pose with their residuals."""
    match, _ = associate(problem, *T_camera_map.writable(), EXACT_POSE)
    seen = np.flatnonzero(match >= 0)
    pairs = np.column_stack([seen, match[seen]])
    residuals = problem_residuals(problem, T_camera_map, pairs)
    return Refinement(
        pairs,
        residuals.residual_px,
        residuals.chi2,
        residuals.inlier,
        np.array([residuals.chi2.sum()]),
    )


def _covariance(problem: PoseProblem, T_camera_map: Pose, pairs: IntArray) -> FloatArray | None:
    """Return the Cramer-Rao bound of the pairs; None if they fix no pose."""
    fisher = information(problem, None, T_camera_map, pairs)
    if np.linalg.eigvalsh(fisher)[0] < LEAST_INFORMATION:
        return None
    return np.asarray(np.linalg.inv(fisher), np.float64)


def _completed(
    work: Localization, problem: PoseProblem, T_camera_map: Pose, fit: Refinement
) -> Localization:
    """Return ``work`` with the pose, its covariance and status."""
    covariance = _covariance(problem, T_camera_map, fit.pairs)
    status: Status = "ambiguous"
    reason = f"Only {int(fit.inlier.sum())} of {len(work.observed)} elements fit the pose."
    if covariance is not None:
        estimate = PoseEstimate(T_camera_map, covariance, fit)
        mode = mode_near(problem, work.given_prior, T_camera_map)
        decision = decide_status(mode, estimate, work.observed, work.submap, work.given_prior)
        status = "ok" if decision.status == "ok" else "ambiguous"
        reason = decision.reason
    return replace(
        work, status=status, reason=reason, T_camera_map=T_camera_map, covariance=covariance
    )
