"""semviz serve: the page, its pictures, and a session for each opened page."""

from collections.abc import Sequence
from pathlib import Path

from aiohttp import web

from semviz.inspector.comparing.side_by_side import CompareTopic
from semviz.inspector.desk import Desk
from semviz.inspector.images.image_view import ImageTopic
from semviz.inspector.images.pictures import picture_route
from semviz.inspector.images.rendering import RenderTopic
from semviz.inspector.mending.labelling import LabellingTools
from semviz.inspector.mending.labels import MendTopic
from semviz.inspector.navigation import Navigation
from semviz.inspector.over_run.decisions import DecisionTopic
from semviz.inspector.over_run.elements import ElementTopic
from semviz.inspector.over_run.forecast import ForecastTopic
from semviz.inspector.scene.space import SpaceTopic
from semviz.inspector.selection.matrix import matrix_route
from semviz.inspector.selection.selected import SelectedTopic
from semviz.inspector.shelf import Shelf
from semviz.inspector.solver import SolverTopic
from semviz.inspector.what_if.topic import WhatIf
from semviz.web.proxy import Proxy
from semviz.web.scenes import Scenes
from semviz.web.sessions import Message, Send, Sessions
from semviz_core.errors import SemvizError

PAGE = Path(__file__).parent / "page"
TOPICS = (
    Navigation,
    SpaceTopic,
    ImageTopic,
    SelectedTopic,
    SolverTopic,
    ElementTopic,
    ForecastTopic,
    DecisionTopic,
    MendTopic,
    WhatIf,
    CompareTopic,
    RenderTopic,
)


class Inspector:
    """The tool behind ``semviz serve``: shows runs, the files ``paths``."""

    title = "semviz serve"

    def __init__(self, paths: Sequence[Path]) -> None:
        self._shelf = Shelf(paths)
        if len(paths) == 1:  # with nothing else to show, a broken run is an error at once
            self._shelf.run(self._shelf.names[0])
        self._tools = LabellingTools()
        self.scenes = Scenes()
        self._sessions = Sessions(self._session)

    def routes(self) -> list[web.AbstractRouteDef]:
        closed = "these labels are not open; select an element of a run, then press O"
        return [
            web.get("/", self._page),
            picture_route(self._shelf),
            matrix_route(self._shelf),
            web.static("/page/", PAGE),
            *self._sessions.routes(),
            *Proxy("annotate", self._tools.address, closed).routes(),
        ]

    def close(self) -> None:
        """Ends the labelling tools that were opened."""
        self._tools.close()

    def _session(self, session_id: str, send: Send) -> "InspectorSession":
        return InspectorSession(session_id, self._shelf, self._tools, self.scenes, send)

    async def _page(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")


class InspectorSession:
    """One opened page: hands its messages to the topic that knows their verb."""

    def __init__(
        self, session_id: str, shelf: Shelf, tools: LabellingTools, scenes: Scenes, send: Send
    ) -> None:
        self._desk = Desk(session_id, shelf, tools, scenes, send)
        self._desk.topics = tuple(topic(self._desk) for topic in TOPICS)
        self._verbs = {
            name: verb for topic in self._desk.topics for name, verb in topic.verbs().items()
        }

    def connected(self) -> None:
        """Tells a page that has just come what is on offer, and where it was."""
        self._desk.say("runs", list(self._desk.shelf.names))
        if self._desk.is_open:
            self._desk.tell_run()
        if self._desk.has_scene:
            self._desk.say("scene", True)

    def receive(self, message: Message) -> None:
        """``{"verb": ...}`` and what belongs to it. Raises SemvizError for anything else."""
        verb = self._verbs.get(str(message.get("verb")))
        if verb is None:
            raise SemvizError(f"the page asks for '{message.get('verb')}', which does not exist")
        with self._desk.lock:
            verb(message)

    def close(self) -> None:
        self._desk.close()
