"""What people wait for, on the terminal's error stream, so that output can be piped."""

import sys
from collections.abc import Iterable, Iterator
from functools import cache
from math import isfinite
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from semviz_core.learning.checkpoint import Course
    from semviz_core.learning.training import Moment

Item = TypeVar("Item")
EVERY_S = 0.5
"""A training's bar is drawn so often: its steps take milliseconds."""
SMOOTH = 0.02
"""Weight of a step in the loss that is shown."""


def track(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield ``items`` while a bar, on a terminal, shows how many of ``total`` are done."""
    from rich.console import Console
    from rich.progress import track as rich_track

    console = Console(stderr=True)
    silent = not console.is_terminal  # in a log file, one line an error is all people want
    return iter(rich_track(items, description=what, total=total, console=console, disable=silent))


@cache  # one listener is enough
def tell_of_compiling() -> None:
    """From here on say, once, why the first frame takes long, if it does."""
    from semviz_core.compiled import tell_when_compiling

    tell_when_compiling(
        lambda: print("compiling the solver, only this once: up to a minute", file=sys.stderr)
    )


class Steps:
    """A bar for each step of something long, on a terminal; within ``with``."""

    def __enter__(self) -> "Steps":
        from rich.console import Console
        from rich.progress import Progress

        console = Console(stderr=True)
        self._bars = Progress(console=console, disable=not console.is_terminal)
        self._tasks: dict[str, Any] = {}
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def show(self, what: str, done: int, of: int) -> None:
        """That so much of a step is done."""
        if what not in self._tasks:
            self._tasks[what] = self._bars.add_task(what, total=of)
        self._bars.update(self._tasks[what], completed=done, total=of)


class TrainingBar:
    """How a training gets on: a bar with loss and speed on a terminal; everywhere, a line with
    held-out figures when they were taken. Within ``with``."""

    def __init__(self, what: str, course: "Course") -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        self._bar = Progress(
            *columns, console=console, disable=not console.is_terminal, refresh_per_second=1
        )
        self._task = self._bar.add_task(what, total=course.of, completed=course.samples)
        self._what, self._first, self._loss = what, course.samples, float("nan")
        self._start_s = self._shown_s = perf_counter()

    def __enter__(self) -> "TrainingBar":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def show(self, moment: "Moment") -> None:
        """What is so after a step."""
        if isfinite(moment.loss):
            before = self._loss if isfinite(self._loss) else moment.loss
            self._loss = before + SMOOTH * (moment.loss - before)
        now = perf_counter()
        if now - self._shown_s > EVERY_S:
            self._shown_s = now
            self._bar.update(self._task, completed=moment.samples, description=self._told(moment))
        if moment.held_out:
            figures = "  ".join(f"{name} {value:.4g}" for name, value in moment.held_out.items())
            print(f"{self._told(moment)}  held out: {figures}", file=sys.stderr)

    def _told(self, moment: "Moment") -> str:
        speed = (moment.samples - self._first) / (perf_counter() - self._start_s)
        seen = f"{self._what} {moment.samples}/{moment.of}"
        return f"{seen}  loss {self._loss:.4g}  {speed:.0f} a second"
