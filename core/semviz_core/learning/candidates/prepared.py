"""A batch with its candidates: all that the matcher's network looks at."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semviz_core.learning.batch import Batch
from semviz_core.learning.candidates.couples import Couples, Posts, couples
from semviz_core.learning.candidates.headings import Bins, Compass, in_bins
from semviz_core.learning.candidates.pairs import FIX_UNIT_M, Pairs, candidate_pairs

PAIR_FEATURES, BIN_FEATURES, COUPLE_FEATURES, POST_FEATURES = 14, 3, 7, 3


@dataclass(frozen=True, eq=False)
class Prepared:
    """b samples with N candidate pairs, E couples and F posts in all."""

    batch: Batch
    pairs: Pairs
    compass: Compass
    feature: Tensor  # (N, PAIR_FEATURES)
    bins: Bins
    couples: Couples
    posts: Posts

    @classmethod
    @torch.no_grad()
    def of(cls, batch: Batch) -> "Prepared":
        """Nothing in here is learned: workers do it."""
        pairs, compass = candidate_pairs(batch), Compass.of(batch)
        together, posts = couples(pairs, compass, len(batch))
        return cls(
            batch=batch,
            pairs=pairs,
            compass=compass,
            feature=_features(pairs, batch),
            bins=in_bins(pairs, compass),
            couples=together,
            posts=posts,
        )

    @property
    def fix_sigma_m(self) -> Tensor:
        """(b,)"""
        return FIX_UNIT_M * self.batch.prior[:, 4]

    def to(self, device: torch.device) -> "Prepared":
        """All of it on a device."""
        return Prepared(
            self.batch.to(device),
            self.pairs.to(device),
            Compass(*(one.to(device) for one in self.compass)),
            self.feature.to(device),
            Bins(*(one.to(device) for one in self.bins)),
            Couples(*(one.to(device) for one in self.couples)),
            Posts(*(one.to(device) for one in self.posts)),
        )


def _features(pairs: Pairs, batch: Batch) -> Tensor:
    """(N, PAIR_FEATURES): how slopes agree with a distance, that distance, and how crowded it is.

    The detector's score is none of them: in simulated frames it tells false detections for certain.
    """
    anchor, end = pairs.off.unbind(dim=1)
    seen, mapped = batch.possible.shape[1:]
    by_seen = torch.bincount(pairs.sample * seen + pairs.seen, minlength=len(batch) * seen)
    rivals = by_seen[pairs.sample * seen + pairs.seen]
    by_mapped = torch.bincount(pairs.sample * mapped + pairs.mapped, minlength=len(batch) * mapped)
    doubles = by_mapped[pairs.sample * mapped + pairs.mapped]
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
        doubles.log() - 1.0,
        batch.seen.sum(dim=1)[pairs.sample].log() - 2.0,
    ]
    return torch.stack(features, dim=1)
