"""One frame as a belief sees it: which element is which, how well that explains it, and the news.

The gates are as wide as the belief says: the covariance of a residual is that of the detection, of
the pose, of the element and of their correlation.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import erfc

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.sequence.belief import POSE, JointBelief
from semviz_core.sequence.rows import PairRows, pair_rows
from semviz_core.solving.association import BEYOND_REACH, NEAREST_M
from semviz_core.solving.residuals import INLIER_CHI2
from semviz_core.solving.scene import Scene

TOLD_APART_NATS = 2.0
"""A pair no better than another one of the same detection or element, or than a false detection, by
this much is not used: two poles side by side, one thing mapped twice, or what fits a wide gate."""
_ROOT_2PI = float(np.sqrt(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class Sight:
    """One frame: what is seen, what could be, and what is known beforehand."""

    camera: Camera
    detector: DetectorModel
    observed: Elements2D
    submap: Elements3D
    prior: Prior

    @cached_property
    def scene(self) -> Scene:
        """With elements where they are mapped."""
        return Scene.of(self.camera, self.observed, self.submap)

    def under(self, belief: JointBelief) -> Scene:
        """With elements where they are believed to be; covariances stay the map's."""
        error_m, mapped = belief.errors_m(self.submap.id), self.scene.mapped.copy()
        ends = np.where(self.submap.is_line[:, None], error_m[:, 3:], error_m[:, :3])
        mapped["anchor_m"] += error_m[:, :3]
        mapped["end_m"] += ends
        return self.scene._replace(mapped=mapped)


@dataclass(frozen=True, eq=False)
class Reading:
    """What a belief makes of a frame."""

    seen: int
    """Elements observed."""
    pairs: IntArray
    """(k, 2) one-to-one pairs (row of observed, row of submap)."""
    element_id: IntArray
    """(k,) of the mapped elements."""
    certain: BoolArray
    """(k,) told apart from every other pair and from false detections."""
    bottom_seen: BoolArray
    """(k,) False where a pole's given bottom is rather hidden."""
    log_likelihood: float
    """Nats of pairs over false detections, and of mapped elements found and missed."""
    log_elsewhere: float
    """The same for a camera somewhere else among as many elements."""


def read(belief: JointBelief, sight: Sight) -> Reading:
    """Pair the frame's elements with mapped ones, one-to-one, under ``belief``."""
    scene = sight.under(belief)
    middle_m = 0.5 * (scene.mapped["anchor_m"] + scene.mapped["end_m"])
    middle_c = belief.T_camera_map.apply(middle_m)
    possible = scene.compatible & (middle_c[:, 2] > NEAREST_M)
    candidates = np.argwhere(possible)
    gain, bottom_seen = _gains(belief, sight, scene, candidates)
    pairs, rank, certain = _one_to_one(gain, candidates, possible.shape)

    chance = _chance_of_detection(sight, middle_c)
    found = np.zeros(len(chance), dtype=bool)
    found[pairs[:, 1]] = True
    seen = np.log(np.maximum(chance, BEYOND_REACH))
    explained = gain[rank].sum() + np.where(found, seen, np.log1p(-chance)).sum()
    expected, false = float(chance.sum()), sight.detector.false_detections
    elsewhere = len(sight.observed) * np.log1p(expected / false) - expected
    tells = len(sight.observed) > 0  # a blind camera and a bare road look alike
    return Reading(
        seen=len(sight.observed),
        pairs=pairs,
        element_id=sight.submap.id[pairs[:, 1]],
        certain=certain,
        bottom_seen=bottom_seen[rank],
        log_likelihood=float(explained) if tells else 0.0,
        log_elsewhere=float(elsewhere) if tells else 0.0,
    )


def _gains(
    belief: JointBelief, sight: Sight, scene: Scene, candidates: IntArray
) -> tuple[FloatArray, BoolArray]:
    """(c,) nats of each pair over a false detection, -inf beyond the gate; and (c,) whether its
    bottom, if given, is rather seen than hidden."""
    rows = pair_rows(scene, belief.T_camera_map, candidates)
    # unused rows are 0 with variance 1, apart from the others: they change nothing
    factor = np.linalg.cholesky(
        _innovation_covariance(belief, sight.submap, rows, candidates[:, 1])
    )
    white = np.linalg.solve(factor, rows.residual_px[..., None])[..., 0]
    sigma = np.diagonal(factor, axis1=1, axis2=2)
    nats = -0.5 * white**2 - np.log(_ROOT_2PI * sigma) - rows.clutter
    bottom, bottom_seen = _bottom_nats(rows, white, sigma, sight.detector.hidden_bottoms)
    nats = np.where(rows.is_bottom, bottom, nats)
    counted = rows.used & (bottom_seen[:, None] | ~rows.is_bottom)
    chi2 = np.where(counted, white**2, 0.0).sum(axis=1)
    passed = rows.used[:, 0] & (chi2 <= INLIER_CHI2[counted.sum(axis=1)])
    gain = np.where(rows.used, nats, 0.0).sum(axis=1) - np.log(sight.detector.false_detections)
    return np.where(passed, gain, -np.inf), bottom_seen


def _bottom_nats(
    rows: PairRows, white: FloatArray, sigma: FloatArray, hidden: float
) -> tuple[FloatArray, BoolArray]:
    """(c, 4) of rows that are bottoms: seen, or hidden and then anywhere between peak and bottom,
    as in ``solving.residuals.hidden_odds``; and (c,) whether rather seen."""
    shown = (1.0 - hidden) * np.exp(-0.5 * white**2) / (_ROOT_2PI * sigma)
    behind = 0.5 * erfc(white / np.sqrt(2.0)) * hidden / rows.length_px[:, None]
    nats = np.log(np.maximum(shown + behind, 1e-300)) - rows.clutter
    return nats, np.asarray(((shown >= behind) | ~rows.is_bottom).all(axis=1))


def _innovation_covariance(
    belief: JointBelief, submap: Elements3D, rows: PairRows, mapped: IntArray
) -> FloatArray:
    """(c, 4, 4) of the rows: detection, pose, element, and the correlation of the last two."""
    with_pose, own = belief.cross_covariance(submap)
    J, E = rows.by_pose, rows.by_element
    mixed = J @ with_pose[mapped] @ np.swapaxes(E, 1, 2)
    S = J @ belief.covariance[POSE, POSE] @ np.swapaxes(J, 1, 2)
    S += E @ own[mapped] @ np.swapaxes(E, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
    index = np.arange(4)
    S[:, index, index] += rows.variance_px2
    return S


def _one_to_one(
    gain: FloatArray, candidates: IntArray, shape: tuple[int, ...]
) -> tuple[IntArray, IntArray, BoolArray]:
    """Greedy pairs by positive gain, their rows in ``gain``, and which are told apart."""
    table = np.full(shape, -np.inf)
    table[candidates[:, 0], candidates[:, 1]] = gain
    free_seen, free_mapped = np.ones(shape[0], dtype=bool), np.ones(shape[1], dtype=bool)
    taken: list[int] = []
    certain: list[bool] = []
    for one in np.argsort(-gain, kind="stable"):
        i, j = candidates[one]
        if gain[one] <= 0.0:
            break
        if not (free_seen[i] and free_mapped[j]):
            continue
        free_seen[i] = free_mapped[j] = False
        taken.append(int(one))
        rivals = np.concatenate([np.delete(table[i], j), np.delete(table[:, j], i)])
        certain.append(bool(rivals.max(initial=0.0) < gain[one] - TOLD_APART_NATS))
    rank = np.array(taken, dtype=np.int64)
    return candidates[rank], rank, np.array(certain, dtype=bool)


def _chance_of_detection(sight: Sight, middle_c: FloatArray) -> FloatArray:
    """(n,) that each mapped element, its middle at ``middle_c`` (n, 3), is detected; 0 out of
    view."""
    detector, depth = sight.detector, middle_c[:, 2]
    share = np.clip((depth - detector.near_m) / (detector.far_m - detector.near_m), 0.0, 1.0)
    chance = detector.recall_near + share * (detector.recall_far - detector.recall_near)
    chance = np.where(depth > detector.reach_m, BEYOND_REACH, chance)
    in_view = (depth > NEAREST_M) & sight.camera.contains(sight.camera.project(middle_c))
    return np.where(in_view, chance, 0.0)
