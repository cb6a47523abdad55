"""Associate a frame's observations with map elements under a belief.

A belief is a Gaussian over the pose AND the errors of map elements seen so far. The error of a
mapped element is the same in every frame. A filter that treats it as new noise each time would,
within a second, claim to be more accurate than the map. So the errors of the elements seen are
part of the state, as in SLAM with a map as prior. The covariance stays consistent, and an element
whose error the others reveal is corrected.

Gates are as wide as the belief requires: the covariance of a residual is that of the detection,
the pose, the element and their correlation. Residuals are those of
`semviz_core.localization.residuals` with derivatives by pose AND by element. The result also
scores how well the belief explains the frame.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import erfc

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Belief, Odometry, Prior, adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.association import BEYOND_REACH, NEAREST_M
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import INLIER_CHI2, bottom_is_given, fill_rows, new_rows

POSE = slice(0, 6)


@dataclass(frozen=True, eq=False)
class JointBelief:
    """A Gaussian over the pose and k mapped elements."""

    T_camera_map: Pose
    id: IntArray
    """(k,) of the mapped elements in the state."""
    error_m: FloatArray
    """(k, 6) estimated correction of their mapped anchors and ends."""
    covariance: FloatArray
    """(6 + 6k, 6 + 6k) of the left perturbation of T_camera_map (metres, radians), then of the
    errors (metres)."""

    @classmethod
    def start(cls, belief: Belief) -> "JointBelief":
        """Return the belief before any element is seen."""
        no_elements = np.zeros(0, dtype=np.int64)
        return cls(belief.T_camera_map, no_elements, np.zeros((0, 6)), belief.covariance)

    @property
    def pose(self) -> Belief:
        """The marginal of the pose."""
        own = self.covariance[POSE, POSE]
        return Belief(self.T_camera_map, 0.5 * (own + own.T))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.pose.covariance[:3, :3])[-1]))

    def moved(self, odometry: Odometry) -> "JointBelief":
        """Return the belief one step of odometry later."""
        A = adjoint(odometry.T_now_before)
        covariance = self.covariance.copy()
        covariance[POSE] = A @ covariance[POSE]
        covariance[:, POSE] = covariance[:, POSE] @ A.T
        covariance[POSE, POSE] += odometry.covariance
        return replace(
            self,
            T_camera_map=odometry.T_now_before @ self.T_camera_map,
            covariance=covariance,
        )

    def errors_m(self, id: IntArray) -> FloatArray:
        """Return the correction (n, 6) of anchors and ends of mapped elements; 0 if not seen."""
        row, known = self.rows(id)
        padded = self.error_m if len(self.id) else np.zeros((1, 6))
        return np.where(known[:, None], padded[row], 0.0)

    def cross_covariance(self, elements: Elements3D) -> tuple[FloatArray, FloatArray]:
        """Return (n, 6, 6) of pose with element, and (n, 6, 6) of each element's own error."""
        row, known = self.rows(elements.id)
        if not len(self.id):
            return np.zeros((len(row), 6, 6)), elements.covariance_m2
        columns = 6 + 6 * row[:, None] + np.arange(6)
        with_pose = np.swapaxes(self.covariance[POSE][:, columns], 0, 1)
        own = self.covariance[columns[:, :, None], columns[:, None, :]]
        inside = known[:, None, None]
        return np.where(inside, with_pose, 0.0), np.where(inside, own, elements.covariance_m2)

    def rows(self, id: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the row (n,) of each id in the state, 0 if missing, and (n,) whether it is in."""
        equal = id[:, None] == self.id
        row = equal.argmax(axis=1) if len(self.id) else np.zeros(len(id), dtype=np.int64)
        return row, equal.any(axis=1)

    def including(self, elements: Elements3D) -> "JointBelief":
        """Return the belief with the errors of ``elements`` in the state."""
        new = elements[~self.rows(elements.id)[1]]
        size, k = len(self.covariance), len(new)
        covariance = np.zeros((size + 6 * k, size + 6 * k))
        covariance[:size, :size] = self.covariance
        for row in range(k):
            block = slice(size + 6 * row, size + 6 * row + 6)
            covariance[block, block] = new.covariance_m2[row]
        return replace(
            self,
            id=np.concatenate([self.id, new.id]),
            error_m=np.concatenate([self.error_m, np.zeros((k, 6))]),
            covariance=covariance,
        )

    def keeping(self, kept: BoolArray) -> "JointBelief":
        """Return the belief without the elements where ``kept`` (k,) is False (marginalized)."""
        index = np.concatenate([np.arange(6), *(6 + 6 * row + np.arange(6)
                                for row in np.flatnonzero(kept))])  # fmt: skip
        return replace(
            self,
            id=self.id[kept],
            error_m=self.error_m[kept],
            covariance=self.covariance[np.ix_(index, index)],
        )

    def shifted(self, step: FloatArray, covariance: FloatArray) -> "JointBelief":
        """Return the belief with its mean moved by ``step`` (6 + 6k,), and a new covariance."""
        return replace(
            self,
            T_camera_map=Pose.exp(step[POSE]) @ self.T_camera_map,
            error_m=self.error_m + step[6:].reshape(-1, 6),
            covariance=0.5 * (covariance + covariance.T),
        )

    def with_pose(self, pose: Belief) -> "JointBelief":
        """Return the belief after its pose was updated to ``pose``; correlated errors follow."""
        before = self.covariance[POSE, POSE]
        gain = np.linalg.solve(before, self.covariance[POSE]).T  # (6 + 6k, 6), identity on top
        step = (pose.T_camera_map @ self.T_camera_map.inverse()).log()
        reduction = gain @ (before - pose.covariance) @ gain.T
        return self.shifted(gain @ step, self.covariance - reduction)


@dataclass(frozen=True, eq=False)
class PairRows:
    """Residual rows of k pairs under one pose; unused rows are 0, with variance 1."""

    residual_px: FloatArray
    """(k, 4) detection minus projection; no row is used if the element is behind the camera."""
    used: BoolArray
    """(k, 4)"""
    is_bottom: BoolArray
    """(k, 4) True for the row, always the last used, of a bottom that may be hidden."""
    by_pose: FloatArray
    """(k, 4, 6) by the left perturbation of T_camera_map."""
    by_element: FloatArray
    """(k, 4, 6) by the mapped anchor and end, map axes."""
    variance_px2: FloatArray
    """(k, 4) of the detection."""
    clutter: FloatArray
    """(k, 4) log density (per px) of a false detection."""
    length_px: FloatArray
    """(k,) of a pole as projected."""


def pair_rows(problem: PoseProblem, T_camera_map: Pose, pairs: IntArray) -> PairRows:
    """Return the residual rows of ``pairs`` (k, 2), rows of observed and mapped elements."""
    pairs = np.ascontiguousarray(pairs)
    R, t = T_camera_map.writable()
    count, bottom, residual, by_pose, by_element, length = _fill(problem, R, t, pairs)
    index = np.arange(4)
    seen = problem.seen[pairs[:, 0]]
    across = (index == 0) | ((index == 1) & seen["is_line"][:, None])
    variance = np.where(across, seen["variance_px2"][:, :1], seen["variance_px2"][:, 1:])
    used = index < count[:, None]
    return PairRows(
        residual_px=residual,
        used=used,
        is_bottom=bottom[:, None] & (index == count[:, None] - 1),
        by_pose=by_pose,
        by_element=by_element,
        variance_px2=np.where(used, variance, 1.0),
        clutter=seen["clutter"][:, np.minimum(index, 2)],
        length_px=np.maximum(length, 1.0),
    )


@compiled
def _fill(
    problem: PoseProblem, R: FloatArray, t: FloatArray, pairs: IntArray
) -> tuple[IntArray, BoolArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    k = len(pairs)
    count, bottom, length = np.zeros(k, np.int64), np.zeros(k, np.bool_), np.zeros(k)
    residual, by_pose, by_element = np.zeros((k, 4)), np.zeros((k, 4, 6)), np.zeros((k, 4, 6))
    rows = new_rows()
    for pair in range(k):
        i, j = pairs[pair, 0], pairs[pair, 1]
        n = fill_rows(problem, R, t, i, j, rows)
        count[pair], bottom[pair] = n, n > 0 and bottom_is_given(problem, i, j, n)
        length[pair] = rows.length_px[0] if problem.seen[i].is_line else 0.0
        residual[pair, :n] = rows.residual[:n]
        by_pose[pair, :n] = rows.jacobian[:n]
        by_element[pair, :n] = rows.by_map[:n]
    return count, bottom, residual, by_pose, by_element, length


MARGIN_NATS = 2.0
"""A pair is certain if it is better by this much than a false positive, and than every other pair
of its detection or element. Two poles side by side, or an element mapped twice, give none."""
_ROOT_2PI = float(np.sqrt(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class TrackingFrame:
    """The input of one frame: observed elements, submap and prior."""

    camera: Camera
    detector: DetectorModel
    observed: Elements2D
    submap: Elements3D
    prior: Prior | None

    @cached_property
    def problem(self) -> PoseProblem:
        """The problem with elements at their mapped positions."""
        return PoseProblem.of(self.camera, self.observed, self.submap)

    def under(self, belief: JointBelief) -> PoseProblem:
        """Return the problem with elements at their believed positions, covariances as mapped."""
        error_m, mapped = belief.errors_m(self.submap.id), self.problem.mapped.copy()
        ends = np.where(self.submap.is_line[:, None], error_m[:, 3:], error_m[:, :3])
        mapped["anchor_m"] += error_m[:, :3]
        mapped["end_m"] += ends
        return self.problem._replace(mapped=mapped)


@dataclass(frozen=True, eq=False)
class FrameAssociation:
    """The association of a frame under a belief."""

    seen: int
    """Number of observed elements."""
    pairs: IntArray
    """(k, 2) one-to-one pairs (row of observed, row of submap)."""
    element_id: IntArray
    """(k,) of the mapped elements."""
    certain: BoolArray
    """(k,) True if better by MARGIN_NATS than every other pair and than a false positive."""
    bottom_seen: BoolArray
    """(k,) False if a pole's given bottom is more likely hidden."""
    log_likelihood: float
    """Nats of pairs over false positives, and of mapped elements detected and missed."""
    log_elsewhere: float
    """The same for a camera elsewhere among as many elements."""


def associate_frame(belief: JointBelief, frame: TrackingFrame) -> FrameAssociation:
    """Pair the frame's observed elements one-to-one with mapped ones under ``belief``."""
    problem = frame.under(belief)
    middle_m = 0.5 * (problem.mapped["anchor_m"] + problem.mapped["end_m"])
    middle_c = belief.T_camera_map.apply(middle_m)
    possible = problem.compatible & (middle_c[:, 2] > NEAREST_M)
    candidates = np.argwhere(possible)
    gain, bottom_seen = _gains(belief, frame, problem, candidates)
    pairs, rank, certain = _one_to_one(gain, candidates, possible.shape)

    chance = _chance_of_detection(frame, middle_c)
    detected = np.zeros(len(chance), dtype=bool)
    detected[pairs[:, 1]] = True
    seen = np.log(np.maximum(chance, BEYOND_REACH))
    explained = gain[rank].sum() + np.where(detected, seen, np.log1p(-chance)).sum()
    expected, false = float(chance.sum()), frame.detector.false_detections
    elsewhere = len(frame.observed) * np.log1p(expected / false) - expected
    informative = len(frame.observed) > 0  # a blind camera is no evidence against any pose
    return FrameAssociation(
        seen=len(frame.observed),
        pairs=pairs,
        element_id=frame.submap.id[pairs[:, 1]],
        certain=certain,
        bottom_seen=bottom_seen[rank],
        log_likelihood=float(explained) if informative else 0.0,
        log_elsewhere=float(elsewhere) if informative else 0.0,
    )


def _gains(
    belief: JointBelief, frame: TrackingFrame, problem: PoseProblem, candidates: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Return the gain (c,) of each pair in nats over a false positive, -inf beyond the gate, and
    (c,) whether its bottom, if given, is more likely visible than hidden."""
    rows = pair_rows(problem, belief.T_camera_map, candidates)
    # unused rows are 0 with variance 1 and uncorrelated: they change nothing
    factor = np.linalg.cholesky(
        _innovation_covariance(belief, frame.submap, rows, candidates[:, 1])
    )
    white = np.linalg.solve(factor, rows.residual_px[..., None])[..., 0]
    sigma = np.diagonal(factor, axis1=1, axis2=2)
    nats = -0.5 * white**2 - np.log(_ROOT_2PI * sigma) - rows.clutter
    bottom, bottom_seen = _bottom_nats(rows, white, sigma, frame.detector.hidden_bottoms)
    nats = np.where(rows.is_bottom, bottom, nats)
    counted = rows.used & (bottom_seen[:, None] | ~rows.is_bottom)
    chi2 = np.where(counted, white**2, 0.0).sum(axis=1)
    passed = rows.used[:, 0] & (chi2 <= INLIER_CHI2[counted.sum(axis=1)])
    gain = np.where(rows.used, nats, 0.0).sum(axis=1) - np.log(frame.detector.false_detections)
    return np.where(passed, gain, -np.inf), bottom_seen


def _bottom_nats(
    rows: PairRows, white: FloatArray, sigma: FloatArray, hidden: float
) -> tuple[FloatArray, BoolArray]:
    """Return the nats (c, 4) of rows that are bottoms, and (c,) whether they are likely visible.

    A hidden bottom is anywhere between peak and bottom, as in
    ``semviz_core.localization.residuals.hidden_odds``.
    """
    visible = (1.0 - hidden) * np.exp(-0.5 * white**2) / (_ROOT_2PI * sigma)
    behind = 0.5 * erfc(white / np.sqrt(2.0)) * hidden / rows.length_px[:, None]
    nats = np.log(np.maximum(visible + behind, 1e-300)) - rows.clutter
    return nats, np.asarray(((visible >= behind) | ~rows.is_bottom).all(axis=1))


def _innovation_covariance(
    belief: JointBelief, submap: Elements3D, rows: PairRows, mapped: IntArray
) -> FloatArray:
    """Return (c, 4, 4) of the rows: detection, pose, element, and the last two's correlation."""
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
    """Return greedy pairs by positive gain, their rows in ``gain``, and which are certain."""
    table = np.full(shape, -np.inf)
    table[candidates[:, 0], candidates[:, 1]] = gain
    free_seen, free_mapped = np.ones(shape[0], dtype=bool), np.ones(shape[1], dtype=bool)
    entries: list[int] = []
    certain: list[bool] = []
    for entry in np.argsort(-gain, kind="stable"):
        i, j = candidates[entry]
        if gain[entry] <= 0.0:
            break
        if not (free_seen[i] and free_mapped[j]):
            continue
        free_seen[i] = free_mapped[j] = False
        entries.append(int(entry))
        rivals = np.concatenate([np.delete(table[i], j), np.delete(table[:, j], i)])
        certain.append(bool(rivals.max(initial=0.0) < gain[entry] - MARGIN_NATS))
    rank = np.array(entries, dtype=np.int64)
    return candidates[rank], rank, np.array(certain, dtype=bool)


def _chance_of_detection(frame: TrackingFrame, middle_c: FloatArray) -> FloatArray:
    """Return the chance (n,) that each mapped element is detected, 0 out of view; ``middle_c``
    (n, 3) is its middle in camera coordinates."""
    detector, depth = frame.detector, middle_c[:, 2]
    share = np.clip((depth - detector.near_m) / (detector.far_m - detector.near_m), 0.0, 1.0)
    chance = detector.recall_near + share * (detector.recall_far - detector.recall_near)
    chance = np.where(depth > detector.reach_m, BEYOND_REACH, chance)
    in_view = (depth > NEAREST_M) & frame.camera.contains(frame.camera.project(middle_c))
    return np.where(in_view, chance, 0.0)
