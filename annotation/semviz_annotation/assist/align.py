"""Move a look of one image to where it fits best in another, at sub-pixel accuracy.

Gauss-Newton over few parameters (Baker & Matthews 2004); what differs counts little.
"""

import numpy as np

from semviz_annotation.assist.look import likeness, pole_points, sign_points
from semviz_annotation.assist.shot import Shot
from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Samples
from semviz_core.measuring.pole import across, shifted

_NOISE = 30.0
"""Levels: how strongly a look speaks against what is expected beforehand."""
_OUTLIER = 15.0
"""Levels of difference at which a row counts half."""
_FURTHEST_PX = 3.0


def aligned_pole(
    look: Samples,
    there: Shot,
    start_px: FloatArray,
    width_px: float,
    lean_px: float,
    along_px: float = 0.0,
) -> FloatArray:
    """(2, 2) where a pole's look fits best near a line (2, 2); the line where that is nowhere near.

    Its ends move across; where the image says nothing, both alike, to about ``lean_px``. They move
    along the pole too, by about ``along_px``, unless that is 0.
    """
    ends = start_px.copy()
    share = ((np.arange(len(look)) + 0.5) / len(look))[:, None, None]
    upright, rigid = (_NOISE / max(one, 0.05) for one in (lean_px, along_px))
    prior = np.array([[upright, -upright, 0.0], [0.0, 0.0, rigid if along_px else 1e4]])
    H_prior = prior.T @ prior + np.diag([10.0, 10.0, 10.0])
    total = np.zeros(3)
    for _ in range(6):
        points = pole_points(ends, width_px)
        normal = across(ends)
        along = np.array([-normal[1], normal[0]])
        now = there.sample(points)
        right, down = (
            there.sample(points + 0.5 * one) - there.sample(points - 0.5 * one)
            for one in (normal, along)
        )
        off = look - now
        weight = 1.0 / (1.0 + (off**2).mean(axis=(1, 2), keepdims=True) / _OUTLIER**2)
        J = np.stack([((1.0 - share) * right).ravel(), (share * right).ravel(), down.ravel()])
        A = J * np.broadcast_to(weight, off.shape).ravel()
        step = np.linalg.solve(A @ J.T + H_prior, A @ off.ravel() - prior.T @ (prior @ total))
        step = np.clip(step, -1.0, 1.0)
        total += step
        ends = shifted(ends, step[0], step[1]) + step[2] * along
        if np.abs(step).max() < 0.02:
            break
    return ends if np.abs(total).max() <= _FURTHEST_PX else start_px


def aligned_sign(
    look: Samples, there: Shot, start_px: FloatArray, half_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(2,) where a sign's look fits best near a place, and its likeness (3,) there.

    Brightness may change: gain and offset are free.
    """
    right_px, down_px = np.array([0.5, 0.0]), np.array([0.0, 0.5])
    place = start_px.copy()
    for _ in range(6):
        points = sign_points(place, half_px)
        now = there.sample(points).astype(np.float64)
        right = there.sample(points + right_px) - there.sample(points - right_px)
        down = there.sample(points + down_px) - there.sample(points - down_px)
        J = np.stack([right.ravel(), down.ravel(), -look.ravel(), -np.ones(look.size)], axis=1)
        step = np.linalg.lstsq(J, -now.ravel(), rcond=None)[0][:2]
        step = np.clip(step, -1.5, 1.5)
        place = place + step
        if np.abs(step).max() < 0.02:
            break
    if np.linalg.norm(place - start_px) > _FURTHEST_PX:
        place = start_px
    return place, likeness(look, there.sample(sign_points(place, half_px))[None])[0]
