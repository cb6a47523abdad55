"""The paper's chain on one screen: a frame's P, its coarse pose, weighted PnPL (sections IV, V).

As written: eq. 6 runs over all of P. In a simple scene, where classes alone fix the matches, every
transport is between one seen and one mapped element: P is Boolean then, and eq. 6 is eq. 8.

The paper answers whenever P3P-RANSAC finds a pose. So does this, but calls it ``ok`` only if enough
elements fit it and it does not contradict the prior, and ``ambiguous`` otherwise.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.learning.inference import Matcher, SoftMatches
from semviz_core.localization import Localization, Match, Refinement, Search, Status
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.association import associate
from semviz_core.solving.least_squares import information
from semviz_core.solving.matched.consensus import LEAST_INFORMATION
from semviz_core.solving.matched.p3p import SAMPLE, Points, most_inliers
from semviz_core.solving.matched.soft import points_and_lines, surest_pairs, weighted_sums
from semviz_core.solving.matched.weighted import weighted_pnpl
from semviz_core.solving.pairing import Pairing
from semviz_core.solving.refine import Failure, Refined
from semviz_core.solving.residuals import SURE, scene_residuals
from semviz_core.solving.scene import Scene
from semviz_core.solving.search import mode_near
from semviz_core.solving.verdict import judge
from semviz_core.stopwatch import Stopwatch


@dataclass(frozen=True)
class Chain:
    """The paper's method with one of ``models``."""

    matcher: Matcher
    seed: int

    def localize(
        self,
        work: Localization,
        scene: Scene,
        pairing: Pairing,
        start: Pose | None,
        watch: Stopwatch,
    ) -> Localization:
        """``work`` with everything from its match to its answer.

        ``scene`` is with ``pairing`` applied; ``start`` (T_camera_map) takes the place of RANSAC.
        """
        given = work.observed, work.submap, work.camera, work.prior
        soft = watch.time("match", lambda: _supposed(self.matcher.match(*given), pairing))
        work = replace(work, match=_match(soft, len(work.observed), len(work.submap)))
        coarse = _Coarse(start, 1)
        if start is None:
            coarse = watch.time("search", lambda: _ransac(soft, self.seed))
        work = replace(work, search=_searched(work, scene, coarse))
        if (begun := coarse.T_camera_map) is None:
            return replace(work, reason=coarse.reason)
        pose = watch.time("refine", lambda: _refined(soft, begun))
        if isinstance(pose, Failure):
            return replace(work, reason=pose.reason)
        fit = _refinement(scene, pose)
        work = replace(work, refinement=fit)
        if unmet := pairing.unmet(fit, work.submap):
            return replace(work, reason=unmet)
        return _answered(work, scene, pose, fit)


@dataclass(frozen=True)
class _Coarse:
    """What RANSAC found."""

    T_camera_map: Pose | None
    hypotheses: int
    reason: str = ""


def _searched(work: Localization, scene: Scene, coarse: _Coarse) -> Search:
    """The one mode, scored as ``search`` would."""
    if coarse.T_camera_map is None:
        nothing = np.zeros((0, len(work.observed)), np.int64)
        return Search(coarse.hypotheses, (), np.zeros(0), None, nothing)
    mode = mode_near(scene, work.prior, coarse.T_camera_map)
    return Search(coarse.hypotheses, (coarse.T_camera_map,), mode.score, None, mode.match)


def _supposed(soft: SoftMatches, pairing: Pairing) -> SoftMatches:
    """With all that its elements have on each forced pair, and nothing on forbidden ones."""
    P, (i, j) = soft.probability.copy(), pairing.forced.T
    P[i], P[:, j] = 0.0, 0.0
    P[i, j] = 1.0 / np.maximum(_smaller_side(soft)[i, j], 1)
    P[tuple(pairing.forbidden.T)] = 0.0
    return replace(soft, probability=P)


def _match(soft: SoftMatches, m: int, n: int) -> Match:
    """P for people: of the frame's elements, in shares of what uniform priors let each have.

    Its entries are multiplied by the smaller side of their block, so that rows or columns,
    whichever are fewer, sum to 1. What the others cannot have is in the dustbins, which the paper
    has not; so is what went to the bottoms of split lines.
    """
    share = np.minimum(soft.probability * _smaller_side(soft), 1.0)[:m, :n]
    probability = np.zeros((m + 1, n + 1))
    probability[:m, :n] = share
    probability[:m, n] = np.maximum(1.0 - share.sum(axis=1), 0.0)
    probability[m, :n] = np.maximum(1.0 - share.sum(axis=0), 0.0)
    cost = np.where(soft.probability > 0.0, soft.cost, np.inf)[:m, :n]
    return Match(cost, probability, surest_pairs(soft.probability[:m, :n], m))


def _smaller_side(soft: SoftMatches) -> IntArray:
    """(m, n) of each pair's block: how many seen elements it has, or mapped ones if fewer."""
    seen, mapped = soft.possible.sum(axis=0), soft.possible.sum(axis=1)
    return np.asarray(np.minimum(seen, mapped[:, None]))


def _ransac(soft: SoftMatches, seed: int) -> _Coarse:
    """The coarse pose from the surest pairs (eq. 5)."""
    sample = soft.sample
    i, j = surest_pairs(soft.probability, len(sample.ray)).T
    known = sample.seen_known[i] & sample.mapped_known[j]
    if (count := int(known.sum())) < SAMPLE:
        return _Coarse(None, 0, f"{count} points of the surest pairs are known, {SAMPLE} needed.")
    rays = np.stack([sample.ray[i], sample.bottom_ray[i]])
    points_m = np.stack([sample.point_m[j], sample.bottom_m[j]])
    R, t, inliers, hypotheses = most_inliers(Points.of(i, known, rays, points_m), seed)
    if inliers < SAMPLE:
        why = f"No pose brings {SAMPLE} of the {len(i)} surest pairs within the threshold."
        return _Coarse(None, hypotheses, why)
    return _Coarse(_in_map(soft, R, t), hypotheses)


def _refined(soft: SoftMatches, T_camera_map: Pose) -> Pose | Failure:
    """Weighted PnPL over all of P (eq. 6)."""
    sample, R = soft.sample, T_camera_map.rotation
    ends = sample.ray, sample.bottom_ray, sample.point_m, sample.bottom_m
    points, lines = points_and_lines(*ends, sample.seen_known, sample.mapped_known)
    of = weighted_sums(*(np.ascontiguousarray(one)[None] for one in ends))
    of = of._replace(
        point_weight=(soft.probability * points)[None], line_weight=(soft.probability * lines)[None]
    )
    found = weighted_pnpl(of, R[None], T_camera_map.apply(sample.origin_m)[None])
    if not found.ok[0]:
        return Failure("Weighted PnPL comes to no minimum: P does not fix the pose.")
    return _in_map(soft, found.rotation[0], found.translation[0])


def _in_map(soft: SoftMatches, rotation: FloatArray, translation: FloatArray) -> Pose:
    """T_camera_map of T_camera_local."""
    R = nearest_rotation(rotation)
    return Pose(R, translation - R @ soft.sample.origin_m)


def _refinement(scene: Scene, T_camera_map: Pose) -> Refinement:
    """What fits the pose, one-to-one."""
    match, _ = associate(scene, T_camera_map.rotation, T_camera_map.translation, SURE)
    seen = np.flatnonzero(match >= 0)
    pairs = np.column_stack([seen, match[seen]])
    off = scene_residuals(scene, T_camera_map, pairs)
    return Refinement(pairs, off.residual_px, off.chi2, off.inlier, np.array([off.chi2.sum()]))


def _covariance(scene: Scene, T_camera_map: Pose, pairs: IntArray) -> FloatArray | None:
    """The least that pairs which fit allow; None where they fix no pose."""
    weight = information(scene, None, T_camera_map, pairs)
    if np.linalg.eigvalsh(weight)[0] < LEAST_INFORMATION:
        return None
    return np.asarray(np.linalg.inv(weight), np.float64)


def _answered(
    work: Localization, scene: Scene, T_camera_map: Pose, fit: Refinement
) -> Localization:
    """The pose, and whether it can be relied on."""
    covariance = _covariance(scene, T_camera_map, fit.pairs)
    status: Status = "ambiguous"
    reason = f"Only {int(fit.inlier.sum())} of {len(work.observed)} elements fit the pose."
    if covariance is not None:
        refined = Refined(T_camera_map, covariance, fit)
        mode = mode_near(scene, work.prior, T_camera_map)
        verdict = judge(mode, refined, work.observed, work.submap, work.prior)
        status = "ok" if verdict.status == "ok" else "ambiguous"
        reason = verdict.reason
    return replace(
        work, status=status, reason=reason, T_camera_map=T_camera_map, covariance=covariance
    )
