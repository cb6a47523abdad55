"""The last word of the learned matcher: whole poses, each rated by all pairs that agree with it."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from semviz_core.learning.candidates.combos import best_of_alike, best_of_each
from semviz_core.learning.candidates.headings import BINS
from semviz_core.learning.candidates.poses import (
    POSE_FEATURES,
    SUPPORT_FEATURES,
    Poses,
    Support,
    fitted,
    support,
)
from semviz_core.learning.candidates.prepared import Prepared
from semviz_core.learning.networks.perceptron import perceptron, single

POSES = 192
"""Couples of a sample that become poses: those that the rounds before make likeliest."""
_CELL_M, _CELLS = 2.0, 512
"""Of couples in one square, under one heading, the likeliest is enough."""
_MOST_NATS = 10.0
_LEAST = 1e-5


class Rated(NamedTuple):
    """Poses and what they make of the pairs."""

    poses: Poses
    share: Tensor
    """(h,) probability of each among those of its sample, and none of them."""
    pair: Tensor
    """(N,) probability of each candidate pair."""
    odds: Tensor
    """(N,) its logarithm, against that of no pair for the seen element."""
    surest: Tensor
    """(b,) the largest share."""
    score: Tensor
    """(b,) nats of the best pose."""


class PoseRound(nn.Module):
    """Rates the poses that the likeliest couples propose."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.of_support = perceptron(SUPPORT_FEATURES + channels, hidden, 1)
        self.of_pose = perceptron(POSE_FEATURES + 3, hidden, 1)

    def forward(self, prepared: Prepared, told: Tensor, worth: Tensor) -> Rated:
        """Candidate pairs are described by ``told`` (N, channels), couples worth (E,) nats."""
        b, m, n = prepared.batch.possible.shape
        pairs = prepared.pairs
        poses, chosen = _proposed(prepared, worth)
        agree = support(poses, pairs, b)
        inputs = [agree.feature, told[agree.pair]]
        likelihood = single(self.of_support, inputs).clamp(-_MOST_NATS, _MOST_NATS).exp()
        seen = agree.pose * m + pairs.seen[agree.pair]
        mapped = agree.pose * n + pairs.mapped[agree.pair]
        h = len(poses.sample)
        by_seen, by_mapped = (
            torch.ones(size, device=seen.device).index_add(0, row, likelihood)
            for size, row in ((h * m, seen), (h * n, mapped))
        )
        ends = [by_seen.log().view(h, m).sum(dim=1), by_mapped.log().view(h, n).sum(dim=1)]
        prior = poses.to_prior(prepared.fix_sigma_m, prepared.compass)
        known = torch.stack([one / 4.0 for one in (worth[chosen], *ends)], dim=1)
        score = ends[0].minimum(ends[1]) + single(self.of_pose, [prior, known])
        share, highest = _among(score, poses.sample, b)
        inside = likelihood / by_seen[seen].maximum(by_mapped[mapped])
        return _rated(prepared, poses, agree, share, inside, highest)


def _proposed(prepared: Prepared, worth: Tensor) -> tuple[Poses, Tensor]:
    """Fitted poses of the best couples, and the rows of these; nothing here has a gradient."""
    couples, sample = prepared.couples, prepared.pairs.sample
    half = len(couples.first) // 2  # the rest is the same in the other order
    of_couple, worth = sample[couples.first[:half]], worth[:half].detach()
    size = len(prepared.batch)
    alike = _cell(of_couple, couples.camera_m[:half], couples.bin[:half, 1])
    apart = best_of_alike(worth, alike)
    chosen = apart[best_of_each(worth[apart], of_couple[apart], size, POSES)]
    start = Poses(of_couple[chosen], couples.camera_m[chosen], couples.turn[chosen])
    return fitted(start, prepared.pairs, size), chosen


def _cell(sample: Tensor, camera_m: Tensor, heading: Tensor) -> Tensor:
    """(k,) number of the sample, square and heading in which a pose is."""
    east, north = (
        torch.round(one / _CELL_M).long().clamp(-_CELLS, _CELLS - 1) + _CELLS
        for one in (camera_m.real, camera_m.imag)
    )
    return ((sample * 2 * _CELLS + east) * 2 * _CELLS + north) * BINS + heading


def _among(score: Tensor, sample: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """(h,) shares of poses in their sample, where none at all has a score of 0; (b,) the best."""
    highest = score.new_zeros(size).scatter_reduce(0, sample, score.detach(), "amax")
    odds = (score - highest[sample]).exp()
    total = (-highest).exp().index_add(0, sample, odds)
    return odds / total[sample], highest


def _rated(
    prepared: Prepared, poses: Poses, agree: Support, share: Tensor, inside: Tensor, score: Tensor
) -> Rated:
    """What poses make of pairs, given each pair's probability ``inside`` (k,) those it supports."""
    b, m, _ = prepared.batch.possible.shape
    pairs = prepared.pairs
    row = pairs.sample * m + pairs.seen
    nothing = torch.zeros(len(row), device=share.device)
    pair = nothing.index_add(0, agree.pair, share[agree.pose] * inside)
    taken = torch.zeros(b * m, device=share.device).index_add(0, row, pair)
    odds = (pair + _LEAST).log() - (1.0 - taken.clamp_max(1.0 - 10.0 * _LEAST))[row].log()
    surest = share.new_zeros(b).scatter_reduce(0, poses.sample, share, "amax")
    return Rated(poses, share, pair, odds, surest, score)
