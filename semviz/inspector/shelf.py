"""The runs on offer, read when first asked for."""

import threading
from collections.abc import Sequence
from pathlib import Path

from semviz.inspector.decisions import Decisions
from semviz.inspector.forecast import Forecast
from semviz.recording.run import Run
from semviz_core.errors import SemvizError


class Shelf:
    """Runs by name; a broken one raises SemvizError when it is opened, not before. Thread-safe."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise SemvizError("no run to show; 'semviz localize' records one")
        self._paths = dict(zip(run_names(paths), paths, strict=True))
        self._runs: dict[str, Run] = {}
        self._decisions: dict[str, Decisions] = {}
        self._forecasts: dict[str, Forecast] = {}
        self._lock = threading.Lock()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def run(self, name: str) -> Run:
        """The run called ``name``. Raises SemvizError for an unknown or broken one."""
        from semviz.recording.reader import load_run

        if name not in self._paths:
            raise SemvizError(f"there is no run '{name}' here; there are {', '.join(self._paths)}")
        with self._lock:
            if name not in self._runs:
                self._runs[name] = load_run(self._paths[name])
            return self._runs[name]

    def decisions(self, name: str) -> Decisions:
        """What was decided for the map of the run called ``name``."""
        run = self.run(name)
        with self._lock:
            if name not in self._decisions:
                self._decisions[name] = Decisions(run, self._paths[name])
            return self._decisions[name]

    def forecast(self, name: str) -> Forecast:
        """What the map of the run called ``name`` lets a camera know along its route."""
        run = self.run(name)
        with self._lock:
            return self._forecasts.setdefault(name, Forecast(run))


def run_names(paths: Sequence[Path]) -> list[str]:
    """File names without ending, with as many folders before them as tell them apart."""
    whole = [path.resolve().with_suffix("").parts for path in paths]
    names = [parts[-1] for parts in whole]
    depth = 1
    while len(set(names)) < len(set(whole)):
        depth += 1
        names = ["/".join(parts[-depth:]) for parts in whole]
    return names
