"""Training of the learned matcher: the likelihood of the true pairs, and of no pair."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.learning.batch import Batch
from semviz_core.learning.candidates.prepared import Prepared
from semviz_core.learning.drills import LEARNED_DRILLS
from semviz_core.learning.networks.consensus import ConsensusNetwork
from semviz_core.learning.sample import Sample
from semviz_core.learning.schedule import cosine
from semviz_core.learning.task import Progress, SampleSource
from semviz_core.learning.transport import sinkhorn_with_dustbins

RATE = 3e-3
MATCHER_SAMPLES = 200_000
PAIR_WEIGHT = 2.0
"""A true pair counts as much as so many elements without one: both of its elements have it."""
_FEW = (1, 5, 10)


class MatcherTask:
    """The matcher on frames with their answers."""

    samples = MATCHER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.network = ConsensusNetwork(len(classes))
        self.options: dict[str, Any] = {
            "classes": [one.name for one in classes],
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> Sample:
        return self.source.sample(number)

    def held_out(self, number: int) -> Sample:
        return self.source.held_out(number)

    def collate(self, items: Sequence[Sample]) -> Prepared:
        return Prepared.of(Batch.of(items))

    def losses(self, together: Prepared, progress: Progress) -> dict[str, Tensor]:
        """Negative log-likelihood of what each element is, or that it is nothing."""
        log_probability = log_probabilities(self.network(together).log_odds, together.batch)
        return {"loss": _surprise(log_probability, together.batch)}

    def finish(self) -> None:
        """Nothing is left to choose."""

    def figures(self, together: Prepared) -> dict[str, Tensor]:
        """Of seen elements with a true pair: whether it is among the likeliest; and how often an
        element with a pair is less likely to have none than an element without."""
        log_probability = log_probabilities(self.network(together).log_odds, together.batch)
        pairs = _pairs(together.batch)
        paired = pairs.any(dim=2)
        rank = true_rank(log_probability, pairs)[paired]
        found = {f"top{few}": (rank < few).double().mean() for few in _FEW}
        alone = log_probability[:, :-1, -1]
        with_pair, without = alone[paired], alone[together.batch.seen & ~paired]
        return {
            "surprise": _surprise(log_probability, together.batch),
            **found,
            "auc": (with_pair[:, None] < without).double().mean(),
        }


def log_probabilities(log_odds: Tensor, batch: Batch) -> Tensor:
    """(b, m + 1, n + 1) of log-odds (b, m, n) against no pair; every dustbin counts as 0 nats."""
    b, m, n = log_odds.shape
    nothing = log_odds.new_zeros
    return sinkhorn_with_dustbins(log_odds, nothing((b, m)), nothing((b, n)), batch.same_class)


def true_rank(log_probability: Tensor, pairs: Tensor) -> Tensor:
    """(b, m) how many mapped elements are likelier than the true one, where there is one."""
    likely = log_probability[:, :-1, :-1]
    best = likely.masked_fill(~pairs, -torch.inf).amax(dim=2, keepdim=True)
    return (likely > best).sum(dim=2)


def make_task(name: str, source: SampleSource | None) -> MatcherTask:
    """With fresh weights; on simulated roads if no source is given."""
    return MatcherTask(name, source or LEARNED_DRILLS)


def _surprise(log_probability: Tensor, batch: Batch) -> Tensor:
    """Mean nats of elements; of several true pairs of one element, as the map may hold a thing
    twice, any is right."""
    pairs = _pairs(batch)
    likely = log_probability[:, :-1, :-1].masked_fill(~pairs, -torch.inf)
    paired, taken = pairs.any(dim=2), pairs.any(dim=1)
    true = likely.masked_fill(~paired[..., None], 0.0).logsumexp(dim=2)[paired]
    seen_alone = log_probability[:, :-1, -1][batch.seen & ~paired]
    mapped_alone = log_probability[:, -1, :-1][batch.mapped & ~taken]
    count = PAIR_WEIGHT * len(true) + len(seen_alone) + len(mapped_alone)
    return -(PAIR_WEIGHT * true.sum() + seen_alone.sum() + mapped_alone.sum()) / count


def _pairs(batch: Batch) -> Tensor:
    """(b, m, n) true pairs that a matcher by class can find."""
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth.pairs & batch.same_class
