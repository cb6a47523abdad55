"""The learned matcher's network: candidate pairs tell each other where the camera must be.

Cross-attention in which geometry says who is heard. What attends is not an element but a pair of a
seen and a mapped one, under each heading: as such a hypothesis is a whole pose, whether two of them
agree is known beforehand (``candidates.couples``), and what is left to learn is how much that, the
slopes, the fix and the compass are worth. Every pair hears from each other seen element what the
best of its partners say, with nothing as a partner too, so that the rounds approach the
probabilities of one-to-one pairs as belief propagation does. The couples that come out best are
fitted as poses, and rated by all pairs (``posing``).

Turning the local frame by a whole bin turns the bins, and changes nothing else of the rounds; of
the poses, only which of those that are close together is kept.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from semviz_core.learning.candidates.headings import BINS
from semviz_core.learning.candidates.prepared import (
    BIN_FEATURES,
    COUPLE_FEATURES,
    PAIR_FEATURES,
    POST_FEATURES,
    Prepared,
)
from semviz_core.learning.networks.perceptron import perceptron, single
from semviz_core.learning.networks.posing import PoseRound, Rated

ROUNDS = 2
CHANNELS, HIDDEN = 8, 16
LEAST_ODDS, MOST_ODDS = -12.0, 15.0
"""Log-odds of pairs that are ruled out, or certain."""
_RULED_OUT = -30.0
_LARGEST = 8.0  # nats of a single message
_SMALLEST = 1e-9


class Found(NamedTuple):
    """What the network makes of a batch."""

    log_odds: Tensor
    """(b, m, n) of pairs against no pair."""
    rated: Rated


class ConsensusNetwork(nn.Module):
    """Log-odds of pairs, and poses."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.of_class = nn.Embedding(classes, CHANNELS)
        self.of_pair = perceptron(PAIR_FEATURES + CHANNELS, 2 * HIDDEN, 1 + CHANNELS)
        self.of_couple = perceptron(COUPLE_FEATURES, 24, ROUNDS)
        self.of_post = perceptron(POST_FEATURES, CHANNELS, ROUNDS)
        first, later = BIN_FEATURES + CHANNELS + 1, BIN_FEATURES + CHANNELS + 5
        inputs = [first] + [later] * ROUNDS
        self.of_belief = nn.ModuleList(perceptron(one, HIDDEN, 1) for one in inputs)
        self.by_pose = PoseRound(1 + CHANNELS, HIDDEN)
        self.last = perceptron(9, HIDDEN, 1)

    def forward(self, prepared: Prepared) -> Found:
        pairs = prepared.pairs
        b, m, n = prepared.batch.possible.shape
        number = prepared.batch.seen_class[pairs.sample, pairs.seen]
        given = torch.cat([prepared.feature, self.of_class(number)], dim=1)
        told = self.of_pair(given).float()
        said = self.of_couple(prepared.couples.feature).float().clamp_max(_LARGEST)
        belief = self._belief(prepared, told, said)

        row = pairs.sample * m + pairs.seen
        share, total = _shares(belief, row, b * m)
        heading = torch.log_softmax(_headings(total, b), dim=1)
        log_total = total.log()
        pair = (belief - log_total[row] + heading[pairs.sample]).logsumexp(dim=1)
        nothing = (heading.repeat_interleave(m, dim=0) - log_total).logsumexp(dim=1)
        odds = pair - nothing[row]
        rated = self.by_pose(prepared, told, _worth(prepared, share, heading, said[:, -1]))
        known = [
            odds / 4.0,
            belief.amax(dim=1).clamp_min(LEAST_ODDS) / 4.0,
            told[:, 0],
            share.amax(dim=1),
            heading.amax(dim=1)[pairs.sample],
            rated.odds / 4.0,
            rated.pair,
            rated.surest[pairs.sample],
            rated.score[pairs.sample] / 10.0,
        ]
        odds = 0.5 * (odds + rated.odds) + single(self.last, [torch.stack(known, dim=1)])
        nowhere = odds.new_full((b, m, n), LEAST_ODDS)
        at = pairs.sample, pairs.seen, pairs.mapped
        return Found(nowhere.index_put(at, odds.clamp(LEAST_ODDS, MOST_ODDS)), rated)

    def _belief(self, prepared: Prepared, told: Tensor, said: Tensor) -> Tensor:
        """(N, BINS) log-odds of pairs under each heading, after all rounds."""
        b, m, _ = prepared.batch.possible.shape
        sample, row = prepared.pairs.sample, prepared.pairs.sample * m + prepared.pairs.seen
        alone, channels = told[:, :1].expand(-1, BINS), told[:, 1:]
        every = [prepared.bins.feature, channels[:, None].expand(-1, BINS, -1)]
        ruled_out = torch.where(prepared.bins.possible, 0.0, _RULED_OUT)
        by_couple = said.exp()
        by_post = self.of_post(prepared.posts.feature).float().clamp_max(_LARGEST).exp()
        belief = alone + single(self.of_belief[0], [*every, alone[..., None]]) + ruled_out
        for k in range(ROUNDS):
            share, total = _shares(belief, row, b * m)
            heard = _heard(prepared, share, by_couple[:, k], by_post[:, k])
            heading = _headings(total, b)[sample]
            known = [alone, heard, belief.clamp_min(LEAST_ODDS) / 4.0, heading, share]
            more = single(self.of_belief[k + 1], [*every, torch.stack(known, dim=2)])
            belief = heard + more + ruled_out
        return belief


def _shares(belief: Tensor, row: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """(N, BINS) probability of each pair among those of its seen element and none at all, if the
    heading were that; and (rows, BINS) what these are out of."""
    odds = belief.clamp_max(MOST_ODDS).exp()
    total = torch.ones((rows, BINS), device=odds.device).index_add(0, row, odds)
    return odds / total[row], total


def _headings(total: Tensor, size: int) -> Tensor:
    """(b, BINS) log-odds of headings against the average one."""
    evidence = total.log().view(size, -1, BINS).sum(dim=1)
    return evidence - evidence.mean(dim=1, keepdim=True)


def _heard(prepared: Prepared, share: Tensor, by_couple: Tensor, by_post: Tensor) -> Tensor:
    """(N, BINS) nats that the other seen elements give each pair in each heading."""
    couples, posts, seen = prepared.couples, prepared.posts, prepared.pairs.seen
    m = prepared.batch.seen.shape[1]
    rows = len(seen) * m
    said = by_couple[:, None] * couples.weight * share[couples.second[:, None], couples.bin]
    from_seen = couples.first * m + seen[couples.second]
    at = from_seen[:, None] * BINS + couples.bin
    message = torch.zeros(rows * BINS, device=share.device)
    message = message.index_add(0, at.flatten(), said.flatten()).view(rows, BINS)
    from_seen = posts.first * m + seen[posts.second]
    message = message.index_add(0, from_seen, by_post[:, None] * share[posts.second])
    return torch.log1p(message).view(-1, m, BINS).sum(dim=1)


def _worth(prepared: Prepared, share: Tensor, heading: Tensor, said: Tensor) -> Tensor:
    """(E,) nats of couples: of both pairs, of what they say to each other, and of the heading."""
    couples = prepared.couples
    nearest = couples.bin[:, 1]
    worth = said + heading[prepared.pairs.sample[couples.first], nearest]
    for end in (couples.first, couples.second):
        worth = worth + share[end, nearest].clamp_min(_SMALLEST).log()
    return worth
