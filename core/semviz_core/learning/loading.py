"""Training batches, made ahead by worker processes, in the order of their numbers."""

import pickle
import signal
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from semviz_core.errors import SemvizError
from semviz_core.learning.task import Task

MOST_SAMPLES = 10_000_000
"""Of one training. Its items are numbered from seed x this on."""
MOST_SEEDS = 100
AHEAD = 4
"""Batches that each worker has ready."""


class Batches(Dataset[bytes]):
    """Batch k of a training: a pure function of k, whole, as bytes.

    A worker collates too, and what it hands over is pickled with its tensors as arrays: cheaper
    than torch's shared memory, a file for each tensor, and it needs no room in /dev/shm.
    """

    def __init__(self, task: Task[Any, Any], seed: int, batch: int, rank: int, world: int) -> None:
        self._task = task
        self._first = seed * MOST_SAMPLES
        self._batch = batch
        self._mine = slice(rank, None, world)

    def __getitem__(self, step: int) -> bytes:
        first = self._first + step * self._batch
        numbers = range(first, first + self._batch)[self._mine]
        try:
            return packed(self._task.collate([self._task.make(number) for number in numbers]))
        except SemvizError as error:
            return pickle.dumps(SemvizError(f"training items from {first} on: {error}"))


def load(batches: Batches, steps: range, workers: int) -> Generator[Any, None, None]:
    """Those batches, in order, within ``telling_of_dead_workers``. Raises SemvizError where one
    cannot be made."""
    loader = DataLoader(
        batches,
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        collate_fn=_as_it_is,
        prefetch_factor=AHEAD if workers else None,
        worker_init_fn=_start_worker,
        generator=torch.Generator(),
    )
    for content in loader:
        batch = pickle.loads(content)
        if isinstance(batch, SemvizError):
            raise batch
        yield batch


@contextmanager
def telling_of_dead_workers() -> Iterator[None]:
    """Raises SemvizError where a worker dies. torch tells of it by a signal, so that its error
    comes up wherever the process happens to be, in the middle of a step too."""
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise SemvizError(
            "a worker process ended (out of memory?); the same command goes on from the last "
            "checkpoint"
        ) from None


def held_out_batches(task: Task[Any, Any], number: int, batch: int) -> list[tuple[int, Any]]:
    """``number`` held-out items, ``batch`` of them side by side; how many, and they together."""
    ranges = (range(first, min(first + batch, number)) for first in range(0, number, batch))
    return [(len(one), task.collate([task.held_out(item) for item in one])) for one in ranges]


def packed(together: Any) -> bytes:
    """Anything picklable, its tensors as arrays. Raises SemvizError where a number is NaN."""
    written = BytesIO()
    _Pickler(written, protocol=pickle.HIGHEST_PROTOCOL).dump(together)
    return written.getvalue()


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, Tensor):
            return NotImplemented
        if value.is_floating_point() and value.isnan().any():
            raise SemvizError("a number is NaN; mend the data")
        return torch.from_numpy, (value.numpy(),)


def _as_it_is(content: Any) -> Any:
    return content


def _start_worker(_: int) -> None:
    """Ctrl-C reaches workers too, and so does the SIGTERM of whoever ends a whole service; who
    trains is who ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
