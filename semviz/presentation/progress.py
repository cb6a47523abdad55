"""Progress bars and notices on standard error, so that output can be piped.

Bars appear only on a terminal. A notice explains a slow first frame while the solver compiles.
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

Item = TypeVar("Item")


def track(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield ``items``; on a terminal, a bar shows how many of ``total`` are done."""
    from rich.console import Console
    from rich.progress import track as rich_track

    console = Console(stderr=True)
    silent = not console.is_terminal  # keep log files short
    return iter(rich_track(items, description=what, total=total, console=console, disable=silent))


@cache  # register one callback only
def announce_compiling(what: str = "the solver") -> None:
    """Print a notice when ``what`` is compiled, which delays the first frame."""
    from semviz_core.common.jit import notify_before_compiling

    notify_before_compiling(
        lambda: print(f"compiling {what}, once only: up to a minute", file=sys.stderr)
    )


@contextmanager
def count_functions() -> Iterator[Callable[[int], None]]:
    """Yield a function that shows on a terminal, in one line, how many functions are compiled."""
    shown = False

    def tell(compiled: int) -> None:
        nonlocal shown
        if sys.stderr.isatty():
            shown = True
            print(f"\r{compiled} functions compiled", end="", file=sys.stderr, flush=True)

    yield tell
    if shown:
        print(file=sys.stderr)


class Steps:
    """Progress bars on a terminal, one for each step of a long job; use it with ``with``."""

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
        """Show that ``done`` of ``of`` parts of the step ``what`` are done."""
        if what not in self._tasks:
            self._tasks[what] = self._bars.add_task(what, total=of)
        self._bars.update(self._tasks[what], completed=done, total=of)
