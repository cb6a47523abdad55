"""Report how far long work has come."""

from collections.abc import Callable
from typing import TypeAlias

OnProgress: TypeAlias = Callable[[str, int, int], None]
"""Called with the name of a step, the number of its parts that are done, and of all. May raise to
stop the work."""

OnCount: TypeAlias = Callable[[int, int], None]
"""`OnProgress` of work that has a single step: the number of parts done, and of all."""


def unwatched(*progress: object) -> None:
    """Nobody wants to know: the default of `on_progress`."""
