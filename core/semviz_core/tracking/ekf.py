"""The extended Kalman filter over the pose and the map's errors: predict and update.

Certain pairs update the belief by an iterated update (Bell and Cathey 1993). The Kalman update
uses plain compiled loops: its products are so small that BLAS threads cost ten times what they
save.
"""

from dataclasses import replace

import numpy as np

from semviz_core.base.frame import Belief, Odometry
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.tracking import association
from semviz_core.tracking.association import JointBelief


def kalman_update(
    covariance: FloatArray, rows: association.PairRows, element: IntArray, around: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the step (6 + 6k,) of the state, and the covariance, after observing ``rows``.

    ``element`` (p,): which of the k elements in the state each pair belongs to. ``around``
    (6 + 6k,): the step at which the rows were linearized.
    """
    return _sequential_update(
        covariance, rows.used, rows.residual_px, rows.by_pose, rows.by_element, rows.variance_px2,
        6 + 6 * element, around,
    )  # fmt: skip


@compiled
def _sequential_update(
    covariance: FloatArray,
    used: BoolArray,
    residual: FloatArray,
    by_pose: FloatArray,
    by_element: FloatArray,
    variance: FloatArray,
    first: IntArray,
    around: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Update by one row at a time, which is exact since their noise is independent."""
    P, size = covariance.copy(), len(covariance)
    step, column = np.zeros(size), np.empty(size)
    for pair in range(len(first)):
        at = first[pair]
        for row in range(4):
            if not used[pair, row]:
                continue
            pose, own = by_pose[pair, row], by_element[pair, row]
            for i in range(size):
                column[i] = 0.0
                for k in range(6):
                    column[i] += P[i, k] * pose[k] + P[i, at + k] * own[k]
            off, expected = residual[pair, row], variance[pair, row]
            for k in range(6):
                off += pose[k] * (step[k] - around[k]) + own[k] * (step[at + k] - around[at + k])
                expected += pose[k] * column[k] + own[k] * column[at + k]
            for i in range(size):
                gain = column[i] / expected
                step[i] -= gain * off
                for j in range(size):
                    P[i, j] -= gain * column[j]
    return step, P


PRIOR_FRAMES = 100
"""The errors of fixes, road heights and IMUs are correlated: so many consecutive frames carry as
much information as one."""
ENOUGH, LEAST_SHARE = 3, 0.6
"""Pairs that suffice for an update. Fewer must be at least this share of the observed elements:
otherwise a pair is too likely a pole that is not in the map."""
FORGOTTEN_M = 5.0
"""Elements further behind the camera leave the state."""
ITERATIONS = 3
_NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


def predict_and_update(
    belief: JointBelief, odometry: Odometry, frame: association.TrackingFrame
) -> tuple[JointBelief, association.FrameAssociation]:
    """Return the belief one frame later, and the association of the frame."""
    belief = update_by_prior(belief.moved(odometry), frame, PRIOR_FRAMES)
    associated = association.associate_frame(belief, frame)
    return _without_passed_elements(update_by_pairs(belief, frame, associated), frame), associated


def update_by_prior(
    belief: JointBelief, frame: association.TrackingFrame, frames: int
) -> JointBelief:
    """Return the belief after the frame's prior, if any, whose error ``frames`` frames share."""
    prior, factor = frame.prior, np.sqrt(frames)
    if prior is None:
        return belief
    prior = replace(
        prior,
        horizontal_sigma_m=prior.horizontal_sigma_m * factor,
        vertical_sigma_m=prior.vertical_sigma_m * factor,
        up_sigma_rad=prior.up_sigma_rad * factor,
        heading_sigma_rad=prior.heading_sigma_rad * factor,
    )
    found = fit_pairs(frame.problem, prior, belief.T_camera_map, _NO_PAIRS, belief=belief.pose)
    covariance = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
    return belief.with_pose(Belief(found.T_camera_map, 0.5 * (covariance + covariance.T)))


def update_by_pairs(
    belief: JointBelief, frame: association.TrackingFrame, associated: association.FrameAssociation
) -> JointBelief:
    """Return the belief after the frame's certain pairs: iterated update (Bell and Cathey 1993)."""
    pairs, bottom_seen = (
        associated.pairs[associated.certain],
        associated.bottom_seen[associated.certain],
    )
    if not len(pairs) or len(associated.pairs) < min(ENOUGH, LEAST_SHARE * associated.seen):
        return belief
    before = belief.including(frame.submap[pairs[:, 1]])
    row, _ = before.rows(frame.submap.id[pairs[:, 1]])
    after, step = before, np.zeros(len(before.covariance))
    for _ in range(ITERATIONS):
        rows = association.pair_rows(frame.under(after), after.T_camera_map, pairs)
        rows = replace(rows, used=rows.used & (bottom_seen[:, None] | ~rows.is_bottom))
        step, covariance = kalman_update(before.covariance, rows, row, step)
        after = before.shifted(step, covariance)
    return after


def _without_passed_elements(belief: JointBelief, frame: association.TrackingFrame) -> JointBelief:
    """Return the belief without elements that are behind the camera or outside the submap."""
    row, known = belief.rows(frame.submap.id)
    depth = belief.T_camera_map.apply(frame.submap.anchor_m)[:, 2]
    kept = np.zeros(len(belief.id), dtype=bool)
    kept[row[known & (depth > -FORGOTTEN_M)]] = True
    return belief.keeping(kept)
