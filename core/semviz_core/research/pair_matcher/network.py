"""The pair matcher's network in torch, for training: batches, with gradients.

It is the network of `semviz_core.localization.correspondences.network`, which describes it and
runs it on one frame without torch. Names and sizes of layers come from there. The geometry of each
frame, in which nothing is learned, is that of inference too; workers compute it and a batch
concatenates it.

Rotating the local frame by a whole bin rotates the bins and changes no round; of the poses,
only the choice among close ones changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.correspondences.candidate_pairs import (
    BINS,
    Compass,
    Sample,
    candidate_pairs,
    in_bins,
)
from semviz_core.localization.correspondences.couples import (
    Couples,
    FrameGeometry,
    Posts,
    pair_features,
)
from semviz_core.localization.correspondences.network import (
    CHANNELS,
    LARGEST,
    LEAST,
    LEAST_ODDS,
    MOST_NATS,
    MOST_ODDS,
    ROUNDS,
    RULED_OUT,
    SMALLEST,
    layer_sizes,
    proposed_poses,
)
from semviz_core.research.training.batch import Batch


class AgreeingPairs(NamedTuple):
    """E couples or posts, each in both orders."""

    first: Tensor  # (2E,) row of the pair that receives the message
    second: Tensor  # (2E,) row of the pair that sends it
    feature: Tensor  # (2E, features)

    @classmethod
    def of(cls, parts: Sequence[Couples | Posts], start: Sequence[int]) -> "AgreeingPairs":
        """Return those of all frames, whose pairs begin at the rows ``start`` (b,)."""
        first = _rows([part.first for part in parts], start)
        second = _rows([part.second for part in parts], start)
        feature = _floats([part.feature for part in parts])
        both = torch.cat([first, second]), torch.cat([second, first])
        return cls(*both, feature=torch.cat([feature, feature]))


class Proposed(NamedTuple):
    """h fitted poses of a batch and their k agreements with pairs, as in ``ProposedPoses``."""

    sample: Tensor  # (h,)
    couple: Tensor  # (h,)
    prior: Tensor  # (h, 3)
    pose: Tensor  # (k,)
    pair: Tensor  # (k,)
    feature: Tensor  # (k, 7)


@dataclass(frozen=True, eq=False)
class Prepared:
    """b samples with N candidate pairs, E couples and F posts in all."""

    batch: Batch
    frames: tuple[FrameGeometry, ...]
    sample: Tensor  # (N,) number of the sample
    seen: Tensor  # (N,) column of the batch's observed elements
    mapped: Tensor  # (N,) column of the batch's mapped elements
    feature: Tensor  # (N, PAIR_FEATURES)
    bin_feature: Tensor  # (N, BINS, BIN_FEATURES)
    possible: Tensor  # (N, BINS)
    couples: AgreeingPairs
    bin: Tensor  # (2E, 3) headings of couples
    weight: Tensor  # (2E, 3)
    posts: AgreeingPairs

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> "Prepared":
        frames = tuple(_geometry(sample) for sample in samples)
        pairs, couples = [frame.pairs for frame in frames], [frame.couples for frame in frames]
        bins = [in_bins(frame.pairs, frame.compass) for frame in frames]
        sizes = [len(frame.seen) for frame in pairs]
        seen = [len(sample.ray) for sample in samples]
        bin = _rows([frame.bin for frame in couples], [0] * len(frames))
        weight = _floats([frame.weight for frame in couples])
        return cls(
            batch=Batch.of(samples),
            frames=frames,
            sample=torch.from_numpy(np.repeat(np.arange(len(frames)), sizes)),
            seen=_rows([frame.seen for frame in pairs], [0] * len(frames)),
            mapped=_rows([frame.mapped for frame in pairs], [0] * len(frames)),
            feature=_floats([pair_features(*both) for both in zip(pairs, seen, strict=True)]),
            bin_feature=_floats([frame.feature for frame in bins]),
            possible=torch.from_numpy(np.concatenate([frame.possible for frame in bins])),
            couples=AgreeingPairs.of(couples, _starts(sizes)),
            bin=torch.cat([bin, bin]),
            weight=torch.cat([weight, weight]),
            posts=AgreeingPairs.of([frame.posts for frame in frames], _starts(sizes)),
        )

    def to(self, device: torch.device) -> "Prepared":
        """Return the batch on a device; the frames' geometry stays in memory."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, value in values.items():
            if isinstance(value, AgreeingPairs):
                values[name] = AgreeingPairs(*(tensor.to(device) for tensor in value))
            elif name != "frames":
                values[name] = value.to(device)
        return Prepared(**values)

    def proposed(self, couple_score: Tensor) -> Proposed:
        """Return the fitted poses of the best couples by score (E,); they have no gradient."""
        score = couple_score.detach().double().cpu().numpy()
        counts = [len(frame.couples.first) for frame in self.frames]
        scores = np.split(score, np.cumsum(counts)[:-1])
        parts = [
            proposed_poses(frame.pairs, frame.compass, frame.couples, of_frame)
            for frame, of_frame in zip(self.frames, scores, strict=True)
        ]
        sizes = [len(part.couple) for part in parts]
        pairs = [len(frame.pairs.seen) for frame in self.frames]
        found = Proposed(
            torch.from_numpy(np.repeat(np.arange(len(parts)), sizes)),
            _rows([part.couple for part in parts], _starts(counts)),
            _floats([part.prior for part in parts]),
            _rows([part.pose for part in parts], _starts(sizes)),
            _rows([part.pair for part in parts], _starts(pairs)),
            _floats([part.feature for part in parts]),
        )
        return Proposed(*(tensor.to(couple_score.device) for tensor in found))


def _geometry(sample: Sample) -> FrameGeometry:
    possible = sample.seen_class[:, None] == sample.mapped_class
    return FrameGeometry.of(candidate_pairs(sample, possible), Compass.of(sample))


def _starts(sizes: list[int]) -> list[int]:
    return [0, *accumulate(sizes[:-1])]


def _rows(parts: Sequence[IntArray], start: Sequence[int]) -> Tensor:
    """Return row numbers of all frames, each frame's counted from its ``start``."""
    return torch.from_numpy(
        np.concatenate([part + first for part, first in zip(parts, start, strict=True)])
    )


def _floats(parts: Sequence[FloatArray]) -> Tensor:
    return torch.from_numpy(np.concatenate(parts).astype(np.float32))


def perceptron(name: str) -> nn.Module:
    """Return the perceptron of ``layer_sizes`` with this name; it has one hidden layer."""
    inputs, hidden, outputs = layer_sizes()[name]
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def single(network: nn.Module, inputs: list[Tensor]) -> Tensor:
    """Return the network's only output (...,), float32, for concatenated inputs (..., k)."""
    number: Tensor = network(torch.cat(inputs, dim=-1))[..., 0].float()
    return number


class Rated(NamedTuple):
    """The pairs' probabilities that follow from poses."""

    pair: Tensor
    """(N,) probability of each candidate pair."""
    odds: Tensor
    """(N,) log-odds of each candidate pair against no pair of its observed element."""
    largest_share: Tensor
    """(b,) the largest share."""
    score: Tensor
    """(b,) nats of the best pose."""


class PoseRound(nn.Module):
    """Rates the poses proposed by the best couples."""

    def __init__(self) -> None:
        super().__init__()
        self.of_support = perceptron("by_pose.of_support")
        self.of_pose = perceptron("by_pose.of_pose")

    def forward(self, prepared: Prepared, encoding: Tensor, couple_score: Tensor) -> Rated:
        """Rate poses, given the pairs' ``encoding`` (N, channels) and ``couple_score`` (E,) in
        nats."""
        b, m, n = prepared.batch.possible.shape
        poses = prepared.proposed(couple_score)
        nats = single(self.of_support, [poses.feature, encoding[poses.pair]])
        likelihood = nats.clamp(-MOST_NATS, MOST_NATS).exp()
        seen = poses.pose * m + prepared.seen[poses.pair]
        mapped = poses.pose * n + prepared.mapped[poses.pair]
        h = len(poses.sample)
        by_seen, by_mapped = (
            torch.ones(size, device=seen.device).index_add(0, row, likelihood)
            for size, row in ((h * m, seen), (h * n, mapped))
        )
        ends = [by_seen.log().view(h, m).sum(dim=1), by_mapped.log().view(h, n).sum(dim=1)]
        known = torch.stack([end / 4.0 for end in (couple_score[poses.couple], *ends)], dim=1)
        score = ends[0].minimum(ends[1]) + single(self.of_pose, [poses.prior, known])
        share, highest = _shares_in_sample(score, poses.sample, b)
        inside = likelihood / by_seen[seen].maximum(by_mapped[mapped])
        return _rated(prepared, poses, share, inside, highest)


def _shares_in_sample(score: Tensor, sample: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the shares (h,) of poses in their sample, "none" having a score of 0, and the best
    score (b,)."""
    highest = score.new_zeros(size).scatter_reduce(0, sample, score.detach(), "amax")
    odds = (score - highest[sample]).exp()
    total = (-highest).exp().index_add(0, sample, odds)
    return odds / total[sample], highest


def _rated(
    prepared: Prepared, poses: Proposed, share: Tensor, inside: Tensor, score: Tensor
) -> Rated:
    """Return the pairs' probabilities, given those under each pose, ``inside`` (k,)."""
    b, m, _ = prepared.batch.possible.shape
    row = prepared.sample * m + prepared.seen
    nothing = torch.zeros(len(row), device=share.device)
    pair = nothing.index_add(0, poses.pair, share[poses.pose] * inside)
    taken = torch.zeros(b * m, device=share.device).index_add(0, row, pair)
    odds = (pair + LEAST).log() - (1.0 - taken.clamp_max(1.0 - 10.0 * LEAST))[row].log()
    largest_share = share.new_zeros(b).scatter_reduce(0, poses.sample, share, "amax")
    return Rated(pair, odds, largest_share, score)


class ConsensusNetwork(nn.Module):
    """Network that returns the log-odds of pairs."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.of_class = nn.Embedding(classes, CHANNELS)
        self.of_pair = perceptron("of_pair")
        self.of_couple = perceptron("of_couple")
        self.of_post = perceptron("of_post")
        rounds = range(ROUNDS + 1)
        self.of_belief = nn.ModuleList(perceptron(f"of_belief.{k}") for k in rounds)
        self.by_pose = PoseRound()
        self.last = perceptron("last")

    def forward(self, prepared: Prepared) -> Tensor:
        """Return the log-odds (b, m, n) of pairs against no pair."""
        b, m, n = prepared.batch.possible.shape
        number = prepared.batch.seen_class[prepared.sample, prepared.seen]
        inputs = torch.cat([prepared.feature, self.of_class(number)], dim=1)
        encoding = self.of_pair(inputs).float()
        couple_nats = self.of_couple(prepared.couples.feature).float().clamp_max(LARGEST)
        belief = self._belief(prepared, encoding, couple_nats)

        row = prepared.sample * m + prepared.seen
        share, total = _shares_by_heading(belief, row, b * m)
        heading = torch.log_softmax(_headings(total, b), dim=1)
        log_total = total.log()
        pair = (belief - log_total[row] + heading[prepared.sample]).logsumexp(dim=1)
        nothing = (heading.repeat_interleave(m, dim=0) - log_total).logsumexp(dim=1)
        odds = pair - nothing[row]
        score = _couple_scores(prepared, share, heading, couple_nats[:, -1])
        rated = self.by_pose(prepared, encoding, score)
        known = [
            odds / 4.0,
            belief.amax(dim=1).clamp_min(LEAST_ODDS) / 4.0,
            encoding[:, 0],
            share.amax(dim=1),
            heading.amax(dim=1)[prepared.sample],
            rated.odds / 4.0,
            rated.pair,
            rated.largest_share[prepared.sample],
            rated.score[prepared.sample] / 10.0,
        ]
        odds = 0.5 * (odds + rated.odds) + single(self.last, [torch.stack(known, dim=1)])
        ruled_out = odds.new_full((b, m, n), LEAST_ODDS)
        at = prepared.sample, prepared.seen, prepared.mapped
        log_odds: Tensor = ruled_out.index_put(at, odds.clamp(LEAST_ODDS, MOST_ODDS))
        return log_odds

    def _belief(self, prepared: Prepared, encoding: Tensor, couple_nats: Tensor) -> Tensor:
        """Return the log-odds (N, BINS) of pairs under each heading, after all rounds."""
        b, m, _ = prepared.batch.possible.shape
        sample, row = prepared.sample, prepared.sample * m + prepared.seen
        alone, channels = encoding[:, :1].expand(-1, BINS), encoding[:, 1:]
        inputs = [prepared.bin_feature, channels[:, None].expand(-1, BINS, -1)]
        ruled_out = torch.where(prepared.possible, 0.0, RULED_OUT)
        by_couple = couple_nats.exp()
        by_post = self.of_post(prepared.posts.feature).float().clamp_max(LARGEST).exp()
        belief = alone + single(self.of_belief[0], [*inputs, alone[..., None]]) + ruled_out
        for k in range(ROUNDS):
            share, total = _shares_by_heading(belief, row, b * m)
            messages = _messages(prepared, share, by_couple[:, k], by_post[:, k])
            heading = _headings(total, b)[sample]
            known = [alone, messages, belief.clamp_min(LEAST_ODDS) / 4.0, heading, share]
            more = single(self.of_belief[k + 1], [*inputs, torch.stack(known, dim=2)])
            belief = messages + more + ruled_out
        return belief


def _shares_by_heading(belief: Tensor, row: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Return the probability (N, BINS) of each pair under each heading, among those of its observed
    element and none; and the normalization (rows, BINS)."""
    odds = belief.clamp_max(MOST_ODDS).exp()
    total = torch.ones((rows, BINS), device=odds.device).index_add(0, row, odds)
    return odds / total[row], total


def _headings(total: Tensor, size: int) -> Tensor:
    """Return the log-odds (b, BINS) of headings against the average one."""
    evidence = total.log().view(size, -1, BINS).sum(dim=1)
    return evidence - evidence.mean(dim=1, keepdim=True)


def _messages(prepared: Prepared, share: Tensor, by_couple: Tensor, by_post: Tensor) -> Tensor:
    """Return the nats (N, BINS) that each pair receives from the other observed elements."""
    couples, posts, seen = prepared.couples, prepared.posts, prepared.seen
    m = prepared.batch.seen.shape[1]
    rows = len(seen) * m
    weighted = by_couple[:, None] * prepared.weight * share[couples.second[:, None], prepared.bin]
    from_seen = couples.first * m + seen[couples.second]
    at = from_seen[:, None] * BINS + prepared.bin
    message = torch.zeros(rows * BINS, device=share.device)
    message = message.index_add(0, at.flatten(), weighted.flatten()).view(rows, BINS)
    from_seen = posts.first * m + seen[posts.second]
    message = message.index_add(0, from_seen, by_post[:, None] * share[posts.second])
    return torch.log1p(message).view(-1, m, BINS).sum(dim=1)


def _couple_scores(
    prepared: Prepared, share: Tensor, heading: Tensor, couple_nats: Tensor
) -> Tensor:
    """Return the nats (E,) of couples: of both pairs, their agreement and the heading."""
    half = len(couple_nats) // 2  # the second half repeats them in the other order
    first, second = prepared.couples.first[:half], prepared.couples.second[:half]
    nearest = prepared.bin[:half, 1]
    couple_score = couple_nats[:half] + heading[prepared.sample[first], nearest]
    for end in (first, second):
        couple_score = couple_score + share[end, nearest].clamp_min(SMALLEST).log()
    return couple_score
