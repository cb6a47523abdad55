"""Train the pair matcher with the likelihood of the true pairs, and of no pair."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.localization.correspondences.sample import Sample
from semviz_core.research.pair_matcher.network import ConsensusNetwork
from semviz_core.research.pair_matcher.prepared import Prepared
from semviz_core.research.paper.transport import sinkhorn_with_dustbins
from semviz_core.research.training.batch import Batch
from semviz_core.research.training.simulated_samples import LEARNED_DISTRIBUTION
from semviz_core.research.training.task import Progress, SampleSource, cosine

RATE = 3e-3
MATCHER_SAMPLES = 200_000
PAIR_WEIGHT = 2.0
"""Weight of a true pair relative to an element without one: a pair has two elements."""
_FEW = (1, 5, 10)


class MatcherTask:
    """Training of the pair matcher on frames with ground truth."""

    samples = MATCHER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.network = ConsensusNetwork(len(classes))
        self.options: dict[str, Any] = {
            "classes": [class_.name for class_ in classes],
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> Sample:
        return self.source.sample(number)

    def held_out(self, number: int) -> Sample:
        return self.source.held_out(number)

    def collate(self, items: Sequence[Sample]) -> Prepared:
        return Prepared.of(items)

    def losses(self, prepared: Prepared, progress: Progress) -> dict[str, Tensor]:
        """Return the mean negative log-likelihood of each element's pair, or of no pair."""
        log_probability = log_probabilities(self.network(prepared), prepared.batch)
        return {"loss": mean_surprise(log_probability, prepared.batch)}

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, prepared: Prepared) -> dict[str, Tensor]:
        """Return the shares of true pairs among the most probable of their observed element, and
        the AUC of having no pair."""
        log_probability = log_probabilities(self.network(prepared), prepared.batch)
        pairs = _pairs(prepared.batch)
        paired = pairs.any(dim=2)
        rank = true_rank(log_probability, pairs)[paired]
        top_shares = {f"top{few}": (rank < few).double().mean() for few in _FEW}
        alone = log_probability[:, :-1, -1]
        with_pair, without = alone[paired], alone[prepared.batch.seen & ~paired]
        return {
            "surprise": mean_surprise(log_probability, prepared.batch),
            **top_shares,
            "auc": (with_pair[:, None] < without).double().mean(),
        }


def log_probabilities(log_odds: Tensor, batch: Batch) -> Tensor:
    """Return log-probabilities (b, m + 1, n + 1) of log-odds (b, m, n) against no pair."""
    b, m, n = log_odds.shape
    zeros = log_odds.new_zeros
    return sinkhorn_with_dustbins(log_odds, zeros((b, m)), zeros((b, n)), batch.same_class)


def true_rank(log_probability: Tensor, pairs: Tensor) -> Tensor:
    """Return (b, m) how many mapped elements are more probable than the true one, if any."""
    likely = log_probability[:, :-1, :-1]
    best = likely.masked_fill(~pairs, -torch.inf).amax(dim=2, keepdim=True)
    return (likely > best).sum(dim=2)


def make_task(name: str, source: SampleSource | None) -> MatcherTask:
    """Return the task with new weights (default source: simulated roads)."""
    return MatcherTask(name, source or LEARNED_DISTRIBUTION)


def mean_surprise(log_probability: Tensor, batch: Batch) -> Tensor:
    """Return the mean negative log-probability; any of an element's true pairs is right, since the
    map may hold an element twice."""
    pairs = _pairs(batch)
    likely = log_probability[:, :-1, :-1].masked_fill(~pairs, -torch.inf)
    paired, taken = pairs.any(dim=2), pairs.any(dim=1)
    true = likely.masked_fill(~paired[..., None], 0.0).logsumexp(dim=2)[paired]
    seen_alone = log_probability[:, :-1, -1][batch.seen & ~paired]
    mapped_alone = log_probability[:, -1, :-1][batch.mapped & ~taken]
    count = PAIR_WEIGHT * len(true) + len(seen_alone) + len(mapped_alone)
    return -(PAIR_WEIGHT * true.sum() + seen_alone.sum() + mapped_alone.sum()) / count


def _pairs(batch: Batch) -> Tensor:
    """Return (b, m, n) the true pairs of one class."""
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth.pairs & batch.same_class
