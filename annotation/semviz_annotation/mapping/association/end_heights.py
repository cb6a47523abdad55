"""Heights of the ends of poles, agreed on by most of the detections of each.

A detector often takes a pole for longer or shorter than it is, by far more than it says. So an end
counts only where it fits the height that most detections of the pole give it; where there is no
such height, the end is unknown.
"""

from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.association.ground_rays import GroundRays
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

_AGREE_SIGMAS, _AGREE_M = 3.0, 0.1
"""An end fits a height within so many of its sigmas, and so many metres."""
_LEAST_SHARE, _LEAST_ENDS = 0.5, 2
"""At least so many of the known ends must fit, or else none counts."""


class AgreedEnds(NamedTuple):
    """Which ends of k detections count."""

    known: BoolArray
    """(k, 2) anchor, end"""
    spread: FloatArray
    """(k,) by how much the ends scatter more than their sigma says, 1 or more"""


def agreed_ends(rays: GroundRays, track: IntArray, at_m: FloatArray) -> AgreedEnds:
    """Return the ends of poles that agree in height; ``track`` (k,) is a row of ``at_m`` (n, 2), or
    negative. Ends of signs, and those outside all tracks, stay as they are."""
    result, spread = rays.known.copy(), np.ones(len(track))
    on_pole = (track >= 0) & np.isfinite(rays.slope[:, 1])
    n = len(at_m)
    worst = np.ones(n)
    for which in range(2):
        rows = np.flatnonzero(on_pole & rays.known[:, which])
        of = track[rows]
        distance = np.linalg.norm(at_m[of] - rays.origin_m[rows, :2], axis=1)
        height = rays.origin_m[rows, 2] + rays.slope[rows, which] * distance
        sigma = np.hypot(distance * rays.slope_sigma[rows], _AGREE_M / _AGREE_SIGMAS)
        middle = _weighted_medians(of, height, 1.0 / sigma, n)
        off = np.abs(height - middle[of]) / sigma
        fits = off <= _AGREE_SIGMAS
        several = np.bincount(of, minlength=n)
        agreeing = np.bincount(of[fits], minlength=n)
        agreed = (agreeing >= _LEAST_ENDS) & (agreeing >= _LEAST_SHARE * several)
        result[rows, which] = fits & agreed[of]
        worst = np.maximum(worst, _weighted_medians(of, off, np.ones(len(of)), n) / 0.6745)
    spread[on_pole] = worst[track[on_pole]]
    return AgreedEnds(result, spread)


def _weighted_medians(
    group: IntArray, values: FloatArray, weights: FloatArray, count: int
) -> FloatArray:
    """Return the weighted median (count,) of the values (m,) of each group; 0 without any."""
    order = np.lexsort((values, group))
    group, values, weights = group[order], values[order], weights[order]
    total = np.bincount(group, weights, minlength=count)
    before = np.cumsum(total) - total
    share = np.cumsum(weights) - before[group]
    upper = np.flatnonzero(share >= 0.5 * total[group] * (1.0 - 1e-9))
    result = np.zeros(count)
    result[group[upper][::-1]] = values[upper][::-1]
    return result
