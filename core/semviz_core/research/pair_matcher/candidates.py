"""Form candidate pairs of a batch: level view, distance from slope, headings in bins.

Gravity is taken out first, as `semviz_core.localization.upright` does for one frame, here in
tensors. The height of a mapped element over the road, seen under a slope, is a distance. Roads
rise: with the plane z = h + g.x of the driven path, a camera at x = p - d u sees the slope s =
(z_p - h - g.p) / d + g.u. So the distance depends on the direction u of the element, and
thereby on the heading, by as much as the road rises. For each heading bin a pair gives a camera
position, tested against fix and compass.
"""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.localization import upright
from semviz_core.research.training.batch import Batch


def rows_of(mask: Tensor) -> Tensor:
    """Return the rows (k,) where ``mask`` (a,) is True."""
    return torch.nonzero(mask)[:, 0]


def of_one_sample(sample: Tensor, other_sample: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the rows (k,), (k,) of all combinations within each of ``size`` samples.

    ``sample`` (a,) and ``other_sample`` (b,) are the sample numbers, in ascending order.
    """
    count = torch.bincount(other_sample, minlength=size)
    before = torch.cumsum(count, dim=0) - count
    others = count[sample]
    rows = torch.arange(len(sample), device=count.device)
    row = torch.repeat_interleave(rows, others)
    begin = torch.cumsum(others, dim=0) - others - before[sample]
    return row, torch.arange(len(row), device=count.device) - begin[row]


def best_of_kind(value: Tensor, kind: Tensor) -> Tensor:
    """Return the row of the largest value (a,) of each ``kind`` (a,)."""
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(kind[order], stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = kind[order[1:]] != kind[order[:-1]]
    return order[first]


def best_of_sample(value: Tensor, sample: Tensor, size: int, most: int) -> Tensor:
    """Return the rows (k,) of the ``most`` largest values (a,) of each sample, largest first."""
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(sample[order], stable=True)]
    count = torch.bincount(sample, minlength=size)
    before = torch.cumsum(count, dim=0) - count
    rank = torch.arange(len(order), device=order.device) - before[sample[order]]
    return order[rank < most]


_LEAST_LENGTH = 1e-4  # of an observed line (rad); shorter ones are points
_EXACT_RAD = 0.01  # unit of the sigma among the prior's numbers


@dataclass(frozen=True, eq=False)
class Level:
    """Observed elements in the level frame: x is the horizontal optical axis, z is up."""

    direction: Tensor
    """(b, m) complex unit x + iy towards the element; of a pole, towards its middle."""
    slope: Tensor
    """(b, m, 2) tangents of the elevation of anchor and end."""
    up_sigma_rad: Tensor
    """(b,)"""


def level_view(batch: Batch) -> Level:
    """Return the observed elements in the level frame.

    Gravity follows from the prior, or a camera that looks about level, and the observed poles.
    """
    up, sigma = _up(batch)
    ahead, left = _across(up)
    R = torch.stack([ahead, left, up], dim=1)
    anchor, end = batch.ray @ R.mT, batch.bottom_ray @ R.mT
    middle = (anchor + end)[..., :2]
    unit = middle / middle.norm(dim=2, keepdim=True).clamp_min(1e-9)
    slope = [ray[..., 2] / ray[..., :2].norm(dim=2).clamp_min(1e-3) for ray in (anchor, end)]
    return Level(torch.view_as_complex(unit.contiguous()), torch.stack(slope, dim=2), sigma)


def _up(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return up (b, 3) in camera axes and its sigma (b,).

    This fits the prior and the vertical vanishing point of the poles by least squares, reweighted
    (Cauchy) since false poles may lean by any angle.
    """
    start, information = _prior_up(batch)
    x, y = _across(start)
    normal = torch.linalg.cross(batch.ray, batch.bottom_ray)
    length = normal.norm(dim=2).clamp_min(1e-9)
    normal = normal / length[..., None]
    line = batch.seen & (length > _LEAST_LENGTH)
    variance = 2.0 * (batch.sigma_rad[..., 0] / length).square() + upright.POLE_LEAN_RAD**2
    off, by_x, by_y = ((normal * axis[:, None]).sum(dim=2) for axis in (start, x, y))
    tilt_x = tilt_y = torch.zeros_like(information)
    for _ in range(3):
        left = off + by_x * tilt_x[:, None] + by_y * tilt_y[:, None]
        weight = torch.where(line, 1.0 / (variance + left.square() / upright.CAUCHY_SIGMAS**2), 0.0)
        a = (weight * by_x.square()).sum(dim=1) + information
        b = (weight * by_x * by_y).sum(dim=1)
        d = (weight * by_y.square()).sum(dim=1) + information
        right_x, right_y = (weight * by_x * off).sum(dim=1), (weight * by_y * off).sum(dim=1)
        determinant = a * d - b.square()
        tilt_x = (b * right_y - d * right_x) / determinant
        tilt_y = (b * right_x - a * right_y) / determinant
    up = torch.nn.functional.normalize(start + tilt_x[:, None] * x + tilt_y[:, None] * y, dim=1)
    return up, torch.sqrt(0.5 * (a + d) / determinant)


def _prior_up(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return up (b, 3) and its information (b,) in 1 / rad^2: the prior's, or the assumed one."""
    up = batch.prior[:, :3]
    known = up.square().sum(dim=1) > 0.5
    assumed = torch.as_tensor(upright.ASSUMED_UP, dtype=up.dtype, device=up.device)
    sigma = torch.where(known, _EXACT_RAD * batch.prior[:, 3].exp(), upright.ASSUMED_UP_SIGMA_RAD)
    return torch.where(known[:, None], up, assumed), sigma**-2


def _across(up: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (b, 3) perpendicular to ``up``: the horizontal optical axis, and its
    left."""
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype, device=up.device)
    ahead = torch.nn.functional.normalize(axis - up * up[:, 2:], dim=1)
    return ahead, torch.linalg.cross(up, ahead)


NEAREST_M, FARTHEST_M = 2.5, 42.0
FIX_UNIT_M = 10.0
"""Unit of the fix's sigma in the prior's numbers."""
_USUAL, _USUAL_SIGMA = 0.07, 0.05
"""Prior of 1 / distance (1 / m): mean and sigma."""
_HEIGHT_SIGMA_M = 0.15
"""Of the road's plane, the map and the vehicle's suspension together."""
_AGREEING = 3.0
"""Sigmas by which a bottom may differ from the anchor's distance; otherwise it is hidden or
wrong."""
_HIDDEN_SHARE, _HIDDEN_SLOPE = 0.4, 0.03
"""Sigma of a bottom without a known anchor: a share of its slope, and a constant."""
_MOST_SIGMAS = 5.0
_MOST_PAIR_FIX_SIGMAS = 2.5
_LEAST_HEIGHT_M = 0.3


@dataclass(frozen=True, eq=False)
class CandidatePairs:
    """N pairs of one class that the prior does not rule out, in order of samples."""

    sample: Tensor  # (N,)
    seen: Tensor  # (N,) column of the batch's observed elements
    mapped: Tensor  # (N,) column of the batch's mapped elements
    direction: Tensor  # (N,) complex, unit: of the observed element in the level frame
    place_m: Tensor  # (N,) complex: of the mapped element in the local frame
    nearness: Tensor  # (N,) 1 / distance (1 / m), on a level road
    by_slope: Tensor  # (N,) its derivative by the slope
    sigma_m: Tensor  # (N,) of the distance
    wide_m: Tensor  # (N,) the same if the direction in the map is unknown
    rise: Tensor  # (N,) complex gradient of the road
    fix_sigma_m: Tensor  # (N,)
    off: Tensor  # (N, 2) residuals of the slopes of anchor and end in sigmas, 0 if unknown
    known: Tensor  # (N, 2) bool: slopes that are compared
    slope_sigma: Tensor  # (N,)
    azimuth_sigma: Tensor  # (N,)

    @property
    def nearness_variance(self) -> Tensor:
        """(N,) variance of ``nearness``."""
        return (self.sigma_m * self.nearness.square()).square()

    def at(self, rows: Tensor) -> "CandidatePairs":
        """Return the pairs in ``rows`` (k,)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return CandidatePairs(
            **{name: value.index_select(0, rows) for name, value in values.items()}
        )

    def to(self, device: torch.device) -> "CandidatePairs":
        """Return the pairs on a device."""
        return CandidatePairs(
            **{field.name: getattr(self, field.name).to(device) for field in fields(self)}
        )

    def distance_m(self, turn: Tensor, rows: Tensor) -> Tensor:
        """Return the distances (...,) of pairs in ``rows`` (...,), if ``turn`` (...,), complex
        units, turns the level frame into the local one."""
        uphill = (self.rise[rows].conj() * self.direction[rows] * turn).real
        nearness = self.nearness[rows] - self.by_slope[rows] * uphill
        return 1.0 / nearness.clamp(1.0 / FARTHEST_M, 1.0 / NEAREST_M)


def candidate_pairs(batch: Batch) -> CandidatePairs:
    """Return pairs of one class whose slopes agree with a distance, and the distance with the
    fix."""
    sample, seen, mapped = batch.same_class.nonzero(as_tuple=True)
    level = level_view(batch)
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
    pairs = CandidatePairs(
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
    return pairs.at(rows_of(agree & in_range & (beyond < _MOST_PAIR_FIX_SIGMAS)))


class _Nearness(NamedTuple):
    """1 / distance (1 / m) of N pairs."""

    mean: Tensor
    sigma: Tensor
    by_slope: Tensor
    """Derivative of the mean by both slopes."""


def _nearness(
    height: Tensor, slope: Tensor, known: Tensor, variance: Tensor, uphill: Tensor
) -> _Nearness:
    """Fit slope = height x nearness at both ends (N, 2) by least squares, with a prior.

    A bottom counts if it agrees with the anchor, or if the anchor is unknown: half of the bottoms
    are hidden. ``variance`` (N,) is that of slopes, ``uphill`` that of the road's slope.
    """
    anchor, end = known.unbind(dim=1)
    prior_information = _USUAL_SIGMA**-2
    near = torch.full_like(variance, _USUAL)
    for _ in range(2):
        slope_variance = variance + (_HEIGHT_SIGMA_M * near).square()
        by_anchor = anchor * height[:, 0] / slope_variance
        information = prior_information + by_anchor * height[:, 0]
        first = (prior_information * _USUAL + by_anchor * slope[:, 0]) / information
        off = slope[:, 1] - height[:, 1] * first
        agrees = off.square() < _AGREEING**2 * (
            slope_variance + uphill + height[:, 1].square() / information
        )
        hidden_variance = (_HIDDEN_SHARE * slope[:, 1]).square() + _HIDDEN_SLOPE**2
        by_end = height[:, 1] / (slope_variance + torch.where(anchor, 0.0, hidden_variance))
        by_end = torch.where(end & (agrees | ~anchor), by_end, 0.0)
        information = information + by_end * height[:, 1]
        both = by_anchor * slope[:, 0] + by_end * slope[:, 1]
        mean = (prior_information * _USUAL + both) / information
        near = mean.clamp(0.5 / FARTHEST_M, 1.0 / NEAREST_M)
    return _Nearness(mean, information.rsqrt(), (by_anchor + by_end) / information)


BINS = 36
"""Ten degrees each."""
BIN_RAD = 2.0 * math.pi / BINS
_MOST_BIN_FIX_SIGMAS = 3.0
_MOST_COMPASS_CHI2 = 14.0
_BIN_SIGMA_RAD = 0.05  # within a bin
_COMPASS_UNIT_RAD = 0.1  # of its sigma among the prior's numbers
USUAL_FIX_SIGMAS = 1.3
"""Typical distance of a fix from the truth, in sigmas."""


class Compass(NamedTuple):
    """The prior's heading."""

    known: Tensor  # (b,) bool
    heading_rad: Tensor  # (b,)
    sigma_rad: Tensor  # (b,)

    @classmethod
    def of(cls, batch: Batch) -> "Compass":
        x, y, log_sigma = batch.prior[:, 5:8].unbind(dim=1)
        return cls(x**2 + y**2 > 0.5, torch.atan2(y, x), _COMPASS_UNIT_RAD * log_sigma.exp())

    def chi2(self, sample: Tensor, heading_rad: Tensor, variance: Tensor | float) -> Tensor:
        """Return chi2 (...,) of headings (...,) in frames ``sample``; 0 without a compass."""
        off = torch.remainder(heading_rad - self.heading_rad[sample] + math.pi, 2.0 * math.pi)
        chi2 = (off - math.pi).square() / (self.sigma_rad[sample].square() + variance)
        return torch.where(self.known[sample], chi2, 0.0)


class Bins(NamedTuple):
    """N pairs under each heading bin."""

    feature: Tensor
    """(N, BINS, 3)"""
    possible: Tensor
    """(N, BINS) True unless fix or compass rules it out."""


def in_bins(pairs: CandidatePairs, compass: Compass) -> Bins:
    """Return how far the camera is from the fix, and the heading from the compass, in each bin."""
    heading = torch.arange(BINS, device=pairs.nearness.device) * BIN_RAD
    rows = torch.arange(len(pairs.sample), device=heading.device)[:, None]
    turn = torch.polar(torch.ones_like(heading), heading)
    offset = pairs.distance_m(turn, rows) * pairs.direction[:, None] * turn
    sigma = torch.hypot(pairs.fix_sigma_m, pairs.sigma_m)
    from_fix = (pairs.place_m[:, None] - offset).abs() / sigma[:, None]
    chi2 = compass.chi2(pairs.sample[:, None], heading, _BIN_SIGMA_RAD**2)
    possible = (from_fix < _MOST_BIN_FIX_SIGMAS) & (chi2 < _MOST_COMPASS_CHI2)
    feature = [
        from_fix.square().clamp_max(_MOST_BIN_FIX_SIGMAS**2) / 3.0,
        (from_fix - USUAL_FIX_SIGMAS).clamp(-2.0, 2.0),
        chi2.clamp_max(_MOST_COMPASS_CHI2) / 5.0,
    ]
    return Bins(torch.stack(feature, dim=2), possible)
