"""Cost of a training step of 12 samples besides the network: transfer of samples, Adam, saving.

    python bench/training_step.py                 a minute, on one core for each of two processes

Processor time of the process that trains, which is what a training waits for; and what torch's own
way of handing tensors over (shared memory, a file each) would cost instead.
"""

import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}

import torch
from torch.utils.data import DataLoader, Dataset

from semviz.research.training_run import make_training_task
from semviz_core.research.training.batch import Progress, TrainingTask
from semviz_core.research.training.checkpoint import (
    Checkpoint,
    Learner,
    TrainingProgress,
    init_process_group,
)
from semviz_core.research.training.trainer import packed

BATCH, BATCHES, TURNS = 12, 20, 1000
SHARES = {"correspondence loss": 0.0, "with pose loss": 0.7}
"""Of the training, in which a step is timed."""


class Ready(Dataset[Any]):
    """Batches that cost their worker nothing."""

    def __init__(self, made: list[Any]) -> None:
        self.made = made

    def __getitem__(self, number: int) -> Any:
        return self.made[number % len(self.made)]


def made_batches(task: TrainingTask[Any, Any], first: int) -> list[Any]:
    starts = range(first, first + BATCH * BATCHES, BATCH)
    return [task.collate([task.make(k) for k in range(start, start + BATCH)]) for start in starts]


def handing_over_ms(made: list[Any], receive: Callable[[Any], Any]) -> float:
    loader = DataLoader(
        Ready(made), batch_size=None, sampler=range(TURNS), num_workers=1, collate_fn=receive
    )
    start = process_time()
    for batch in loader:
        if isinstance(batch, bytes):
            pickle.loads(batch)
    return (process_time() - start) / TURNS * 1e3


def as_it_is(value: Any) -> Any:
    return value


def step_ms(learner: Learner, batches: list[Any], share: float) -> float:
    progress = Progress(int(share * 1e6), 1_000_000)
    for batch in batches[:3]:
        learner.step(batch, progress)
    start = process_time()
    for batch in batches:
        learner.step(batch, progress)
    return (process_time() - start) / len(batches) * 1e3


def main() -> None:
    torch.set_num_threads(1)
    task = make_training_task("paper")
    made_batches(task, 0)  # their roads, too, which many more stand on
    start = process_time()
    batches = made_batches(task, BATCH * BATCHES)
    each_ms = (process_time() - start) / len(batches) * 1e3
    print(f"made by a worker:     {each_ms:6.1f} ms a batch")
    ours_ms = handing_over_ms([packed(batch) for batch in batches], as_it_is)
    torch_ms = handing_over_ms(batches, as_it_is)
    print(f"handed over:          {ours_ms:6.2f} ms a batch (in shared memory: {torch_ms:.2f} ms)")
    learner = Learner(task, init_process_group())
    for name, share in SHARES.items():
        print(f"step, {name + ':':<20}{step_ms(learner, batches, share):6.1f} ms")
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        Checkpoint({}, TrainingProgress(), learner.state()).save(
            Path(folder) / "checkpoint.safetensors"
        )
        print(f"checkpoint:           {(perf_counter() - start) * 1e3:6.1f} ms, once a minute")


if __name__ == "__main__":
    main()
