"""Candidate pairs by twos: where the camera would be, and how well they agree, if both were true.

Two mapped elements and the distances and azimuths of two seen ones make a triangle on the ground.
Its third side must be as long as the mapped elements are apart, which corrects the distances by
least squares, and its direction is the heading. Elements on one post have no such direction, but
must be seen one above the other.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.learning.candidates.combos import of_one_sample, rows_of
from semviz_core.learning.candidates.headings import BIN_RAD, BINS, USUAL_FIX_SIGMAS, Compass
from semviz_core.learning.candidates.pairs import NEAREST_M, Pairs

SPREAD_RAD = 0.6 * BIN_RAD
"""A couple counts in its bin and in those beside it, less by how far off they are."""
ON_ONE_POST_M = 1.5
FARTHEST_APART_M = 85.0
_MAP_SIGMA_M = 0.25
_LEAST_SIDE_M = 0.3
_MOST_SIGMAS = 5.0
"""By which the third side may differ at first."""
_CORRECTED_SIGMAS = 3.0
_MOST_CHI2 = 16.0
_MOST_FIX_SIGMAS = 2.8
_MOST_COMPASS_CHI2 = 12.0
_MOST_TURN_RAD = 0.5
"""Couples that know their heading less well tell nothing."""
_TURN_SIGMA_RAD = 0.01


class Couples(NamedTuple):
    """E couples, each in both orders."""

    first: Tensor  # (E,) row of the pair that is told
    second: Tensor  # (E,) row of the pair that tells
    feature: Tensor  # (E, 7)
    bin: Tensor  # (E, 3) headings
    weight: Tensor  # (E, 3) of these, in (0, 1]
    camera_m: Tensor  # (E,) complex
    turn: Tensor  # (E,) complex, unit: from the level frame to the local one


class Posts(NamedTuple):
    """F couples of elements on one post, each in both orders; they agree in every heading."""

    first: Tensor  # (F,)
    second: Tensor  # (F,)
    feature: Tensor  # (F, 3)


def couples(pairs: Pairs, compass: Compass, size: int) -> tuple[Couples, Posts]:
    """Of ``size`` samples."""
    first, second = _by_twos(pairs, size)
    apart = pairs.place_m[second] - pairs.place_m[first]
    length = apart.abs()
    on_one_post = rows_of(length < ON_ONE_POST_M)
    further = rows_of((length >= ON_ONE_POST_M) & (length < FARTHEST_APART_M))
    posts = _posts(pairs, first[on_one_post], second[on_one_post], apart[on_one_post])
    triangle = _Triangle.of(pairs, first[further], second[further], apart[further])
    likely = triangle.off_m.square() < _MOST_SIGMAS**2 * triangle.variance
    triangle = triangle.at(rows_of(likely))
    return _agreeing(pairs, triangle.settled(pairs), compass), posts


def _by_twos(pairs: Pairs, size: int) -> tuple[Tensor, Tensor]:
    """(k,), (k,) rows of two pairs of one sample that may both be true."""
    first, second = of_one_sample(pairs.sample, pairs.sample, size)
    both = (pairs.seen[first] < pairs.seen[second]) & (pairs.mapped[first] != pairs.mapped[second])
    rows = rows_of(both)
    return first[rows], second[rows]


def _posts(pairs: Pairs, first: Tensor, second: Tensor, apart: Tensor) -> Posts:
    one, other = 1.0 / pairs.nearness[first], 1.0 / pairs.nearness[second]
    turn = (pairs.direction[first] * pairs.direction[second].conj()).imag.abs()
    beside, deeper = turn * 0.5 * (one + other), (one - other).abs()
    wide = torch.hypot(pairs.wide_m[first], pairs.wide_m[second])
    kept = rows_of((beside < ON_ONE_POST_M) & (deeper < _CORRECTED_SIGMAS * wide))
    sigma = torch.hypot(pairs.sigma_m[first], pairs.sigma_m[second])
    feature = torch.stack([beside, deeper / sigma, apart.abs()], dim=1)[kept]
    first, second = first[kept], second[kept]
    return Posts(
        torch.cat([first, second]), torch.cat([second, first]), torch.cat([feature, feature])
    )


class _Triangle(NamedTuple):
    """k couples with what least squares knows of the two distances."""

    first: Tensor  # (k,) rows of pairs
    second: Tensor
    direction: Tensor  # (k, 2) complex: of both seen elements
    apart: Tensor  # (k,) complex: from the first mapped element to the second
    given_m: Tensor  # (k, 2) distances that slopes tell
    sigma_m: Tensor  # (k, 2)
    distance_m: Tensor  # (k, 2) corrected
    gain: Tensor  # (k, 2) how the third side grows with them
    variance: Tensor  # (k,) of the third side
    off_m: Tensor  # (k,) what the third side is too short by, as given

    @classmethod
    def of(cls, pairs: Pairs, first: Tensor, second: Tensor, apart: Tensor) -> "_Triangle":
        """With distances for a level road, and sigmas that cover what it may rise."""
        both = torch.stack([first, second], dim=1)
        distance, nothing = 1.0 / pairs.nearness[both], torch.zeros_like(apart.real)
        given = distance, pairs.wide_m[both], distance
        return cls(
            first, second, pairs.direction[both], apart, *given, distance, nothing, nothing
        )._corrected()

    @property
    def side(self) -> Tensor:
        """(k,) complex, in the level frame: from the first element to the second."""
        at = self.direction * self.distance_m
        return at[:, 1] - at[:, 0]

    def turn(self) -> Tensor:
        """(k,) complex, unit: from the level frame to the local one."""
        return torch.sgn(self.apart * self.side.conj())

    def at(self, rows: Tensor) -> "_Triangle":
        return _Triangle(*(one.index_select(0, rows) for one in self))

    def _corrected(self) -> "_Triangle":
        """After a Gauss-Newton step to distances that make the third side as long as it is."""
        side = self.side
        length = side.abs().clamp_min(_LEAST_SIDE_M)
        toward = (self.direction.conj() * side[:, None]).real / length[:, None]
        gain = torch.stack([-toward[:, 0], toward[:, 1]], dim=1)
        variance = (gain * self.sigma_m).square().sum(dim=1) + _MAP_SIGMA_M**2
        moved = (gain * (self.distance_m - self.given_m)).sum(dim=1)
        off = self.apart.abs() - length + moved
        step = self.sigma_m.square() * gain * (off / variance)[:, None]
        most = _CORRECTED_SIGMAS * self.sigma_m
        distance = (self.given_m + step.clamp(-most, most)).clamp_min(0.8 * NEAREST_M)
        return self._replace(distance_m=distance, gain=gain, variance=variance, off_m=off)

    def settled(self, pairs: Pairs) -> "_Triangle":
        """With distances for the road as it rises under the heading that is found meanwhile."""
        both = torch.stack([self.first, self.second], dim=1)
        now = self._replace(sigma_m=pairs.sigma_m[both])
        for _ in range(2):
            given = pairs.distance_m(now.turn()[:, None], both)
            now = now._replace(given_m=given)._corrected()
        return now

    def turn_variance(self) -> Tensor:
        """(k,) of the heading, with the third side's length taken into account."""
        side = self.side
        by = (self.direction * side[:, None].conj()).imag / side.abs().square().clamp_min(
            _LEAST_SIDE_M**2
        )[:, None]
        by = torch.stack([by[:, 0], -by[:, 1]], dim=1)
        shared = (by * self.gain * self.sigma_m.square()).sum(dim=1)
        own = (by * self.sigma_m).square().sum(dim=1) - shared.square() / self.variance
        of_map = (_LEAST_SIDE_M / self.apart.abs()).square()
        return own.clamp_min(0.0) + of_map + _TURN_SIGMA_RAD**2

    def chi2(self) -> Tensor:
        """(k,) of the corrections and of what they leave."""
        left = (self.apart.abs() - self.side.abs().clamp_min(_LEAST_SIDE_M)) / _MAP_SIGMA_M
        corrected = ((self.distance_m - self.given_m) / self.sigma_m).square().sum(dim=1)
        return corrected + left.square().clamp_max(100.0)


def _agreeing(pairs: Pairs, triangle: _Triangle, compass: Compass) -> Couples:
    """Those that fit the fix and the compass, in bins."""
    turn, chi2, variance = triangle.turn(), triangle.chi2(), triangle.turn_variance()
    camera = (
        pairs.place_m[triangle.first] - triangle.distance_m[:, 0] * triangle.direction[:, 0] * turn
    )
    from_fix = camera.abs() / pairs.fix_sigma_m[triangle.first]
    heading = torch.angle(turn)
    fits = (chi2 < _MOST_CHI2) & (from_fix < _MOST_FIX_SIGMAS) & (variance < _MOST_TURN_RAD**2)
    fits &= compass.chi2(pairs.sample[triangle.first], heading, variance) < _MOST_COMPASS_CHI2
    kept = rows_of(fits)
    feature = torch.stack(
        [
            chi2 / 5.0,
            chi2.sqrt(),
            triangle.variance.log(),
            0.5 * variance.log() + 3.0,
            triangle.apart.abs().log() - 2.5,
            from_fix,
            (from_fix - USUAL_FIX_SIGMAS).abs(),
        ],
        dim=1,
    )[kept]
    first, second = triangle.first[kept], triangle.second[kept]
    bins, weight = _spread(heading[kept], variance[kept])
    both = torch.cat([first, second]), torch.cat([second, first])
    values = feature, bins, weight, camera[kept], turn[kept]
    return Couples(*both, *(torch.cat([one, one]) for one in values))


def _spread(heading_rad: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """(k, 3) nearest bins, and how much each counts."""
    at = heading_rad / BIN_RAD
    bins = at.round()[:, None] + torch.arange(-1, 2, device=at.device)
    chi2 = ((bins - at[:, None]) * BIN_RAD).square() / (variance + SPREAD_RAD**2)[:, None]
    return torch.remainder(bins, BINS).long(), torch.exp(-0.5 * chi2)
