"""Candidate pairs of a batch, and how far away the camera would be if one were true.

The height of a mapped element over the road, seen under a slope, is a distance. Roads rise: with
the plane z = h + g.x of where cameras drove, a camera at x = p - d u sees the slope
s = (z_p - h - g.p) / d + g.u, so that the distance depends on the direction u of the element in the
map, and thereby on the heading, by as much as the road rises.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.learning.batch import Batch
from semviz_core.learning.candidates.combos import rows_of
from semviz_core.learning.candidates.level import levelled

NEAREST_M, FARTHEST_M = 2.5, 42.0
FIX_UNIT_M = 10.0
"""Of the fix's sigma among the prior's numbers."""
_USUAL, _USUAL_SIGMA = 0.07, 0.05
"""Of 1 / distance, before any slope is compared."""
_HEIGHT_SIGMA_M = 0.15
"""Of the road's plane, of the map and of the vehicle on its springs."""
_AGREEING = 3.0
"""Sigmas by which a bottom may differ from the anchor's distance; else it is hidden, or wrong."""
_HIDDEN_SHARE, _HIDDEN_SLOPE = 0.4, 0.03
"""How far off, of its slope and beside, a bottom may be that nothing else confirms."""
_MOST_SIGMAS = 5.0
_MOST_FIX_SIGMAS = 2.5
_LEAST_HEIGHT_M = 0.3


@dataclass(frozen=True, eq=False)
class Pairs:
    """N pairs of one class that the prior does not rule out, those of sample 0 first."""

    sample: Tensor  # (N,)
    seen: Tensor  # (N,) column of the batch's seen elements
    mapped: Tensor  # (N,) column of the batch's mapped elements
    direction: Tensor  # (N,) complex, unit: of the seen element in the level frame
    place_m: Tensor  # (N,) complex: of the mapped element in the local frame
    nearness: Tensor  # (N,) 1 / distance (1 / m), on a level road
    by_slope: Tensor  # (N,) how much it grows with what the slope is larger by
    sigma_m: Tensor  # (N,) of the distance
    wide_m: Tensor  # (N,) the same where the direction in the map is unknown
    rise: Tensor  # (N,) complex gradient of the road
    fix_sigma_m: Tensor  # (N,)
    off: Tensor  # (N, 2) sigmas by which slopes of anchor and end are off, 0 where unknown
    known: Tensor  # (N, 2) bool: slopes that are compared
    slope_sigma: Tensor  # (N,)
    azimuth_sigma: Tensor  # (N,)

    @property
    def nearness_variance(self) -> Tensor:
        """(N,)"""
        return (self.sigma_m * self.nearness.square()).square()

    def at(self, rows: Tensor) -> "Pairs":
        """Those ``rows`` (k,)."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return Pairs(**{name: value.index_select(0, rows) for name, value in values.items()})

    def to(self, device: torch.device) -> "Pairs":
        """All of it on a device."""
        return Pairs(**{one.name: getattr(self, one.name).to(device) for one in fields(self)})

    def distance_m(self, turn: Tensor, rows: Tensor) -> Tensor:
        """(...,) of pairs in ``rows`` (...,), if ``turn`` (...,), complex units, turns the level
        frame into the local one."""
        uphill = (self.rise[rows].conj() * self.direction[rows] * turn).real
        nearness = self.nearness[rows] - self.by_slope[rows] * uphill
        return 1.0 / nearness.clamp(1.0 / FARTHEST_M, 1.0 / NEAREST_M)


def candidate_pairs(batch: Batch) -> Pairs:
    """Pairs of one class whose slopes agree with a distance, and that with the fix."""
    sample, seen, mapped = batch.same_class.nonzero(as_tuple=True)
    level = levelled(batch)
    anchor, end = batch.point_m[sample, mapped], batch.bottom_m[sample, mapped]
    place = 0.5 * (anchor + end)[:, :2]
    road = batch.road[sample]
    ground = road[:, 0] + (road[:, 1:] * place).sum(dim=1)
    height = torch.stack([anchor[:, 2], end[:, 2]], dim=1) - ground[:, None]
    variance = batch.sigma_rad[sample, seen, 1].square() + level.up_sigma_rad[sample].square()
    slope = level.slope[sample, seen]
    known = batch.seen_known[sample, seen] & batch.mapped_known[sample, mapped]
    rise = torch.complex(road[:, 1], road[:, 2])
    uphill = 0.5 * rise.abs().square()  # variance of g.u where u may be any
    near = _nearness(height, slope, known, variance, uphill)
    cut = ~batch.seen_known[sample, seen, 0] & batch.mapped_known[sample, mapped, 0]
    least = torch.where(cut, slope[:, 0] / height[:, 0].clamp_min(_LEAST_HEIGHT_M), 0.0)
    nearness = near.mean.maximum(least.clamp(1.0 / FARTHEST_M, 0.25)).clamp_max(1.0 / NEAREST_M)
    distance = 1.0 / nearness
    sigma = (near.sigma * distance.square()).clamp_max(0.5 * distance) + 0.1
    wide = torch.hypot(sigma, uphill.sqrt() * near.by_slope.abs() * distance.square())
    slope_sigma = torch.sqrt(variance + uphill + (_HEIGHT_SIGMA_M * nearness).square())
    off = known * (slope - height * nearness[:, None]) / slope_sigma[:, None]
    pairs = Pairs(
        sample=sample,
        seen=seen,
        mapped=mapped,
        direction=level.direction[sample, seen],
        place_m=torch.complex(place[:, 0], place[:, 1]),
        nearness=nearness,
        by_slope=near.by_slope,
        sigma_m=sigma,
        wide_m=wide.minimum(0.6 * distance),
        rise=rise,
        fix_sigma_m=FIX_UNIT_M * batch.prior[sample, 4],
        off=off,
        known=known,
        slope_sigma=slope_sigma,
        azimuth_sigma=batch.sigma_rad[sample, seen, 0],
    )
    beyond = ((pairs.place_m.abs() - distance).abs() - _AGREEING * pairs.wide_m) / pairs.fix_sigma_m
    agree = (off[:, 0].abs() < _MOST_SIGMAS) & (off[:, 1] > -_MOST_SIGMAS)
    in_range = nearness - near.mean < _AGREEING * near.sigma
    return pairs.at(rows_of(agree & in_range & (beyond < _MOST_FIX_SIGMAS)))


class _Nearness(NamedTuple):
    """1 / distance (1 / m) of N pairs."""

    mean: Tensor
    sigma: Tensor
    by_slope: Tensor
    """How much the mean grows with both slopes."""


def _nearness(
    height: Tensor, slope: Tensor, known: Tensor, variance: Tensor, uphill: Tensor
) -> _Nearness:
    """Least squares of slope = height x nearness at both ends (N, 2), with what is usual.

    A bottom joins where it agrees with the anchor, or where nothing else is known: half of the
    bottoms are hidden. ``variance`` (N,) is that of slopes, ``uphill`` that of the road's.
    """
    anchor, end = known.unbind(dim=1)
    usual = _USUAL_SIGMA**-2
    near = torch.full_like(variance, _USUAL)
    for _ in range(2):
        spread = variance + (_HEIGHT_SIGMA_M * near).square()
        by_anchor = anchor * height[:, 0] / spread
        information = usual + by_anchor * height[:, 0]
        first = (usual * _USUAL + by_anchor * slope[:, 0]) / information
        off = slope[:, 1] - height[:, 1] * first
        agrees = off.square() < _AGREEING**2 * (
            spread + uphill + height[:, 1].square() / information
        )
        doubt = (_HIDDEN_SHARE * slope[:, 1]).square() + _HIDDEN_SLOPE**2
        by_end = height[:, 1] / (spread + torch.where(anchor, 0.0, doubt))
        by_end = torch.where(end & (agrees | ~anchor), by_end, 0.0)
        information = information + by_end * height[:, 1]
        both = by_anchor * slope[:, 0] + by_end * slope[:, 1]
        mean = (usual * _USUAL + both) / information
        near = mean.clamp(0.5 / FARTHEST_M, 1.0 / NEAREST_M)
    return _Nearness(mean, information.rsqrt(), (by_anchor + by_end) / information)
