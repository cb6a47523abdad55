"""Motions of one camera in metres: images show the direction of a step, but not its length.

A vehicle's speed changes only so fast, so the steps around one tell its length with a sigma. It
keeps that of its given poses unless it stands out against theirs. Where images hardly move, other
vehicles decide the direction that they show, and a step keeps its given one.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.pose_checks.image_motions import ImageMotions
from semviz_core.pose_checks.motion import MOTION

ACCELERATION_MPS2 = 3.0
"""One sigma: a car brakes with less than 10 m/s2."""
SIDE = 3
"""Steps before, and steps after, whose median speed is expected."""
STANDS_OUT_SIGMAS = 5.0
LEAST_PARALLAX_PX = 4.0
"""Images with less show no direction."""
HARDLY_MOVING_SIGMA = np.repeat([10.0, np.deg2rad(0.05)], 3)
"""What images with less add to the errors of a step: of 1 m, then rad."""
LEAST_STEP_M = 1e-6


def with_lengths(
    motions: ImageMotions, given_m: FloatArray, known: BoolArray, time_s: FloatArray
) -> tuple[ImageMotions, FloatArray]:
    """Return motions in metres, and (n, 3, 3) information of translations by the speed around them.

    That is part of the motions where the given translation (n, 3) of T_now_before stands out, and
    beside them elsewhere. ``known`` (n,) tells which are given; ``time_s`` is of n + 1 frames.
    """
    length_m = np.linalg.norm(given_m, axis=1)
    steps = step_lengths(length_m, known, time_s)
    shown = motions.parallax_px >= LEAST_PARALLAX_PX
    direction = np.where(
        shown[:, None], motions.translation_m, given_m / np.maximum(length_m, LEAST_STEP_M)[:, None]
    )
    along = direction[:, :, None] * direction[:, None, :] / steps.sigma_m[:, None, None] ** 2
    around = np.eye(3) / (steps.length_m**2 + steps.sigma_m**2)[:, None, None]
    by_speed = np.where(shown[:, None, None], along, around)
    ratio = np.where(steps.length_m > LEAST_STEP_M, steps.length_m, 1.0)
    scaled = _scaled(_weakened(motions, ~shown), ratio)
    scaled.information[steps.stands_out, :3, :3] += by_speed[steps.stands_out]
    scaled = replace(
        scaled, translation_m=direction * np.where(shown, ratio, steps.length_m)[:, None]
    )
    return scaled, np.where(steps.stands_out[:, None, None], 0.0, by_speed)


def _scaled(motions: ImageMotions, ratio: FloatArray) -> ImageMotions:
    scale = np.ones((len(motions), 9))
    scale[:, :3] = 1.0 / ratio[:, None]
    information = motions.information * scale[:, :, None] * scale[:, None, :]
    return replace(motions, information=information, linear=motions.linear * scale)


def _weakened(motions: ImageMotions, rows: BoolArray) -> ImageMotions:
    """Return motions that in ``rows`` (n,) tell no translation, and rotations less well."""
    H, linear = motions.information[rows], motions.linear[rows]
    noise = np.linalg.inv(H[:, MOTION, MOTION] + np.diag(HARDLY_MOVING_SIGMA**-2))
    less = H[:, :, MOTION] @ noise
    H = H - less @ H[:, MOTION, :]  # (H^-1 + S)^-1 of a singular H
    H = 0.5 * (H + H.transpose(0, 2, 1))
    linear = linear - np.einsum("nij,nj->ni", less, linear[:, MOTION])
    H[:, :3, :], H[:, :, :3], linear[:, :3] = 0.0, 0.0, 0.0
    information, all_linear = motions.information.copy(), motions.linear.copy()
    information[rows], all_linear[rows] = H, linear
    return replace(motions, information=information, linear=all_linear)


@dataclass(frozen=True, eq=False)
class StepLengths:
    """Of n steps."""

    length_m: FloatArray
    """(n,)"""
    sigma_m: FloatArray
    """(n,) infinite where too few steps are around."""
    stands_out: BoolArray
    """(n,) where the length is not that of the given poses."""


def step_lengths(given_m: FloatArray, known: BoolArray, time_s: FloatArray) -> StepLengths:
    """Return the lengths of n steps of given poses (n,), ``known`` (n,) or not.

    ``time_s`` are the times of the n + 1 frames.
    """
    from scipy.stats import median_abs_deviation

    took_s, middle_s = np.diff(time_s), 0.5 * (time_s[:-1] + time_s[1:])
    expected_m, change_m = given_m.copy(), np.full(len(given_m), np.inf)
    usable = np.flatnonzero(known & (took_s > 0.0))
    for place, row in enumerate(usable.tolist()):
        around = _around(usable, place)
        if len(around) >= SIDE:
            expected_m[row] = np.median(given_m[around] / took_s[around]) * took_s[row]
            away_s = np.median(np.abs(middle_s[around] - middle_s[row]))
            change_m[row] = ACCELERATION_MPS2 * away_s * took_s[row]
    off_m = given_m - expected_m
    judged = np.isfinite(change_m)
    spread_m = median_abs_deviation(off_m[judged], scale="normal") if judged.any() else 0.0
    sigma_m = np.hypot(change_m, spread_m)
    stands_out = np.abs(off_m) > STANDS_OUT_SIGMAS * sigma_m
    return StepLengths(np.where(stands_out, expected_m, given_m), sigma_m, stands_out)


def _around(rows: IntArray, place: int) -> IntArray:
    """Return the rows next to that at ``place``, without it."""
    return np.concatenate([rows[max(place - SIDE, 0) : place], rows[place + 1 : place + 1 + SIDE]])
