"""The paper's coarse pose (section V-A): P3P-RANSAC over a prioritized list of matches.

Matches are sorted by probability and the top K kept; the bottoms of matched poles join as further
points. Each iteration solves P3P for three points, of whose up to four poses a fourth point picks
one. The pose with the most inliers by eq. 5 wins. The paper leaves K open.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.least_squares import information
from semviz_core.solving.matched.consensus import needed_inliers, sure_estimate, too_few_agree
from semviz_core.solving.matched.matches import Estimate, Matches
from semviz_core.solving.matched.pnpl import paper_pnpl
from semviz_core.solving.matched.samples import FARTHEST_M
from semviz_core.solving.refine import Failure

ITERATIONS = 1000
INLIER_RAD = 0.003
"""Largest angle between an observed ray and its mapped point (eq. 5)."""
TOP_K = 24
_SAMPLE = 4


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
    points = _Points.of(matches, np.argsort(-matches.score, kind="stable")[:TOP_K])
    if len(points.ray) < _SAMPLE:
        return Failure(f"{len(points.ray)} matched points are known, {_SAMPLE} needed.")
    rotation, translation = _poses(points, np.random.default_rng(seed))
    if not len(rotation):
        return Failure("No sample of three points has a P3P solution.")
    cosine = points.cosine(rotation, translation)
    best = int(points.inliers(cosine).sum(axis=1).argmax())
    inlier = _one_to_one(matches, points, cosine[best])
    if (found := int(inlier.sum())) < needed_inliers(len(matches)):
        return too_few_agree(matches, found, len(rotation))
    return Coarse(Pose(nearest_rotation(rotation[best]), translation[best]), inlier, len(rotation))


@dataclass(frozen=True, eq=False)
class _Points:
    """Peaks, middles and bottoms of the prioritized matches, sorted by observed point."""

    ray: FloatArray  # (p, 3) unit
    point_m: FloatArray  # (p, 3)
    match: IntArray  # (p,) row of the matches
    first: IntArray  # (q,) where each observed point's rows begin

    @classmethod
    def of(cls, matches: Matches, top: IntArray) -> "_Points":
        at, end = np.nonzero(matches.known()[top])  # end 0: peak or middle; 1: bottom
        match = top[at]
        seen = matches.pairs[match, 0]
        order = np.lexsort((end, seen))
        match, end, seen = match[order], end[order], seen[order]
        ray, point = np.stack(matches.rays()), np.stack(matches.points_m())
        _, first = np.unique(2 * seen + end, return_index=True)
        return cls(ray[end, match], point[end, match], match, first)

    def cosine(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """(b, p) of the angles of eq. 5."""
        moved = self.point_m @ np.swapaxes(rotation, -1, -2) + translation[:, None, :]
        cosine: FloatArray = (moved * self.ray).sum(axis=-1) / np.linalg.norm(moved, axis=-1)
        return cosine

    def inliers(self, cosine: FloatArray) -> BoolArray:
        """(b, q) whether the closest of the points paired with an observed one is an inlier."""
        closest = np.maximum.reduceat(cosine, self.first, axis=1)
        return np.asarray(closest > np.cos(INLIER_RAD))


def _poses(points: _Points, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """(b, 3, 3) and (b, 3) one pose of each sample that has any."""
    import poselib

    keys = rng.random((ITERATIONS, len(points.ray)))
    samples = np.argpartition(keys, _SAMPLE - 1, axis=1)[:, :_SAMPLE]
    ray, point = points.ray[samples], points.point_m[samples]
    found = [poselib.p3p(*one) for one in zip(ray[:, :3], point[:, :3], strict=True)]
    rotation = np.array([one.R for poses in found for one in poses]).reshape(-1, 3, 3)
    translation = np.array([one.t for poses in found for one in poses]).reshape(-1, 3)
    sample = np.repeat(np.arange(ITERATIONS), [len(poses) for poses in found])
    fourth = np.einsum("bij,bj->bi", rotation, point[sample, 3]) + translation
    distance = np.linalg.norm(fourth, axis=1)
    cosine = (fourth * ray[sample, 3]).sum(axis=1) / distance
    good = np.flatnonzero((distance > MIN_DEPTH_M) & (distance < FARTHEST_M))  # NaN is not
    by_sample = good[np.lexsort((-cosine[good], sample[good]))]
    _, chosen = np.unique(sample[by_sample], return_index=True)
    return rotation[by_sample[chosen]], translation[by_sample[chosen]]


def _one_to_one(matches: Matches, points: _Points, cosine: FloatArray) -> BoolArray:
    """(k,) matches with a point within INLIER_RAD; of those that share an element, the closest."""
    closest = np.full(len(matches), -1.0)
    np.maximum.at(closest, points.match, cosine)
    inlier, conflicts = np.zeros(len(matches), dtype=bool), matches.conflicts()
    for row in np.argsort(-closest, kind="stable"):
        if closest[row] <= np.cos(INLIER_RAD):
            break
        inlier[row] = not (inlier & conflicts[row]).any()
    return inlier
