"""Collate samples into padded float32 tensors.

Padding is False in ``seen`` and ``mapped`` and changes no result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semviz_core.common.arrays import BoolArray
from semviz_core.localization.correspondences.sample import Sample


@dataclass(frozen=True, eq=False)
class BatchTruth:
    """The ground truth of a batch."""

    rotation: Tensor
    """(b, 3, 3) of T_camera_local, float64."""
    translation: Tensor
    """(b, 3) metres, float64."""
    pairs: Tensor
    """(b, m, n) bool."""


@dataclass(frozen=True, eq=False)
class Batch:
    """b samples; fields as in ``Sample``, float32. Padding is False in ``seen`` and ``mapped``.

    Padded rays point ahead and padded points lie at the origin, so that nothing is NaN.
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
        """Return the samples as a batch, with ground truth if all of them have it."""
        m = max(len(sample.ray) for sample in samples)
        n = max(len(sample.point_m) for sample in samples)
        ahead = (0.0, 0.0, 1.0)
        truths = [sample.truth for sample in samples if sample.truth is not None]
        truth = None
        if len(truths) == len(samples):
            truth = BatchTruth(
                torch.from_numpy(np.stack([target.rotation for target in truths])),
                torch.from_numpy(np.stack([target.translation for target in truths])),
                _pairs([target.pairs for target in truths], m, n),
            )
        return cls(
            ray=_padded([sample.ray for sample in samples], m, ahead),
            bottom_ray=_padded([sample.bottom_ray for sample in samples], m, ahead),
            sigma_rad=_padded([sample.sigma_rad for sample in samples], m, (0.0, 0.0)),
            score=_padded([sample.score for sample in samples], m),
            seen_class=_padded([sample.seen_class for sample in samples], m),
            seen_known=_padded([sample.seen_known for sample in samples], m, (False, False)),
            seen=_padded([np.ones(len(sample.ray), dtype=bool) for sample in samples], m),
            point_m=_padded([sample.point_m for sample in samples], n, (0.0, 0.0, 0.0)),
            bottom_m=_padded([sample.bottom_m for sample in samples], n, (0.0, 0.0, 0.0)),
            mapped_class=_padded([sample.mapped_class for sample in samples], n),
            mapped_known=_padded([sample.mapped_known for sample in samples], n, (False, False)),
            road=torch.from_numpy(np.stack([sample.road for sample in samples])).float(),
            mapped=_padded([np.ones(len(sample.point_m), dtype=bool) for sample in samples], n),
            prior=torch.from_numpy(np.stack([sample.prior for sample in samples])).float(),
            truth=truth,
        )

    def __len__(self) -> int:
        return len(self.ray)

    @property
    def possible(self) -> Tensor:
        """(b, m, n) True for pairs that are not padded."""
        return self.seen[:, :, None] & self.mapped[:, None, :]

    @property
    def same_class(self) -> Tensor:
        """(b, m, n) True for pairs of one class that are not padded."""
        return self.possible & (self.seen_class[:, :, None] == self.mapped_class[:, None, :])

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device."""
        moved = {
            field.name: value.to(device)
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        truth = self.truth
        if truth is not None:
            truth = BatchTruth(
                truth.rotation.to(device), truth.translation.to(device), truth.pairs.to(device)
            )
        return Batch(**moved, truth=truth)


def _padded(arrays: Sequence[NDArray[Any]], length: int, filler: tuple[float, ...] = ()) -> Tensor:
    """Return arrays (k, ...) as one (b, length, ...), padded with ``filler``; floats as float32."""
    first = np.asarray(arrays[0])
    shape = (len(arrays), length, *first.shape[1:])
    kind = np.float32 if first.dtype == np.float64 else first.dtype
    padded = np.zeros(shape, dtype=kind)
    if filler:
        padded[:] = filler
    for row, array in enumerate(arrays):
        padded[row, : len(array)] = array
    return torch.from_numpy(padded)


def _pairs(arrays: Sequence[BoolArray], m: int, n: int) -> Tensor:
    padded = np.zeros((len(arrays), m, n), dtype=bool)
    for row, array in enumerate(arrays):
        padded[row, : array.shape[0], : array.shape[1]] = array
    return torch.from_numpy(padded)
