"""A quick rating of many upright hypotheses by azimuth and slope, before pixels are compared."""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.scene import Known, Record, Scene
from semviz_core.solving.standing import compare_slopes, standing_elements
from semviz_core.solving.upright import UprightView

POSITION_DOUBT_M, HEIGHT_DOUBT_M, HEADING_DOUBT_RAD = 0.4, 0.15, float(np.deg2rad(1.0))
"""How far a hypothesis made from two noisy matches is off, one standard deviation."""
GATE_CHI2 = 9.0
"""Pairs whose azimuths differ by more are not looked at again."""
MOST_CHI2 = 20.0
"""Of all that is compared of a pair."""
_FALSE_TURN, _FALSE_SLOPE = float(np.log(0.25 * np.pi)), float(np.log(0.2))
"""A false detection is anywhere in a quarter turn and half a unit of slope."""


@compiled
def rate(scene: Scene, view: UprightView, known: Known, poses: FloatArray) -> FloatArray:
    """(h,) nats above nothing matched of poses (h, 5): pairs by class, at most one for each
    element, and the prior.

    One-to-one is bounded from both sides (the best of each observed, the best of each mapped
    element), which is enough to keep a row of equal poles from being matched to one pole.
    """
    standing, partner = standing_elements(scene)
    widest = 1.2 * _widest(view) + 0.2
    by_seen = np.empty(len(scene.seen))
    rating = np.empty(len(poses))
    for h in range(len(poses)):
        pose = poses[h]
        by_seen[:] = 0.0
        by_mapped = 0.0
        for j in range(len(standing)):
            east = standing[j].place_m[0] - pose[0]
            north = standing[j].place_m[1] - pose[1]
            ahead = pose[3] * east + pose[4] * north
            left = pose[3] * north - pose[4] * east
            if abs(left) <= widest * ahead:
                by_mapped += _best_of_mapped(
                    scene.setting, view, standing[j], partner, ahead, left, pose[2], by_seen
                )
        dx, dy = pose[0] - known.value.place_m[0], pose[1] - known.value.place_m[1]
        off = 0.5 * (dx * dx + dy * dy) / known.value.place_sigma_m[0] ** 2
        rating[h] = min(by_seen.sum(), by_mapped) - off
    return rating


@compiled
def _widest(view: UprightView) -> float:
    """The largest tangent of an azimuth that is seen."""
    widest = 0.0
    for i in range(len(view.seen)):
        azimuth = view.seen[i].azimuth
        widest = max(widest, abs(azimuth[1]) / max(azimuth[0], 0.1))
    return widest


@compiled
def _best_of_mapped(
    setting: Record,
    view: UprightView,
    mapped: Record,
    partner: IntArray,
    ahead: float,
    left: float,
    height: float,
    by_seen: FloatArray,
) -> float:
    """The largest gain of a mapped element, seen ``ahead`` and to the left, with any observed one;
    raises theirs, ``by_seen`` (m,)."""
    near = 1.0 / max(np.sqrt(ahead * ahead + left * left), 1.0)
    ahead, left = ahead * near, left * near
    variance = (POSITION_DOUBT_M * near) ** 2 + HEADING_DOUBT_RAD**2
    largest = 0.0
    for at in range(mapped.first, mapped.last):
        i = partner[at]
        seen = view.seen[i]
        off = seen.azimuth[0] * left - seen.azimuth[1] * ahead  # sine of the angle between
        if off * off > GATE_CHI2 * variance:
            continue
        chi2, product, nats, count = compare_slopes(
            setting, seen, mapped, near, height, view.up_sigma_rad,
            POSITION_DOUBT_M, HEIGHT_DOUBT_M,
        )  # fmt: skip
        chi2 += off * off / variance
        if chi2 > MOST_CHI2:
            continue
        gain = nats + _FALSE_TURN + count * _FALSE_SLOPE
        gain -= 0.5 * (chi2 + np.log(product * variance))
        largest = max(largest, gain)
        by_seen[i] = max(by_seen[i], gain)
    return largest
