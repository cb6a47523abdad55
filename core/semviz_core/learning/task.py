"""What training needs of something that is to be learned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from torch import Tensor, nn

from semviz_core.learning.sample import Sample

Item = TypeVar("Item")
Together = TypeVar("Together")


@dataclass(frozen=True)
class Progress:
    """How far training has come."""

    samples: int
    """Seen before this batch."""
    of: int
    """In the whole training."""

    @property
    def share(self) -> float:
        """In [0, 1)."""
        return self.samples / self.of


class SampleSource(Protocol):
    """Samples by number: a pure function of it. Picklable; used in worker processes."""

    def sample(self, number: int) -> Sample:
        """Training sample ``number``, which may be large."""

    def held_out(self, number: int) -> Sample:
        """Sample ``number`` of those that are never trained on."""

    def describe(self) -> dict[str, Any]:
        """What the samples are made with, as JSON: kept in checkpoints and told in cards."""


class Task(Protocol[Item, Together]):
    """A network, what it learns from, and what it is to make small.

    Everything is a function of numbers, so that training can stop and go on anywhere: item k is the
    same whichever process makes it, and randomness in ``losses`` comes from ``progress``.
    """

    name: str
    network: nn.Module
    options: dict[str, Any]
    """Model, classes and data it was made with, as JSON; a training goes on only with the same."""
    samples: int
    """How many a whole training sees, unless people say otherwise."""

    def learning_rate(self, progress: Progress) -> float:
        """Adam's step size for a batch; ``schedule`` has some."""

    def make(self, number: int) -> Item:
        """Training item ``number``; called in worker processes."""

    def held_out(self, number: int) -> Item:
        """Item ``number`` of those that are never trained on."""

    def collate(self, items: Sequence[Item]) -> Together:
        """Items side by side."""

    def losses(self, together: Together, progress: Progress) -> dict[str, Tensor]:
        """``loss`` to follow downhill, and its parts and other figures to show."""

    def figures(self, together: Together) -> dict[str, Tensor]:
        """Figures of held-out items, each a mean, without gradients."""

    def finish(self) -> None:
        """What is chosen once all is learned, such as thresholds; it is part of the network."""
