"""Prior-guided upright search: from classes and a rough position to poses that explain the image.

Places about the prior vote for headings (``hypotheses``); azimuths and slopes rate what they
propose quickly (``rating``), with more effort a second time after a few quick steps (``polish``);
the best distinct ones are paired one-to-one and fitted, with gates that narrow as they settle; what
remains are the modes, best first.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.frame import Prior
from semviz_core.pose import Pose
from semviz_core.solving.association import associate, log_likelihood, one_to_one
from semviz_core.solving.effort import USUAL, Effort
from semviz_core.solving.hypotheses import upright_hypotheses
from semviz_core.solving.least_squares import fit
from semviz_core.solving.linear import inverse
from semviz_core.solving.polish import polish
from semviz_core.solving.rating import POLISHED, VOTED, rate
from semviz_core.solving.residuals import SURE
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.upright import UprightView, likely_ups, upright_view

BASIN_M, BASIN_RAD = 2.5, float(np.deg2rad(8.0))
"""Hypotheses closer than both are fitted to the same pose."""
APART_M, APART_RAD = 1.0, float(np.deg2rad(2.0))
"""Poses further apart than either are different answers."""
COARSE: FloatArray = np.diag([0.3**2] * 3 + [np.deg2rad(0.7) ** 2] * 3)
"""Covariance of a polished hypothesis."""
FINE: FloatArray = np.diag([0.1**2] * 3 + [np.deg2rad(0.2) ** 2] * 3)
"""Left after the first fits, besides what the pairs leave open."""


@dataclass(frozen=True, eq=False)
class Modes:
    """b distinct poses, best first, with their pairs."""

    tried: int
    passed: int
    """Hypotheses within the gates of the prior."""
    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    score: FloatArray  # (b,) nats
    match: IntArray  # (b, m)
    gain: FloatArray  # (b, m, n)

    def pairs(self, row: int) -> IntArray:
        """(k, 2) observed and mapped rows of the pairs of one mode."""
        seen = np.flatnonzero(self.match[row] >= 0)
        return np.column_stack([seen, self.match[row, seen]])


def apart(
    rotation: FloatArray, translation: FloatArray, other_rotation: FloatArray, other: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances of camera centres (b,) and angles (b,) in radians from one pose to b others."""
    center = -rotation.T @ translation
    centers = -np.einsum("bji,bj->bi", other_rotation, other)
    trace = np.einsum("ij,bij->b", rotation, other_rotation)
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    return np.linalg.norm(centers - center, axis=1), angle


class Candidates(NamedTuple):
    """Room for b poses with what they are worth."""

    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    worth: FloatArray  # (b,)


def search(scene: Scene, prior: Prior, effort: Effort = USUAL) -> Modes:
    """The modes of the pose, best first; none where no hypothesis passes the gates."""
    known = Known.of(prior)
    tried = passed = 0
    found: list[Candidates] = []
    ups, up_sigma_rad = likely_ups(scene, known)
    each = _shared(effort, len(ups))
    for up in ups:
        view = upright_view(scene, up, up_sigma_rad)
        candidates, view_tried, view_passed = _candidates(scene, view, known, each)
        tried, passed = tried + view_tried, passed + view_passed
        found.append(candidates)
    together = Candidates(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    return Modes(tried, passed, *_settle(scene, known, together, effort))


def _shared(effort: Effort, views: int) -> Effort:
    """What each of several views may try: their hypotheses are much the same."""
    started = max(effort.started // views, min(effort.started, USUAL.started))
    polished = effort.polished * started // effort.started
    return effort._replace(started=started, polished=polished)


def mode_near(scene: Scene, prior: Prior, T_camera_map: Pose) -> Modes:
    """The one mode that a pose leads to, settled and scored as the search would have done."""
    R, t = T_camera_map.rotation.copy(), T_camera_map.translation.copy()
    match, _ = associate(scene, R, t, FINE)
    R, t, match, gain, score = _fitted(scene, Known.of(prior), R, t, match)
    return Modes(1, 1, R[None], t[None], np.array([score]), match[None], gain[None])


@compiled
def _candidates(
    scene: Scene, view: UprightView, known: Known, effort: Effort
) -> tuple[Candidates, int, int]:
    """The best distinct hypotheses of one view, paired and fitted once; tried; rated."""
    hypotheses = upright_hypotheses(scene, view, known, effort)
    poses = hypotheses.pose
    if len(poses) == 0:
        nothing = Candidates(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0))
        return nothing, hypotheses.tried, 0
    tried, rated = hypotheses.tried, len(poses)
    rating = rate(scene, view, known, poses, VOTED)
    likely = np.argsort(-rating, kind="mergesort")[: effort.polished]
    poses = polish(scene, view, poses[likely], effort.step_m)
    rating = rate(scene, view, known, poses, POLISHED)
    chosen = _distinct_best(poses, rating, effort)
    b = len(chosen)
    candidates = Candidates(np.empty((b, 3, 3)), np.empty((b, 3)), np.empty(b))
    for row in range(b):
        R, t = camera_pose(view, poses[chosen[row]])
        match, _ = associate(scene, R, t, COARSE)
        R, t, information, _ = fit(scene, known, R, t, match, 3)
        match, gain = associate(scene, R, t, inverse(information) + FINE)
        candidates.rotation[row], candidates.translation[row] = R, t
        candidates.worth[row] = log_likelihood(scene, known, R, t, match, gain)
    return candidates, tried, rated


@compiled
def camera_pose(view: UprightView, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """T_camera_map of an upright pose (6,): its rotation (3, 3) and translation (3,)."""
    c, s = pose[3], pose[4]
    level, raised = np.cos(pose[5]), np.sin(pose[5])
    nominal, left, up = view.R_level_camera[0], view.R_level_camera[1], view.R_level_camera[2]
    R, t = np.empty((3, 3)), np.empty(3)
    for k in range(3):
        ahead = level * nominal[k] - raised * up[k]
        R[k, 0], R[k, 1] = ahead * c - left[k] * s, ahead * s + left[k] * c
        R[k, 2] = level * up[k] + raised * nominal[k]
        t[k] = -(R[k, 0] * pose[0] + R[k, 1] * pose[1] + R[k, 2] * pose[2])
    return R, t


@compiled
def _distinct_best(poses: FloatArray, rating: FloatArray, effort: Effort) -> IntArray:
    """Rows of the best hypotheses of which no two are close, as many as are started."""
    likely = np.flatnonzero(rating > rating.max() - effort.hopeful_nats)
    order = likely[np.argsort(-rating[likely], kind="mergesort")]
    kept = np.empty(effort.started, dtype=np.int64)
    count = 0
    for row in order:
        new = True
        for k in range(count):
            dx, dy = poses[row, 0] - poses[kept[k], 0], poses[row, 1] - poses[kept[k], 1]
            if dx * dx + dy * dy < BASIN_M * BASIN_M:
                turn = poses[row, 3] * poses[kept[k], 3] + poses[row, 4] * poses[kept[k], 4]
                if turn > np.cos(BASIN_RAD):
                    new = False
                    break
        if new:
            kept[count] = row
            count += 1
            if count == effort.started:
                break
    return kept[:count]


@compiled
def _settle(
    scene: Scene, known: Known, candidates: Candidates, effort: Effort
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
    """Candidates fitted to the end, scored, sorted; those that ran into a better one left out."""
    m, n = scene.compatible.shape
    kept = _hopeful(candidates, _distinct(candidates)[: effort.finished], effort)
    b = len(kept)
    settled = Candidates(np.empty((b, 3, 3)), np.empty((b, 3)), np.empty(b))
    matches, gains = np.empty((b, m), dtype=np.int64), np.empty((b, m, n))
    for row in range(b):
        R, t = candidates.rotation[kept[row]].copy(), candidates.translation[kept[row]].copy()
        match, _ = associate(scene, R, t, FINE)
        _put(settled, matches, gains, row, _fitted(scene, known, R, t, match))
    best = _distinct(settled)
    for row in _hopeful(settled, best[: effort.improved], effort):
        here = settled.rotation[row], settled.translation[row], matches[row], gains[row]
        _put(settled, matches, gains, row, _improved(scene, known, *here, settled.worth[row]))
    best = _distinct(settled)
    return (
        settled.rotation[best],
        settled.translation[best],
        settled.worth[best],
        matches[best],
        gains[best],
    )


@compiled
def _put(
    settled: Candidates,
    matches: IntArray,
    gains: FloatArray,
    row: int,
    fitted: tuple[FloatArray, FloatArray, IntArray, FloatArray, float],
) -> None:
    settled.rotation[row], settled.translation[row] = fitted[0], fitted[1]
    matches[row], gains[row], settled.worth[row] = fitted[2], fitted[3], fitted[4]


@compiled
def _fitted(
    scene: Scene, known: Known, R: FloatArray, t: FloatArray, match: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, float]:
    """The pose fitted to its pairs until they stay the same, with pairs, gains and score."""
    for _ in range(3):
        R, t, information, _ = fit(scene, known, R, t, match, 5)
        before = match
        match, _ = associate(scene, R, t, inverse(information))
        if (match == before).all():
            break
    R, t, _, _ = fit(scene, known, R, t, match, 5)
    match, gain = associate(scene, R, t, SURE)
    return R, t, match, gain, log_likelihood(scene, known, R, t, match, gain)


@compiled
def _improved(
    scene: Scene,
    known: Known,
    R: FloatArray,
    t: FloatArray,
    match: IntArray,
    gain: FloatArray,
    score: float,
) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, float]:
    """The pose without the one pair, if any, whose leaving makes the others agree better.

    A false pair, such as with the neighbour or the double of the right element, pulls the pose
    until others fail the inlier test.
    """
    best = R, t, match, gain, score
    for i in range(len(match)):
        if match[i] < 0:
            continue
        without = match.copy()
        without[i] = -1
        free_R, free_t, information, _ = fit(scene, known, R, t, without, 4)
        again, others = associate(scene, free_R, free_t, inverse(information))
        if (again == match).all():
            continue  # the others agree with it
        found = _fitted(scene, known, free_R, free_t, one_to_one(others))
        if found[4] > best[4]:
            best = found
    return best


@compiled
def _distinct(candidates: Candidates) -> IntArray:
    """Rows, best first, without poses close to a better one."""
    order = np.argsort(-candidates.worth, kind="mergesort")
    kept = np.empty(len(order), dtype=np.int64)
    count = 0
    for row in order:
        new = True
        for k in range(count):
            away, angle = _apart(candidates, kept[k], row)
            if away <= APART_M and angle <= APART_RAD:
                new = False
                break
        if new:
            kept[count] = row
            count += 1
    return kept[:count]


@compiled
def _hopeful(candidates: Candidates, order: IntArray, effort: Effort) -> IntArray:
    """The first of ``order``, best first, that are not far below the best."""
    count = 0
    while count < len(order):
        if candidates.worth[order[count]] < candidates.worth[order[0]] - effort.hopeful_nats:
            break
        count += 1
    return order[:count]


@compiled
def _apart(candidates: Candidates, a: int, b: int) -> tuple[float, float]:
    """Distance of the camera centres (m) and angle (rad) between two poses."""
    R, t = candidates.rotation[a], candidates.translation[a]
    other_R, other_t = candidates.rotation[b], candidates.translation[b]
    square, trace = 0.0, 0.0
    for column in range(3):
        off = 0.0
        for row in range(3):
            off += other_R[row, column] * other_t[row] - R[row, column] * t[row]
            trace += other_R[row, column] * R[row, column]
        square += off * off
    return np.sqrt(square), np.arccos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))
