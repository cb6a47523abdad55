"""Misplaced labels, and label elements that hold two landmarks.

Badly fitting observations are set apart. If enough of them agree on another position, over several
frames, they are another landmark under the same name. The rest are outliers.
"""

import numpy as np

from semviz_annotation.mapping.association.nodes import LEFT_OUT
from semviz_annotation.mapping.placement import reprojection
from semviz_annotation.mapping.placement.landmarks import Landmarks
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.triangulation import best_of_pairs, triangulate_landmarks
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

CHANCE = 1e-6
"""Probability that a good label counts as an outlier: the level of each chi2 test."""
_MOST_PARTS = 4
_PART_OBSERVATIONS, _PART_FRAMES = 3, 2
"""Least observations and frames of a separate landmark: more than a wrong pair, which always has
some position."""


def find_outliers(
    views: ViewArray,
    observations: ObservationArray,
    ends_m: FloatArray,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> BoolArray:
    """Return which observations (k,) do not fit their landmarks at ``ends_m`` (n, 6: anchor and
    end).

    The test allows for pose errors, which matter most in near views.
    """
    from scipy.special import chdtri

    at = reprojection.residuals(views, observations, ends_m[:, :3], ends_m[:, 3:])
    depth = views.depth_m(observations.view, ends_m[observations.landmark, :3])
    pose_px = views.K[observations.view, 0, 0] * pose_sigma_m / np.maximum(depth, MIN_DEPTH_M)
    variance_px2 = (options.sigma_px * at.sigma_ratio) ** 2 + pose_px[:, None] ** 2
    chi2 = (at.pixels_off**2 / variance_px2).sum(axis=1)
    return np.asarray(~at.ahead | (chi2 > chdtri(at.counts.sum(axis=1), CHANCE)))


def parts(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> IntArray:
    """Return the part (k,) of its landmark that each observation belongs to.

    0 is the main part, ``LEFT_OUT`` none. Landmarks that are too far away for a position, or seen
    only twice, stay whole.
    """
    part = np.zeros(len(observations), dtype=np.int64)
    ends = np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)
    torn = ~placed.ok & ~placed.too_narrow & (observations.seen >= _PART_OBSERVATIONS)
    open_ = torn[observations.landmark]
    rows = placed.ok[observations.landmark]
    open_[rows] = find_outliers(
        views, observations.where(rows), np.nan_to_num(ends), options, pose_sigma_m
    )
    part[open_] = LEFT_OUT
    for number in range(_MOST_PARTS):
        still = np.flatnonzero(open_)
        agreed = still[_agreeing(views, observations.where(open_), options, pose_sigma_m)]
        part[agreed] = number + 1
        open_[agreed] = False
    return main_first(observations, part)


def _agreeing(
    views: ViewArray,
    observations: ObservationArray,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> BoolArray:
    """Return which observations (k,) form a landmark of their own, the largest one per landmark."""
    result = np.zeros(len(observations), dtype=bool)
    enough = observations.seen >= _PART_OBSERVATIONS
    rows = np.flatnonzero(enough[observations.landmark])
    if not len(rows):
        return result
    chosen = observations.only(enough)
    X, cost = best_of_pairs(views, chosen, options)
    X, cost = reprojection.refine_positions(views, chosen, X, np.isfinite(cost), options)
    fits = ~find_outliers(views, chosen, X, options, pose_sigma_m)
    fits &= np.isfinite(cost)[chosen.landmark]
    agreed = chosen.where(fits)
    frames = np.unique(np.stack([agreed.landmark, views.frame_index[agreed.view]]), axis=1)[0]
    own = (agreed.seen >= _PART_OBSERVATIONS) & triangulate_landmarks(views, agreed, options).ok
    own &= np.bincount(frames, minlength=chosen.count) >= _PART_FRAMES
    result[rows] = fits & own[chosen.landmark]
    return result


def main_first(observations: ObservationArray, part: IntArray) -> IntArray:
    """Renumber parts (k,) of landmarks from 0, by the number of observations, then by the first.

    ``LEFT_OUT`` stays.
    """
    result = np.full(len(part), LEFT_OUT)
    rows = np.flatnonzero(part != LEFT_OUT)
    key = observations.landmark[rows] * (part.max(initial=0) + 1) + part[rows]
    _, first, index, count = np.unique(
        key, return_index=True, return_inverse=True, return_counts=True
    )
    landmark = observations.landmark[rows][first]
    order = np.lexsort((first, -count, landmark))
    start = np.searchsorted(landmark[order], landmark[order])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - start
    result[rows] = rank[index]
    return result
