"""Express observed and mapped elements as azimuths and slopes, with gravity known.

In the level frame z is up and x is the optical axis projected onto the horizontal plane. So the
only unknown angle is the heading. An observed element becomes an azimuth and, where an end is
known, a slope (tangent of elevation). Mapped elements become a position on the ground, heights,
and the observed elements of their class.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.frame import Prior
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.localization.problem import (
    SIGHT_M,
    PoseProblem,
    PriorRecord,
    Record,
    RecordArray,
    rows_within,
)

ASSUMED_UP = np.array([0.0, -1.0, 0.0])
"""Up in camera coordinates without an IMU: cameras on vehicles look about level."""
ASSUMED_UP_SIGMA_RAD = float(np.deg2rad(4.0))
POLE_LEAN_RAD = float(np.deg2rad(1.0))
"""Standard deviation of the lean of poles; limits the accuracy of gravity derived from them."""
FALSE_POLES, FALSE_LEAN_RAD = 0.3, 0.15
"""Share of observed poles that are none, and how far these lean to either side."""
GRID_SIGMAS, GRID_STEP, GRID_LEAST, GRID_MOST = 3.2, 0.7, 5, 20
"""Tilts tried: up to so many sigmas of the prior, by this share of a pole's lean, and the least and
largest number of steps to either side."""
DOUBTFUL_UP_RAD = float(np.deg2rad(1.8))
"""If up is less certain than this about an axis, three angles about that axis are searched."""
TILT_SIGMAS = 1.2
"""Distance of the outer two of the three angles from the middle one."""
LEAST_SINE = 0.05
"""A camera whose axis is closer to the vertical than this (sine) has no heading."""

UPRIGHT_OBSERVATION = np.dtype(
    [
        # cosine and sine of the angle anticlockwise from the optical axis; of a pole, at the middle
        # of its visible part
        ("azimuth", float, (2,)),
        ("azimuth_rad", float),
        ("slope", float, (2,)),  # of anchor and end; only where known
        ("slope_sigma", float),  # of the detection
        ("known", np.uint8, (2,)),
    ],
    align=True,
)
"""An observed element in the level frame."""


class UprightView(NamedTuple):
    """m observed elements in the level frame."""

    R_level_camera: FloatArray
    """(3, 3)"""
    up_sigma_rad: float
    seen: RecordArray
    """(m,) UPRIGHT_OBSERVATION"""


def assumed_upright(prior: Prior) -> Prior:
    """Return ``prior``, with a camera assumed to look about level if there is no IMU."""
    if prior.up_camera is not None:
        return prior
    return replace(prior, up_camera=ASSUMED_UP, up_sigma_rad=ASSUMED_UP_SIGMA_RAD)


@compiled
def likely_ups(problem: PoseProblem, prior: PriorRecord) -> tuple[FloatArray, float]:
    """Return directions of up (k, 3) in camera coordinates to search, the estimate first, and the
    sigma of each (rad). They are several if gravity stays doubtful."""
    up, covariance = gravity(problem, prior)
    mean = 0.5 * (covariance[0, 0] + covariance[1, 1])
    differ = 0.5 * (covariance[0, 0] - covariance[1, 1])
    radius = np.hypot(differ, covariance[0, 1])
    sigma = np.sqrt(np.array([max(mean - radius, 0.0), mean + radius]))  # of the principal axes
    turn = 0.5 * np.arctan2(covariance[0, 1], differ)
    across = prior.value.across_up
    major = np.cos(turn) * across[0] + np.sin(turn) * across[1]
    minor = np.cos(turn) * across[1] - np.sin(turn) * across[0]
    ups = np.empty((9, 3))
    ups[0] = up
    count = 1
    for k in range(2):
        if sigma[k] > DOUBTFUL_UP_RAD:
            lean = TILT_SIGMAS * sigma[k] * (minor if k == 0 else major)
            for row in range(count):
                ups[count + 2 * row] = ups[row] - lean
                ups[count + 2 * row + 1] = ups[row] + lean
            count *= 3
    for row in range(count):
        ups[row] /= np.sqrt((ups[row] ** 2).sum())
    return ups[:count], min(sigma[1], DOUBTFUL_UP_RAD)


@compiled
def gravity(problem: PoseProblem, prior: PriorRecord) -> tuple[FloatArray, FloatArray]:
    """Return up (3,) in camera coordinates, and its covariance (2, 2) in rad^2 along ``across_up``.

    They are the mean and covariance of the posterior over tilts, on a grid. The vertical vanishing
    point lies in the plane of every observed pole, unless the pole is false. Where poles disagree,
    the covariance is as large as their disagreement.
    """
    start, across, sigma = prior.value.up_camera, prior.value.across_up, prior.value.up_sigma_rad
    widest = GRID_SIGMAS * sigma
    half = min(max(int(np.ceil(widest / (GRID_STEP * POLE_LEAN_RAD))), GRID_LEAST), GRID_MOST)
    tilt = widest / half * np.arange(-half, half + 1)
    nats = np.empty((len(tilt), len(tilt)))
    for row in range(len(tilt)):
        for column in range(len(tilt)):
            nats[row, column] = -0.5 * (tilt[row] ** 2 + tilt[column] ** 2) / sigma**2
    for i in range(len(problem.seen)):
        if problem.seen[i].is_line:
            _add_pole(problem.seen[i], problem.setting.K[0, 0], start, across, tilt, nats)
    weight = np.exp(nats - nats.max())
    weight /= weight.sum()
    of_row, of_column = weight.sum(axis=1), weight.sum(axis=0)
    mean = (of_row * tilt).sum(), (of_column * tilt).sum()
    covariance = np.empty((2, 2))
    covariance[0, 0] = (of_row * (tilt - mean[0]) ** 2).sum()
    covariance[1, 1] = (of_column * (tilt - mean[1]) ** 2).sum()
    covariance[0, 1] = covariance[1, 0] = (
        (tilt - mean[0]) * (weight * (tilt - mean[1])).sum(axis=1)
    ).sum()
    up = start + mean[0] * across[0] + mean[1] * across[1]
    return up / np.sqrt((up**2).sum()), covariance


@compiled
def _add_pole(
    seen: Record,
    focal: float,
    start: FloatArray,
    across: FloatArray,
    tilt: FloatArray,
    nats: FloatArray,
) -> None:
    """Add the log-likelihood of an observed pole over that of a false one, by tilts."""
    length = max(np.sqrt(((seen.end_ray - seen.anchor_ray) ** 2).sum()), 1e-4)
    offset = (seen.plane * start).sum()
    first, second = (seen.plane * across[0]).sum(), (seen.plane * across[1]).sum()
    variance = seen.variance_px2[0] / (focal * length) ** 2 + POLE_LEAN_RAD**2
    of_true = (
        (1.0 - FALSE_POLES) / FALSE_POLES * 2.0 * FALSE_LEAN_RAD / np.sqrt(2.0 * np.pi * variance)
    )
    for row in range(len(tilt)):
        for column in range(len(tilt)):
            left = offset + first * tilt[row] + second * tilt[column]
            nats[row, column] += np.log(1.0 + of_true * np.exp(-0.5 * left * left / variance))


@compiled
def upright_view(problem: PoseProblem, up: FloatArray, up_sigma_rad: float) -> UprightView:
    """Return the observed elements as azimuths and slopes for ``up`` (3,) in camera coordinates."""
    R = level_rotation(up)
    seen = np.zeros(len(problem.seen), UPRIGHT_OBSERVATION)
    for i in range(len(seen)):
        seen_element = problem.seen[i]
        first, last = R @ seen_element.anchor_ray, R @ seen_element.end_ray
        x, y = first[0] + last[0], first[1] + last[1]
        length = max(np.hypot(x, y), 1e-9)
        seen[i].azimuth[0], seen[i].azimuth[1] = x / length, y / length
        seen[i].azimuth_rad = np.arctan2(y, x)
        seen[i].slope[0] = first[2] / max(np.hypot(first[0], first[1]), 1e-9)
        seen[i].slope[1] = last[2] / max(np.hypot(last[0], last[1]), 1e-9)
        seen[i].known[0] = seen_element.known[0]
        seen[i].known[1] = seen_element.known[1] and seen_element.is_line
        seen[i].slope_sigma = np.sqrt(seen_element.variance_px2[1]) / problem.setting.K[0, 0]
    return UprightView(R, up_sigma_rad, seen)


@compiled
def level_rotation(up_camera: FloatArray) -> FloatArray:
    """Return R_level_camera (3, 3): z is up, x the horizontal part of the optical axis."""
    x = np.array([0.0, 0.0, 1.0]) - up_camera * up_camera[2]
    length = np.sqrt((x**2).sum())
    if length < LEAST_SINE:
        x = np.cross(up_camera, np.array([1.0, 0.0, 0.0]))
        length = np.sqrt((x**2).sum())
    R = np.empty((3, 3))
    R[0] = x / length
    R[1] = np.cross(up_camera, R[0])
    R[2] = up_camera
    return R


UPRIGHT_ELEMENT = np.dtype(
    [
        ("position_m", float, (2,)),
        ("height_m", float, (2,)),  # of anchor and end
        ("known", np.uint8, (2,)),
        ("first", np.int64),  # compatible observed rows: candidate[first:last]
        ("last", np.int64),
    ],
    align=True,
)
"""A mapped element; small records lie close together in memory."""
FALSE_TURN, FALSE_SLOPE = float(np.log(0.25 * np.pi)), float(np.log(0.2))
"""A false positive is anywhere in a quarter turn and half a unit of slope."""
WITHIN_REACH = 1.1
"""Elements further away than this times the detector's reach propose and rate no poses."""
MOST_IN_REACH = 700.0
"""In maps of more elements within reach, only so many of them, the nearest, propose poses."""
_SAMPLES = 8
HIDDEN_CHI2 = 9.0
"""A bottom observed above the mapped one by more than this (squared sigmas) is hidden."""


@compiled
def upright_elements(problem: PoseProblem) -> tuple[RecordArray, IntArray]:
    """Return (n,) UPRIGHT_ELEMENT, and the compatible observed rows they refer to."""
    elements = np.zeros(len(problem.mapped), UPRIGHT_ELEMENT)
    candidate = np.empty(len(problem.candidate), dtype=np.int64)
    count = 0
    for j in range(len(elements)):
        a, e = problem.mapped[j].anchor_m, problem.mapped[j].end_m
        elements[j].position_m[0], elements[j].position_m[1] = (
            0.5 * (a[0] + e[0]),
            0.5 * (a[1] + e[1]),
        )
        elements[j].height_m[0], elements[j].height_m[1] = a[2], e[2]
        elements[j].known[:] = problem.mapped[j].known
        elements[j].first = count
        for i in range(len(problem.seen)):
            if problem.compatible[i, j]:
                candidate[count] = i
                count += 1
        elements[j].last = count
    return elements, candidate


@compiled
def rated_reach(problem: PoseProblem) -> float:
    """Return the distance beyond which no element is rated: out of sight, or of reach."""
    return min(SIGHT_M, WITHIN_REACH * problem.setting.reach_m)


@compiled
def proposing_reach(problem: PoseProblem) -> float:
    """Return the distance beyond which no element proposes poses; less in a very crowded map, so
    that the time does not grow with it."""
    crowded = elements_in_reach(problem) / MOST_IN_REACH
    return rated_reach(problem) / np.sqrt(max(crowded, 1.0))


@compiled
def elements_in_reach(problem: PoseProblem) -> float:
    """Return how many mapped elements are within reach of a mapped element, on average."""
    n, near = len(problem.mapped), 0
    samples = min(n, _SAMPLES)
    for k in range(samples):
        x, y = problem.anchor_m[:, k * n // samples]
        near += len(rows_within(problem, x, y, rated_reach(problem)))
    return near / max(samples, 1)


@compiled_leaf
def compare_slopes(
    setting: Record,
    seen: Record,
    mapped: Record,
    near: float,
    camera_height_m: float,
    up_sigma_rad: float,
    position_m: float,
    height_m: float,
    tilt_rad: float,
) -> tuple[float, float, float, int]:
    """Compare the slopes of an observed element with those of one mapped 1 / ``near`` metres away.

    ``position_m``, ``height_m`` and ``up_sigma_rad`` are sigmas of the camera; it looks up by
    ``tilt_rad`` more than the level frame. Return chi2, the product of its variances, the nats of
    bottoms being hidden or visible, and the number of slopes.
    """
    chi2, product, nats, count, off_anchor = 0.0, 1.0, 0.0, 0, 0.0
    variance, common = slope_variances(seen, near, up_sigma_rad, position_m, height_m)
    for end in range(2):
        if not (seen.known[end] and mapped.known[end]):
            continue
        off = (mapped.height_m[end] - camera_height_m) * near - tilted_slope(seen, end, tilt_rad)
        of_end = variance[end]
        if end == 0:
            off_anchor = off
        elif count:
            off, of_end = off - common * off_anchor, variance[GIVEN_ANCHOR]
        if end == 1 and setting.hidden_bottoms > 0.0:
            if off < 0.0 and off * off > HIDDEN_CHI2 * of_end:
                nats += setting.log_hidden
                continue
            nats += setting.log_visible
        chi2 += off * off / of_end
        product *= of_end
        count += 1
    return chi2, product, nats, count


GIVEN_ANCHOR = 2
"""Index of the variance of an end given its anchor, after those of anchor and end."""


@compiled_leaf
def slope_variances(
    seen: Record, near: float, up_sigma_rad: float, position_m: float, height_m: float
) -> tuple[tuple[float, float, float], float]:
    """Return the variances of the slopes of an element 1 / ``near`` metres away (of its anchor, of
    its end, and of its end given its anchor), and the share of the anchor's error that the end has.

    Errors of up, position and height move both ends alike, so the distance between them, which
    depends on none of these, says more than either.
    """
    own = seen.slope_sigma**2 + 0.5 * (height_m * near) ** 2
    shared = up_sigma_rad**2 + 0.5 * (height_m * near) ** 2
    by_position = (position_m * near) ** 2
    anchor = own + shared + by_position * seen.slope[0] ** 2
    end = own + shared + by_position * seen.slope[1] ** 2
    covariance = shared + by_position * seen.slope[0] * seen.slope[1]
    return (anchor, end, end - covariance * covariance / anchor), covariance / anchor


@compiled_leaf
def tilted_slope(seen: Record, end: int, tilt_rad: float) -> float:
    """Return the slope of an end if the camera looks up by ``tilt_rad`` more, to first order."""
    slope = seen.slope[end]
    return slope + tilt_rad * seen.azimuth[0] * (1.0 + slope * slope)
