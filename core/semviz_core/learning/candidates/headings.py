"""Headings in bins: where a pair puts the camera for each of them, against fix and compass."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.learning.batch import Batch
from semviz_core.learning.candidates.pairs import Pairs

BINS = 36
"""Ten degrees each."""
BIN_RAD = 2.0 * math.pi / BINS
_MOST_FIX_SIGMAS = 3.0
_MOST_COMPASS_CHI2 = 14.0
_BIN_SIGMA_RAD = 0.05  # within a bin
_COMPASS_UNIT_RAD = 0.1  # of its sigma among the prior's numbers
USUAL_FIX_SIGMAS = 1.3
"""How far off fixes are, in the middle of what is usual."""


class Compass(NamedTuple):
    """What the prior says of the heading."""

    known: Tensor  # (b,) bool
    heading_rad: Tensor  # (b,)
    sigma_rad: Tensor  # (b,)

    @classmethod
    def of(cls, batch: Batch) -> "Compass":
        x, y, log_sigma = batch.prior[:, 5:8].unbind(dim=1)
        return cls(x**2 + y**2 > 0.5, torch.atan2(y, x), _COMPASS_UNIT_RAD * log_sigma.exp())

    def chi2(self, sample: Tensor, heading_rad: Tensor, variance: Tensor | float) -> Tensor:
        """(...,) of headings (...,) in frames ``sample``; 0 where there is no compass."""
        off = torch.remainder(heading_rad - self.heading_rad[sample] + math.pi, 2.0 * math.pi)
        chi2 = (off - math.pi).square() / (self.sigma_rad[sample].square() + variance)
        return torch.where(self.known[sample], chi2, 0.0)


class Bins(NamedTuple):
    """N pairs under each heading."""

    feature: Tensor
    """(N, BINS, 3)"""
    possible: Tensor
    """(N, BINS) bool: neither fix nor compass rules it out."""


def in_bins(pairs: Pairs, compass: Compass) -> Bins:
    """How far the camera would be from the fix, and the heading from the compass."""
    heading = torch.arange(BINS, device=pairs.nearness.device) * BIN_RAD
    rows = torch.arange(len(pairs.sample), device=heading.device)[:, None]
    turn = torch.polar(torch.ones_like(heading), heading)
    sight = pairs.distance_m(turn, rows) * pairs.direction[:, None] * turn
    sigma = torch.hypot(pairs.fix_sigma_m, pairs.sigma_m)
    from_fix = (pairs.place_m[:, None] - sight).abs() / sigma[:, None]
    chi2 = compass.chi2(pairs.sample[:, None], heading, _BIN_SIGMA_RAD**2)
    possible = (from_fix < _MOST_FIX_SIGMAS) & (chi2 < _MOST_COMPASS_CHI2)
    feature = [
        from_fix.square().clamp_max(_MOST_FIX_SIGMAS**2) / 3.0,
        (from_fix - USUAL_FIX_SIGMAS).clamp(-2.0, 2.0),
        chi2.clamp_max(_MOST_COMPASS_CHI2) / 5.0,
    ]
    return Bins(torch.stack(feature, dim=2), possible)
