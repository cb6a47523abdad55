"""Compiled loops of the search for tracks: votes along rays, refinement, existence, claims."""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled

NEAREST_M, FURTHEST_M = 2.0, 90.0
_CELLS = 256
"""Cells of a ray, evenly spaced in inverse range."""
_VOTE_SIGMAS = 2.0
_GATES_SIGMAS = np.array([6.0, 4.0, 3.0, 3.0])
"""Within these a ray belongs to a landmark, one after the other in its refinement."""
_TURN_RAD_PER_M = 0.025
"""Error of the camera's heading, relative to that of its position: 0.03 deg at 0.02 m."""
BIN_M = 10.0
_PRIOR_LOG_ODDS = -float(np.log(_CELLS))
"""Of a landmark in a ray's best cell: one of its cells is the best in any case."""
_END_M = 0.1
"""How well the ends of poles are defined."""


class RayScene(NamedTuple):
    """k rays of one class by image, and v images, as compiled code takes them."""

    origin: FloatArray
    direction: FloatArray
    sigma: FloatArray
    slope: FloatArray
    """(k,) of signs; NaN for poles, whose ends do not matter here"""
    slope_sigma: FloatArray
    ends: FloatArray
    """(k, 2) slopes of the known ends of poles; NaN otherwise"""
    image: IntArray
    begin: IntArray
    """(v + 1,) first ray of each image"""
    path: FloatArray
    center: FloatArray
    forward: FloatArray
    edges: FloatArray
    span: float
    """Tangent of the vertical angle of the images"""
    area: FloatArray
    """(v,) of the image: radians of bearing (poles), or also times slope (signs)"""
    keyframe: IntArray
    expected: BoolArray
    """(v,) whether a landmark in view is expected to be detected"""
    recall: FloatArray
    """Share of the landmarks in view that are detected, by range in bins of ``BIN_M``"""
    good_ends: FloatArray
    """(2,) share of known tops and bottoms that are where the detector says"""


@compiled
def voted_ranges(
    scene: RayScene, window: IntArray, pose_m: float, starts: IntArray, free: BoolArray
) -> FloatArray:
    """Return the range (s,) on each ray where most images have a ray; 0 if none has."""
    result = np.zeros(len(starts))
    near, far = 1.0 / NEAREST_M, 1.0 / FURTHEST_M
    width = (near - far) / _CELLS
    for row in range(len(starts)):
        i = starts[row]
        votes = np.zeros(_CELLS)
        cast = np.zeros(_CELLS)
        for image in range(window[scene.image[i], 0], window[scene.image[i], 1]):
            if image == scene.image[i]:
                continue
            first, last = _CELLS, 0
            for j in range(scene.begin[image], scene.begin[image + 1]):
                cross = (
                    scene.direction[i, 0] * scene.direction[j, 1]
                    - scene.direction[i, 1] * scene.direction[j, 0]
                )
                if not free[j] or abs(cross) < 1e-3:
                    continue
                x = scene.origin[j, 0] - scene.origin[i, 0]
                y = scene.origin[j, 1] - scene.origin[i, 1]
                own = (x * scene.direction[j, 1] - y * scene.direction[j, 0]) / cross
                other = (x * scene.direction[i, 1] - y * scene.direction[i, 0]) / cross
                if own < NEAREST_M or own > FURTHEST_M or other < 0.5 * NEAREST_M:
                    continue
                sigma = np.sqrt(
                    (other * (scene.sigma[j] + _TURN_RAD_PER_M * pose_m)) ** 2
                    + (own * scene.sigma[i]) ** 2
                    + pose_m**2
                ) / abs(cross)
                if not np.isnan(scene.slope[i]):
                    rise = scene.slope[i] * own + scene.origin[i, 2]
                    rise -= scene.slope[j] * other + scene.origin[j, 2]
                    if abs(rise) > 3.0 * np.sqrt(
                        (scene.slope_sigma[i] * own) ** 2
                        + (scene.slope_sigma[j] * other) ** 2
                        + pose_m**2
                        + (0.02 * sigma) ** 2
                    ):
                        continue
                reach = _VOTE_SIGMAS * sigma
                low = int((1.0 / min(own + reach, FURTHEST_M) - far) / width)
                high = int((1.0 / max(own - reach, NEAREST_M) - far) / width)
                for cell in range(max(low, 0), min(high, _CELLS - 1) + 1):
                    off = (1.0 / (far + (cell + 0.5) * width) - own) / sigma
                    cast[cell] = max(cast[cell], np.exp(-0.5 * off * off))
                first, last = min(first, max(low, 0)), max(last, min(high, _CELLS - 1) + 1)
            for cell in range(first, last):
                votes[cell] += cast[cell]
                cast[cell] = 0.0
        best = np.argmax(votes)
        if votes[best] > 0.0:
            result[row] = 1.0 / (far + (best + 0.5) * width)
    return result


@compiled
def _nearest_ray(
    scene: RayScene,
    image: int,
    x: float,
    y: float,
    z: float,
    pose_m: float,
    gate: float,
    free: BoolArray,
) -> tuple[int, float, float]:
    """Return the free ray of an image that passes a position best, within ``gate`` sigmas; its chi2
    and its variance there (m2). -1 if there is none."""
    best, least, variance = -1, gate * gate, 0.0
    for j in range(scene.begin[image], scene.begin[image + 1]):
        if not free[j]:
            continue
        dx, dy = x - scene.origin[j, 0], y - scene.origin[j, 1]
        along = dx * scene.direction[j, 0] + dy * scene.direction[j, 1]
        if along < 0.5 * NEAREST_M:
            continue
        across = dy * scene.direction[j, 0] - dx * scene.direction[j, 1]
        spread = (along * (scene.sigma[j] + _TURN_RAD_PER_M * pose_m)) ** 2 + pose_m**2
        chi2 = across * across / spread
        if not np.isnan(scene.slope[j]):
            rise = scene.origin[j, 2] + scene.slope[j] * along - z
            chi2 += (
                rise
                * rise
                / ((along * (scene.slope_sigma[j] + _TURN_RAD_PER_M * pose_m)) ** 2 + pose_m**2)
            )
        if chi2 < least:
            best, least, variance = j, chi2, spread
    return best, least, variance


@compiled
def _is_in_view(scene: RayScene, image: int, x: float, y: float) -> float:
    """Return the range (m) of a position in an image; 0 if it is outside."""
    dx, dy = x - scene.center[image, 0], y - scene.center[image, 1]
    ahead = dx * scene.forward[image, 0] + dy * scene.forward[image, 1]
    aside = dx * scene.forward[image, 1] - dy * scene.forward[image, 0]
    if ahead < NEAREST_M or ahead > FURTHEST_M:
        return 0.0
    if aside < ahead * scene.edges[image, 0] or aside > ahead * scene.edges[image, 1]:
        return 0.0
    return float(np.hypot(dx, dy))


@compiled
def refined(
    scene: RayScene,
    window: IntArray,
    pose_m: float,
    most_sigma_m: float,
    starts: IntArray,
    ranges: FloatArray,
    free: BoolArray,
    clutter_of: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Refine candidates (s,); see ``TrackCandidates``. Of vague positions, the log-odds are
    -infinity."""
    n = len(starts)
    at, height = np.zeros((n, 2)), np.zeros(n)
    score, frames = np.full(n, -np.inf), np.zeros(n, np.int64)
    for row in range(n):
        i = starts[row]
        if ranges[row] == 0.0:
            continue
        x = scene.origin[i, 0] + ranges[row] * scene.direction[i, 0]
        y = scene.origin[i, 1] + ranges[row] * scene.direction[i, 1]
        z = scene.origin[i, 2] + ranges[row] * scene.slope[i]
        first, last = window[scene.image[i], 0], window[scene.image[i], 1]
        sigma = np.inf
        for gate in _GATES_SIGMAS:
            xx, xy, yy, bx, by, zz, bz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for image in range(first, last):
                j, _, variance = _nearest_ray(scene, image, x, y, z, pose_m, gate, free)
                if j < 0:
                    continue
                nx, ny = -scene.direction[j, 1], scene.direction[j, 0]
                off = nx * (scene.origin[j, 0] - x) + ny * (scene.origin[j, 1] - y)
                xx += nx * nx / variance
                xy += nx * ny / variance
                yy += ny * ny / variance
                bx += nx * off / variance
                by += ny * off / variance
                if not np.isnan(scene.slope[j]):
                    along = np.hypot(x - scene.origin[j, 0], y - scene.origin[j, 1])
                    spread = (along * scene.slope_sigma[j]) ** 2 + pose_m**2
                    zz += 1.0 / spread
                    bz += (scene.origin[j, 2] + along * scene.slope[j]) / spread
            determinant = xx * yy - xy * xy
            sigma = np.inf
            if not determinant > 1e-9 * max(xx, yy) ** 2:
                break
            x += (yy * bx - xy * by) / determinant
            y += (xx * by - xy * bx) / determinant
            z = bz / zz if zz > 0.0 else z
            half = 0.5 * (xx + yy)
            least = half - np.sqrt(max(half * half - determinant, 0.0))
            sigma = 1.0 / np.sqrt(max(least, 1e-12))
        if not sigma <= most_sigma_m:
            continue
        at[row, 0], at[row, 1], height[row] = x, y, z
        score[row], frames[row] = _log_odds(scene, first, last, x, y, z, pose_m, free, clutter_of)
    return at, height, score, frames


@compiled
def _log_odds(
    scene: RayScene,
    first: int,
    last: int,
    x: float,
    y: float,
    z: float,
    pose_m: float,
    free: BoolArray,
    clutter_of: FloatArray,
) -> tuple[float, int]:
    """Return the log-odds that a landmark is at a position, and the number of camera positions that
    detect it."""
    result, frames, before = _PRIOR_LOG_ODDS, 0, -1
    members = np.empty(last - first, np.int64)
    count = 0
    for image in range(first, last):
        distance = _is_in_view(scene, image, x, y)
        j, chi2, variance = _nearest_ray(scene, image, x, y, z, pose_m, 3.0, free)
        share = scene.recall[min(int(distance / BIN_M), len(scene.recall) - 1)]
        if j < 0:
            result += np.log(1.0 - share) if distance > 0.0 and scene.expected[image] else 0.0
            continue
        distance = np.hypot(x - scene.origin[j, 0], y - scene.origin[j, 1])
        density = np.exp(-0.5 * chi2) / (np.sqrt(2.0 * np.pi * variance) / distance)
        if not np.isnan(scene.slope[j]):
            density /= np.sqrt(2.0 * np.pi) * max(scene.slope_sigma[j], pose_m / distance)
        clutter = clutter_of[image] / scene.area[image]
        result += np.log(share * density / clutter + 1.0 - share)
        frames += scene.keyframe[image] != before
        before = scene.keyframe[image]
        members[count] = j
        count += 1
    for end in range(2):
        result += _agreement_of_ends(scene, members[:count], x, y, end)
    return result, frames


@compiled
def _agreement_of_ends(scene: RayScene, members: IntArray, x: float, y: float, end: int) -> float:
    """Return the log-odds that the rays of a pole at a position show one end of it, and not others
    anywhere in the images. The end that fits best does not count: it tells where the end is."""
    n = 0
    height, sigma, distance = np.empty((3, len(members)))
    for j in members:
        if not np.isnan(scene.ends[j, end]):
            distance[n] = np.hypot(x - scene.origin[j, 0], y - scene.origin[j, 1])
            height[n] = scene.origin[j, 2] + distance[n] * scene.ends[j, end]
            sigma[n] = np.hypot(distance[n] * scene.slope_sigma[j], _END_M)
            n += 1
    if n < 2:
        return 0.0
    off = (height[:n] - np.median(height[:n])) / sigma[:n]
    density = np.exp(-0.5 * off * off) / (np.sqrt(2.0 * np.pi) * sigma[:n]) * distance[:n]
    good = scene.good_ends[end]
    odds = np.log(good * density * scene.span + 1.0 - good)
    return float(odds.sum() - odds.max())


@compiled
def claimed(
    scene: RayScene,
    window: IntArray,
    pose_m: float,
    order: IntArray,
    starts: IntArray,
    at: FloatArray,
    height: FloatArray,
    free: BoolArray,
    track: IntArray,
    count: int,
) -> IntArray:
    """Let candidates claim their rays, in ``order``; return those that get all of them.

    A candidate that has lost a ray to a better one is not chosen: it is searched again on the rest.
    ``free`` and ``track`` (k,) are updated; the first new track has number ``count``.
    """
    chosen: list[int] = []
    still = free.copy()
    for row in order:
        i = starts[row]
        if not free[i]:
            continue
        rays, lost = [], False
        for image in range(window[scene.image[i], 0], window[scene.image[i], 1]):
            j, _, _ = _nearest_ray(
                scene, image, at[row, 0], at[row, 1], height[row], pose_m, 3.0, still
            )
            if j >= 0:
                rays.append(j)
                lost = lost or not free[j]
        if lost or len(rays) < 2:
            continue
        for j in rays:
            free[j] = False
            track[j] = count + len(chosen)
        chosen.append(row)
    return np.array(chosen, dtype=np.int64)
