"""The paper's coarse pose (section V-A): P3P-RANSAC over a prioritized list of matches.

Matches are sorted by probability and the top K kept; the bottoms of matched poles join as further
points. Each iteration solves P3P for three points, of whose up to four poses a fourth point picks
one. The pose with the most inliers by eq. 5 wins. The paper leaves K open.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M
from semviz_core.compiled import compiled
from semviz_core.pose import Pose
from semviz_core.solving.least_squares import information
from semviz_core.solving.matched.consensus import needed_inliers, sure_estimate, too_few_agree
from semviz_core.solving.matched.matches import Estimate, Matches
from semviz_core.solving.matched.pnpl import paper_pnpl
from semviz_core.solving.matched.samples import FARTHEST_M
from semviz_core.solving.matched.three_points import MOST_POSES, solve_p3p
from semviz_core.solving.refine import Failure

ITERATIONS = 1000
INLIER_RAD = 0.003
"""Largest angle between an observed ray and its mapped point (eq. 5)."""
TOP_K = 24
SAMPLE = 4
"""Points: three to solve for a pose, one to choose among up to four."""


@dataclass(frozen=True, eq=False)
class Coarse:
    """The pose with the most inliers."""

    T_camera_map: Pose
    inlier: BoolArray
    """(k,) matches within INLIER_RAD, one-to-one."""
    hypotheses: int


def localize_p3p(matches: Matches, seed: int) -> Estimate | Failure:
    """The coarse pose refined over its inliers by direct PnPL (eq. 8).

    The covariance is the least that those inliers allow, by their stated sigmas; PnPL, which weighs
    all alike, is off by more.
    """
    coarse = p3p_ransac(matches, seed)
    if isinstance(coarse, Failure):
        return coarse
    true = coarse.inlier.astype(np.float64)
    pose = paper_pnpl(matches, true, coarse.T_camera_map).T_camera_map
    weight = information(matches.scene(), None, pose, matches.pairs[coarse.inlier])
    return sure_estimate(matches, pose, weight, coarse.inlier, coarse.hypotheses)


def p3p_ransac(matches: Matches, seed: int) -> Coarse | Failure:
    """The pose that brings the most prioritized points within INLIER_RAD, or why there is none."""
    top = np.argsort(-matches.score, kind="stable")[:TOP_K]
    points = Points.of(
        matches.pairs[top, 0],
        matches.known()[top],
        np.stack(matches.rays())[:, top],
        np.stack(matches.points_m())[:, top],
    )
    if len(points.ray) < SAMPLE:
        return Failure(f"{len(points.ray)} matched points are known, {SAMPLE} needed.")
    rotation, translation, _, hypotheses = most_inliers(points, seed)
    if not hypotheses:
        return Failure("No sample of three points has a P3P solution.")
    cosine = points.cosine(rotation, translation)
    inlier = _one_to_one(matches, top[points.match], cosine)
    if (found := int(inlier.sum())) < needed_inliers(len(matches)):
        return too_few_agree(matches, found, hypotheses)
    return Coarse(Pose(rotation, translation), inlier, hypotheses)


@dataclass(frozen=True, eq=False)
class Points:
    """Peaks, middles and bottoms of the prioritized matches, sorted by observed point."""

    ray: FloatArray  # (p, 3) unit
    point_m: FloatArray  # (p, 3)
    match: IntArray  # (p,) row of the prioritized matches
    first: IntArray  # (q + 1,) where each observed point's rows begin, and the last ones end

    @classmethod
    def of(cls, seen: IntArray, known: BoolArray, ray: FloatArray, point_m: FloatArray) -> "Points":
        """Of k matches: observed row (k,), and of anchor and end whether they are known (k, 2), ray
        and mapped point (2, k, 3)."""
        match, end = np.nonzero(known)
        group = 2 * seen[match] + end
        order = np.argsort(group, kind="stable")
        match, end, group = match[order], end[order], group[order]
        first = np.flatnonzero(np.diff(group, prepend=-1, append=-1))
        return cls(ray[end, match], point_m[end, match], match, first)

    def cosine(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """(p,) of the angles of eq. 5."""
        moved = self.point_m @ rotation.T + translation
        cosine: FloatArray = (moved * self.ray).sum(axis=1) / np.linalg.norm(moved, axis=1)
        return cosine


def most_inliers(points: Points, seed: int) -> tuple[FloatArray, FloatArray, int, int]:
    """Rotation (3, 3), translation (3,), how many observed points they explain, and of how many
    hypotheses they are the best: one of each of ITERATIONS samples that has any."""
    draws = np.random.default_rng(seed).random((ITERATIONS, SAMPLE))
    return _ransac(points.ray, points.point_m, points.first, draws)


@compiled
def _ransac(
    ray: FloatArray, point_m: FloatArray, first: IntArray, draws: FloatArray
) -> tuple[FloatArray, FloatArray, int, int]:
    order = np.arange(len(ray))
    rotation, translation = np.empty((MOST_POSES, 3, 3)), np.empty((MOST_POSES, 3))
    best_rotation, best_translation = np.eye(3), np.zeros(3)
    most, hypotheses = 0, 0
    for draw in draws:
        for k in range(SAMPLE):  # a shuffle, as far as it is needed
            other = k + int(draw[k] * (len(order) - k))
            order[k], order[other] = order[other], order[k]
        three, fourth = order[: SAMPLE - 1], order[SAMPLE - 1]
        found = solve_p3p(ray[three], point_m[three], rotation, translation)
        chosen, closest = -1, -2.0
        for pose in range(found):
            cosine = _cosine(ray[fourth], point_m[fourth], rotation[pose], translation[pose])
            if cosine > closest:  # NaN is not
                chosen, closest = pose, cosine
        if chosen < 0:
            continue
        hypotheses += 1
        inliers = _inliers(ray, point_m, first, rotation[chosen], translation[chosen])
        if inliers > most:
            most = inliers
            best_rotation[:], best_translation[:] = rotation[chosen], translation[chosen]
    return best_rotation, best_translation, most, hypotheses


@compiled
def _inliers(
    ray: FloatArray, point_m: FloatArray, first: IntArray, R: FloatArray, t: FloatArray
) -> int:
    """How many observed points are within INLIER_RAD of the closest of those paired with them."""
    count, least = 0, np.cos(INLIER_RAD)
    for group in range(len(first) - 1):
        for row in range(first[group], first[group + 1]):
            if _cosine(ray[row], point_m[row], R, t) > least:
                count += 1
                break
    return count


@compiled
def _cosine(ray: FloatArray, point_m: FloatArray, R: FloatArray, t: FloatArray) -> float:
    """Of the angle of eq. 5; -2 where the point is in the camera or beyond FARTHEST_M."""
    along, square = 0.0, 0.0
    for k in range(3):
        x = R[k, 0] * point_m[0] + R[k, 1] * point_m[1] + R[k, 2] * point_m[2] + t[k]
        along += ray[k] * x
        square += x * x
    if not MIN_DEPTH_M**2 < square < FARTHEST_M**2:  # NaN is not
        return -2.0
    return along / np.sqrt(square)


def _one_to_one(matches: Matches, of: IntArray, cosine: FloatArray) -> BoolArray:
    """(k,) matches with a point within INLIER_RAD; of those that share an element, the closest."""
    closest = np.full(len(matches), -1.0)
    np.maximum.at(closest, of, cosine)
    inlier, conflicts = np.zeros(len(matches), dtype=bool), matches.conflicts()
    for row in np.argsort(-closest, kind="stable"):
        if closest[row] <= np.cos(INLIER_RAD):
            break
        inlier[row] = not (inlier & conflicts[row]).any()
    return inlier
