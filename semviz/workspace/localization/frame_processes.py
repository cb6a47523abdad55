"""Localize the frames of a sequence in several processes.

Each process opens the workspace itself, and localizes the chunks of frames that it gets. A frame
alone depends on no other, so the records are those of one process, but for their times. If a
process dies, this one localizes the remaining frames.
"""

import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Protocol, TypeAlias

from semviz.runs.run import KNOWN_DIAGNOSES, FrameRecord
from semviz_core.diagnosis.fault import FrameDiagnosis

CHUNK = 8
"""Frames that a process gets at once."""
QUEUED = 3
"""Chunks that are asked for of each process before the first is awaited."""

Chunk: TypeAlias = list[tuple[FrameRecord, FrameDiagnosis | None]]
"""Frames and their diagnoses, if these are known."""


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
    ``make``, which is pickled."""
    done = 0
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start, (make,))
    try:
        for chunk in _chunks(pool, count, jobs):
            for record, diagnosis in chunk:
                if diagnosis is not None:
                    KNOWN_DIAGNOSES[record] = diagnosis
                yield record
            done += len(chunk)
    except BrokenProcessPool:
        print(
            f"a process of localize died (out of memory?) at frame {done} of {count}; "
            "one process does the rest",
            file=sys.stderr,
        )
        yield from make().localized(range(done, count))
    finally:
        pool.shutdown(cancel_futures=True)


def _chunks(pool: ProcessPoolExecutor, count: int, jobs: int) -> Iterator[Chunk]:
    """Yield the chunks of frames in order; a few of them are always asked for."""
    waiting: deque[Future[Chunk]] = deque()
    for start in range(0, count, CHUNK):
        with _without_interrupts():
            waiting.append(pool.submit(_localize, range(start, min(start + CHUNK, count))))
        if len(waiting) == QUEUED * jobs:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ignore ctrl-C meanwhile: processes started within ignore it, too, and their parent ends
    them."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _start(make: Callable[[], SeparateFrames]) -> None:
    global _localization
    _localization = make()
    _localization.warmup()


def _localize(rows: range) -> Chunk:
    assert _localization is not None
    records = list(_localization.localized(rows))
    return [(record, KNOWN_DIAGNOSES.get(record)) for record in records]
