"""The context of an open page, the library of runs, and the base class of a page's panels.

A context holds a page's state, run, 3D scene and connection. Request handlers and panel hooks hold
its lock. A panel's own threads take it before they touch the context. Long work runs once, in a
background thread. Runs are read on first use; their images are served over HTTP.
"""

import asyncio
import gc
import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from aiohttp import web

from semviz.inspector import views, views_run
from semviz.inspector.scene.scene_view import InspectorScene
from semviz.inspector.state import State
from semviz.runs.codec import DamagedRowError
from semviz.runs.frame_table import frame_table
from semviz.runs.images import frame_image, missing_image_reason
from semviz.runs.run import Run, run_names
from semviz.web.protocol import Event, RefusedError, SceneEvent
from semviz.web.sessions import Send
from semviz.web.tool import InnerTools
from semviz.web.viser_servers import ViserServers
from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

Cached = TypeVar("Cached")
Report = Callable[[str, float], None]


class RunLibrary:
    """Runs by name, read on first use. Thread-safe."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise SemvizError("no run to show; 'semviz localize' records one")
        self._paths = dict(zip(run_names(paths), paths, strict=True))
        self._runs: dict[str, Run] = {}
        self._cache: dict[tuple[str, Callable[[Run, Path], Any]], object] = {}
        self._of_maps: dict[str, object] = {}
        self._lock = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        """One a run: reading a run takes seconds, and other pages show other runs."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def run(self, name: str, report: Report = lambda _, share: None) -> Run:
        """Return the run ``name``; ``report`` gets what reading it has done, and the share of it.

        Raise SemvizError if it is unknown or broken.
        """
        from semviz.runs.stored_run import open_run

        path = self.path(name)
        with self._lock_of(name):
            if name not in self._runs:
                self._runs[name] = open_run(path, report)
                gc.freeze()  # runs stay in memory: searching them for garbage would delay all pages
            return self._runs[name]

    def check(self, name: str, report: Report) -> None:
        """Read the run ``name`` again, without the frames that are damaged."""
        from semviz.runs.stored_run import open_run

        checked = open_run(self.path(name), report, checks_frames=True)
        with self._lock_of(name):
            self._runs[name] = checked
            for key in [key for key in self._cache if key[0] == name]:
                del self._cache[key]

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

    def of_map(self, digest: str, make: Callable[[], Cached]) -> Cached:
        """Return ``make()`` of the map with this digest, computed once and then kept."""
        with self._lock:
            if digest not in self._of_maps:
                self._of_maps[digest] = make()
            return cast(Cached, self._of_maps[digest])

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


class Panel:
    """A part of the page. Its handlers (``handles``) and hooks run under the context's lock."""

    def __init__(self, context: "PageContext") -> None:
        self.context = context

    def on_opened(self) -> None:
        """Another run was opened, and its map is not drawn yet."""

    def on_run(self) -> None:
        """Another run was opened."""

    def on_theme(self) -> None:
        """The theme changed, and the 3D map was drawn again."""

    def on_frame(self) -> None:
        """The page shows another frame."""

    def on_state(self) -> None:
        """The selection or the display settings changed."""

    def on_drawn(self) -> None:
        """The frame was drawn in 3D."""


class EmbeddedAnnotators:
    """The annotators of all workspaces whose labels were opened. Thread-safe.

    Each is a tool inside the inspector: same port, same access policy.
    """

    def __init__(self) -> None:
        self.tools = InnerTools("annotate")
        """Part of the inspector's routes."""
        self._lock = threading.Lock()
        self._open = ExitStack()
        self._names: dict[Path, str] = {}
        """Names by workspace folder."""

    def open(self, workspace: Workspace) -> str:
        """Start the annotator of a workspace on first use. Return NAME of ``/annotate/NAME/``.

        Raise SemvizError if the labels cannot be opened.
        """
        from semviz.annotator.server import Annotator

        folder = workspace.path.resolve()
        with self._lock:
            if folder not in self._names:
                annotator = Annotator(workspace)
                self._open.callback(annotator.close)
                self._open.callback(annotator.scenes.close_all)
                name = str(len(self._names) + 1)
                self.tools.add(name, annotator)
                self._names[folder] = name
            return self._names[folder]

    def close(self) -> None:
        with self._lock:
            self.tools.clear()
            self._open.close()
            self._names.clear()


class PageContext:
    """What the panels of one page share. Its methods notify the page and the panels."""

    def __init__(
        self,
        session_id: str,
        library: RunLibrary,
        annotators: EmbeddedAnnotators,
        scenes: ViserServers,
        send: Send,
    ) -> None:
        self.library = library
        self.annotators = annotators
        self.state = State()
        self.panels: Sequence[Panel] = ()
        self.lock = threading.RLock()
        """Held in every handler and hook; a panel's own threads take it first."""
        self._session_id = session_id
        self._scenes = scenes
        self._send = send
        self._run: Run | None = None
        self._scene: InspectorScene | None = None

    @property
    def is_open(self) -> bool:
        """Whether a run is open."""
        return self._run is not None

    @property
    def run(self) -> Run:
        """The open run. Raise SemvizError if no run is open."""
        if self._run is None:
            raise SemvizError("no run is open; choose one at the top left")
        return self._run

    @property
    def has_scene(self) -> bool:
        """Whether the 3D pane was used."""
        return self._scene is not None

    @property
    def scene(self) -> InspectorScene:
        """The 3D pane, created on first use: importing viser takes a second."""
        if self._scene is None:
            self._scene = InspectorScene(
                self._scenes.scene(self._session_id), self._clicked, self.library.path
            )
            self.send(SceneEvent())
        return self._scene

    def cached(self, make: Callable[[Run, Path], Cached]) -> Cached:
        """Return ``make(run, path)`` of the open run, computed once for all pages."""
        return self.library.cached(self.state.run, make)

    def open(self, name: str, frame: int | None) -> None:
        """Show another run at the frame with number ``frame``, or at its worst frame."""
        run = self.library.run(name, partial(self._send_reading, name))
        self.state = self.state.opened(name, run, frame)
        self._run = run
        self.send_run()
        for panel in self.panels:
            panel.on_opened()
        self.draw_run()
        for panel in self.panels:
            panel.on_run()

    def open_checked(self) -> None:
        """Open the run again, without the frames that are damaged: one was to be shown."""
        name, index = self.state.run, int(frame_table(self.run).index[self.state.position])
        self.library.check(name, partial(self._send_reading, name))
        self.open(name, index)

    def select(self, observed: int | None, element: int | None) -> None:
        """Select a detection (row), a map element (id), a pair of them, or nothing."""
        self.state = self.state.with_selection(observed, element, self.run)
        self.send_state()
        self.scene.select(self.run, self.state)

    def draw_run(self) -> None:
        """Draw map and frame in 3D from scratch."""
        self.scene.show_run(self.run, self.state)
        self._drawn()

    def draw_frame(self) -> None:
        """Draw the frame in 3D."""
        self.scene.show_frame(self.run, self.state)
        self._drawn()

    def send(self, event: Event) -> None:
        """Send an event to the page."""
        self._send(event)

    def send_runs(self) -> None:
        """Send the names of the runs that can be opened."""
        self.send(views_run.RunsEvent(names=self.library.names))

    def send_run(self) -> None:
        """Send the run and its frame."""
        self.send(views.RunEvent(run=views.run_view(self.state.run, self.run)))
        self.send_frame()

    def send_frame(self) -> None:
        """Send the frame and the state, and notify the panels."""
        frame = views.frame_view(self.run, self.state.position)
        self.send(views.FrameEvent(frame=frame, state=views.state_view(self.state)))
        for panel in self.panels:
            panel.on_frame()

    def send_state(self) -> None:
        """Send the state, and notify the panels."""
        self.send(views.StateEvent(state=views.state_view(self.state)))
        for panel in self.panels:
            panel.on_state()

    def close(self) -> None:
        self._scenes.close(self._session_id)

    def _send_reading(self, name: str, step: str, share: float) -> None:
        self.send(views_run.ReadingEvent(name=name, step=step, share=share))

    def _drawn(self) -> None:
        for panel in self.panels:
            panel.on_drawn()

    def _clicked(self, kind: str, number: int) -> None:
        """Called in a viser thread. ``number`` is an element's id or a frame's position."""
        with self.lock:
            if kind == "frame":
                self.state = self.state.at(number, self.run)
                self.send_frame()
                self.draw_frame()
            else:
                self.select(None, number)


REPORTS = 20
"""Progress reports of one pass."""
Listener = Callable[[], None]
Item = TypeVar("Item")
Value = TypeVar("Value")


class Background(ABC, Generic[Value]):
    """Work in a background thread, started on first request. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: list[Listener] = []
        self._stopped = threading.Event()
        self._started = False
        self.progress = "waiting to start"
        """How far the work is, or why it failed."""
        self.value: Value | None = None
        """The result; None until the work is done."""
        self.is_over = False
        """Whether the work is done or failed."""
        self.met_damage = False
        """Whether it failed because a frame is damaged."""

    @abstractmethod
    def work(self) -> Value:
        """Compute the value, passing loops through ``watch``. Raise SemvizError if impossible."""

    def start(self, listener: Listener) -> None:
        """Start the work if needed. Call ``listener`` now, on progress, and at the end."""
        with self._lock:
            if not self.is_over:
                self._listeners.append(listener)
            is_first, self._started = not self._started, True
        if is_first:
            threading.Thread(target=self._complete, daemon=True).start()
        listener()

    def stop(self) -> None:
        """Stop soon: ``watch`` yields no more items."""
        self._stopped.set()

    @property
    def is_stopped(self) -> bool:
        return self._stopped.is_set()

    def watch(self, items: Iterable[Item], step: str, total: int) -> Iterator[Item]:
        """Yield the items and report how many are done; ``step`` names the work."""
        interval = max(total // REPORTS, 1)
        for number, item in enumerate(items):
            if self.is_stopped:
                return
            if number % interval == 0:
                hint = "" if number else "; on a new machine it compiles first, up to a minute"
                self.report(f"{step}: {number} of {total}{hint}")
            yield item

    def report(self, text: str) -> None:
        """Report how far the work is."""
        self.progress = text
        self._notify()

    def _complete(self) -> None:
        from semviz_core.common.jit import count_compiled

        self.report("reading frames")
        try:
            with count_compiled(self._tell_compiled):
                self.value = self.work()
        except SemvizError as error:
            self.progress = str(error)
            self.met_damage = isinstance(error, DamagedRowError)
        except Exception as error:  # a bug must be seen, not leave the page waiting
            logging.getLogger(__name__).exception("work in the background failed")
            self.progress = (
                f"Internal error: {type(error).__name__}: {error}. The terminal has more."
            )
        with self._lock:
            self.is_over = True
        self._notify()
        with self._lock:
            self._listeners.clear()

    def _tell_compiled(self, functions: int) -> None:
        self.report(f"compiling the solver, once on this machine: {functions} parts so far")

    def _notify(self) -> None:
        with self._lock:
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()
