"""Training: from a task's items to its weights, stopped and gone on with at any moment."""

import signal
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import IO, Any, Literal

import torch

from semviz_core.errors import SemvizError
from semviz_core.learning.checkpoint import Checkpoint, Course
from semviz_core.learning.crew import Crew, join
from semviz_core.learning.history import WINDOW_STEPS, History, Window, add, means
from semviz_core.learning.learner import Learner, Precision, has_bf16
from semviz_core.learning.loading import (
    MOST_SAMPLES,
    MOST_SEEDS,
    Batches,
    held_out_batches,
    load,
    telling_of_dead_workers,
)
from semviz_core.learning.machine import describe_machine
from semviz_core.learning.task import Progress, Task

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

CHECKPOINT, HISTORY, LOCK = "checkpoint.safetensors", "losses.jsonl", "lock"
MEASUREMENTS = 40
"""Held-out figures are taken so often in a training, if it is not short."""
LEAST_SEEN = 4
"""For each item that is measured, so many are trained on first."""
MEASURE_S = 20.0
"""After so long, a measurement begins no further batch."""
MOST_SKIPPED = 50
"""Steps in a row."""
Ending = Literal["finished", "time is over", "interrupted"]


@dataclass(frozen=True)
class TrainingOptions:
    """How a task is trained."""

    samples: int | None = None
    """In all, rounded up to whole batches; if none, as planned before, or as the task plans."""
    batch: int = 12
    """Over all processes together."""
    seed: int = 0
    workers: int = 1
    """Processes that make items, for each that trains; 0 for none."""
    precision: Precision = "float32"
    held_out: int = 240
    """How many items that are never trained on are measured."""
    stop_after_s: float = float("inf")
    save_every_s: float = 60.0


@dataclass(frozen=True)
class Moment:
    """What there is to tell after a step."""

    samples: int
    of: int
    loss: float
    held_out: dict[str, float]
    """Figures, if they were just taken."""


class Training:
    """One task that is trained in one folder."""

    def __init__(self, task: Task[Any, Any], folder: Path, options: TrainingOptions) -> None:
        """Goes on with what the folder holds; raises SemvizError where that is something else."""
        torch.set_num_threads(1)  # samples are small: more threads would wait for each other
        self.crew = join()
        _check(options, self.crew)
        if self.crew.leads:
            self._lock = _locked(folder)
        self._task, self._options, self._path = task, options, folder / CHECKPOINT
        self._identity = {
            "task": task.name, "options": task.options,
            "seed": options.seed, "batch": options.batch,
        }  # fmt: skip
        self._learner = Learner(task, self.crew, options.precision)
        self.course = self._found()
        self._plan()
        if self.crew.leads:
            self._history = History(folder / HISTORY, self.course.samples)
        self._held_out: list[tuple[int, Any]] = []
        self._started_s = self._counted_s = perf_counter()

    def run(self, tell: Callable[[Moment], None] = lambda moment: None) -> Ending:
        """Train until all samples are seen, time is over, or ctrl-C or SIGTERM comes; then save.

        Raises SemvizError where items cannot be made, losses are not finite or files cannot be
        written; the last checkpoint then stays.
        """
        ending: Ending = "finished"
        in_a_row = 0
        with (
            _asked_to_stop() as asked,
            telling_of_dead_workers(),
            closing(self._batches()) as batches,
        ):
            for batch in batches:
                moment, done = self._step(batch)
                tell(moment)
                in_a_row = 0 if done else in_a_row + 1
                _check_skipped(in_a_row, self.course)
                over = perf_counter() - self._started_s > self._options.stop_after_s
                if self.crew.any(bool(asked) or over):
                    ending = "interrupted" if asked else "time is over"
                    break
                if perf_counter() - self._counted_s > self._options.save_every_s:
                    self._save()
        if ending == "finished":
            self._task.finish()
        self._save()
        return ending

    def _found(self) -> Course:
        """Of the checkpoint in the folder, whose weights are taken; of a new training if none."""
        if not self._path.is_file():
            return Course()
        found = Checkpoint.load(self._path)
        found.check(self._identity, self._path)
        try:
            self._learner.restore(found.tensors)
        except (KeyError, RuntimeError):
            raise SemvizError(
                f"{self._path}: the weights of another network than {self._task.name} is now: "
                "give another --out"
            ) from None
        return found.course

    def _plan(self) -> None:
        """How many samples in all, from here on."""
        course, batch = self.course, self._options.batch
        planned = course.of if course.plans else self._task.samples
        wanted = -(-(self._options.samples or planned) // batch) * batch
        if wanted < course.samples:
            raise SemvizError(
                f"{self._path}: has seen {course.samples} samples already, more than {wanted}"
            )
        if not course.plans or wanted != planned:
            course.plans.append((course.samples, wanted))

    def _batches(self) -> Generator[Any, None, None]:
        course, options, crew = self.course, self._options, self.crew
        batches = Batches(self._task, options.seed, options.batch, crew.rank, crew.world)
        steps = range(course.samples // options.batch, course.of // options.batch)
        return load(batches, steps, options.workers)

    def _step(self, batch: Any) -> tuple[Moment, bool]:
        """One step, and whether it was made; the history is of the leading process's items."""
        course, size = self.course, self._options.batch
        losses, done = self._learner.step(batch, Progress(course.samples, course.of))
        course.samples += size
        course.skipped += not done
        add(course.window, losses)
        last = course.samples == course.of
        if last or course.samples // size % WINDOW_STEPS == 0:
            self._write(losses=means(course.window))
            course.window.clear()
        every = max(course.of // MEASUREMENTS, LEAST_SEEN * self._options.held_out)
        measured = last or course.samples // every > (course.samples - size) // every
        held_out = self._measure() if measured and self.crew.leads else {}
        return Moment(course.samples, course.of, losses["loss"], held_out), done

    def _measure(self) -> dict[str, float]:
        """Figures of the same held-out items each time."""
        start, sums = perf_counter(), Window()
        self._held_out = self._held_out or held_out_batches(
            self._task, self._options.held_out, self._options.batch
        )
        number = 0
        for items, batch in self._held_out:
            add(sums, self._learner.measure(batch), items)
            number += items
            if perf_counter() - start > MEASURE_S:
                break
        self.course.held_out = {"items": number, **means(sums)}
        self._write(held_out=self.course.held_out)
        return self.course.held_out

    def _write(self, **facts: dict[str, float]) -> None:
        if self.crew.leads:
            self._history.write(self.course.samples, **facts)

    def _save(self) -> None:
        now = perf_counter()
        machine = describe_machine(self.crew.device, self.crew.world)
        before = self.course.seconds.get(machine, 0.0)
        self.course.seconds[machine] = before + now - self._counted_s
        self._counted_s = now
        if self.crew.leads:
            Checkpoint(self._identity, self.course, self._learner.state()).save(self._path)


def _locked(folder: Path) -> IO[bytes]:
    """A file in the folder that is locked while it is open, so that nobody else trains there."""
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


def _check(options: TrainingOptions, crew: Crew) -> None:
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
    if options.batch % crew.world:
        raise SemvizError(f"--batch {options.batch}: not a multiple of {crew.world} processes")
    if options.precision != "float32" and not has_bf16(crew.device):
        raise SemvizError(
            f"--precision {options.precision}: is for a GPU or a processor with AMX; none is here"
        )


def _check_skipped(in_a_row: int, course: Course) -> None:
    if in_a_row == MOST_SKIPPED:
        raise SemvizError(
            f"{MOST_SKIPPED} steps in a row had losses or gradients that are not finite; stopped "
            f"at sample {course.samples}, the last checkpoint is kept"
        )


@contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """A list that gets the number of a signal that asks to stop; a second one stops at once."""
    asked: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def ask(number: int, _: object) -> None:
        asked.append(number)
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, ask)
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
