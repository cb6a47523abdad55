"""Batches for the pair matcher: the geometry of each frame, concatenated as tensors.

Geometry is that of inference, computed per frame by workers
(`semviz_core.localization.correspondences`). Nothing here is learned.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.correspondences.candidate_pairs import (
    Compass,
    candidate_pairs,
    in_bins,
)
from semviz_core.localization.correspondences.couples import (
    Couples,
    FrameGeometry,
    Posts,
    pair_features,
)
from semviz_core.localization.correspondences.pose_support import proposed_poses
from semviz_core.localization.correspondences.sample import Sample
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
