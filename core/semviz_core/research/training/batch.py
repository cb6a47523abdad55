"""What a training needs of a task, and batches of samples as padded float32 tensors.

Padding is False in ``seen`` and ``mapped`` and changes no result. The learning rate rises to its
maximum within the first hundredth, then falls to 0 along half a cosine.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import cos, pi
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from semviz_core.common.arrays import BoolArray
from semviz_core.localization.correspondences.candidate_pairs import Sample


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


Item = TypeVar("Item")
BatchT = TypeVar("BatchT")


@dataclass(frozen=True)
class Progress:
    """Position of a batch in the training."""

    samples: int
    """Number of samples before this batch."""
    of: int
    """Number of samples of the whole training."""

    @property
    def share(self) -> float:
        """In [0, 1)."""
        return self.samples / self.of


class SampleSource(Protocol):
    """Samples as a pure function of their number. Picklable; used in worker processes."""

    def sample(self, number: int) -> Sample:
        """Return training sample ``number``, which may be large."""

    def held_out(self, number: int) -> Sample:
        """Return validation sample ``number``, which is never trained on."""

    def describe(self) -> dict[str, Any]:
        """Return the settings of the samples as JSON, stored in checkpoints and model cards."""


class TrainingTask(Protocol[Item, BatchT]):
    """A network with its training items and losses.

    Everything is a function of numbers, so that training can stop and resume anywhere: item k is
    the same whichever process makes it, and randomness in ``losses`` comes from ``progress``.
    """

    name: str
    network: nn.Module
    options: dict[str, Any]
    """Model, classes and data as JSON; a training resumes only with the same."""
    samples: int
    """Default number of samples of a whole training."""

    def learning_rate(self, progress: Progress) -> float:
        """Return Adam's step size for a batch; see ``cosine``."""

    def make(self, number: int) -> Item:
        """Return training item ``number``; called in worker processes."""

    def held_out(self, number: int) -> Item:
        """Return validation item ``number``, which is never trained on."""

    def collate(self, items: Sequence[Item]) -> BatchT:
        """Return the items as a batch."""

    def losses(self, batch: BatchT, progress: Progress) -> dict[str, Tensor]:
        """Return ``loss``, which training minimizes, with its parts and other figures to show."""

    def figures(self, batch: BatchT) -> dict[str, Tensor]:
        """Return figures of validation items, each a mean, without gradients."""

    def finish(self) -> None:
        """Choose what follows the training, such as thresholds, and store it in the network."""


PAPER_RATE = 5e-4
"""Adam's step size throughout the training (paper, "Implementation Details")."""
WARM_UP = 0.01


def cosine(progress: Progress, highest: float = PAPER_RATE) -> float:
    """Return a rate that rises to ``highest`` and falls to 0 along half a cosine."""
    if progress.share < WARM_UP:
        return highest * (progress.share + 1e-3) / (WARM_UP + 1e-3)
    return highest * 0.5 * (1.0 + cos(pi * (progress.share - WARM_UP) / (1.0 - WARM_UP)))
