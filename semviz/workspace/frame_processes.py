"""Localize the frames of a sequence in several processes.

Each process opens the workspace itself, and localizes the chunks of frames that it gets. A frame
alone depends on no other, so the records are those of one process, but for their times.
"""

import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Protocol

from semviz.runs.run import FrameRecord
from semviz_core.common.errors import SemvizError

CHUNK = 8
"""Frames that a process gets at once."""
QUEUED = 3
"""Chunks that are asked for of each process before the first is awaited."""


class SeparateFrames(Protocol):
    """Frames that are localized each on its own."""

    def warmup(self) -> None:
        """Compile, or load from disk, what localizing needs."""

    def localized(self, rows: range) -> Iterator[FrameRecord]:
        """Yield the records of these frames."""


_localization: SeparateFrames | None = None
"""That of this process, if it is a worker."""


def localized_in_processes(
    make: Callable[[], SeparateFrames], count: int, jobs: int
) -> Iterator[FrameRecord]:
    """Yield the records of frames 0 to ``count``, in order, from ``jobs`` processes that each call
    ``make``, which is pickled. Raise SemvizError if a process dies."""
    chunks = (range(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK))
    waiting: deque[Future[list[FrameRecord]]] = deque()
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start, (make,))
    try:
        for rows in chunks:
            waiting.append(pool.submit(_localize, rows))
            if len(waiting) == QUEUED * jobs:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()
    except BrokenProcessPool:
        raise SemvizError(
            "a process of localize died (out of memory?); run again with fewer --jobs"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _start(make: Callable[[], SeparateFrames]) -> None:
    global _localization
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches us too; our parent ends us
    _localization = make()
    _localization.warmup()


def _localize(rows: range) -> list[FrameRecord]:
    assert _localization is not None
    return list(_localization.localized(rows))
