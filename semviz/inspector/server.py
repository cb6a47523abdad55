"""semviz serve: the page, its pictures, and a session for each opened page."""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from aiohttp import web

from semviz.inspector import views
from semviz.inspector.scene_view import SceneView
from semviz.inspector.session import State
from semviz.inspector.shelf import Shelf
from semviz.recording.run import Run
from semviz.web.scenes import Scenes
from semviz.web.sessions import Message, Send, Sessions
from semviz_core.errors import SemvizError

PAGE = Path(__file__).parent / "page"


class Inspector:
    """The tool behind ``semviz serve``: shows runs, the files ``paths``."""

    title = "semviz serve"

    def __init__(self, paths: Sequence[Path]) -> None:
        self._shelf = Shelf(paths)
        if len(paths) == 1:  # with nothing else to show, a broken run is an error at once
            self._shelf.run(self._shelf.names[0])
        self.scenes = Scenes()
        self._sessions = Sessions(self._session)

    def routes(self) -> list[web.AbstractRouteDef]:
        return [
            web.get("/", self._page),
            web.get("/image", self._image),
            web.static("/page/", PAGE),
            *self._sessions.routes(),
        ]

    def _session(self, session_id: str, send: Send) -> "InspectorSession":
        return InspectorSession(session_id, self._shelf, self.scenes, send)

    async def _page(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _image(self, request: web.Request) -> web.Response:
        """``/image?run=NAME&position=K``: the left image of a frame, JPEG."""
        try:
            run = self._shelf.run(request.query.get("run", ""))
            record = run.frames[int(request.query.get("position", ""))]
        except (SemvizError, ValueError, IndexError):
            raise web.HTTPNotFound(text="no such frame\n") from None
        if record.image is None:
            raise web.HTTPNotFound(text="this run was recorded without images\n")
        headers = {"Cache-Control": "private, max-age=3600"}
        return web.Response(body=record.image, content_type="image/jpeg", headers=headers)


class InspectorSession:
    """One opened page: turns its messages into verbs on the state, and shows what follows."""

    def __init__(self, session_id: str, shelf: Shelf, scenes: Scenes, send: Send) -> None:
        self._id = session_id
        self._shelf = shelf
        self._scenes = scenes
        self._send = send
        self._state = State()
        self._run: Run | None = None
        self._lock = threading.RLock()  # clicks in 3D come in threads of viser's
        self._scene: SceneView | None = (
            None  # made when first shown: viser takes a second to import
        )
        self._verbs: dict[str, Callable[[Message], None]] = {
            "open": self._open,
            "go": self._go,
            "draw": self._draw,
            "select": self._select,
            "look": self._look,
            "theme": self._theme,
            "alternatives": self._alternatives,
            "forecast": self._forecast,
            "decisions": self._decisions,
            "see": self._see,
            "answer": self._answer,
            "undo": self._undo,
        }

    def connected(self) -> None:
        """Tells a page that has just come what is on offer, and where it was."""
        self._send({"type": "runs", "names": list(self._shelf.names)})
        if self._run is not None:
            self._tell_run(self._run)
        if self._scene is not None:
            self._send({"type": "scene"})

    def receive(self, message: Message) -> None:
        """``{"verb": ...}`` and what belongs to it. Raises SemvizError for anything else."""
        verb = self._verbs.get(str(message.get("verb")))
        if verb is None:
            raise SemvizError(f"the page asks for '{message.get('verb')}', which does not exist")
        with self._lock:
            verb(message)

    def close(self) -> None:
        self._scenes.close(self._id)

    def _open(self, message: Message) -> None:
        name = str(message.get("run") or self._shelf.names[0])
        self._state = self._state.themed(str(message.get("theme")))
        run = self._shelf.run(name)
        self._state = self._state.opened(name, run, _whole(message, "frame"))
        self._run = run
        self._tell_run(run)
        self._shown().show_run(run, self._state)
        self._show_forecast(run)

    def _go(self, message: Message) -> None:
        run = self._opened()
        position = _whole(message, "position")
        if position is None:
            raise SemvizError("going to a frame needs its position")
        self._state = self._state.at(position, run)
        self._tell_frame(run)

    def _draw(self, _: Message) -> None:
        """Asked for once the page shows the frame, and not for frames that it rushes through."""
        self._shown().show_frame(self._opened(), self._state)

    def _select(self, message: Message) -> None:
        run = self._opened()
        observed, element = _whole(message, "observed"), _whole(message, "element")
        self._state = self._state.selecting(observed, element, run)
        self._tell_state()
        self._shown().select(run, self._state)

    def _look(self, message: Message) -> None:
        run = self._opened()
        self._state = self._state.looking(str(message.get("view")))
        self._tell_state()
        self._shown().look(run, self._state)

    def _theme(self, message: Message) -> None:
        self._state = self._state.themed(str(message.get("theme")))
        if self._run is not None:
            self._shown().show_run(self._run, self._state)
            self._show_forecast(self._run)

    def _alternatives(self, message: Message) -> None:
        run = self._opened()
        self._state = self._state.showing_alternatives(bool(message.get("shown")))
        self._tell_state()
        self._shown().show_frame(run, self._state)

    def _forecast(self, message: Message) -> None:
        run = self._opened()
        self._state = self._state.showing_forecast(bool(message.get("shown")))
        self._tell_state()
        self._show_forecast(run)

    def _show_forecast(self, run: Run) -> None:
        """Shown, or taken away; asked for where it is not worked out yet."""
        if self._state.forecast:
            self._shelf.forecast(self._state.run).ask(lambda: self._forecast_got_on(run))
        elif self._scene is not None:
            self._scene.show_forecast(None, run, self._state)

    def _forecast_got_on(self, run: Run) -> None:
        """Called in the forecast's thread; the page may show another run by then."""
        with self._lock:
            if self._run is not run or not self._state.forecast:
                return
            forecast = self._shelf.forecast(self._state.run)
            self._send({"type": "forecast", "forecast": forecast.view()})
            if forecast.predicted is not None:
                self._shown().show_forecast(forecast.predicted, run, self._state)

    def _decisions(self, message: Message) -> None:
        self._opened()
        shown = self._shelf.decisions(self._state.run).view(message.get("findings") is True)
        self._send({"type": "decisions", "decisions": shown})

    def _see(self, message: Message) -> None:
        """Selects the map element of a decision, in a frame that shows it."""
        run, key = self._opened(), str(message.get("key"))
        position, element = self._shelf.decisions(self._state.run).place(key)
        if position is not None:
            self._state = self._state.at(position, run)
        self._state = self._state.selecting(None, element, run)
        self._tell_frame(run)
        self._shown().show_frame(run, self._state)

    def _answer(self, message: Message) -> None:
        self._opened()
        decisions = self._shelf.decisions(self._state.run)
        decisions.answer(str(message.get("key")), str(message.get("name")))
        self._decisions(message)

    def _undo(self, message: Message) -> None:
        self._opened()
        self._shelf.decisions(self._state.run).undo(str(message.get("key")))
        self._decisions(message)

    def _clicked(self, element: int) -> None:
        with self._lock:
            self._select({"element": element})

    def _opened(self) -> Run:
        if self._run is None:
            raise SemvizError("no run is open; choose one at the top left")
        return self._run

    def _shown(self) -> SceneView:
        if self._scene is None:
            self._scene = SceneView(self._scenes.scene(self._id), self._clicked)
            self._send({"type": "scene"})
        return self._scene

    def _tell_run(self, run: Run) -> None:
        self._send({"type": "run", "run": views.run_view(self._state.run, run)})
        self._tell_frame(run)

    def _tell_frame(self, run: Run) -> None:
        frame = views.frame_view(run, self._state.position)
        self._send({"type": "frame", "frame": frame, "state": views.state_view(self._state)})

    def _tell_state(self) -> None:
        self._send({"type": "state", "state": views.state_view(self._state)})


def _whole(message: Message, name: str) -> int | None:
    value = message.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) else None
