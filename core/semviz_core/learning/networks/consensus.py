"""The learned matcher's network: candidate pairs tell each other where the camera must be.

Cross-attention in which geometry says who is heard. What attends is not an element but a pair of a
seen and a mapped one, under each heading: as such a hypothesis is a whole pose, whether two of them
agree is known beforehand (``candidates.couples``), and what is left to learn is how much that, the
slopes, the fix and the compass are worth. Every pair hears from each other seen element what the
best of its partners say, with nothing as a partner too, so that several rounds approach the
probabilities of one-to-one pairs as belief propagation does.

Turning the local frame by a whole bin turns the bins, and changes nothing else.
"""

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

ROUNDS = 3
CHANNELS, HIDDEN = 8, 16
LEAST_ODDS, MOST_ODDS = -12.0, 15.0
"""Log-odds of pairs that are ruled out, or certain."""
_RULED_OUT = -30.0
_LARGEST = 8.0  # nats of a single message


class ConsensusNetwork(nn.Module):
    """Log-odds of pairs against no pair."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.of_class = nn.Embedding(classes, CHANNELS)
        self.of_pair = _perceptron(PAIR_FEATURES + CHANNELS, 2 * HIDDEN, 1 + CHANNELS)
        self.of_couple = _perceptron(COUPLE_FEATURES, 24, ROUNDS)
        self.of_post = _perceptron(POST_FEATURES, CHANNELS, ROUNDS)
        first, later = BIN_FEATURES + CHANNELS + 1, BIN_FEATURES + CHANNELS + 5
        inputs = [first] + [later] * ROUNDS
        self.of_belief = nn.ModuleList(_perceptron(one, HIDDEN, 1) for one in inputs)
        self.last = _perceptron(5, HIDDEN, 1)

    def forward(self, prepared: Prepared) -> Tensor:
        """(b, m, n)"""
        b, m, n = prepared.batch.possible.shape
        row = prepared.sample * m + prepared.seen  # of the seen element, in the batch
        number = prepared.batch.seen_class[prepared.sample, prepared.seen]
        given = torch.cat([prepared.feature, self.of_class(number)], dim=1)
        told = self.of_pair(given).float()
        alone, channels = told[:, :1].expand(-1, BINS), told[:, 1:]
        every = [prepared.bins.feature, channels[:, None].expand(-1, BINS, -1)]
        ruled_out = torch.where(prepared.bins.possible, 0.0, _RULED_OUT)

        belief = alone + _single(self.of_belief[0], [*every, alone[..., None]]) + ruled_out
        by_couple = self.of_couple(prepared.couples.feature).float().clamp_max(_LARGEST).exp()
        by_post = self.of_post(prepared.posts.feature).float().clamp_max(_LARGEST).exp()
        for k in range(ROUNDS):
            share, total = _shares(belief, row, b * m)
            heard = _heard(prepared, share, by_couple[:, k], by_post[:, k], m)
            heading = _headings(total, b)[prepared.sample]
            known = [alone, heard, belief.clamp_min(LEAST_ODDS) / 4.0, heading, share]
            more = _single(self.of_belief[k + 1], [*every, torch.stack(known, dim=2)])
            belief = heard + more + ruled_out

        share, total = _shares(belief, row, b * m)
        heading = torch.log_softmax(_headings(total, b), dim=1)
        log_total = total.log()
        pair = (belief - log_total[row] + heading[prepared.sample]).logsumexp(dim=1)
        nothing = (heading.repeat_interleave(m, dim=0) - log_total).logsumexp(dim=1)
        odds = pair - nothing[row]
        known = [
            odds / 4.0,
            belief.amax(dim=1).clamp_min(LEAST_ODDS) / 4.0,
            alone[:, 0],
            share.amax(dim=1),
            heading.amax(dim=1)[prepared.sample],
        ]
        odds = odds + _single(self.last, [torch.stack(known, dim=1)])
        at = prepared.sample, prepared.seen, prepared.mapped
        nowhere = odds.new_full((b, m, n), LEAST_ODDS)
        found: Tensor = nowhere.index_put(at, odds.clamp(LEAST_ODDS, MOST_ODDS))
        return found


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def _single(perceptron: nn.Module, inputs: list[Tensor]) -> Tensor:
    """(...,) of inputs (..., k) side by side."""
    found: Tensor = perceptron(torch.cat(inputs, dim=-1))[..., 0].float()
    return found


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


def _heard(prepared: Prepared, share: Tensor, by_couple: Tensor, by_post: Tensor, m: int) -> Tensor:
    """(N, BINS) nats that the other seen elements give each pair in each heading."""
    couples, posts, rows = prepared.couples, prepared.posts, len(prepared.seen) * m
    said = by_couple[:, None] * couples.weight * share[couples.second[:, None], couples.bin]
    from_seen = couples.first * m + prepared.seen[couples.second]
    at = from_seen[:, None] * BINS + couples.bin
    message = torch.zeros(rows * BINS, device=share.device)
    message = message.index_add(0, at.flatten(), said.flatten()).view(rows, BINS)
    from_seen = posts.first * m + prepared.seen[posts.second]
    message = message.index_add(0, from_seen, by_post[:, None] * share[posts.second])
    return torch.log1p(message).view(-1, m, BINS).sum(dim=1)
