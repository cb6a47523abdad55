"""The paper's estimator: P3P-RANSAC over prioritized matches (section V-A), then PnPL.

Matches are sorted by probability and the top K kept; the paper leaves K open. Bottoms of
matched poles join as further points. Each iteration solves P3P for three points, and a fourth
point selects one of up to four poses. The pose with the most inliers by eq. 5 wins.

Weighted PnPL (eq. 6-7), and direct PnPL (eq. 8) with a Boolean P, refine it as in the paper,
but in float64: 1 - cos of a small angle has no digits left in float32. The module
`semviz_core.localization.least_squares` is more accurate, for two reasons:

- f_l holds one point of each line, a metre below the peak, to the observed plane. That is about
  half of what a line constrains.
- All pairs count, however wrong. With a soft P over many elements the wrong ones dominate.

Peaks enter f_p where known on both sides: eq. 7 sums f_p over all m and n elements, and f_l
over the m2 and n2 lines among them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.base.pose import Pose, so3_exp, so3_left_jacobian, so3_log
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, float_array, unit_vectors
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import compiled
from semviz_core.localization.least_squares import information
from semviz_core.localization.matched import ransac
from semviz_core.localization.matched.chance import needed_inliers
from semviz_core.localization.matched.matches import Estimate, Matches
from semviz_core.localization.matched.minimal_solvers import FARTHEST_M
from semviz_core.localization.matched.p3p import MOST_POSES, solve_p3p
from semviz_core.localization.refinement import Failure

PNPL_ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class PnplFit:
    """The optimum of eq. 6 or 8."""

    T_camera_map: Pose
    cost: float
    iterations: int


@dataclass(frozen=True, eq=False)
class Objective:
    """f_p + f_l (eq. 7) over axis-angle and translation."""

    weight: FloatArray  # (p,) the P of each point pair
    ray: FloatArray  # (p, 3) f
    point_m: FloatArray  # (p, 3)
    line_weight: FloatArray  # (l,) the P of each line pair
    normal: FloatArray  # (l, 3) unit f x v_2d
    line_point_m: FloatArray  # (l, 3) p + v_3d

    @classmethod
    def of(cls, matches: Matches, weight: FloatArray, origin_m: FloatArray) -> "Objective":
        """Return the objective of the P (k,) of each match; map coordinates are relative to
        ``origin_m`` (3,)."""
        line, point = matches.is_line, matches.known()[:, 0]
        (first, last), (anchor, end) = matches.rays(), matches.points_m()
        down = unit_vectors(end - anchor)
        normal = unit_vectors(np.cross(first, last))
        return cls(
            weight[point],
            first[point],
            anchor[point] - origin_m,
            weight[line],
            normal[line],
            (anchor + down - origin_m)[line],
        )

    def __call__(self, parameters: FloatArray) -> tuple[float, FloatArray]:
        """Return cost and gradient (6,) at ``parameters`` (6,): axis-angle and translation (m)."""
        rotvec, translation = parameters[:3], parameters[3:]
        R = so3_exp(rotvec)
        turned = self.point_m @ R.T, self.line_point_m @ R.T
        u, distance = _unit_and_length(turned[0] + translation)
        cosine = (self.ray * u).sum(axis=1)
        f_p = float(self.weight @ (1.0 - cosine))
        by_point = -self.weight[:, None] * (self.ray - cosine[:, None] * u) / distance

        u, distance = _unit_and_length(turned[1] + translation)
        sine = (self.normal * u).sum(axis=1)
        norm = np.sqrt(np.maximum(1.0 - sine**2, 1e-12))  # |n x u|
        f_l = float(self.line_weight @ (1.0 - norm))
        slope = (self.line_weight * sine / norm)[:, None]
        by_line = slope * (self.normal - sine[:, None] * u) / distance

        turn = np.cross(turned[0], by_point).sum(axis=0) + np.cross(turned[1], by_line).sum(axis=0)
        move = by_point.sum(axis=0) + by_line.sum(axis=0)
        return f_p + f_l, np.concatenate([so3_left_jacobian(rotvec).T @ turn, move])


def paper_pnpl(matches: Matches, P: ArrayLike, T_camera_map: Pose) -> PnplFit:
    """Minimize eq. 6 from ``T_camera_map`` with L-BFGS.

    ``P`` (k,) holds the entries of the paper's P for the matches; all others are 0. They are
    probabilities for eq. 6, zeros and ones for eq. 8.
    """
    from scipy.optimize import minimize

    weight = float_array(P, (len(matches),), "P")
    total = float(weight.sum())
    if (weight < 0.0).any() or total == 0.0:
        raise SemvizError("P holds negative numbers or zeros only; give probabilities")
    # relative to the elements' middle, so that axis-angle and translation are nearly independent
    middle = matches.points_m()[0].mean(axis=0)
    objective = Objective.of(matches, weight / total, middle)

    def scaled(parameters: FloatArray) -> tuple[float, FloatArray]:
        cost, gradient = objective(parameters)
        return cost * _SCALE, gradient * _SCALE

    start = np.concatenate([so3_log(T_camera_map.rotation), T_camera_map.apply(middle)])
    result = minimize(
        scaled, start, jac=True, method="L-BFGS-B",
        options={"maxiter": PNPL_ITERATIONS, "ftol": 1e-14, "gtol": 1e-9},
    )  # fmt: skip
    R = so3_exp(result.x[:3])
    pose = Pose(R, result.x[3:] - R @ middle)
    return PnplFit(pose, float(result.fun) / _SCALE * total, int(result.nit))


_SCALE = 1e4
"""1 - cos of a few pixels is tiny; the stopping rules of L-BFGS expect costs of about 1."""


def _unit_and_length(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    length = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return vectors / length, length


RANSAC_ITERATIONS = 1000
INLIER_RAD = 0.003
"""Largest angle between an observed ray and its mapped point (eq. 5)."""
TOP_K = 24
SAMPLE = 4
"""Points: three to solve for a pose, one to choose among up to four."""


@dataclass(frozen=True, eq=False)
class RansacPose:
    """The pose with the most inliers."""

    T_camera_map: Pose
    inlier: BoolArray
    """(k,) matches within INLIER_RAD, one-to-one."""
    hypotheses: int


def localize_p3p(matches: Matches, seed: int) -> Estimate | Failure:
    """Return the P3P-RANSAC pose refined over its inliers by direct PnPL (eq. 8).

    The covariance is the Cramer-Rao bound of those inliers at their stated sigmas. The error of
    PnPL, which weights all of them alike, is larger.
    """
    coarse = p3p_ransac(matches, seed)
    if isinstance(coarse, Failure):
        return coarse
    P = coarse.inlier.astype(np.float64)
    pose = paper_pnpl(matches, P, coarse.T_camera_map).T_camera_map
    fisher = information(matches.problem(), None, pose, matches.pairs[coarse.inlier])
    return ransac.confident_estimate(matches, pose, fisher, coarse.inlier, coarse.hypotheses)


def p3p_ransac(matches: Matches, seed: int) -> RansacPose | Failure:
    """Return the pose with the most prioritized points within INLIER_RAD, or why there is none."""
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
    if (inliers := int(inlier.sum())) < needed_inliers(len(matches)):
        return ransac.too_few_agree(matches, inliers, hypotheses)
    return RansacPose(Pose(rotation, translation), inlier, hypotheses)


@dataclass(frozen=True, eq=False)
class Points:
    """Peaks, centers and bottoms of the prioritized matches, sorted by observed point."""

    ray: FloatArray  # (p, 3) unit
    point_m: FloatArray  # (p, 3)
    match: IntArray  # (p,) row of the prioritized matches
    first: IntArray  # (q + 1,) the first row of each observed point, and the end of the last

    @classmethod
    def of(cls, seen: IntArray, known: BoolArray, ray: FloatArray, point_m: FloatArray) -> "Points":
        """Return the points of k matches from the observed row (k,), whether anchor and end are
        known (k, 2), and their rays and mapped points (2, k, 3)."""
        match, end = np.nonzero(known)
        group = 2 * seen[match] + end
        order = np.argsort(group, kind="stable")
        match, end, group = match[order], end[order], group[order]
        first = np.flatnonzero(np.diff(group, prepend=-1, append=-1))
        return cls(ray[end, match], point_m[end, match], match, first)

    def cosine(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """Return the cosines (p,) of the angles of eq. 5."""
        moved = self.point_m @ rotation.T + translation
        cosine: FloatArray = (moved * self.ray).sum(axis=1) / np.linalg.norm(moved, axis=1)
        return cosine


def most_inliers(points: Points, seed: int) -> tuple[FloatArray, FloatArray, int, int]:
    """Return rotation (3, 3) and translation (3,) of the best hypothesis, its number of inliers,
    and the number of hypotheses: at most one for each of RANSAC_ITERATIONS samples."""
    draws = np.random.default_rng(seed).random((RANSAC_ITERATIONS, SAMPLE))
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
        for k in range(SAMPLE):  # a partial shuffle
            other = k + int(draw[k] * (len(order) - k))
            order[k], order[other] = order[other], order[k]
        three, fourth = order[: SAMPLE - 1], order[SAMPLE - 1]
        count = solve_p3p(ray[three], point_m[three], rotation, translation)
        chosen, closest = -1, -2.0
        for pose in range(count):
            cosine = _cosine(ray[fourth], point_m[fourth], rotation[pose], translation[pose])
            if cosine > closest:  # False for NaN
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
    """Return how many observed points have a mapped point within INLIER_RAD."""
    count, least = 0, np.cos(INLIER_RAD)
    for group in range(len(first) - 1):
        for row in range(first[group], first[group + 1]):
            if _cosine(ray[row], point_m[row], R, t) > least:
                count += 1
                break
    return count


@compiled
def _cosine(ray: FloatArray, point_m: FloatArray, R: FloatArray, t: FloatArray) -> float:
    """Return the cosine of eq. 5's angle; -2 if the point is at the camera or beyond FARTHEST_M."""
    along, square = 0.0, 0.0
    for k in range(3):
        x = R[k, 0] * point_m[0] + R[k, 1] * point_m[1] + R[k, 2] * point_m[2] + t[k]
        along += ray[k] * x
        square += x * x
    if not MIN_DEPTH_M**2 < square < FARTHEST_M**2:  # also for NaN
        return -2.0
    return along / np.sqrt(square)


def _one_to_one(matches: Matches, match: IntArray, cosine: FloatArray) -> BoolArray:
    """Return (k,) the inliers: within INLIER_RAD, the closest of those that share an element."""
    closest = np.full(len(matches), -1.0)
    np.maximum.at(closest, match, cosine)
    inlier, conflicts = np.zeros(len(matches), dtype=bool), matches.conflicts()
    for row in np.argsort(-closest, kind="stable"):
        if closest[row] <= np.cos(INLIER_RAD):
            break
        inlier[row] = not (inlier & conflicts[row]).any()
    return inlier
