"""An extended Kalman filter over the pose and the errors of the map: one step of the drive."""

from dataclasses import replace

import numpy as np

from semviz_core.frame import Belief
from semviz_core.sequence.belief import JointBelief
from semviz_core.sequence.kalman import kalman_update
from semviz_core.sequence.odometry import Odometry
from semviz_core.sequence.rows import pair_rows
from semviz_core.sequence.sight import Reading, Sight, read
from semviz_core.solving.least_squares import fit_pairs

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
    found = fit_pairs(sight.scene, prior, belief.T_camera_map, _NO_PAIRS, belief=belief.pose)
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
        rows = pair_rows(sight.under(here), here.T_camera_map, pairs)
        rows = replace(rows, used=rows.used & (bottom_seen[:, None] | ~rows.is_bottom))
        step, covariance = kalman_update(before.covariance, rows, row, step)
        here = before.shifted(step, covariance)
    return here


def _without_passed(belief: JointBelief, sight: Sight) -> JointBelief:
    """Without the elements that lie behind or are no longer near."""
    row, known = belief.rows(sight.submap.id)
    depth = belief.T_camera_map.apply(sight.submap.anchor_m)[:, 2]
    kept = np.zeros(len(belief.id), dtype=bool)
    kept[row[known & (depth > -FORGOTTEN_M)]] = True
    return belief.keeping(kept)
