"""The runs that can be opened, read on first use, and their images over HTTP."""

import asyncio
import gc
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from aiohttp import web

from semviz.runs.images import frame_image, missing_image_reason
from semviz.runs.run import Run, run_names
from semviz.web.protocol import RefusedError
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

Cached = TypeVar("Cached")


class RunLibrary:
    """Runs by name, read on first use. Thread-safe."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise SemvizError("no run to show; 'semviz localize' records one")
        self._paths = dict(zip(run_names(paths), paths, strict=True))
        self._runs: dict[str, Run] = {}
        self._cache: dict[tuple[str, Callable[[Run, Path], Any]], object] = {}
        self._lock = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        """One a run: reading a run takes seconds, and other pages show other runs."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def run(self, name: str) -> Run:
        """Return the run ``name``. Raise SemvizError if it is unknown or broken."""
        from semviz.runs.reader import load_run

        path = self.path(name)
        with self._lock_of(name):
            if name not in self._runs:
                self._runs[name] = load_run(path)
                gc.freeze()  # runs stay in memory: searching them for garbage would delay all pages
            return self._runs[name]

    def path(self, name: str) -> Path:
        """Return the file of the run ``name``. Raise RefusedError if it is unknown."""
        if name not in self._paths:
            known = ", ".join(self._paths)
            raise RefusedError("not_found", f"there is no run '{name}'; choose one of {known}")
        return self._paths[name]

    def add(self, path: Path) -> str:
        """Add a run, unless it is there already. Return its name."""
        with self._lock:
            if path not in self._paths.values():
                names = run_names([*self._paths.values(), path])
                name = names[-1] if names[-1] not in self._paths else str(path)
                self._paths[name] = path
            return next(name for name, known in self._paths.items() if known == path)

    def cached(self, name: str, make: Callable[[Run, Path], Cached]) -> Cached:
        """Return ``make(run, path)`` of the run ``name``, computed once and then kept."""
        run = self.run(name)
        with self._lock_of(name):
            if (name, make) not in self._cache:
                self._cache[name, make] = make(run, self._paths[name])
            return cast(Cached, self._cache[name, make])

    def _lock_of(self, name: str) -> threading.Lock:
        with self._lock:
            return self._locks.setdefault(name, threading.Lock())


SIDES: dict[str, Side] = {"left": "left", "right": "right"}
JPEG_START = b"\xff\xd8"
CACHE_CONTROL = "private, max-age=3600"
"""The address of an image holds the creation time of its run."""


@dataclass(frozen=True, eq=False)
class RunImages:
    """The images of one run, from the file ``path``."""

    run: Run
    path: Path

    def response(self, position: int, side: Side) -> web.Response:
        """Return an image. If there is none, return one line with the reason, which is no error."""
        data = frame_image(self.run, self.path, position, side)
        if data is None:
            reason = missing_image_reason(self.run, self.path, position, side)
            return web.Response(text=reason, headers={"Cache-Control": "no-store"})
        content_type = "image/jpeg" if data.startswith(JPEG_START) else "image/png"
        return web.Response(
            body=data, content_type=content_type, headers={"Cache-Control": CACHE_CONTROL}
        )


def image_route(library: RunLibrary) -> web.AbstractRouteDef:
    """Serve images of frames at ``/image?run=NAME&position=K&side=left``, as JPEG or PNG."""

    async def respond(request: web.Request) -> web.Response:
        query = request.query
        try:
            images = library.cached(query["run"], RunImages)
            position, side = int(query["position"]), SIDES[query.get("side", "left")]
            if not 0 <= position < len(images.run.frames):
                raise IndexError(position)
        except (SemvizError, ValueError, LookupError):
            raise web.HTTPNotFound(text="no such frame\n") from None
        return await asyncio.to_thread(images.response, position, side)

    return web.get("/image", respond)
