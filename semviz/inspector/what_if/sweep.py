"""Kept changes tried on all frames in which they matter, and what came of it saved as a run."""

from collections.abc import Sequence
from pathlib import Path

from semviz.inspector.background import Background
from semviz.inspector.what_if.views import Json
from semviz.recording.run import Run
from semviz.trying.change import Change
from semviz.trying.over import Tried, concerned, free_path, in_words, save, tried


class Sweep(Background[tuple[Tried, ...]]):
    """One pass over a run's frames; what was tried until it is stopped counts."""

    def __init__(self, run: Run, changes: tuple[Change, ...]) -> None:
        super().__init__()
        self.run = run
        self.changes = changes

    def work(self) -> tuple[Tried, ...]:
        self.tell_doing("looking for frames in which it matters")
        records = concerned(self.run, self.changes)
        watched = self.watch(records, "tried", len(records))
        return tuple(tried(self.run, record, self.changes) for record in watched)

    @property
    def is_whole(self) -> bool:
        """Whether all was tried."""
        return self.value is not None and not self.is_stopped

    def view(self) -> Json:
        """How far it is, or what came of it."""
        if self.value is None:
            return {"isOver": self.is_over, "canSave": False, "text": self.doing, "changed": []}
        frames = [one.change for one in self.value]
        stopped = "" if self.is_whole else "Stopped. "
        return {
            "isOver": True,
            "canSave": self.is_whole and bool(frames),
            "text": stopped + in_words(frames),
            "changed": [
                {"index": one.index, "change": one.change} for one in frames if one.change != "same"
            ],
        }


class Save(Background[Path]):
    """A new run beside the run's file: its frames as a sweep found them."""

    def __init__(self, sweep: Sweep, found: Sequence[Tried], beside: Path) -> None:
        super().__init__()
        self._sweep = sweep
        self._found = {one.change.index: one.record for one in found}
        self._beside = beside

    def work(self) -> Path:
        path = free_path(self._beside, "tried")
        save(self._sweep.run, self._sweep.changes, self._found, path)
        return path

    @property
    def said(self) -> str:
        """Where it is, or why it is nowhere."""
        if not self.is_over:
            return "Saving."
        if self.value is None:
            return f"Not saved: {self.doing}"
        return f"Saved as {self.value}. Compare: semviz compare {self._beside} {self.value}"
