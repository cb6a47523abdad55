"""Serve the inspector's page and images, and dispatch requests to the panels."""

from collections.abc import Sequence
from pathlib import Path

from aiohttp import web

from semviz.inspector.all_runs import all_runs_routes
from semviz.inspector.comparison import ComparisonPanel
from semviz.inspector.context import EmbeddedAnnotators, PageContext, RunLibrary, image_route
from semviz.inspector.decisions import DecisionPanel
from semviz.inspector.elements import ElementPanel, ForecastPanel
from semviz.inspector.image import ImagePanel, RenderPanel
from semviz.inspector.label_repair import LabelRepairPanel
from semviz.inspector.map_over_time.over_time_panel import OverTimePanel, changes_route
from semviz.inspector.messages import InspectorRequest
from semviz.inspector.navigation import BackdropPanel, NavigationPanel, ViewpointPanel
from semviz.inspector.selection import SelectionPanel, matrix_route
from semviz.inspector.solver import SolverPanel
from semviz.inspector.story import StoryPanel
from semviz.inspector.what_if import WhatIfPanel
from semviz.runs.codec import DamagedRowError
from semviz.runs.stored_run import check_run_head
from semviz.web.protocol import Handlers, Request, SceneEvent
from semviz.web.sessions import Send, Sessions
from semviz.web.viser_servers import ViserServers

PAGE = Path(__file__).parent / "page"
PANELS = (
    NavigationPanel,
    ViewpointPanel,
    BackdropPanel,
    ImagePanel,
    SelectionPanel,
    SolverPanel,
    StoryPanel,
    OverTimePanel,
    ElementPanel,
    ForecastPanel,
    DecisionPanel,
    LabelRepairPanel,
    WhatIfPanel,
    ComparisonPanel,
    RenderPanel,
)
HANDLERS = Handlers(InspectorRequest, *PANELS)


class Inspector:
    """The web tool behind ``semviz serve``; ``paths`` are files of runs."""

    title = "semviz serve"

    def __init__(self, paths: Sequence[Path]) -> None:
        self._library = RunLibrary(paths)
        if len(paths) == 1:  # a single broken run is an error at once
            check_run_head(paths[0])
        self._annotators = EmbeddedAnnotators()
        self.scenes = ViserServers()
        self._sessions = Sessions(self._session, HANDLERS.decode)

    def routes(self) -> list[web.AbstractRouteDef]:
        return [
            web.get("/", self._page),
            image_route(self._library),
            matrix_route(self._library),
            changes_route(self._library),
            *all_runs_routes(self._library),
            web.static("/page/", PAGE),
            *self._sessions.routes(),
            self._annotators.tools,
        ]

    def close(self) -> None:
        """Close the annotators that were opened."""
        self._annotators.close()

    def _session(self, session_id: str, send: Send, _: str) -> "InspectorSession":
        return InspectorSession(session_id, self._library, self._annotators, self.scenes, send)

    async def _page(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")


class InspectorSession:
    """One open page: passes each request to the panel that handles it."""

    def __init__(
        self,
        session_id: str,
        library: RunLibrary,
        annotators: EmbeddedAnnotators,
        scenes: ViserServers,
        send: Send,
    ) -> None:
        self._context = PageContext(session_id, library, annotators, scenes, send)
        self._context.panels = tuple(panel(self._context) for panel in PANELS)
        self._handle = HANDLERS.bound_to(*self._context.panels)

    def connected(self) -> None:
        """Send a page that has connected the runs and its last state."""
        self._context.send_runs()
        if self._context.is_open:
            self._context.send_run()
        if self._context.has_scene:
            self._context.send(SceneEvent())

    def receive(self, request: Request) -> None:
        """Handle a request of the page. Raise SemvizError if it cannot be met."""
        with self._context.lock:
            try:
                self._handle(request)
            except DamagedRowError:
                self._context.open_checked()

    def close(self) -> None:
        self._context.close()
