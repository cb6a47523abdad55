"""Train a task from its samples to its weights, interruptible and resumable at any step.

Worker processes prepare batches ahead, in the order of their numbers. A dying worker raises a
SemvizError at once; torch reports it by a signal that may arrive inside a step. The machine is
described without naming it, for example "AMD EPYC 7B13, 2 cores".
"""

import os
import pickle
import platform
import signal
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from time import perf_counter
from typing import IO, Any, Literal

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from semviz_core.common.errors import SemvizError
from semviz_core.research.training import checkpoint
from semviz_core.research.training.batch import Progress, TrainingTask

MOST_SAMPLES = 10_000_000
"""Largest number of samples of a training; its items are numbered from seed x this on."""
MOST_SEEDS = 100
AHEAD = 4
"""Batches that each worker prepares ahead."""


class BatchLoader(Dataset[bytes]):
    """Batch k of a training as bytes: a pure function of k.

    Workers also collate, and pickle the batch with its tensors as arrays. This is cheaper than
    torch's shared memory, which takes a file for each tensor, and needs no space in /dev/shm.
    """

    def __init__(
        self, task: TrainingTask[Any, Any], seed: int, batch: int, rank: int, world: int
    ) -> None:
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


def load(batches: BatchLoader, steps: range, workers: int) -> Generator[Any, None, None]:
    """Yield the batches of ``steps`` in order; use within ``raise_on_dead_worker``.

    Raise SemvizError if one cannot be made.
    """
    loader = DataLoader(
        batches,
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        collate_fn=_unchanged,
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
def raise_on_dead_worker() -> Iterator[None]:
    """Raise SemvizError if a worker dies. torch reports this from a signal handler, so its error
    can come up anywhere, even in the middle of a step."""
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise SemvizError(
            "a worker process ended (out of memory?); the same command resumes from the last "
            "checkpoint"
        ) from None


def held_out_batches(
    task: TrainingTask[Any, Any], number: int, batch: int
) -> list[tuple[int, Any]]:
    """Return ``number`` validation items in batches of ``batch``, each with its size."""
    ranges = (range(first, min(first + batch, number)) for first in range(0, number, batch))
    return [
        (len(range_), task.collate([task.held_out(item) for item in range_])) for range_ in ranges
    ]


def packed(value: Any) -> bytes:
    """Pickle ``value`` with its tensors as arrays. Raise SemvizError if a number is NaN."""
    written = BytesIO()
    _Pickler(written, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    return written.getvalue()


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, Tensor):
            return NotImplemented
        if value.is_floating_point() and value.isnan().any():
            raise SemvizError("a number is NaN; fix the data")
        return torch.from_numpy, (value.numpy(),)


def _unchanged(content: Any) -> Any:
    return content


def _start_worker(_: int) -> None:
    """Ignore Ctrl-C and SIGTERM, which reach workers too: the training process ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def describe_machine(device: torch.device, processes: int) -> str:
    """Return for example ``AMD EPYC 7B13, 2 cores``, then the GPU and the number of processes."""
    words = [_cpu(), f"{os.cpu_count()} cores"]
    if device.type == "cuda":
        words.append(torch.cuda.get_device_name(device))
    if processes > 1:
        words.append(f"{processes} processes")
    return ", ".join(words)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

CHECKPOINT, HISTORY, LOCK = "checkpoint.safetensors", "losses.jsonl", "lock"
MEASUREMENTS = 40
"""Number of validations in a training, unless it is short."""
LEAST_SEEN = 4
"""Least number of samples trained on between validations, per validation item."""
MEASURE_S = 20.0
"""After so long, a validation begins no further batch."""
MOST_SKIPPED = 50
"""Most consecutive steps that may be skipped."""
Ending = Literal["finished", "time is over", "interrupted"]


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training."""

    samples: int | None = None
    """Total, rounded up to whole batches (default: the earlier plan, or the task's)."""
    batch: int = 12
    """Batch size over all processes."""
    seed: int = 0
    workers: int = 1
    """Worker processes per training process; with 0 it makes the items itself."""
    precision: checkpoint.Precision = "float32"
    held_out: int = 240
    """Number of validation items."""
    stop_after_s: float = float("inf")
    save_every_s: float = 60.0


@dataclass(frozen=True)
class TrainerEvent:
    """The state after a step, for display."""

    samples: int
    of: int
    loss: float
    held_out: dict[str, float]
    """Validation figures, if just measured."""


class Trainer:
    """Trains one task in one folder."""

    def __init__(
        self, task: TrainingTask[Any, Any], folder: Path, options: TrainingOptions
    ) -> None:
        """Resume from the folder's checkpoint, if any. Raise SemvizError if it belongs to another
        training."""
        torch.set_num_threads(1)  # samples are small: more threads would wait for each other
        self.process_group = checkpoint.init_process_group()
        _check(options, self.process_group)
        if self.process_group.leads:
            self._lock = _locked(folder)
        self._task, self._options, self._path = task, options, folder / CHECKPOINT
        self._identity = {
            "task": task.name, "options": task.options,
            "seed": options.seed, "batch": options.batch,
        }  # fmt: skip
        self._learner = checkpoint.Learner(task, self.process_group, options.precision)
        self.progress = self._resumed_progress()
        self._plan()
        if self.process_group.leads:
            self._history = checkpoint.LossLog(folder / HISTORY, self.progress.samples)
        self._held_out: list[tuple[int, Any]] = []
        self._started_s = self._counted_s = perf_counter()

    def run(self, tell: Callable[[TrainerEvent], None] = lambda event: None) -> Ending:
        """Train until all samples are seen, the time is over or a signal stops it; then save.

        Raise SemvizError if items cannot be made, losses are not finite or files cannot be written;
        the last checkpoint then stays.
        """
        ending: Ending = "finished"
        skipped = 0
        with (
            _stop_requested() as stop_signals,
            raise_on_dead_worker(),
            closing(self._batches()) as batches,
        ):
            for batch in batches:
                event, done = self._step(batch)
                tell(event)
                skipped = 0 if done else skipped + 1
                _check_skipped(skipped, self.progress)
                over = perf_counter() - self._started_s > self._options.stop_after_s
                if self.process_group.any(bool(stop_signals) or over):
                    ending = "interrupted" if stop_signals else "time is over"
                    break
                if perf_counter() - self._counted_s > self._options.save_every_s:
                    self._save()
        if ending == "finished":
            self._task.finish()
        self._save()
        return ending

    def _resumed_progress(self) -> checkpoint.TrainingProgress:
        """Restore the folder's checkpoint and return its progress, or that of a new training."""
        if not self._path.is_file():
            return checkpoint.TrainingProgress()
        stored = checkpoint.Checkpoint.load(self._path)
        stored.check(self._identity, self._path)
        try:
            self._learner.restore(stored.tensors)
        except (KeyError, RuntimeError):
            raise SemvizError(
                f"{self._path}: the weights of another network than {self._task.name} is now: "
                "give another --out"
            ) from None
        return stored.progress

    def _plan(self) -> None:
        """Plan the total number of samples."""
        progress, batch = self.progress, self._options.batch
        planned = progress.of if progress.plans else self._task.samples
        wanted = -(-(self._options.samples or planned) // batch) * batch
        if wanted < progress.samples:
            raise SemvizError(
                f"{self._path}: has seen {progress.samples} samples already, more than {wanted}"
            )
        if not progress.plans or wanted != planned:
            progress.plans.append((progress.samples, wanted))

    def _batches(self) -> Generator[Any, None, None]:
        progress, options, process_group = self.progress, self._options, self.process_group
        batches = BatchLoader(
            self._task, options.seed, options.batch, process_group.rank, process_group.world
        )
        steps = range(progress.samples // options.batch, progress.of // options.batch)
        return load(batches, steps, options.workers)

    def _step(self, batch: Any) -> tuple[TrainerEvent, bool]:
        """Run a step; return its event and whether it was made. Only the leading process logs."""
        progress, size = self.progress, self._options.batch
        losses, done = self._learner.step(batch, Progress(progress.samples, progress.of))
        progress.samples += size
        progress.skipped += not done
        checkpoint.add(progress.window, losses)
        last = progress.samples == progress.of
        if last or progress.samples // size % checkpoint.WINDOW_STEPS == 0:
            self._write(losses=checkpoint.means(progress.window))
            progress.window.clear()
        every = max(progress.of // MEASUREMENTS, LEAST_SEEN * self._options.held_out)
        measured = last or progress.samples // every > (progress.samples - size) // every
        held_out = self._measure() if measured and self.process_group.leads else {}
        return TrainerEvent(progress.samples, progress.of, losses["loss"], held_out), done

    def _measure(self) -> dict[str, float]:
        """Measure and return the figures of the validation items."""
        start, sums = perf_counter(), checkpoint.Window()
        self._held_out = self._held_out or held_out_batches(
            self._task, self._options.held_out, self._options.batch
        )
        number = 0
        for items, batch in self._held_out:
            checkpoint.add(sums, self._learner.measure(batch), items)
            number += items
            if perf_counter() - start > MEASURE_S:
                break
        self.progress.held_out = {"items": number, **checkpoint.means(sums)}
        self._write(held_out=self.progress.held_out)
        return self.progress.held_out

    def _write(self, **values: dict[str, float]) -> None:
        if self.process_group.leads:
            self._history.write(self.progress.samples, **values)

    def _save(self) -> None:
        now = perf_counter()
        machine = describe_machine(self.process_group.device, self.process_group.world)
        earlier = self.progress.seconds.get(machine, 0.0)
        self.progress.seconds[machine] = earlier + now - self._counted_s
        self._counted_s = now
        if self.process_group.leads:
            checkpoint.Checkpoint(self._identity, self.progress, self._learner.state()).save(
                self._path
            )


def _locked(folder: Path) -> IO[bytes]:
    """Return a file in the folder that is locked while open, so that no other process trains
    there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("wb")
    except OSError as error:
        raise SemvizError(f"{folder}: cannot be written ({error.strerror})") from None
    if fcntl is not None:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # not inherited by workers
        except OSError:
            raise SemvizError(f"{folder}: another process is training there") from None
    return file


def _check(options: TrainingOptions, process_group: checkpoint.ProcessGroup) -> None:
    samples = 1 if options.samples is None else options.samples
    for number, name, least, most in (
        (samples, "samples", 1, MOST_SAMPLES),
        (options.batch, "batch", 1, 1000),
        (options.seed, "seed", 0, MOST_SEEDS - 1),
        (options.workers, "workers", 0, 1000),
        (options.held_out, "held-out", 1, 100_000),
    ):
        if not least <= number <= most:
            raise SemvizError(f"--{name} {number}: give {least} to {most}")
    if options.batch % process_group.world:
        raise SemvizError(
            f"--batch {options.batch}: not a multiple of {process_group.world} processes"
        )
    if options.precision != "float32" and not checkpoint.has_bf16(process_group.device):
        raise SemvizError(
            f"--precision {options.precision}: is for a GPU or a processor with AMX or AVX-512 "
            "BF16; none is here"
        )


def _check_skipped(skipped: int, progress: checkpoint.TrainingProgress) -> None:
    if skipped == MOST_SKIPPED:
        raise SemvizError(
            f"{MOST_SKIPPED} steps in a row had losses or gradients that are not finite; stopped "
            f"at sample {progress.samples}, the last checkpoint is kept"
        )


@contextmanager
def _stop_requested() -> Iterator[list[int]]:
    """Yield a list to which a first SIGINT or SIGTERM appends its number; a second one stops at
    once."""
    signals: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def handle(number: int, _: object) -> None:
        signals.append(number)
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, handle)
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
