"""Which of many things are near enough to each other to be one, by their places alone."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.placing.placed import Placed
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray

_REACH_SIGMAS = 6.0
_LEAST_REACH_M = 0.5
_MOST_REACH_M = 40.0
HARDLY_KNOWN_M = 20.0
"""A place that is not known better is none."""
_NOMINAL_M = 30.0
"""How far away something without a place is looked for, and ``_MOST_REACH_M`` around that."""
_KINDS_APART_M = 1e6


class Pairs(NamedTuple):
    """p pairs of things; where the first stands is known less well."""

    vague: IntArray
    """(p,)"""
    sharp: IntArray
    """(p,)"""

    def __len__(self) -> int:
        return len(self.vague)

    def where(self, rows: BoolArray | IntArray) -> "Pairs":
        return Pairs(self.vague[rows], self.sharp[rows])


@dataclass(frozen=True, eq=False)
class Spots:
    """Where n things stand on the ground plane."""

    at_m: FloatArray
    """(n, 2); of things without a place, where they are looked for"""
    covariance_m2: FloatArray
    """(n, 2, 2)"""
    sigma_m: FloatArray
    """(n,) in the worst direction; infinite without a place"""

    @classmethod
    def of(cls, views: Views, sightings: Sightings, placed: Placed) -> "Spots":
        """Of the things of ``sightings``; a place that is hardly known counts as none."""
        n = sightings.count
        ray, known = _on_rays(views, sightings), _MOST_REACH_M**2 * np.eye(2)
        spots = cls(ray, np.tile(known, (n, 1, 1)), np.full(n, np.inf))
        spots.put(np.arange(n), placed)
        return spots

    def put(self, rows: IntArray, placed: Placed) -> None:
        """New places, of the things in rows (m,); those of ``placed`` that have one."""
        at_m, spread, sigma = stands(placed)
        good = sigma < HARDLY_KNOWN_M
        self.at_m[rows[good]] = at_m[good]
        self.covariance_m2[rows[good]] = spread[good]
        self.sigma_m[rows[good]] = sigma[good]

    def pairs(self, things: IntArray, level_m: float, kind: IntArray, pose_sigma_m: float) -> Pairs:
        """Of ``things`` (m,), ascending, that may be one: of one ``kind`` (n,), and near enough.

        The sharper of each pair is known to ``level_m`` or better, the vaguer one too, unless
        that is infinite: then it may have no place at all.
        """
        from scipy.spatial import cKDTree

        sigma = self.sigma_m[things]
        sharp = things[np.isfinite(sigma) & (sigma <= level_m)]
        vague = things[sigma <= level_m]
        if not len(sharp):
            return Pairs(sharp, sharp)
        points = np.column_stack([self.at_m, kind * _KINDS_APART_M])
        reach = 2.0 * _REACH_SIGMAS * (self.sigma_m[vague] + pose_sigma_m)
        near = cKDTree(points[sharp]).query_ball_point(
            points[vague], np.clip(reach, _LEAST_REACH_M, _MOST_REACH_M), return_sorted=True
        )
        counts = np.array([len(rows) for rows in near])
        other = sharp[np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])]
        pairs = Pairs(np.repeat(vague, counts), other)
        pairs = pairs.where(self._is_sharper(pairs))
        return pairs.where(self._may_touch(pairs, pose_sigma_m))

    def _is_sharper(self, pairs: Pairs) -> BoolArray:
        """(p,) whether the second of a pair is; of two alike, the first in order is."""
        one, other = self.sigma_m[pairs.vague], self.sigma_m[pairs.sharp]
        return np.asarray((other < one) | ((other == one) & (pairs.sharp < pairs.vague)))

    def _may_touch(self, pairs: Pairs, pose_sigma_m: float) -> BoolArray:
        """(p,) by the covariances; roughly, since those of far things are."""
        x, y = (self.at_m[pairs.vague] - self.at_m[pairs.sharp]).T
        slack = (_LEAST_REACH_M / _REACH_SIGMAS + pose_sigma_m) ** 2 * np.eye(2)
        both = self.covariance_m2[pairs.vague] + self.covariance_m2[pairs.sharp] + slack
        a, b, d = both[:, 0, 0], both[:, 0, 1], both[:, 1, 1]
        squared = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
        return np.asarray(squared <= _REACH_SIGMAS**2)


def stands(placed: Placed) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 2) m where things stand on the ground plane, (n, 2, 2) its covariance, and (n,) sigma in
    the worst direction: infinite without a place."""
    share = np.where(np.isfinite(placed.end_m[:, 0]), 0.5, 1.0)
    shares = np.stack([share, 1.0 - share], axis=1)
    ends = np.stack([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)[:, :, :2]
    covariance = placed.covariance_m2.reshape(-1, 2, 3, 2, 3)[:, :, :2, :, :2]
    spread = np.einsum("ne,neifj,nf->nij", shares, covariance, shares)
    sigma = np.sqrt(np.linalg.eigvalsh(spread)[:, 1])
    at_m = np.einsum("ne,nei->ni", shares, ends)
    return at_m, spread, np.where(placed.ok, sigma, np.inf)


def _on_rays(views: Views, sightings: Sightings) -> FloatArray:
    """(n, 2) on the ground plane, on the ray of each thing's first sighting."""
    first = np.cumsum(sightings.seen) - sightings.seen
    view = sightings.view[first]
    rays = views.rays(view, sightings.anchor_px[first])
    return np.asarray(views.center_m[view, :2] + _NOMINAL_M * rays[:, :2])
