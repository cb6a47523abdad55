"""Wall time of the stages of a method."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class Stopwatch:
    time_ms: dict[str, float] = field(default_factory=dict)
    """By stage, in order."""

    def time(self, stage: str, action: Callable[[], Result]) -> Result:
        start = perf_counter()
        result = action()
        self.time_ms[stage] = (perf_counter() - start) * 1e3
        return result
