"""A task that learns in a second: a line through points, with what real tasks have.

``torchrun toy_task.py FOLDER`` trains it there, without dropout, which differs between processes.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from semviz_core.common.errors import SemvizError
from semviz_core.research.training.batch import Progress, cosine
from semviz_core.research.training.trainer import Trainer, TrainingOptions


@dataclass(frozen=True, eq=False)
class Points:
    x: Tensor
    y: Tensor


def fresh_network(dropout: float = 0.1) -> nn.Module:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(4, 16), nn.Dropout(dropout), nn.ReLU(), nn.Linear(16, 1))


@dataclass
class ToyTask:
    name: str = "toy"
    options: dict[str, Any] = field(default_factory=lambda: {"width": 16, "classes": ["pole"]})
    samples: int = 480
    delay_s: float = 0.0
    nan_from: int | None = None
    broken_from: int | None = None
    infinite: range = range(0)
    """Samples whose loss is infinite."""
    network: nn.Module = field(default_factory=fresh_network)

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, 0.01)

    def make(self, number: int) -> np.ndarray:
        if self.broken_from is not None and number >= self.broken_from:
            raise SemvizError("no frame has 4 labels")
        point = np.random.default_rng(number).normal(size=4)
        if self.nan_from is not None and number >= self.nan_from:
            point[2] = np.nan
        return point

    def held_out(self, number: int) -> np.ndarray:
        return np.random.default_rng([1, number]).normal(size=4)

    def collate(self, items: Sequence[np.ndarray]) -> Points:
        x = torch.from_numpy(np.stack(items)).float()
        return Points(x, (x @ torch.tensor([1.0, -2.0, 0.5, 3.0]))[:, None])

    def losses(self, batch: Points, progress: Progress) -> dict[str, Tensor]:
        time.sleep(self.delay_s)
        loss = (self.network(batch.x) - batch.y).square().mean()
        if progress.samples in self.infinite:
            loss = loss * torch.inf
        return {"loss": loss, "half": loss / 2.0}

    def finish(self) -> None:
        pass

    def figures(self, batch: Points) -> dict[str, Tensor]:
        return {"error": (self.network(batch.x) - batch.y).abs().mean()}


TOGETHER = TrainingOptions(samples=400, batch=4, held_out=8, workers=0)


if __name__ == "__main__":
    training = Trainer(ToyTask(network=fresh_network(dropout=0.0)), Path(sys.argv[1]), TOGETHER)
    print(training.run())
    training.process_group.leave()
