"""Define what a training needs of a task, and the learning-rate schedule.

The rate rises to its maximum within the first hundredth, then falls to 0 along half a cosine.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, pi
from typing import Any, Protocol, TypeVar

from torch import Tensor, nn

from semviz_core.localization.correspondences.sample import Sample

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
