"""The annotator behind the door: its page, its images, and its opened pages."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from aiohttp import web

from semviz.annotator.opened_page import OpenedPage
from semviz.annotator.session import LabelSession
from semviz.annotator.views import Json
from semviz.author import login_name
from semviz.web.scenes import Scenes
from semviz.web.sessions import Send, Sessions
from semviz.workspace import Workspace
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

PAGE = Path(__file__).parent / "page"
NEWS_EVERY_S = 1.0
"""How often to look for what other processes have written: one query."""
LEARN_S = 0.005
"""So long an edit may have to wait for what is learnt in the background."""
PAUSE_S = 0.01
KEEP_IMAGE = "private, max-age=3600"


class Annotator:
    """The labelling tool for one workspace, as a ``Tool`` of the door.

    Raises SemvizError where the images or the label file cannot be opened.
    """

    def __init__(self, workspace: Workspace, author: str | None = None) -> None:
        self.session = LabelSession(workspace, author or login_name())
        self.lock = threading.RLock()
        self.scenes = Scenes()
        self.painter = ThreadPoolExecutor(1, "semviz-scenes")
        self.observer = ThreadPoolExecutor(1, "semviz-observer")
        self._pages: list[OpenedPage] = []
        self._closing = threading.Event()
        self.session.map_work.look()
        self._listener = threading.Thread(target=self._listen, name="semviz-news", daemon=True)
        self._listener.start()
        self._learner = threading.Thread(target=self._learn, name="semviz-facts", daemon=True)
        self._learner.start()
        self._sessions = Sessions(self._open)

    @property
    def title(self) -> str:
        return f"semviz annotate, {self.session.workspace.name}"

    @property
    def pages(self) -> tuple[OpenedPage, ...]:
        return tuple(self._pages)

    def forget(self, page: OpenedPage) -> None:
        self._pages.remove(page)

    def close(self) -> None:
        """Stops the threads and closes the label file."""
        self._closing.set()
        self._listener.join()
        self._learner.join()
        for pool in (self.painter, self.observer):
            pool.shutdown(wait=True, cancel_futures=True)
        self.session.close()

    def routes(self) -> list[web.AbstractRouteDef]:
        return [
            web.get("/", self._index),
            web.static("/page/", PAGE),
            web.get(r"/image/{frame:\d+}/{side:left|right}.png", self._image),
            web.get(r"/thumbnail/{frame:\d+}.jpg", self._thumbnail),
            *self._sessions.routes(),
        ]

    def _open(self, session_id: str, send: Send) -> OpenedPage:
        page = OpenedPage(session_id, send, self)
        self._pages.append(page)
        return page

    def _listen(self) -> None:
        """Tells open pages what other processes have done to the labels."""
        while not self._closing.wait(NEWS_EVERY_S):
            # where the file cannot be read, whoever asks for something next is told
            self.session.map_work.look()
            with contextlib.suppress(sqlite3.Error):
                self._tell_news()

    def _learn(self) -> None:
        """Works out what is worth a visit, a few frames at a time: edits come first."""
        frames: list[Json] = []
        done, told = True, time.monotonic()
        while not self._closing.wait(NEWS_EVERY_S if done else PAUSE_S):
            with contextlib.suppress(sqlite3.Error), self.lock:
                learnt, done = self.session.learn(LEARN_S)
                frames += learnt
            if frames and (done or time.monotonic() > told + NEWS_EVERY_S):
                for page in self.pages:
                    page.send_facts(frames)
                frames, told = [], time.monotonic()

    def _tell_news(self) -> None:
        with self.lock:
            if self._pages and self.session.has_news():
                state = self.session.news()
                for page in self.pages:
                    page.tell("news", state)

    async def _index(self, request: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _image(self, request: web.Request) -> web.Response:
        side: Side = "left" if request.match_info["side"] == "left" else "right"
        future = self.session.images.png(int(request.match_info["frame"]), side)
        return await _picture(future, "image/png")

    async def _thumbnail(self, request: web.Request) -> web.Response:
        future = self.session.images.thumbnail(int(request.match_info["frame"]))
        return await _picture(future, "image/jpeg")


async def _picture(future: "Future[bytes]", kind: str) -> web.Response:
    try:
        data = await asyncio.shield(asyncio.wrap_future(future))  # others may wait for it too
    except SemvizError as error:
        raise web.HTTPNotFound(text=str(error)) from None
    return web.Response(body=data, content_type=kind, headers={"Cache-Control": KEEP_IMAGE})
