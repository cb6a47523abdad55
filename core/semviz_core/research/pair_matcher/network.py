"""The pair matcher's network: candidate pairs exchange evidence for a pose.

Cross-attention whose weights geometry restricts. The attending unit is a pair of an observed
and a mapped element under a heading, so it is a whole pose hypothesis. Geometry decides whether
two pairs agree (`couples`). The network learns how much that, the slopes, the fix and the
compass are worth. Every pair receives, from each other observed element, the best evidence of
its correspondences, with "no match" among them. So the rounds approach the probabilities of
one-to-one pairs, as belief propagation does. The best couples are fitted as poses and rated by
all pairs that agree.

Rotating the local frame by a whole bin rotates the bins and changes no round; of the poses,
only the choice among close ones changes.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from semviz_core.research.pair_matcher import candidates
from semviz_core.research.pair_matcher.couples import (
    BIN_FEATURES,
    COUPLE_FEATURES,
    PAIR_FEATURES,
    POST_FEATURES,
    Prepared,
)


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Module:
    """Return a perceptron with one hidden layer."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def single(network: nn.Module, inputs: list[Tensor]) -> Tensor:
    """Return the network's only output (...,), float32, for concatenated inputs (..., k)."""
    number: Tensor = network(torch.cat(inputs, dim=-1))[..., 0].float()
    return number


SUPPORT_FEATURES, POSE_FEATURES = 7, 3
_DOUBTS = ((1.2, 0.05), (0.6, 0.02))
"""Sigmas (m, rad) of poses before each fit, which widen the gates."""
_LEFT = (0.3, 0.01)
"""Sigmas (m, rad) of fitted poses."""
_MOST_CHI2 = 12.0
_CAUCHY_CHI2 = 4.0
_NOTHING = 0.05
"""Likelihood that an observed element has no mapped one, relative to a perfect pair."""
_MAP_SIGMA_M = 0.15
_STAY = (0.5, 0.5, 10.0)
"""Square roots of the information of the start pose, per metre and radian."""
_LONGEST_STEP = 2.0


class Poses(NamedTuple):
    """h upright cameras."""

    sample: Tensor  # (h,)
    camera_m: Tensor  # (h,) complex
    turn: Tensor  # (h,) complex, unit: from the level frame to the local one

    def to_prior(self, fix_sigma_m: Tensor, compass: candidates.Compass) -> Tensor:
        """Return (h, POSE_FEATURES): distances from the fixes (sigma ``fix_sigma_m`` (b,)) and from
        the compass."""
        from_fix = self.camera_m.abs() / fix_sigma_m[self.sample]
        chi2 = compass.chi2(self.sample, torch.angle(self.turn), _LEFT[1] ** 2)
        features = [
            from_fix.square().clamp_max(12.0) / 3.0,
            (from_fix - candidates.USUAL_FIX_SIGMAS).abs().clamp_max(2.0),
            chi2.clamp_max(16.0) / 5.0,
        ]
        return torch.stack(features, dim=1)


class Support(NamedTuple):
    """k agreements of a pair with a pose."""

    pose: Tensor  # (k,)
    pair: Tensor  # (k,)
    feature: Tensor  # (k, SUPPORT_FEATURES)


class _Off(NamedTuple):
    """Residuals of k pairs under poses."""

    pose: Tensor
    pair: Tensor
    sight: Tensor  # complex: from the camera to the mapped element, in the level frame
    angle: Tensor  # rad, of azimuths
    nearness: Tensor  # of 1 / distance
    angle_variance: Tensor
    nearness_variance: Tensor

    @property
    def chi2(self) -> Tensor:
        """(k,) of angle and nearness."""
        return (
            self.angle.square() / self.angle_variance
            + self.nearness.square() / self.nearness_variance
        )


def fitted(poses: Poses, pairs: candidates.CandidatePairs, size: int) -> Poses:
    """Return the poses of ``size`` samples, fitted to the pairs that agree with them."""
    for doubt in _DOUBTS:
        poses = _gauss_newton_step(poses, pairs, _agreeing(poses, pairs, size, *doubt))
    return poses


def pose_support(poses: Poses, pairs: candidates.CandidatePairs, size: int) -> Support:
    """Return the pairs that agree with fitted poses."""
    off = _agreeing(poses, pairs, size, *_LEFT)
    anchor, end = pairs.off[off.pair].unbind(dim=1)
    features = [
        off.angle.square() / off.angle_variance / 3.0,
        off.nearness.square() / off.nearness_variance / 3.0,
        0.5 * off.angle_variance.log() + 4.0,
        0.5 * off.nearness_variance.log() + 5.0,
        off.sight.abs().log() - 2.7,
        anchor.square().clamp_max(16.0) / 4.0,
        end.clamp(-6.0, 6.0) / 2.0,
    ]
    return Support(off.pose, off.pair, torch.stack(features, dim=1))


def _agreeing(
    poses: Poses, pairs: candidates.CandidatePairs, size: int, doubt_m: float, doubt_rad: float
) -> _Off:
    """Return the residuals of pairs whose azimuth and distance agree with poses of these sigmas."""
    pose, pair = candidates.of_one_sample(poses.sample, pairs.sample, size)
    back, against = poses.turn.conj()[pose], pairs.direction.conj()[pair]
    sight = (pairs.place_m[pair] - poses.camera_m[pose]) * back
    relative = torch.view_as_real(sight * against)
    ahead, beside = relative.unbind(dim=1)
    own = pairs.azimuth_sigma.square() + doubt_rad**2
    wide_m2 = _MAP_SIGMA_M**2 + doubt_m**2
    most = _MOST_CHI2 * (own[pair] * relative.square().sum(dim=1) + wide_m2)
    kept = candidates.rows_of((ahead > 0.0) & (beside.square() < most))
    pose, pair, sight, ahead, beside = (
        value.index_select(0, kept) for value in (pose, pair, sight, ahead, beside)
    )
    turn, direction = poses.turn[pose], pairs.direction[pair]
    angle = torch.atan2(beside, ahead)
    distance = torch.hypot(ahead, beside).clamp_min(candidates.NEAREST_M)
    variance = own[pair] + wide_m2 / distance.square()
    uphill = (pairs.rise[pair].conj() * direction * turn).real
    nearness = 1.0 / distance - pairs.nearness[pair] + pairs.by_slope[pair] * uphill
    spread = pairs.nearness_variance[pair] + (doubt_m / distance.square()).square()
    off = _Off(pose, pair, sight, angle, nearness, variance, spread)
    kept = candidates.rows_of(off.chi2 < _MOST_CHI2)
    return _Off(*(value.index_select(0, kept) for value in off))


def _gauss_newton_step(poses: Poses, pairs: candidates.CandidatePairs, off: _Off) -> Poses:
    """Return the poses after a Gauss-Newton step of position and heading."""
    turn = poses.turn[off.pose]
    distance = off.sight.abs().clamp_min(candidates.NEAREST_M)
    by_place = -turn.conj() / off.sight  # the angle grows by Im(by_place dx)
    toward = off.sight * turn / distance**3
    zeros, ones = torch.zeros_like(distance), torch.ones_like(distance)
    rows = [by_place.imag, by_place.real, -ones, toward.real, toward.imag, zeros]
    J = torch.stack(rows, dim=1).view(-1, 2, 3)
    angle_variance = pairs.azimuth_sigma[off.pair].square() + (_MAP_SIGMA_M / distance).square()
    variance = torch.stack([angle_variance, pairs.nearness_variance[off.pair]], dim=1)
    residual = torch.stack([off.angle, off.nearness], dim=1)
    doubtless = 1.0 + (residual.square() / variance).sum(dim=1) / _CAUCHY_CHI2
    weight = (_shares_of_pose(off, pairs) / doubtless)[:, None] / variance
    weighted = (weight[:, :, None] * J).mT
    h = len(poses.sample)
    stay = torch.diag(torch.tensor(_STAY, device=weight.device).square())
    information = stay.repeat(h, 1, 1).index_add(0, off.pose, weighted @ J)
    right = torch.zeros_like(information[:, 0]).index_add(
        0, off.pose, (weighted @ residual[:, :, None])[..., 0]
    )
    step = torch.linalg.solve(information, -right).clamp(-_LONGEST_STEP, _LONGEST_STEP)
    return Poses(
        poses.sample,
        poses.camera_m + torch.complex(step[:, 0], step[:, 1]),
        poses.turn * torch.polar(torch.ones_like(step[:, 2]), step[:, 2]),
    )


def _shares_of_pose(off: _Off, pairs: candidates.CandidatePairs) -> Tensor:
    """Return each pair's share (k,) among its observed element's pairs under the pose, and none."""
    seen = int(pairs.seen.max()) + 1 if len(pairs.seen) else 1
    row = off.pose * seen + pairs.seen[off.pair]
    likelihood = torch.exp(-0.5 * off.chi2)
    rows = seen * (int(off.pose.max()) + 1 if len(off.pose) else 1)
    total = torch.full((rows,), _NOTHING, device=row.device).index_add(0, row, likelihood)
    return likelihood / total[row]


POSES = 192
"""Most couples of a sample that become poses: those with the highest score."""
_CELL_M, _CELLS = 2.0, 512
"""Only the best couple per square of the ground and heading becomes a pose."""
_MOST_NATS = 10.0
_LEAST = 1e-5


class Rated(NamedTuple):
    """Poses, and the pairs' probabilities that follow from them."""

    poses: Poses
    share: Tensor
    """(h,) probability of each among the poses of its sample, and none."""
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

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.of_support = perceptron(SUPPORT_FEATURES + channels, hidden, 1)
        self.of_pose = perceptron(POSE_FEATURES + 3, hidden, 1)

    def forward(self, prepared: Prepared, encoding: Tensor, couple_score: Tensor) -> Rated:
        """Rate poses, given the pairs' ``encoding`` (N, channels) and ``couple_score`` (E,) in
        nats."""
        b, m, n = prepared.batch.possible.shape
        pairs = prepared.pairs
        poses, chosen = _proposed(prepared, couple_score)
        agree = pose_support(poses, pairs, b)
        inputs = [agree.feature, encoding[agree.pair]]
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
        known = torch.stack([end / 4.0 for end in (couple_score[chosen], *ends)], dim=1)
        score = ends[0].minimum(ends[1]) + single(self.of_pose, [prior, known])
        share, highest = _shares_in_sample(score, poses.sample, b)
        inside = likelihood / by_seen[seen].maximum(by_mapped[mapped])
        return _rated(prepared, poses, agree, share, inside, highest)


def _proposed(prepared: Prepared, couple_score: Tensor) -> tuple[Poses, Tensor]:
    """Return the fitted poses of the best couples, and their rows; nothing here has a gradient."""
    couples, sample = prepared.couples, prepared.pairs.sample
    half = len(couples.first) // 2  # the second half repeats them in the other order
    of_couple, couple_score = sample[couples.first[:half]], couple_score[:half].detach()
    size = len(prepared.batch)
    alike = _cell(of_couple, couples.camera_m[:half], couples.bin[:half, 1])
    apart = candidates.best_of_kind(couple_score, alike)
    chosen = apart[candidates.best_of_sample(couple_score[apart], of_couple[apart], size, POSES)]
    start = Poses(of_couple[chosen], couples.camera_m[chosen], couples.turn[chosen])
    return fitted(start, prepared.pairs, size), chosen


def _cell(sample: Tensor, camera_m: Tensor, heading: Tensor) -> Tensor:
    """Return (k,) a number for the sample, square and heading of each pose."""
    east, north = (
        torch.round(coordinate / _CELL_M).long().clamp(-_CELLS, _CELLS - 1) + _CELLS
        for coordinate in (camera_m.real, camera_m.imag)
    )
    return ((sample * 2 * _CELLS + east) * 2 * _CELLS + north) * candidates.BINS + heading


def _shares_in_sample(score: Tensor, sample: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the shares (h,) of poses in their sample, "none" having a score of 0, and the best
    score (b,)."""
    highest = score.new_zeros(size).scatter_reduce(0, sample, score.detach(), "amax")
    odds = (score - highest[sample]).exp()
    total = (-highest).exp().index_add(0, sample, odds)
    return odds / total[sample], highest


def _rated(
    prepared: Prepared, poses: Poses, agree: Support, share: Tensor, inside: Tensor, score: Tensor
) -> Rated:
    """Return the pairs' probabilities, given those under each pose, ``inside`` (k,)."""
    b, m, _ = prepared.batch.possible.shape
    pairs = prepared.pairs
    row = pairs.sample * m + pairs.seen
    nothing = torch.zeros(len(row), device=share.device)
    pair = nothing.index_add(0, agree.pair, share[agree.pose] * inside)
    taken = torch.zeros(b * m, device=share.device).index_add(0, row, pair)
    odds = (pair + _LEAST).log() - (1.0 - taken.clamp_max(1.0 - 10.0 * _LEAST))[row].log()
    largest_share = share.new_zeros(b).scatter_reduce(0, poses.sample, share, "amax")
    return Rated(poses, share, pair, odds, largest_share, score)


ROUNDS = 2
CHANNELS, HIDDEN = 8, 16
LEAST_ODDS, MOST_ODDS = -12.0, 15.0
"""Limits of the log-odds of pairs."""
_RULED_OUT = -30.0
_LARGEST = 8.0  # nats of a single message
_SMALLEST = 1e-9


class ConsensusOutput(NamedTuple):
    """The network's output for a batch."""

    log_odds: Tensor
    """(b, m, n) of pairs against no pair."""
    rated: Rated


class ConsensusNetwork(nn.Module):
    """Network that returns log-odds of pairs, and poses."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.of_class = nn.Embedding(classes, CHANNELS)
        self.of_pair = perceptron(PAIR_FEATURES + CHANNELS, 2 * HIDDEN, 1 + CHANNELS)
        self.of_couple = perceptron(COUPLE_FEATURES, 24, ROUNDS)
        self.of_post = perceptron(POST_FEATURES, CHANNELS, ROUNDS)
        first, later = BIN_FEATURES + CHANNELS + 1, BIN_FEATURES + CHANNELS + 5
        inputs = [first] + [later] * ROUNDS
        self.of_belief = nn.ModuleList(perceptron(input_, HIDDEN, 1) for input_ in inputs)
        self.by_pose = PoseRound(1 + CHANNELS, HIDDEN)
        self.last = perceptron(9, HIDDEN, 1)

    def forward(self, prepared: Prepared) -> ConsensusOutput:
        pairs = prepared.pairs
        b, m, n = prepared.batch.possible.shape
        number = prepared.batch.seen_class[pairs.sample, pairs.seen]
        inputs = torch.cat([prepared.feature, self.of_class(number)], dim=1)
        encoding = self.of_pair(inputs).float()
        couple_nats = self.of_couple(prepared.couples.feature).float().clamp_max(_LARGEST)
        belief = self._belief(prepared, encoding, couple_nats)

        row = pairs.sample * m + pairs.seen
        share, total = _shares_by_heading(belief, row, b * m)
        heading = torch.log_softmax(_headings(total, b), dim=1)
        log_total = total.log()
        pair = (belief - log_total[row] + heading[pairs.sample]).logsumexp(dim=1)
        nothing = (heading.repeat_interleave(m, dim=0) - log_total).logsumexp(dim=1)
        odds = pair - nothing[row]
        rated = self.by_pose(
            prepared, encoding, _couple_scores(prepared, share, heading, couple_nats[:, -1])
        )
        known = [
            odds / 4.0,
            belief.amax(dim=1).clamp_min(LEAST_ODDS) / 4.0,
            encoding[:, 0],
            share.amax(dim=1),
            heading.amax(dim=1)[pairs.sample],
            rated.odds / 4.0,
            rated.pair,
            rated.largest_share[pairs.sample],
            rated.score[pairs.sample] / 10.0,
        ]
        odds = 0.5 * (odds + rated.odds) + single(self.last, [torch.stack(known, dim=1)])
        ruled_out = odds.new_full((b, m, n), LEAST_ODDS)
        at = pairs.sample, pairs.seen, pairs.mapped
        return ConsensusOutput(ruled_out.index_put(at, odds.clamp(LEAST_ODDS, MOST_ODDS)), rated)

    def _belief(self, prepared: Prepared, encoding: Tensor, couple_nats: Tensor) -> Tensor:
        """Return the log-odds (N, BINS) of pairs under each heading, after all rounds."""
        b, m, _ = prepared.batch.possible.shape
        sample, row = prepared.pairs.sample, prepared.pairs.sample * m + prepared.pairs.seen
        alone, channels = encoding[:, :1].expand(-1, candidates.BINS), encoding[:, 1:]
        inputs = [prepared.bins.feature, channels[:, None].expand(-1, candidates.BINS, -1)]
        ruled_out = torch.where(prepared.bins.possible, 0.0, _RULED_OUT)
        by_couple = couple_nats.exp()
        by_post = self.of_post(prepared.posts.feature).float().clamp_max(_LARGEST).exp()
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
    total = torch.ones((rows, candidates.BINS), device=odds.device).index_add(0, row, odds)
    return odds / total[row], total


def _headings(total: Tensor, size: int) -> Tensor:
    """Return the log-odds (b, BINS) of headings against the average one."""
    evidence = total.log().view(size, -1, candidates.BINS).sum(dim=1)
    return evidence - evidence.mean(dim=1, keepdim=True)


def _messages(prepared: Prepared, share: Tensor, by_couple: Tensor, by_post: Tensor) -> Tensor:
    """Return the nats (N, BINS) that each pair receives from the other observed elements."""
    couples, posts, seen = prepared.couples, prepared.posts, prepared.pairs.seen
    m = prepared.batch.seen.shape[1]
    rows = len(seen) * m
    weighted = by_couple[:, None] * couples.weight * share[couples.second[:, None], couples.bin]
    from_seen = couples.first * m + seen[couples.second]
    at = from_seen[:, None] * candidates.BINS + couples.bin
    message = torch.zeros(rows * candidates.BINS, device=share.device)
    message = message.index_add(0, at.flatten(), weighted.flatten()).view(rows, candidates.BINS)
    from_seen = posts.first * m + seen[posts.second]
    message = message.index_add(0, from_seen, by_post[:, None] * share[posts.second])
    return torch.log1p(message).view(-1, m, candidates.BINS).sum(dim=1)


def _couple_scores(
    prepared: Prepared, share: Tensor, heading: Tensor, couple_nats: Tensor
) -> Tensor:
    """Return the nats (E,) of couples: of both pairs, their agreement and the heading."""
    couples = prepared.couples
    nearest = couples.bin[:, 1]
    couple_score = couple_nats + heading[prepared.pairs.sample[couples.first], nearest]
    for end in (couples.first, couples.second):
        couple_score = couple_score + share[end, nearest].clamp_min(_SMALLEST).log()
    return couple_score
