"""All things placed at once: the places with the least reprojection error over all their views.

A misplaced click loses its say the further off it is (Cauchy's loss). Where several are, the place
that most sightings agree with is looked for, from two sightings at a time.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from semviz_annotation.mapping.placing.least_squares import PlaceOptions, settled
from semviz_annotation.mapping.placing.linear import along_lines, end_rays, linear_start, outermost
from semviz_annotation.mapping.placing.pairs import best_of_pairs
from semviz_annotation.mapping.placing.placed import Placed, measured, rms_px
from semviz_annotation.mapping.placing.residuals import residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray

__all__ = ["PlaceOptions", "Placed", "place", "place_linearly"]

_MISFIT = 5.0
"""A sighting this far off, as a multiple of sigma (rms of its rows), is of something else."""
_REFUSED = 0.5
"""Things are not placed where so many of their sightings are misfits."""
_DOUBTFUL = 0.1
"""Where so many are, the place may be between those of two things."""
_AT_ONCE = 20_000
"""Sightings, so that memory does not grow with their number."""


def place(
    views: Views,
    sightings: Sightings,
    options: PlaceOptions = PlaceOptions(),
    on_progress: Callable[[int, int], None] = lambda done, of: None,
) -> Placed:
    """The things of ``sightings`` from all their views; ``on_progress`` counts things."""
    parts, done = [], 0
    for part in _parts(sightings):
        parts.append(_place(views, part, options))
        done += part.count
        on_progress(done, sightings.count)
    return Placed.joined(parts)


def place_linearly(
    views: Views, sightings: Sightings, options: PlaceOptions = PlaceOptions()
) -> Placed:
    """As ``place``, but from the rays and planes alone, whatever the fit: the paper's way."""
    start = linear_start(views, sightings, options.min_angle_rad)
    return measured(
        views,
        sightings,
        start.places_m(),
        start.failure,
        start.too_narrow,
        start.angle_rad,
        replace(options, outlier_sigmas=np.inf),
    )


def _parts(sightings: Sightings) -> Iterator[Sightings]:
    """Of about ``_AT_ONCE`` rows each, whole things."""
    if not sightings.count:
        yield sightings
    part = np.cumsum(sightings.seen) // _AT_ONCE
    for number in np.unique(part):
        yield sightings.only(part == number)


def _place(views: Views, sightings: Sightings, options: PlaceOptions) -> Placed:
    start = linear_start(views, sightings, options.min_angle_rad)
    X, cost = settled(views, sightings, start.places_m(), start.ok, options)
    misfits, _ = _misfits(views, sightings, X, options)
    doubtful = (np.isinf(cost) | (misfits >= _DOUBTFUL)) & ~start.too_narrow & (sightings.seen > 2)
    _put_better(views, sightings, doubtful, X, cost, options)
    found = np.isfinite(cost)
    start.failure[found] = ""
    start.fail(~found, "the views do not agree on a place: are these different things?")
    misfits, rms = _misfits(views, sightings, X, options)
    for thing in np.flatnonzero(found & (misfits >= _REFUSED)):
        words = f"the views disagree by {rms[thing]:.1f} px: are these different things?"
        start.failure[thing] = words
    X = _stretched(views, sightings, X, options)
    return measured(views, sightings, X, start.failure, start.too_narrow, start.angle_rad, options)


def _put_better(
    views: Views,
    sightings: Sightings,
    things: BoolArray,
    X: FloatArray,
    cost: FloatArray,
    options: PlaceOptions,
) -> None:
    """Into X (n, 6) and cost (n,): places of things (n,) that more sightings agree with."""
    if not things.any():
        return
    sightings = sightings.only(things)
    near, agreed = best_of_pairs(views, sightings, options)
    new_X, new_cost = settled(views, sightings, near, np.isfinite(agreed), options)
    better = new_cost < cost[things]
    rows = np.flatnonzero(things)[better]
    X[rows], cost[rows] = new_X[better], new_cost[better]


def _misfits(
    views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """(n,) share of the sightings that are misfits of things at X (n, 6), and (n,) rms in px."""
    at = residuals(views, sightings, X[:, :3], X[:, 3:])
    off = (at.error_px**2).sum(axis=1) / np.maximum(at.counts.sum(axis=1), 1)
    misfit = ~at.ahead | (off > (_MISFIT * options.sigma_px) ** 2)
    share = sightings.per_thing(np.add, misfit.astype(float)) / np.maximum(sightings.seen, 1)
    return share, rms_px(sightings, at)


def _stretched(
    views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions
) -> FloatArray:
    """X (n, 6) with the ends that nobody saw at the furthest point of the line that anybody saw.

    Sightings that lie beside the line say nothing about its length, unless all do.
    """
    sightings = sightings.where(sightings.is_line)
    unseen = [~sightings.of(known) for known in (sightings.anchor_known, sightings.end_known)]
    anchor, end = X[:, :3], X[:, 3:]
    at = residuals(views, sightings, anchor, end)
    on_line = at.squared_px2()[:, 0] <= (options.outlier_sigmas * options.sigma_px) ** 2
    usable = sightings.where(on_line | ~sightings.of(on_line)[sightings.thing])
    length = np.maximum(np.linalg.norm(end - anchor, axis=1, keepdims=True), 1e-9)
    direction = (end - anchor) / length
    along = along_lines(views, usable, end_rays(views, usable), anchor, direction)
    is_line = sightings.seen > 0
    result = X.copy()
    for which, place in enumerate(outermost(usable, along)):
        moved = is_line & unseen[which]
        result[moved, 3 * which : 3 * which + 3] = (anchor + place[:, None] * direction)[moved]
    return result
