"""Take candidate pairs by twos: the pose they imply, and how well they agree.

Two mapped elements, and the distances and azimuths of two observed ones, make a triangle on the
ground. Its third side must be as long as the mapped elements are apart, which corrects the
distances by least squares; its direction is the heading. Elements on one post have no such
direction, but one must be seen above the other.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.research.pair_matcher import candidates
from semviz_core.research.training.batch import Batch

SPREAD_RAD = 0.6 * candidates.BIN_RAD
"""Width of the Gaussian weights by which a couple counts in its bin and the adjacent ones."""
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
"""Couples whose heading is less certain are dropped."""
_TURN_SIGMA_RAD = 0.01


class Couples(NamedTuple):
    """E couples (two pairs each), each in both orders."""

    first: Tensor  # (E,) row of the pair that receives the message
    second: Tensor  # (E,) row of the pair that sends it
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


def couples(
    pairs: candidates.CandidatePairs, compass: candidates.Compass, size: int
) -> tuple[Couples, Posts]:
    """Return the couples of ``size`` samples, and those on one post."""
    first, second = _pairs_of_pairs(pairs, size)
    apart = pairs.place_m[second] - pairs.place_m[first]
    length = apart.abs()
    on_one_post = candidates.rows_of(length < ON_ONE_POST_M)
    further = candidates.rows_of((length >= ON_ONE_POST_M) & (length < FARTHEST_APART_M))
    posts = _posts(pairs, first[on_one_post], second[on_one_post], apart[on_one_post])
    triangle = _Triangle.of(pairs, first[further], second[further], apart[further])
    likely = triangle.off_m.square() < _MOST_SIGMAS**2 * triangle.variance
    triangle = triangle.at(candidates.rows_of(likely))
    return _agreeing(pairs, triangle.on_sloped_road(pairs), compass), posts


def _pairs_of_pairs(pairs: candidates.CandidatePairs, size: int) -> tuple[Tensor, Tensor]:
    """Return rows (k,), (k,) of two pairs of one sample that can both be true."""
    first, second = candidates.of_one_sample(pairs.sample, pairs.sample, size)
    both = (pairs.seen[first] < pairs.seen[second]) & (pairs.mapped[first] != pairs.mapped[second])
    rows = candidates.rows_of(both)
    return first[rows], second[rows]


def _posts(pairs: candidates.CandidatePairs, first: Tensor, second: Tensor, apart: Tensor) -> Posts:
    first_m, second_m = 1.0 / pairs.nearness[first], 1.0 / pairs.nearness[second]
    turn = (pairs.direction[first] * pairs.direction[second].conj()).imag.abs()
    sideways, depth = turn * 0.5 * (first_m + second_m), (first_m - second_m).abs()
    wide = torch.hypot(pairs.wide_m[first], pairs.wide_m[second])
    kept = candidates.rows_of((sideways < ON_ONE_POST_M) & (depth < _CORRECTED_SIGMAS * wide))
    sigma = torch.hypot(pairs.sigma_m[first], pairs.sigma_m[second])
    feature = torch.stack([sideways, depth / sigma, apart.abs()], dim=1)[kept]
    first, second = first[kept], second[kept]
    return Posts(
        torch.cat([first, second]), torch.cat([second, first]), torch.cat([feature, feature])
    )


class _Triangle(NamedTuple):
    """k couples with the least-squares estimate of their two distances."""

    first: Tensor  # (k,) rows of pairs
    second: Tensor
    direction: Tensor  # (k, 2) complex: of both observed elements
    apart: Tensor  # (k,) complex: from the first mapped element to the second
    given_m: Tensor  # (k, 2) distances derived from slopes
    sigma_m: Tensor  # (k, 2)
    distance_m: Tensor  # (k, 2) corrected
    gain: Tensor  # (k, 2) derivative of the third side by them
    variance: Tensor  # (k,) of the third side
    off_m: Tensor  # (k,) by how much the third side is too short at the given distances

    @classmethod
    def of(
        cls, pairs: candidates.CandidatePairs, first: Tensor, second: Tensor, apart: Tensor
    ) -> "_Triangle":
        """Return triangles with distances for a level road, and sigmas that cover its slope."""
        both = torch.stack([first, second], dim=1)
        distance, zero = 1.0 / pairs.nearness[both], torch.zeros_like(apart.real)
        given = distance, pairs.wide_m[both], distance
        return cls(
            first, second, pairs.direction[both], apart, *given, distance, zero, zero
        )._with_corrected_distances()

    @property
    def side(self) -> Tensor:
        """(k,) complex, in the level frame: from the first element to the second."""
        at = self.direction * self.distance_m
        return at[:, 1] - at[:, 0]

    def turn(self) -> Tensor:
        """Return the rotations (k,), complex units, from the level frame to the local one."""
        return torch.sgn(self.apart * self.side.conj())

    def at(self, rows: Tensor) -> "_Triangle":
        return _Triangle(*(value.index_select(0, rows) for value in self))

    def _with_corrected_distances(self) -> "_Triangle":
        """Return the triangle after a Gauss-Newton step of the distances towards the length of the
        third side in the map."""
        side = self.side
        length = side.abs().clamp_min(_LEAST_SIDE_M)
        toward = (self.direction.conj() * side[:, None]).real / length[:, None]
        gain = torch.stack([-toward[:, 0], toward[:, 1]], dim=1)
        variance = (gain * self.sigma_m).square().sum(dim=1) + _MAP_SIGMA_M**2
        moved = (gain * (self.distance_m - self.given_m)).sum(dim=1)
        off = self.apart.abs() - length + moved
        step = self.sigma_m.square() * gain * (off / variance)[:, None]
        most = _CORRECTED_SIGMAS * self.sigma_m
        distance = (self.given_m + step.clamp(-most, most)).clamp_min(0.8 * candidates.NEAREST_M)
        return self._replace(distance_m=distance, gain=gain, variance=variance, off_m=off)

    def on_sloped_road(self, pairs: candidates.CandidatePairs) -> "_Triangle":
        """Return the triangle with distances for the road's slope under its heading, which is
        estimated alternately."""
        both = torch.stack([self.first, self.second], dim=1)
        triangle = self._replace(sigma_m=pairs.sigma_m[both])
        for _ in range(2):
            given = pairs.distance_m(triangle.turn()[:, None], both)
            triangle = triangle._replace(given_m=given)._with_corrected_distances()
        return triangle

    def turn_variance(self) -> Tensor:
        """Return the variance (k,) of the heading, given the length of the third side."""
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
        """Return chi2 (k,) of the corrections and of the remaining difference."""
        left = (self.apart.abs() - self.side.abs().clamp_min(_LEAST_SIDE_M)) / _MAP_SIGMA_M
        corrected = ((self.distance_m - self.given_m) / self.sigma_m).square().sum(dim=1)
        return corrected + left.square().clamp_max(100.0)


def _agreeing(
    pairs: candidates.CandidatePairs, triangle: _Triangle, compass: candidates.Compass
) -> Couples:
    """Return the couples that agree with the fix and the compass, in heading bins."""
    turn, chi2, variance = triangle.turn(), triangle.chi2(), triangle.turn_variance()
    camera = (
        pairs.place_m[triangle.first] - triangle.distance_m[:, 0] * triangle.direction[:, 0] * turn
    )
    from_fix = camera.abs() / pairs.fix_sigma_m[triangle.first]
    heading = torch.angle(turn)
    fits = (chi2 < _MOST_CHI2) & (from_fix < _MOST_FIX_SIGMAS) & (variance < _MOST_TURN_RAD**2)
    fits &= compass.chi2(pairs.sample[triangle.first], heading, variance) < _MOST_COMPASS_CHI2
    kept = candidates.rows_of(fits)
    feature = torch.stack(
        [
            chi2 / 5.0,
            chi2.sqrt(),
            triangle.variance.log(),
            0.5 * variance.log() + 3.0,
            triangle.apart.abs().log() - 2.5,
            from_fix,
            (from_fix - candidates.USUAL_FIX_SIGMAS).abs(),
        ],
        dim=1,
    )[kept]
    first, second = triangle.first[kept], triangle.second[kept]
    bins, weight = _spread(heading[kept], variance[kept])
    both = torch.cat([first, second]), torch.cat([second, first])
    values = feature, bins, weight, camera[kept], turn[kept]
    return Couples(*both, *(torch.cat([value, value]) for value in values))


def _spread(heading_rad: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the three nearest bins (k, 3) of each heading, and their weights."""
    at = heading_rad / candidates.BIN_RAD
    bins = at.round()[:, None] + torch.arange(-1, 2, device=at.device)
    chi2 = ((bins - at[:, None]) * candidates.BIN_RAD).square() / (variance + SPREAD_RAD**2)[
        :, None
    ]
    return torch.remainder(bins, candidates.BINS).long(), torch.exp(-0.5 * chi2)


PAIR_FEATURES, BIN_FEATURES, COUPLE_FEATURES, POST_FEATURES = 14, 3, 7, 3


@dataclass(frozen=True, eq=False)
class Prepared:
    """b samples with N candidate pairs, E couples and F posts in all."""

    batch: Batch
    pairs: candidates.CandidatePairs
    compass: candidates.Compass
    feature: Tensor  # (N, PAIR_FEATURES)
    bins: candidates.Bins
    couples: Couples
    posts: Posts

    @classmethod
    @torch.no_grad()
    def of(cls, batch: Batch) -> "Prepared":
        """Return the prepared batch. Nothing here is learned, so workers do it."""
        pairs, compass = candidates.candidate_pairs(batch), candidates.Compass.of(batch)
        pair_couples, posts = couples(pairs, compass, len(batch))
        return cls(
            batch=batch,
            pairs=pairs,
            compass=compass,
            feature=_features(pairs, batch),
            bins=candidates.in_bins(pairs, compass),
            couples=pair_couples,
            posts=posts,
        )

    @property
    def fix_sigma_m(self) -> Tensor:
        """(b,) sigma of the fix."""
        return candidates.FIX_UNIT_M * self.batch.prior[:, 4]

    def to(self, device: torch.device) -> "Prepared":
        """Return the batch on a device."""
        return Prepared(
            self.batch.to(device),
            self.pairs.to(device),
            candidates.Compass(*(value.to(device) for value in self.compass)),
            self.feature.to(device),
            candidates.Bins(*(value.to(device) for value in self.bins)),
            Couples(*(couple.to(device) for couple in self.couples)),
            Posts(*(post.to(device) for post in self.posts)),
        )


def _features(pairs: candidates.CandidatePairs, batch: Batch) -> Tensor:
    """Return (N, PAIR_FEATURES): agreement of slopes and distance, the distance, and crowding.

    The detector's score is left out: in simulated frames it separates false positives perfectly.
    """
    anchor, end = pairs.off.unbind(dim=1)
    seen, mapped = batch.possible.shape[1:]
    by_seen = torch.bincount(pairs.sample * seen + pairs.seen, minlength=len(batch) * seen)
    rivals = by_seen[pairs.sample * seen + pairs.seen]
    by_mapped = torch.bincount(pairs.sample * mapped + pairs.mapped, minlength=len(batch) * mapped)
    competitors = by_mapped[pairs.sample * mapped + pairs.mapped]
    features = [
        anchor,
        anchor.square().clamp_max(16.0) / 4.0,
        end.clamp(-6.0, 6.0),
        end.square().clamp_max(16.0) / 4.0,
        (end > 3.0).to(end.dtype),
        *pairs.known.to(end.dtype).unbind(dim=1),
        -pairs.nearness.log() - 2.7,
        (pairs.sigma_m * pairs.nearness).log(),
        pairs.slope_sigma.log() + 4.0,
        pairs.fix_sigma_m.log() - 2.0,
        rivals.log() - 2.0,
        competitors.log() - 1.0,
        batch.seen.sum(dim=1)[pairs.sample].log() - 2.0,
    ]
    return torch.stack(features, dim=1)
