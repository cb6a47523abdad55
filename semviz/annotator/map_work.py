"""The last map of a workspace: read when its file changes, looked over, and built anew."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from semviz.workspace import MAIN, Workspace
from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap


@dataclass(frozen=True, eq=False)
class Built:
    """A map with what looks odd in it."""

    semantic_map: SemanticMap
    findings: tuple[Finding, ...]
    """The worst first."""


class MapWork:
    """Works in a thread of its own. What it has found is taken over whole, so anybody may read."""

    def __init__(self, workspace: Workspace, labels: Callable[[], Labels]) -> None:
        self._workspace = workspace
        self._labels = labels
        self._path = workspace.map_path(MAIN)
        self._pool = ThreadPoolExecutor(1, "semviz-map")
        self._stamp: tuple[int, int] | None = None
        self._stopping = False
        self.built: Built | None = None
        """None where there is no map yet, or it has not been read."""
        self.failure = ""
        """Why the last map could not be read or built."""
        self.building: str | None = None
        """What is being done for the next map; None while none is built."""
        self.version = 0
        """Another number when any of these has changed."""

    def look(self) -> None:
        """Has the file read, soon, where it is another one than was read last."""
        stamp = _stamp(self._path)
        if stamp != self._stamp:
            self._stamp = stamp
            self._pool.submit(self._work, self._read)

    def build(self) -> None:
        """Builds the map, soon; SemvizError where that is going on already."""
        if self.building is not None:
            raise SemvizError("the map is being built already")
        self.building, self._stopping = "starting", False
        self.version += 1
        self._pool.submit(self._work, self._build)

    def stop(self) -> None:
        """Gives up what is being built, soon; the map that is there stays."""
        self._stopping = True

    def close(self) -> None:
        """Stops, and waits for the thread."""
        self.stop()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _work(self, do: Callable[[], None]) -> None:
        try:
            self.failure = ""
            do()
        except SemvizError as error:
            self.failure = str(error)
        except Exception as error:  # nobody else hears of it in this thread
            self.failure = f"the map: {error!r}; please report this"
        finally:
            self.version += 1

    def _read(self) -> None:
        if self._stamp is None:
            self.built = None
        else:
            self._take(self._workspace.read_map(MAIN))

    def _build(self) -> None:
        from semviz_annotation.mapping.build import build_map
        from semviz_core.map_file import save_map

        try:
            built, _ = build_map(
                self._labels(),
                self._workspace.source,
                classes=self._workspace.classes,
                on_progress=self._note,
            )
            save_map(built, self._path)
            self._stamp = _stamp(self._path)
            self._take(built)
        finally:
            self.building = None

    def _note(self, what: str, done: int, of: int) -> None:
        if self._stopping:
            raise SemvizError("Stopped: the map is as it was.")
        self.building = f"{what}, {100 * done // max(of, 1)} %"
        self.version += 1

    def _take(self, semantic_map: SemanticMap) -> None:
        from semviz_annotation.mapping.quality.lint import lint

        findings = lint(semantic_map, self._labels(), self._workspace.source)
        self.built = Built(semantic_map, findings)


def _stamp(path: Path) -> tuple[int, int] | None:
    """Differs between two versions of a file; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
