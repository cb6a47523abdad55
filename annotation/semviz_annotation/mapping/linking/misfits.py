"""Clicks that are not where they should be, and label elements that are two things.

What fits badly is set apart. Where enough of it agrees on another place, over several frames, it is
another thing under the same name; the rest are misplaced clicks.
"""

import numpy as np

from semviz_annotation.mapping.linking.nodes import LEFT_OUT
from semviz_annotation.mapping.placing.least_squares import PlaceOptions, settled
from semviz_annotation.mapping.placing.pairs import best_of_pairs
from semviz_annotation.mapping.placing.place import place
from semviz_annotation.mapping.placing.placed import Placed
from semviz_annotation.mapping.placing.residuals import residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M

CHANCE = 1e-6
"""That a good click is taken for a misfit: the level of the chi2 test of each sighting."""
_MOST_PARTS = 4
_PART_SIGHTINGS, _PART_FRAMES = 3, 2
"""What it takes to be a thing of its own: more than a wrong pair, which always has some place."""


def misfits(
    views: Views,
    sightings: Sightings,
    ends_m: FloatArray,
    options: PlaceOptions,
    pose_sigma_m: float,
) -> BoolArray:
    """(k,) sightings that do not fit their things at ends_m (n, 6: anchor and end).

    Errors of poses are allowed for, which near views show most.
    """
    from scipy.special import chdtri

    at = residuals(views, sightings, ends_m[:, :3], ends_m[:, 3:])
    depth = views.depth_m(sightings.view, ends_m[sightings.thing, :3])
    pose_px = views.K[sightings.view, 0, 0] * pose_sigma_m / np.maximum(depth, MIN_DEPTH_M)
    chi2 = (at.error_px**2).sum(axis=1) / (options.sigma_px**2 + pose_px**2)
    return np.asarray(~at.ahead | (chi2 > chdtri(at.counts.sum(axis=1), CHANCE)))


def parts(
    views: Views,
    sightings: Sightings,
    placed: Placed,
    options: PlaceOptions,
    pose_sigma_m: float,
) -> IntArray:
    """(k,) part of its thing that each sighting belongs to: 0 is the main one, ``LEFT_OUT`` none.

    Things that are too far away for any place, or seen only twice, stay whole.
    """
    part = np.zeros(len(sightings), dtype=np.int64)
    ends = np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)
    torn = ~placed.ok & ~placed.too_narrow & (sightings.seen >= _PART_SIGHTINGS)
    open_ = torn[sightings.thing]
    rows = placed.ok[sightings.thing]
    open_[rows] = misfits(views, sightings.where(rows), np.nan_to_num(ends), options, pose_sigma_m)
    part[open_] = LEFT_OUT
    for number in range(_MOST_PARTS):
        still = np.flatnonzero(open_)
        agreed = still[_agreeing(views, sightings.where(open_), options, pose_sigma_m)]
        part[agreed] = number + 1
        open_[agreed] = False
    return main_first(sightings, part)


def _agreeing(
    views: Views, sightings: Sightings, options: PlaceOptions, pose_sigma_m: float
) -> BoolArray:
    """(k,) sightings that make one thing of their own, the largest of each thing's."""
    result = np.zeros(len(sightings), dtype=bool)
    enough = sightings.seen >= _PART_SIGHTINGS
    rows = np.flatnonzero(enough[sightings.thing])
    if not len(rows):
        return result
    chosen = sightings.only(enough)
    X, cost = best_of_pairs(views, chosen, options)
    X, cost = settled(views, chosen, X, np.isfinite(cost), options)
    fits = ~misfits(views, chosen, X, options, pose_sigma_m)
    fits &= np.isfinite(cost)[chosen.thing]
    agreed = chosen.where(fits)
    frames = np.unique(np.stack([agreed.thing, views.frame_index[agreed.view]]), axis=1)[0]
    own = (agreed.seen >= _PART_SIGHTINGS) & place(views, agreed, options).ok
    own &= np.bincount(frames, minlength=chosen.count) >= _PART_FRAMES
    result[rows] = fits & own[chosen.thing]
    return result


def main_first(sightings: Sightings, part: IntArray) -> IntArray:
    """(k,) parts (k,) of things numbered anew, from 0: by sightings, most first, then by the first.

    ``LEFT_OUT`` stays.
    """
    result = np.full(len(part), LEFT_OUT)
    rows = np.flatnonzero(part != LEFT_OUT)
    key = sightings.thing[rows] * (part.max(initial=0) + 1) + part[rows]
    _, first, index, count = np.unique(
        key, return_index=True, return_inverse=True, return_counts=True
    )
    thing = sightings.thing[rows][first]
    order = np.lexsort((first, -count, thing))
    start = np.searchsorted(thing[order], thing[order])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - start
    result[rows] = rank[index]
    return result
