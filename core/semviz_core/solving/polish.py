"""Moves upright hypotheses to where the azimuths and slopes of their likeliest pairs agree.

A place of the search is a metre or two beside the pose that it stands for, and its heading a
degree: too far to tell by azimuths and slopes which of thousands are worth a fit. And gravity may
be off by more than slopes are, all of them together. Three steps of least squares over x, y,
heading and tilt take microseconds, a fit in pixels fifty.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.linear import cholesky, solve_cholesky
from semviz_core.solving.rating import Doubt, before, quick_gain, toward, widest_tangent
from semviz_core.solving.scene import Record, RecordArray, Scene
from semviz_core.solving.standing import HIDDEN_CHI2, standing_elements, tilted_slope
from semviz_core.solving.upright import UprightView

ROUNDS = 3
AXES = 4
"""x, y, heading and tilt."""
START_STEPS, START_RAD = 0.45, float(np.deg2rad(2.0))
"""How far a hypothesis is off at first: a share of the step between places, and the heading."""
LEFT = 0.4
"""Share of that which the first round leaves."""
HEIGHT_DOUBT_M = 0.15
PAIR_M, PAIR_RAD = 0.15, float(np.deg2rad(0.5))
"""How well a pair can fit: map and height, detection and gravity."""
CAUCHY_SIGMAS = 3.0
"""Pairs that are off by more count less (Cauchy weights)."""


class _Pairs(NamedTuple):
    """The likeliest pair of each observed element."""

    mapped: IntArray  # (m,) -1 for none
    gain: FloatArray  # (m,)


@compiled
def polish(scene: Scene, view: UprightView, poses: FloatArray, step_m: float) -> FloatArray:
    """Poses (h, 6) as in ``Hypotheses``, moved; ``step_m`` is the step between their places."""
    standing, partner = standing_elements(scene)
    widest = 1.2 * widest_tangent(view) + 0.4
    first = Doubt(START_STEPS * step_m, HEIGHT_DOUBT_M, START_RAD, 1.0)
    later = Doubt(LEFT * first.position_m, HEIGHT_DOUBT_M, LEFT * START_RAD, LEFT)
    sigma = np.array([first.position_m, first.position_m, START_RAD, view.up_sigma_rad])
    m = len(view.seen)
    pairs = _Pairs(np.empty(m, dtype=np.int64), np.empty(m))
    information, gradient, moved = np.empty((AXES, AXES)), np.empty(AXES), np.empty(AXES)
    polished = poses.copy()
    for h in range(len(poses)):
        moved[:] = 0.0
        for k in range(ROUNDS):
            doubt = first if k == 0 else later
            _choose(scene.setting, view, standing, partner, polished[h], doubt, widest, pairs)
            _start(sigma, moved, information, gradient)
            for i in range(m):
                if pairs.mapped[i] >= 0:
                    mapped = standing[pairs.mapped[i]]
                    _add(
                        scene.setting, view, view.seen[i], mapped, polished[h], doubt.position_m,
                        information, gradient,
                    )  # fmt: skip
            if cholesky(information, AXES):
                solve_cholesky(information, gradient)
                moved -= gradient
                _move(poses[h], moved, polished[h])
    return polished


@compiled
def _choose(
    setting: Record,
    view: UprightView,
    standing: RecordArray,
    partner: IntArray,
    pose: FloatArray,
    doubt: Doubt,
    widest: float,
    pairs: _Pairs,
) -> None:
    """Fill ``pairs``: the best observed element of each mapped one, of these the best."""
    pairs.mapped[:], pairs.gain[:] = -1, 0.0
    for j in range(len(standing)):
        ahead, left = before(pose, standing[j])
        if abs(left) > widest * ahead + 1.0:
            continue
        there = toward(ahead, left, doubt)
        best, most = -1, 0.0
        for at in range(standing[j].first, standing[j].last):
            seen = view.seen[partner[at]]
            gain = quick_gain(setting, view, seen, standing[j], there, pose, doubt)
            if gain > most:
                best, most = partner[at], gain
        if best >= 0 and most > pairs.gain[best]:
            pairs.mapped[best], pairs.gain[best] = j, most


@compiled
def _start(
    sigma: FloatArray, moved: FloatArray, information: FloatArray, gradient: FloatArray
) -> None:
    """What is known without pairs: that the pose is close to where it was at first."""
    information[:] = 0.0
    for axis in range(AXES):
        information[axis, axis] = 1.0 / sigma[axis] ** 2
        gradient[axis] = moved[axis] / sigma[axis] ** 2


@compiled
def _add(
    setting: Record,
    view: UprightView,
    seen: Record,
    mapped: Record,
    pose: FloatArray,
    position_m: float,
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the azimuth and the slopes of a pair, by x, y, heading and tilt."""
    east, north = mapped.place_m[0] - pose[0], mapped.place_m[1] - pose[1]
    square = east * east + north * north
    near = 1.0 / np.sqrt(square)
    ahead, left = before(pose, mapped)
    off = (seen.azimuth[0] * left - seen.azimuth[1] * ahead) * near
    variance = PAIR_RAD**2 + (PAIR_M * near) ** 2
    by = north / square, -east / square, -1.0, 0.0
    _add_row(off, variance, by, information, gradient)
    for end in range(2):
        if not (seen.known[end] and mapped.known[end]):
            continue
        rise = mapped.height_m[end] - pose[2]
        off = rise * near - tilted_slope(seen, end, pose[5])
        lean = seen.azimuth[1] * view.up_sigma_rad  # to the side, which is not solved for
        variance = seen.slope_sigma**2 + lean**2 + (PAIR_M * near) ** 2
        doubtful = variance + (position_m * seen.slope[end] * near) ** 2
        may_hide = end == 1 and setting.hidden_bottoms > 0.0
        if may_hide and off < 0.0 and off * off > HIDDEN_CHI2 * doubtful:
            continue
        by_place = rise * near / square
        by_tilt = -seen.azimuth[0] * (1.0 + seen.slope[end] ** 2)
        by = by_place * east, by_place * north, 0.0, by_tilt
        _add_row(off, variance, by, information, gradient)


@compiled
def _add_row(
    off: float,
    variance: float,
    by: tuple[float, float, float, float],
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    weight = 1.0 / (variance + off * off / CAUCHY_SIGMAS**2)
    for row in range(AXES):
        gradient[row] += weight * by[row] * off
        for column in range(row + 1):
            information[row, column] += weight * by[row] * by[column]


@compiled
def _move(start: FloatArray, moved: FloatArray, pose: FloatArray) -> None:
    """Fill ``pose`` (6,) with ``start``, moved by x, y, heading and tilt."""
    pose[0], pose[1] = start[0] + moved[0], start[1] + moved[1]
    c, s = np.cos(moved[2]), np.sin(moved[2])
    pose[3], pose[4] = start[3] * c - start[4] * s, start[4] * c + start[3] * s
    pose[5] = start[5] + moved[3]
