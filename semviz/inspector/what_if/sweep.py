"""Kept changes tried on all frames in which they matter: in a thread, with progress, and saved."""

import threading
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from semviz.inspector.what_if.views import Json
from semviz.recording.run import FrameRecord, Run
from semviz.trying.change import Change
from semviz.trying.over import Tried, concerned, free_path, in_words, save, tried
from semviz_core.errors import SemvizError

TELL_EVERY_S = 0.2


class Sweep:
    """One pass over a run's frames; ``tell`` is called in its thread as it gets on."""

    def __init__(
        self, run: Run, changes: tuple[Change, ...], tell: Callable[["Sweep"], None]
    ) -> None:
        self._run = run
        self._changes = changes
        self._tell = tell
        self._total: int | None = None
        self._found: list[Tried] = []
        self._stopped = threading.Event()
        self._said = ""

    def start(self) -> None:
        threading.Thread(target=self._work, name="what-if sweep", daemon=True).start()

    def stop(self) -> None:
        """After the frame in hand."""
        self._stopped.set()

    def view(self) -> Json:
        """How far it is, and what came of it."""
        frames = tuple(one.change for one in self._found)
        return {
            "done": len(frames),
            "total": self._total,
            "isRunning": self._is_running,
            "isWhole": self._is_whole,
            "text": "" if self._is_running else in_words(frames),
            "said": self._said,
            "changed": [
                {"index": one.index, "change": one.change} for one in frames if one.change != "same"
            ],
        }

    def save(self, beside: Path) -> None:
        """A new run beside the run's file, in a thread. SemvizError where not all was tried."""
        if not self._is_whole:
            raise SemvizError("not all frames were tried; try them again, then save")
        self._said = "Saving."
        self._tell(self)
        threading.Thread(target=lambda: self._write(beside), name="what-if save").start()

    def _write(self, beside: Path) -> None:
        found: dict[int, FrameRecord] = {one.change.index: one.record for one in self._found}
        path = free_path(beside, "tried")
        try:
            save(self._run, self._changes, found, path)
            self._said = f"Saved as {path}. Compare: semviz compare {beside} {path}"
        except SemvizError as error:
            self._said = f"Not saved: {error}"
        self._tell(self)

    @property
    def _is_whole(self) -> bool:
        return self._total is not None and len(self._found) == self._total

    @property
    def _is_running(self) -> bool:
        return not (self._is_whole or self._stopped.is_set())

    def _work(self) -> None:
        told_s = monotonic()
        try:
            records = concerned(self._run, self._changes)
            self._total = len(records)
            self._tell(self)
            for record in records:
                if self._stopped.is_set():
                    break
                self._found.append(tried(self._run, record, self._changes))
                if monotonic() - told_s > TELL_EVERY_S:
                    told_s = monotonic()
                    self._tell(self)
        except SemvizError as error:
            self._said = str(error)
            self.stop()
        self._tell(self)
