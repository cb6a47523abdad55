"""What people wait for, on the terminal's error stream, so that output can be piped."""

import sys
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any, TypeVar

Item = TypeVar("Item")


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
