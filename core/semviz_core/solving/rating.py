"""A quick rating of many upright hypotheses by azimuths and slopes, before any pixel is compared."""

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.frame import Prior
from semviz_core.solving.hypotheses import Hypotheses
from semviz_core.solving.residuals import Scene
from semviz_core.solving.upright import UprightView

POSITION_DOUBT_M, HEIGHT_DOUBT_M, HEADING_DOUBT_RAD = 0.4, 0.15, float(np.deg2rad(1.0))
"""How far a hypothesis made from two noisy matches is off, one standard deviation."""
CHUNK = 2048


def rate(scene: Scene, view: UprightView, prior: Prior, hypotheses: Hypotheses) -> FloatArray:
    """(h,) nats above nothing matched: pairs by class, at most one for each element, and the prior.

    One-to-one is bounded from both sides (the best of each observed, the best of each mapped
    element), which is enough to keep a row of equal poles from being matched to one pole.
    """
    parts = [
        _rate_chunk(scene, view, prior, hypotheses, slice(start, start + CHUNK))
        for start in range(0, len(hypotheses), CHUNK)
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


def _rate_chunk(
    scene: Scene, view: UprightView, prior: Prior, hypotheses: Hypotheses, chunk: slice
) -> FloatArray:
    position = hypotheses.position_m[chunk].astype(np.float32)
    heading = hypotheses.heading_rad[chunk].astype(np.float32)
    middle = (0.5 * (scene.anchor_m + scene.end_m)).astype(np.float32)
    east = middle[:, 0] - position[:, :1]
    north = middle[:, 1] - position[:, 1:2]
    reach = np.maximum(np.hypot(east, north), np.float32(1.0))
    azimuth = np.arctan2(north, east) - heading[:, None]
    near = np.float32(1.0) / reach
    ends = np.stack([scene.anchor_m[:, 2], scene.end_m[:, 2]]).astype(np.float32)
    slopes = [(end - position[:, 2:]) * near for end in ends]
    i, j = np.nonzero(scene.compatible)
    far = near[:, j]
    gain = _azimuth_gain(azimuth[:, j] - view.azimuth_rad[i].astype(np.float32), far)
    for end in range(2):
        known = view.slope_known[i, end] & scene.mapped_known[j, end]
        k = np.flatnonzero(known)
        if len(k):
            seen = view.slope[i[k], end].astype(np.float32)
            sigma = np.hypot(view.sigma_rad[i[k], 1], view.up_sigma_rad).astype(np.float32)
            off = slopes[end][:, j[k]] - seen
            gain[:, k] += _slope_gain(off, seen, sigma, far[:, k])
    np.maximum(gain, np.float32(0.0), out=gain)
    best = np.minimum(_sum_of_best(gain, i), _sum_of_best(gain, j))
    offset = (hypotheses.position_m[chunk, :2] - prior.position_m[:2]) / prior.horizontal_sigma_m
    off_prior = np.maximum(np.linalg.norm(offset, axis=1), 0.0) ** 2
    return np.asarray(best - 0.5 * off_prior, dtype=np.float64)


def _azimuth_gain(
    off: "np.ndarray[tuple[int, int], np.dtype[np.float32]]",
    near: "np.ndarray[tuple[int, int], np.dtype[np.float32]]",
) -> "np.ndarray[tuple[int, int], np.dtype[np.float32]]":
    """Log density against a false detection anywhere in a quarter turn."""
    turn = np.float32(2.0 * np.pi)
    off = off - turn * np.rint(off / turn)
    variance = (np.float32(POSITION_DOUBT_M) * near) ** 2 + np.float32(HEADING_DOUBT_RAD**2)
    return np.asarray(
        np.float32(-0.5) * (off**2 / variance + np.log(variance)) + np.float32(np.log(0.25 * np.pi))
    )


def _slope_gain(
    off: "np.ndarray[tuple[int, int], np.dtype[np.float32]]",
    seen: "np.ndarray[tuple[int], np.dtype[np.float32]]",
    sigma: "np.ndarray[tuple[int], np.dtype[np.float32]]",
    near: "np.ndarray[tuple[int, int], np.dtype[np.float32]]",
) -> "np.ndarray[tuple[int, int], np.dtype[np.float32]]":
    """Log density against a false detection anywhere within half a unit of slope."""
    doubt = np.float32(HEIGHT_DOUBT_M**2) + (np.float32(POSITION_DOUBT_M) * seen) ** 2
    variance = doubt * near**2 + sigma**2
    return np.asarray(
        np.float32(-0.5) * (off**2 / variance + np.log(variance)) + np.float32(np.log(0.2))
    )


def _sum_of_best(
    gain: "np.ndarray[tuple[int, int], np.dtype[np.float32]]", groups: "np.ndarray"
) -> "np.ndarray[tuple[int], np.dtype[np.float32]]":
    """Sum over groups (of columns) of the largest gain in each."""
    if not gain.shape[1]:
        return np.zeros(len(gain), dtype=np.float32)
    order = np.argsort(groups, kind="stable")
    ordered = groups[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    best: np.ndarray[tuple[int], np.dtype[np.float32]] = np.maximum.reduceat(
        gain[:, order], starts, axis=1
    ).sum(axis=1)
    return best
