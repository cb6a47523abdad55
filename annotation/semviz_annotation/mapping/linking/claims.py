"""Which sightings a thing explains, its own or not: those near it in their images, tested.

Things that stand behind one another look alike from some places, so several may claim a sighting.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.linking.agreement import AT_ONCE, Agreement, Places, agreement
from semviz_annotation.mapping.linking.exclusion import spans
from semviz_annotation.mapping.linking.nearby import stands
from semviz_annotation.mapping.linking.rounds import LinkOptions
from semviz_annotation.mapping.placing.placed import Placed
from semviz_annotation.mapping.placing.residuals import projected
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M

_FURTHEST_M = 100.0
"""Nothing is looked for further away from a camera."""
_REACH_SIGMAS = 6.0
_VIEWS_AT_ONCE = 1000
"""So that memory does not grow with their number."""


@dataclass(frozen=True, eq=False)
class Claims:
    """c pairs of a sighting and a thing that it may be of."""

    sighting: IntArray
    """(c,) row"""
    thing: IntArray
    """(c,)"""

    def __len__(self) -> int:
        return len(self.sighting)

    def where(self, rows: BoolArray | IntArray) -> "Claims":
        return Claims(self.sighting[rows], self.thing[rows])

    def and_(self, others: "Claims") -> "Claims":
        return Claims(
            np.concatenate([self.sighting, others.sighting]),
            np.concatenate([self.thing, others.thing]),
        )

    def tested(
        self, views: Views, sightings: Sightings, places: Places, options: LinkOptions
    ) -> tuple[BoolArray, FloatArray]:
        """(c,) whether each sighting, by itself, fits the place of the thing; and (c,) its
        log-likelihood there."""
        results = []
        for start in range(0, len(self), AT_ONCE):
            some = self.where(np.arange(start, min(start + AT_ONCE, len(self))))
            alone = sightings.taken(some.sighting, np.arange(len(some)), len(some))
            there = places[some.thing]
            results.append(
                agreement(views, alone, there, options.place.sigma_px, options.pose_sigma_m)
            )
        result = Agreement.joined(results)
        return options.fits(result), result.log_likelihood


def claims_near(
    views: Views,
    sightings: Sightings,
    kind_of: IntArray,
    placed: Placed,
    kind: IntArray,
    options: LinkOptions,
) -> Claims:
    """Of sightings of kinds (k,) and n things of kinds (n,) that have a place: those which are near
    each other in an image, roughly."""
    from scipy.spatial import cKDTree

    ok = np.flatnonzero(placed.ok)
    at_m, _, sigma_m = stands(placed)
    tree = cKDTree(at_m[ok])
    order = np.argsort(sightings.view, kind="stable")
    begin = np.searchsorted(sightings.view[order], np.arange(len(views) + 1))
    result = Claims(ok[:0], ok[:0])
    for first in range(0, len(views), _VIEWS_AT_ONCE):
        some = np.arange(first, min(first + _VIEWS_AT_ONCE, len(views)))
        near = tree.query_ball_point(views.center_m[some, :2], _FURTHEST_M, return_sorted=True)
        view = np.repeat(some, [len(rows) for rows in near])
        thing = ok[np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])]
        projections = _projected(views, placed, view, thing, sigma_m, options)
        rows, pair = spans(begin[projections.view], begin[projections.view + 1])
        claims = Claims(order[rows], projections.thing[pair])
        alike = kind_of[claims.sighting] == kind[claims.thing]
        claims, pair = claims.where(alike), pair[alike]
        result = result.and_(claims.where(projections.are_near(sightings, claims.sighting, pair)))
    return result


class _Projections(NamedTuple):
    """p things in images that they are ahead of."""

    view: IntArray
    """(p,)"""
    thing: IntArray
    """(p,)"""
    anchor_px: FloatArray
    """(p, 2)"""
    end_px: FloatArray
    """(p, 2), the anchor for points"""
    reach_px: FloatArray
    """(p,) how far from there sightings of the thing may be"""

    def are_near(self, sightings: Sightings, rows: IntArray, pair: IntArray) -> BoolArray:
        """(c,) whether sightings in rows (c,) are near projections (c,): signs in u and v, poles
        along u at the middle of what was seen."""
        is_line = sightings.is_line[rows]
        seen = sightings.anchor_px[rows]
        middle = np.where(is_line[:, None], (seen + sightings.end_px[rows]) / 2.0, seen)
        anchor, along = self.anchor_px[pair], (self.end_px - self.anchor_px)[pair]
        down = np.where(along[:, 1] == 0.0, 1.0, along[:, 1])
        share = np.where(is_line, (middle[:, 1] - anchor[:, 1]) / down, 0.0)
        off = np.abs(anchor + share[:, None] * along - middle)
        return np.asarray(off.max(axis=1) <= self.reach_px[pair])


def _projected(
    views: Views,
    placed: Placed,
    view: IntArray,
    thing: IntArray,
    sigma_m: FloatArray,
    options: LinkOptions,
) -> _Projections:
    """Things (p,) in views (p,), known to sigma_m (n,), where these are ahead."""
    depth_m = views.depth_m(view, placed.anchor_m[thing])
    ahead = depth_m > MIN_DEPTH_M
    view, thing, depth_m = view[ahead], thing[ahead], depth_m[ahead]
    anchor, _, _ = projected(views, view, placed.anchor_m[thing])
    end_m = np.where(np.isnan(placed.end_m), placed.anchor_m, placed.end_m)
    end, _, _ = projected(views, view, end_m[thing])
    vague_px = views.K[view, 0, 0] * (sigma_m[thing] + options.pose_sigma_m) / depth_m
    reach_px = _REACH_SIGMAS * (options.place.sigma_px + vague_px)
    return _Projections(view, thing, anchor, end, reach_px)
