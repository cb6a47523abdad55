"""A quick rating of many upright hypotheses by azimuth and slope, before pixels are compared."""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.scene import Known, Record, Scene
from semviz_core.solving.standing import compare_slopes, standing_elements
from semviz_core.solving.upright import UprightView


class Doubt(NamedTuple):
    """How far a hypothesis is off, one standard deviation."""

    position_m: float
    height_m: float
    heading_rad: float
    of_up: float
    """Share that is left of the doubt about up."""


class Toward(NamedTuple):
    """Where a mapped element is from a hypothesis."""

    ahead: float  # of a unit vector, as left
    left: float
    near: float
    """1 / distance (1/m)"""
    variance: float
    """Of the azimuth (rad^2)."""


VOTED = Doubt(0.4, 0.15, float(np.deg2rad(1.0)), 1.0)
"""Of hypotheses as places and headings give them."""
POLISHED = Doubt(0.3, 0.08, float(np.deg2rad(0.7)), 0.3)
"""Of those that are polished."""
GATE_CHI2 = 9.0
"""Pairs whose azimuths differ by more are not looked at again."""
MOST_CHI2 = 20.0
"""Of all that is compared of a pair."""
NEAREST_MISSED_M = 6.0
"""What is closer ahead may be cut off; it is not missed when it is not seen."""
_FALSE_TURN, _FALSE_SLOPE = float(np.log(0.25 * np.pi)), float(np.log(0.2))
"""A false detection is anywhere in a quarter turn and half a unit of slope."""


@compiled
def rate(
    scene: Scene, view: UprightView, known: Known, poses: FloatArray, doubt: Doubt
) -> FloatArray:
    """(h,) nats above nothing matched of poses (h, 6): pairs by class, at most one for each
    element, what is in view and has no pair, and the prior.

    One-to-one is bounded from both sides (the best of each observed, the best of each mapped
    element), which is enough to keep a row of equal poles from being matched to one pole.
    """
    standing, partner = standing_elements(scene)
    half = 0.5 * scene.setting.size_px[0] / scene.setting.K[0, 0]
    widest = max(1.2 * widest_tangent(view) + 0.2, half)
    by_seen = np.empty(len(scene.seen))
    rating = np.empty(len(poses))
    for h in range(len(poses)):
        pose = poses[h]
        by_seen[:] = 0.0
        by_mapped = missed = 0.0
        for j in range(len(standing)):
            ahead, left = before(pose, standing[j])
            if abs(left) <= widest * ahead:
                there = toward(ahead, left, doubt)
                largest = _best_of_mapped(
                    scene.setting, view, standing[j], partner, there, pose, doubt, by_seen
                )
                by_mapped += largest
                if largest == 0.0 and abs(left) < half * ahead:
                    missed += _nats_of_miss(scene.setting, ahead)
        dx, dy = pose[0] - known.value.place_m[0], pose[1] - known.value.place_m[1]
        off = (dx * dx + dy * dy) / known.value.place_sigma_m[0] ** 2
        off += (pose[5] / view.up_sigma_rad) ** 2
        rating[h] = min(by_seen.sum(), by_mapped) + missed - 0.5 * off
    return rating


@compiled
def widest_tangent(view: UprightView) -> float:
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
    there: Toward,
    pose: FloatArray,
    doubt: Doubt,
    by_seen: FloatArray,
) -> float:
    """The largest gain of a mapped element with any observed one; raises theirs, ``by_seen``
    (m,)."""
    largest = 0.0
    for at in range(mapped.first, mapped.last):
        i = partner[at]
        gain = quick_gain(setting, view, view.seen[i], mapped, there, pose, doubt)
        largest = max(largest, gain)
        by_seen[i] = max(by_seen[i], gain)
    return largest


@compiled
def before(pose: FloatArray, mapped: Record) -> tuple[float, float]:
    """Metres ahead and to the left of a pose (6,)."""
    east, north = mapped.place_m[0] - pose[0], mapped.place_m[1] - pose[1]
    return pose[3] * east + pose[4] * north, pose[3] * north - pose[4] * east


@compiled
def toward(ahead: float, left: float, doubt: Doubt) -> Toward:
    """From metres ahead and to the left."""
    near = 1.0 / max(np.sqrt(ahead * ahead + left * left), 1.0)
    variance = (doubt.position_m * near) ** 2 + doubt.heading_rad**2
    return Toward(ahead * near, left * near, near, variance)


@compiled
def quick_gain(
    setting: Record,
    view: UprightView,
    seen: Record,
    mapped: Record,
    there: Toward,
    pose: FloatArray,
    doubt: Doubt,
) -> float:
    """Nats of a pair over a false detection, 0 where it does not fit."""
    # sine of the angle between
    off = seen.azimuth[0] * there.left - seen.azimuth[1] * there.ahead
    if off * off > GATE_CHI2 * there.variance:
        return 0.0
    chi2, product, nats, count = compare_slopes(
        setting, seen, mapped, there.near, pose[2], doubt.of_up * view.up_sigma_rad,
        doubt.position_m, doubt.height_m, pose[5],
    )  # fmt: skip
    chi2 += off * off / there.variance
    if chi2 > MOST_CHI2:
        return 0.0
    gain = nats + _FALSE_TURN + count * _FALSE_SLOPE
    return max(gain - 0.5 * (chi2 + np.log(product * there.variance)), 0.0)


@compiled
def _nats_of_miss(setting: Record, ahead: float) -> float:
    """Of a mapped element ``ahead`` in view that is not detected; 0 beyond the detector's reach."""
    if not NEAREST_MISSED_M < ahead < setting.far_m:
        return 0.0
    share = max((ahead - setting.near_m) / (setting.far_m - setting.near_m), 0.0)
    return np.log(1.0 - setting.recall_near - share * (setting.recall_far - setting.recall_near))
