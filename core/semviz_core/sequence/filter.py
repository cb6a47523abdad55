"""An extended Kalman filter over the pose and the errors of the map: one step of the drive."""

from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.frame import Belief
from semviz_core.sequence.belief import POSE, JointBelief
from semviz_core.sequence.odometry import Odometry
from semviz_core.sequence.rows import PairRows, pair_rows
from semviz_core.sequence.sight import Reading, Sight, read
from semviz_core.solving.least_squares import fit_pairs
from semviz_core.solving.scene import Scene

PRIOR_FRAMES = 100
"""The errors of fixes, road heights and IMUs last: so many frames in a row say as much as one."""
ENOUGH, LEAST_SHARE = 3, 0.6
"""Pairs that are believed whatever else is seen; of fewer, one that fits beside others that do not
is too likely a pole that is not in the map."""
FORGOTTEN_M = 5.0
"""Elements further behind the camera are left out of the state."""
ITERATIONS = 3
_NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


def driven(belief: JointBelief, odometry: Odometry, sight: Sight) -> tuple[JointBelief, Reading]:
    """The belief one frame later, and what it made of the frame."""
    belief = informed(belief.moved(odometry), sight, PRIOR_FRAMES)
    reading = read(belief, sight)
    return _without_passed(updated(belief, sight, reading), sight), reading


def informed(belief: JointBelief, sight: Sight, frames: int) -> JointBelief:
    """The belief after the frame's prior, one of ``frames`` that tell the same."""
    prior, often = sight.prior, np.sqrt(frames)
    prior = replace(
        prior,
        horizontal_sigma_m=prior.horizontal_sigma_m * often,
        vertical_sigma_m=prior.vertical_sigma_m * often,
        up_sigma_rad=prior.up_sigma_rad * often,
        heading_sigma_rad=prior.heading_sigma_rad * often,
    )
    scene = Scene.of(sight.camera, sight.observed, sight.submap)
    found = fit_pairs(scene, prior, belief.T_camera_map, _NO_PAIRS, belief=belief.pose)
    covariance = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
    return belief.with_pose(Belief(found.T_camera_map, 0.5 * (covariance + covariance.T)))


def updated(belief: JointBelief, sight: Sight, reading: Reading) -> JointBelief:
    """The belief after the frame's certain pairs: iterated update (Bell and Cathey 1993)."""
    pairs, bottom_seen = reading.pairs[reading.certain], reading.bottom_seen[reading.certain]
    if not len(pairs) or len(reading.pairs) < min(ENOUGH, LEAST_SHARE * reading.seen):
        return belief
    before = belief.including(sight.submap[pairs[:, 1]])
    row, _ = before.rows(sight.submap.id[pairs[:, 1]])
    here, step = before, np.zeros(len(before.covariance))
    for _ in range(ITERATIONS):
        scene = Scene.of(sight.camera, sight.observed, here.corrected(sight.submap))
        rows = pair_rows(scene, here.T_camera_map, pairs)
        used = rows.used & (bottom_seen[:, None] | ~rows.is_bottom)
        H = _stacked(rows, row, len(step))[used.ravel()]
        PH = before.covariance @ H.T
        noise = rows.variance_px2[used]
        gain = cho_solve(cho_factor(H @ PH + np.diag(noise)), PH.T).T
        step = -gain @ (rows.residual_px[used] - H @ step)
        here = before.shifted(step, before.covariance)
    kept = np.eye(len(step)) - gain @ H  # Joseph's form: stays positive whatever the rounding
    return before.shifted(step, kept @ before.covariance @ kept.T + (gain * noise) @ gain.T)


def _stacked(rows: PairRows, row: IntArray, size: int) -> FloatArray:
    """(4k, size) derivative of all rows by the whole state."""
    H = np.zeros((len(row), 4, size))
    H[:, :, POSE] = rows.by_pose
    for pair, element in enumerate(row):
        H[pair, :, 6 + 6 * element : 12 + 6 * element] = rows.by_element[pair]
    return H.reshape(-1, size)


def _without_passed(belief: JointBelief, sight: Sight) -> JointBelief:
    """Without the elements that lie behind or are no longer near."""
    row, known = belief.rows(sight.submap.id)
    depth = belief.T_camera_map.apply(sight.submap.anchor_m)[:, 2]
    kept = np.zeros(len(belief.id), dtype=bool)
    kept[row[known & (depth > -FORGOTTEN_M)]] = True
    return belief.keeping(kept)
