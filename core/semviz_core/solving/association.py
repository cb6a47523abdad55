"""Which observed element is which mapped one under a pose, and how well that explains the image.

A log-likelihood in nats: each pair against a false detection, each mapped element in view without a
pair against a missed one, and the prior. One-to-one: two detections never share a mapped element.
"""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.known import known_chi2
from semviz_core.solving.residuals import (
    INLIER_CHI2,
    bottom_is_given,
    fill_rows,
    hidden_odds,
    moved,
    new_rows,
    rows_that_count,
    whiten,
)
from semviz_core.solving.scene import Known, Record, Scene

NEAREST_M = 3.0
"""Elements closer to the camera are not missed when they are not seen."""
BEYOND_REACH = 0.02
"""Chance that something beyond the detector's reach is detected all the same."""
LEAST_CHANCE = 1e-200
"""Smaller products come near to what a number can hold."""
_NONE = -np.inf
_LOG_2PI = np.log(2.0 * np.pi)


@compiled
def associate(
    scene: Scene, R: FloatArray, t: FloatArray, doubt: FloatArray
) -> tuple[IntArray, FloatArray]:
    """One-to-one pairs under a pose: the mapped row (m,) of each observed element, -1 for none;
    and the gains (m, n) in nats of every pair over a false detection, -inf beyond the gate.

    Gates are as wide as ``doubt`` (6, 6), the covariance of the pose, asks for.
    """
    gain = np.full(scene.compatible.shape, _NONE)
    variance, toward = _sights(scene, R, t, doubt)
    rows = new_rows()
    for i in range(len(gain)):
        for at in range(scene.seen[i].first, scene.seen[i].last):
            j = scene.candidate[at]
            if _is_near(scene, i, toward[j], variance[j]):
                gain[i, j] = pair_gain(scene, R, t, i, j, doubt, rows)
    return one_to_one(gain), gain


@compiled
def one_to_one(gain: FloatArray) -> IntArray:
    """Greedy pairs by positive gain (m, n): the mapped row (m,) or -1."""
    m, n = gain.shape
    match, taken = np.full(m, -1), np.zeros(n, dtype=np.bool_)
    flat = gain.ravel()
    positive = np.flatnonzero(flat > 0.0)
    for at in positive[np.argsort(-flat[positive], kind="mergesort")]:
        i, j = at // n, at % n
        if match[i] < 0 and not taken[j]:
            match[i], taken[j] = j, True
    return match


@compiled
def log_likelihood(
    scene: Scene, known: Known, R: FloatArray, t: FloatArray, match: IntArray, gain: FloatArray
) -> float:
    """Nats of a pose with its pairs: gains, misses and the prior."""
    total = -0.5 * known_chi2(known, R, t)
    paired = np.zeros(len(scene.mapped), dtype=np.bool_)
    for i in range(len(match)):
        if match[i] >= 0:
            total += gain[i, match[i]]
            paired[match[i]] = True
    chance = 1.0  # of what is and is not detected; one logarithm in the end
    for j in range(len(paired)):
        recall = _recall(scene, R, t, j)
        # a pair beyond the stated reach of detection is unlikely, not impossible
        chance *= max(recall, BEYOND_REACH) if paired[j] else 1.0 - recall
        if chance < LEAST_CHANCE:
            total += np.log(chance)
            chance = 1.0
    return total + np.log(chance)


@compiled
def _sights(
    scene: Scene, R: FloatArray, t: FloatArray, doubt: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Of each mapped anchor from a pose: variance (rad^2) of its direction, and the direction."""
    n = len(scene.mapped)
    moving, turning = _largest(doubt, 0), _largest(doubt, 3)
    variance, toward = np.empty(n), np.empty((n, 3))
    for j in range(n):
        x, y, z = moved(R, t, scene.mapped[j].anchor_m)
        square = x * x + y * y + z * z
        reach = max(np.sqrt(square), 1e-6)
        toward[j, 0], toward[j, 1], toward[j, 2] = x / reach, y / reach, z / reach
        spread = moving + _largest(scene.mapped[j].covariance_m2, 0)
        variance[j] = spread / max(square, 1.0) + turning
    return variance, toward


@compiled
def _largest(covariance: FloatArray, first: int) -> float:
    """At least the variance in any direction of three axes (Gershgorin), often not much more."""
    largest = 0.0
    for row in range(first, first + 3):
        total = 0.0
        for column in range(first, first + 3):
            total += abs(covariance[row, column])
        largest = max(largest, total)
    return largest


@compiled
def _is_near(scene: Scene, i: int, toward: FloatArray, variance: float) -> bool:
    """Whether a pair is close enough in angle to be worth a residual."""
    ray = scene.seen[i].anchor_ray
    cosine = ray[0] * toward[0] + ray[1] * toward[1] + ray[2] * toward[2]
    if cosine < 0.5:
        return False
    focal = scene.setting.K[0, 0]
    seen = max(scene.seen[i].variance_px2[0], scene.seen[i].variance_px2[1]) / (focal * focal)
    gate = 1.5 * INLIER_CHI2[4] * (seen + variance)  # wider than the test that follows
    if scene.seen[i].is_line:
        plane = scene.seen[i].plane
        aside = plane[0] * toward[0] + plane[1] * toward[1] + plane[2] * toward[2]
        return aside * aside < gate
    return 2.0 - 2.0 * cosine < gate


@compiled
def pair_gain(
    scene: Scene, R: FloatArray, t: FloatArray, i: int, j: int, doubt: FloatArray, rows: Record
) -> float:
    """Log-likelihood of a pair over that of a false detection; -inf where it is no inlier."""
    count = fill_rows(scene, R, t, i, j, rows)
    if count == 0:
        return _NONE
    whiten(scene, i, j, count, doubt, rows)
    used = rows_that_count(scene, i, j, count, rows)
    chi2, gain = 0.0, -scene.setting.log_false_detections
    for row in range(used):
        chi2 += rows.residual[row] ** 2
        gain -= np.log(rows.factor[row, row]) + 0.5 * _LOG_2PI + scene.seen[i].clutter[min(row, 2)]
    if not chi2 <= INLIER_CHI2[used]:
        return _NONE
    gain -= 0.5 * chi2
    if scene.setting.hidden_bottoms > 0.0 and bottom_is_given(scene, i, j, count):
        gain += _bottom_gain(scene, i, count, used, rows)
    return gain


@compiled
def _bottom_gain(scene: Scene, i: int, count: int, used: int, rows: Record) -> float:
    """What a bottom that may be hidden adds to the rows counted already."""
    e = rows.residual[count - 1]
    seen = 1.0 - scene.setting.hidden_bottoms
    hidden = hidden_odds(scene, count, rows)
    if used == count:  # counted as if surely seen
        return np.log(seen + hidden * np.exp(0.5 * e * e))
    density = np.log(rows.factor[count - 1, count - 1]) + 0.5 * _LOG_2PI
    return np.log(seen * np.exp(-0.5 * e * e) + hidden) - density - scene.seen[i].clutter[2]


@compiled
def _recall(scene: Scene, R: FloatArray, t: FloatArray, j: int) -> float:
    """Chance that a mapped element is detected; 0 out of view."""
    x, y, z = moved(R, t, 0.5 * (scene.mapped[j].anchor_m + scene.mapped[j].end_m))
    if z <= NEAREST_M:
        return 0.0
    u = (scene.setting.K[0, 0] * x + scene.setting.K[0, 1] * y) / z + scene.setting.K[0, 2]
    v = scene.setting.K[1, 1] * y / z + scene.setting.K[1, 2]
    if not (0.0 < u < scene.setting.size_px[0] and 0.0 < v < scene.setting.size_px[1]):
        return 0.0
    model = scene.setting
    if z > model.reach_m:
        return BEYOND_REACH
    share = min(max((z - model.near_m) / (model.far_m - model.near_m), 0.0), 1.0)
    return model.recall_near + share * (model.recall_far - model.recall_near)
