"""A quick rating of many upright hypotheses by azimuth and slope, before pixels are compared."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.solving.hypotheses import Hypotheses
from semviz_core.solving.residuals import Scene
from semviz_core.solving.upright import UprightView

SingleArray: TypeAlias = NDArray[np.float32]

POSITION_DOUBT_M, HEIGHT_DOUBT_M, HEADING_DOUBT_RAD = 0.4, 0.15, float(np.deg2rad(1.0))
"""How far a hypothesis made from two noisy matches is off, one standard deviation."""
GATE_SIGMAS = 3.0
"""Pairs further off in azimuth are not looked at again."""
CHUNK = 1024
_FALSE_TURN, _FALSE_SLOPE = np.log(0.25 * np.pi), np.log(0.2)
"""A false detection is anywhere in a quarter turn and half a unit of slope."""


def rate(scene: Scene, view: UprightView, prior: Prior, hypotheses: Hypotheses) -> FloatArray:
    """(h,) nats above nothing matched: pairs by class, at most one for each element, and the prior.

    One-to-one is bounded from both sides (the best of each observed, the best of each mapped
    element), which is enough to keep a row of equal poles from being matched to one pole.
    """
    parts = [
        _rate_chunk(scene, view, hypotheses, slice(start, start + CHUNK))
        for start in range(0, len(hypotheses), CHUNK)
    ]
    offset = (hypotheses.position_m[:, :2] - prior.position_m[:2]) / prior.horizontal_sigma_m
    rating: FloatArray = np.concatenate([np.zeros(0), *parts]) - 0.5 * (offset**2).sum(axis=1)
    return rating


def _rate_chunk(
    scene: Scene, view: UprightView, hypotheses: Hypotheses, chunk: slice
) -> FloatArray:
    position, heading = hypotheses.position_m[chunk], hypotheses.heading_rad[chunk, None]
    middle = 0.5 * (scene.anchor_m + scene.end_m)
    east = (middle[:, 0] - position[:, :1]).astype(np.float32)
    north = (middle[:, 1] - position[:, 1:2]).astype(np.float32)
    c, s = np.cos(heading).astype(np.float32), np.sin(heading).astype(np.float32)
    azimuth = np.arctan2(c * north - s * east, c * east + s * north)
    near = 1.0 / np.maximum(np.hypot(east, north), np.float32(1.0))
    variance = np.float32(POSITION_DOUBT_M**2) * near**2 + np.float32(HEADING_DOUBT_RAD**2)
    h, i, j = _in_line(scene, view, azimuth, np.float32(GATE_SIGMAS) * np.sqrt(variance))

    far, turn_variance = near[h, j], variance[h, j]
    off = azimuth[h, j] - view.azimuth_rad[i]
    gain = _FALSE_TURN - 0.5 * (off**2 / turn_variance + np.log(turn_variance))
    for end, ends_m in enumerate((scene.anchor_m, scene.end_m)):
        known = view.slope_known[i, end] & scene.mapped_known[j, end]
        seen = view.slope[i, end]
        off = (ends_m[j, 2] - position[h, 2]) * far - seen
        doubt = HEIGHT_DOUBT_M**2 + (POSITION_DOUBT_M * seen) ** 2
        sigma2 = view.sigma_rad[i, 1] ** 2 + view.up_sigma_rad**2
        slope_variance = doubt * far**2 + sigma2
        nats = _FALSE_SLOPE - 0.5 * (off**2 / slope_variance + np.log(slope_variance))
        gain += np.where(known, nats, 0.0)
    kept = gain > 0.0
    h, i, j, gain = h[kept], i[kept], j[kept], gain[kept]
    shape = len(position), *scene.compatible.shape
    return np.minimum(
        _sum_of_best(gain, h, i, (shape[0], shape[1])),
        _sum_of_best(gain, h, j, (shape[0], shape[2])),
    )


def _in_line(
    scene: Scene,
    view: UprightView,
    azimuth: SingleArray,
    tolerance: SingleArray,
) -> tuple[IntArray, IntArray, IntArray]:
    """Rows of hypothesis, observed and mapped element whose azimuths agree; cameras don't look
    backwards, so angles need no wrapping."""
    found: list[tuple[IntArray, IntArray, IntArray]] = []
    low, high = azimuth - tolerance, azimuth + tolerance
    for i, seen in enumerate(view.azimuth_rad.astype(np.float32)):
        columns = np.flatnonzero(scene.compatible[i])
        h, column = np.nonzero((low[:, columns] < seen) & (high[:, columns] > seen))
        found.append((h, np.full(len(h), i), columns[column]))
    h, i_all, j = (np.concatenate(column) for column in zip(*found, strict=True))
    return h, i_all, j


def _sum_of_best(
    gain: FloatArray, rows: IntArray, groups: IntArray, shape: tuple[int, int]
) -> FloatArray:
    """(shape[0],) sum over groups of the largest gain in each row and group."""
    best = np.zeros(shape)
    np.maximum.at(best.reshape(-1), rows * shape[1] + groups, gain)
    total: FloatArray = best.sum(axis=1)
    return total
