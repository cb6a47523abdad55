"""Progress bars on the terminal's error stream, so that output can be piped."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def track(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield ``items`` while a bar, on a terminal, shows how many of ``total`` are done."""
    from rich.console import Console
    from rich.progress import track as rich_track

    console = Console(stderr=True)
    silent = not console.is_terminal  # in a log file, one line an error is all people want
    return iter(rich_track(items, description=what, total=total, console=console, disable=silent))
