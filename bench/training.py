"""What a training step of 12 samples costs beside the network: handing samples over, Adam, saving.

    python bench/training.py                 a minute, on one core for each of two processes

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

from semviz_core.learning.checkpoint import Checkpoint, Course
from semviz_core.learning.crew import join
from semviz_core.learning.learner import Learner
from semviz_core.learning.loading import packed
from semviz_core.learning.task import Progress, Task
from semviz_core.learning.tasks import make_task

BATCH, BATCHES, TURNS = 12, 20, 1000
SHARES = {"correspondence loss": 0.0, "with pose loss": 0.7}
"""Of the training, in which a step is timed."""


class Ready(Dataset[Any]):
    """Batches that cost their worker nothing."""

    def __init__(self, made: list[Any]) -> None:
        self.made = made

    def __getitem__(self, number: int) -> Any:
        return self.made[number % len(self.made)]


def made_batches(task: Task[Any, Any], first: int) -> list[Any]:
    starts = range(first, first + BATCH * BATCHES, BATCH)
    return [task.collate([task.make(k) for k in range(one, one + BATCH)]) for one in starts]


def handing_over_ms(made: list[Any], receive: Callable[[Any], Any]) -> float:
    loader = DataLoader(
        Ready(made), batch_size=None, sampler=range(TURNS), num_workers=1, collate_fn=receive
    )
    start = process_time()
    for one in loader:
        if isinstance(one, bytes):
            pickle.loads(one)
    return (process_time() - start) / TURNS * 1e3


def as_it_is(one: Any) -> Any:
    return one


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
    task = make_task("paper")
    made_batches(task, 0)  # their roads, too, which many more stand on
    start = process_time()
    batches = made_batches(task, BATCH * BATCHES)
    each_ms = (process_time() - start) / len(batches) * 1e3
    print(f"made by a worker:     {each_ms:6.1f} ms a batch")
    ours_ms = handing_over_ms([packed(one) for one in batches], as_it_is)
    torch_ms = handing_over_ms(batches, as_it_is)
    print(f"handed over:          {ours_ms:6.2f} ms a batch (in shared memory: {torch_ms:.2f} ms)")
    learner = Learner(task, join())
    for name, share in SHARES.items():
        print(f"step, {name + ':':<20}{step_ms(learner, batches, share):6.1f} ms")
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        Checkpoint({}, Course(), learner.state()).save(Path(folder) / "checkpoint.safetensors")
        print(f"checkpoint:           {(perf_counter() - start) * 1e3:6.1f} ms, once a minute")


if __name__ == "__main__":
    main()
