"""Samples side by side as tensors, padded to the largest of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semviz_core.arrays import BoolArray
from semviz_core.learning.sample import Sample


@dataclass(frozen=True, eq=False)
class BatchTruth:
    """The right answers of a batch."""

    rotation: Tensor
    """(b, 3, 3) of T_camera_local, float64."""
    translation: Tensor
    """(b, 3) metres, float64."""
    pairs: Tensor
    """(b, m, n) bool."""


@dataclass(frozen=True, eq=False)
class Batch:
    """b samples; fields as in ``Sample``, float32. What is padded is False in ``seen``, ``mapped``.

    Padded rays look ahead and padded points lie at the origin, so that nothing is NaN.
    """

    ray: Tensor  # (b, m, 3)
    bottom_ray: Tensor  # (b, m, 3)
    sigma_rad: Tensor  # (b, m, 2)
    score: Tensor  # (b, m)
    seen_class: Tensor  # (b, m) int64
    seen_known: Tensor  # (b, m, 2) bool
    seen: Tensor  # (b, m) bool: not padded
    point_m: Tensor  # (b, n, 3)
    bottom_m: Tensor  # (b, n, 3)
    mapped_class: Tensor  # (b, n) int64
    mapped_known: Tensor  # (b, n, 2) bool
    road: Tensor  # (b, 3)
    mapped: Tensor  # (b, n) bool: not padded
    prior: Tensor  # (b, PRIOR_LENGTH)
    truth: BatchTruth | None = None

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> "Batch":
        """The truth is there if all samples have one."""
        m = max(len(one.ray) for one in samples)
        n = max(len(one.point_m) for one in samples)
        ahead = (0.0, 0.0, 1.0)
        truths = [one.truth for one in samples if one.truth is not None]
        truth = None
        if len(truths) == len(samples):
            truth = BatchTruth(
                torch.from_numpy(np.stack([one.rotation for one in truths])),
                torch.from_numpy(np.stack([one.translation for one in truths])),
                _pairs([one.pairs for one in truths], m, n),
            )
        return cls(
            ray=_padded([one.ray for one in samples], m, ahead),
            bottom_ray=_padded([one.bottom_ray for one in samples], m, ahead),
            sigma_rad=_padded([one.sigma_rad for one in samples], m, (0.0, 0.0)),
            score=_padded([one.score for one in samples], m),
            seen_class=_padded([one.seen_class for one in samples], m),
            seen_known=_padded([one.seen_known for one in samples], m, (False, False)),
            seen=_padded([np.ones(len(one.ray), dtype=bool) for one in samples], m),
            point_m=_padded([one.point_m for one in samples], n, (0.0, 0.0, 0.0)),
            bottom_m=_padded([one.bottom_m for one in samples], n, (0.0, 0.0, 0.0)),
            mapped_class=_padded([one.mapped_class for one in samples], n),
            mapped_known=_padded([one.mapped_known for one in samples], n, (False, False)),
            road=torch.from_numpy(np.stack([one.road for one in samples])).float(),
            mapped=_padded([np.ones(len(one.point_m), dtype=bool) for one in samples], n),
            prior=torch.from_numpy(np.stack([one.prior for one in samples])).float(),
            truth=truth,
        )

    def __len__(self) -> int:
        return len(self.ray)

    @property
    def possible(self) -> Tensor:
        """(b, m, n) bool: pairs that are not padded."""
        return self.seen[:, :, None] & self.mapped[:, None, :]

    @property
    def same_class(self) -> Tensor:
        """(b, m, n) bool: pairs of one class that are not padded."""
        return self.possible & (self.seen_class[:, :, None] == self.mapped_class[:, None, :])

    def to(self, device: torch.device) -> "Batch":
        """The batch on a device."""
        moved = {
            one.name: value.to(device)
            for one in fields(self)
            if isinstance(value := getattr(self, one.name), Tensor)
        }
        truth = self.truth
        if truth is not None:
            truth = BatchTruth(
                truth.rotation.to(device), truth.translation.to(device), truth.pairs.to(device)
            )
        return Batch(**moved, truth=truth)


def _padded(arrays: Sequence[NDArray[Any]], length: int, filler: tuple[float, ...] = ()) -> Tensor:
    """(b, length, ...) of arrays (k, ...), filled up with ``filler``; floats as float32."""
    first = np.asarray(arrays[0])
    shape = (len(arrays), length, *first.shape[1:])
    kind = np.float32 if first.dtype == np.float64 else first.dtype
    together = np.zeros(shape, dtype=kind)
    if filler:
        together[:] = filler
    for row, one in enumerate(arrays):
        together[row, : len(one)] = one
    return torch.from_numpy(together)


def _pairs(arrays: Sequence[BoolArray], m: int, n: int) -> Tensor:
    together = np.zeros((len(arrays), m, n), dtype=bool)
    for row, one in enumerate(arrays):
        together[row, : one.shape[0], : one.shape[1]] = one
    return torch.from_numpy(together)
