"""The runs on offer, read when first asked for."""

import gc
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

from semviz.recording.run import Run
from semviz.run_names import run_names
from semviz_core.errors import SemvizError

Made = TypeVar("Made")


class Shelf:
    """Runs by name; a broken one raises SemvizError when it is opened, not before. Thread-safe."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise SemvizError("no run to show; 'semviz localize' records one")
        self._paths = dict(zip(run_names(paths), paths, strict=True))
        self._runs: dict[str, Run] = {}
        self._kept: dict[tuple[str, Callable[[Run, Path], Any]], object] = {}
        self._lock = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        """Of each run: one may take seconds to read, and other pages show others."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def run(self, name: str) -> Run:
        """The run called ``name``. Raises SemvizError for an unknown or broken one."""
        from semviz.recording.reader import load_run

        if name not in self._paths:
            raise SemvizError(f"there is no run '{name}' here; there are {', '.join(self._paths)}")
        with self._lock_of(name):
            if name not in self._runs:
                self._runs[name] = load_run(self._paths[name])
                gc.freeze()  # it stays: to look through it for garbage would hold up all pages
            return self._runs[name]

    def path(self, name: str) -> Path:
        """The file of the run called ``name``."""
        return self._paths[name]

    def offer(self, path: Path) -> str:
        """Puts a run on offer, where it is not yet; its name."""
        with self._lock:
            if path not in self._paths.values():
                names = run_names([*self._paths.values(), path])
                name = names[-1] if names[-1] not in self._paths else str(path)
                self._paths[name] = path
            return next(name for name, one in self._paths.items() if one == path)

    def kept(self, name: str, make: Callable[[Run, Path], Made]) -> Made:
        """What ``make`` makes of the run called ``name`` and its file: made once, then kept."""
        run = self.run(name)
        with self._lock_of(name):
            if (name, make) not in self._kept:
                self._kept[name, make] = make(run, self._paths[name])
            return cast(Made, self._kept[name, make])

    def _lock_of(self, name: str) -> threading.Lock:
        with self._lock:
            return self._locks.setdefault(name, threading.Lock())
