"""Serve the annotator: its page, its images, and a session for each opened page."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from aiohttp import web

from semviz.annotator.drive.drive_requests import PoseUndo
from semviz.annotator.drive.pose_views import PoseWork
from semviz.annotator.page_session import HANDLERS, AnnotatorPage
from semviz.annotator.session import LabelSession
from semviz.annotator.team.blind_shares import BlindShares
from semviz.annotator.team.people_view import PersonView, people_views
from semviz.web.protocol import RefusedError
from semviz.web.sessions import Send, Sessions
from semviz.web.viser_servers import ViserServers
from semviz.workspace.people import People, Role
from semviz.workspace.settings import login_name
from semviz.workspace.workspace import Workspace
from semviz_annotation.assist.snap import warm_up
from semviz_annotation.labels.own_classes import attribute_types
from semviz_annotation.storage.label_file import Health, LabelFileError
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

PAGE = Path(__file__).parent / "page"
FLUSH_EVERY_S = 0.05
FLUSH_PAGE_S = 0.02
"""Shortest time between two updates of a page by the edits of others; the second for each page
that is open. With thirty pages that is two thirds of a second, in which edits are gathered."""
POLL_EVERY_S = 1.0
"""How often to check for changes of other processes: one query."""
SEND_EVERY_S = 0.5
"""How often to send what was analyzed."""
ANALYZE_S = 0.005
"""Longest time that background analysis may delay an edit."""
PAUSE_S, BUSY_PAUSE_S = 0.01, 0.05
"""Between two slices of that analysis: longer for so long after an edit as ``BUSY_S``."""
BUSY_S = 1.0
KEEP_IMAGE = "private, max-age=3600"
P = TypeVar("P", bytes, Path | bytes)


class Annotator:
    """The labelling tool for one workspace; a ``Tool`` of the gateway.

    Raise SemvizError if the images or the label file cannot be opened.
    """

    def __init__(self, workspace: Workspace, author: str | None = None) -> None:
        self.session = LabelSession(workspace, author or login_name())
        self.lock = threading.RLock()
        self.scenes = ViserServers()
        self.scene_thread = ThreadPoolExecutor(1, "semviz-scenes")
        self.search_thread = ThreadPoolExecutor(1, "semviz-search")
        self._pages: list[AnnotatorPage] = []
        self._closing = threading.Event()
        self.people = People(workspace.path)
        self.shares = BlindShares(
            workspace, lambda: self.session.team.store, tuple(self.session.frames)
        )
        self.session.beside_blind = self.shares.beside
        self.updates_queued = threading.Event()
        self._flushed = -BUSY_S
        """When updates by the edits of others were sent last."""
        self._people_changed = threading.Event()
        self._sent_people: list[PersonView] = []
        self._sent_health: Health | None = None
        self._sent_classes = self.session.classes, attribute_types(self.session.labels)
        self.session.map_work.refresh()
        self.pose_work = PoseWork(workspace, lambda: self.session.labels)
        self.pose_steps = PoseUndo()
        self._sent_poses = self.pose_work.version
        self.pose_work.look_up()
        self._poller = threading.Thread(target=self._poll, name="semviz-updates", daemon=True)
        self._poller.start()
        self._analyzer = threading.Thread(target=self._analyze, name="semviz-analysis", daemon=True)
        self._analyzer.start()
        # on a new machine the code of a snap is compiled, which the first click must not wait for
        threading.Thread(target=warm_up, name="semviz-warm-up", daemon=True).start()
        self._flusher = threading.Thread(target=self._flush, name="semviz-flush", daemon=True)
        self._flusher.start()
        self._sessions = Sessions(self._open, HANDLERS.decode)

    @property
    def title(self) -> str:
        return f"semviz annotate, {self.session.workspace.name}"

    @property
    def pages(self) -> tuple[AnnotatorPage, ...]:
        return tuple(self._pages)

    def forget(self, page: AnnotatorPage) -> None:
        self._pages.remove(page)

    def role_of(self, person: str) -> Role | None:
        if not person:
            return "review"
        known = self.people.by_name().get(person)
        return None if known is None else known.role

    def people_changed(self) -> None:
        self._people_changed.set()

    def blind_address(self, name: str) -> str:
        """Return where a person labels blind. Raise RefusedError: not within another tool."""
        raise RefusedError("not_found", "label these frames in 'semviz annotate'")

    def shares_changed(self) -> None:
        """Let the annotators of those who label blind follow the shares."""

    def close(self) -> None:
        """Stop the threads and close the label file."""
        self._closing.set()
        self.updates_queued.set()
        self._poller.join()
        self._flusher.join()
        self._analyzer.join()
        self.pose_work.close()
        self.scene_thread.shutdown(wait=True, cancel_futures=True)
        self.scenes.close_all()  # one may have been opened after its page had gone
        self.search_thread.shutdown(wait=True)  # its last task may be to close a session
        self.shares.close()
        self.session.close()

    def use_chosen_poses(self) -> None:
        """Open the session again with the poses that are chosen now, and tell all pages.

        Raise SemvizError, and keep the session, if the choices cannot be used.
        """
        with self.lock:
            old = self.session
            self.session = LabelSession(Workspace.open(old.workspace.path), old.author)
            self.session.map_work.refresh()
            self.shares.follow()
            self.session.beside_blind = self.shares.beside
            for page in self.pages:
                page.restart()
        self.search_thread.submit(old.close)  # after the searches that use it
        self.pose_work.look_up()

    def routes(self) -> list[web.AbstractRouteDef]:
        return [
            web.get("/", self._index),
            web.static("/page/", PAGE),
            web.get(r"/image/{frame:[0-9]{1,9}}/{side:left|right}.png", self._image),
            web.get(r"/thumbnail/{frame:[0-9]{1,9}}.jpg", self._thumbnail),
            *self._sessions.routes(),
        ]

    def _open(self, session_id: str, send: Send, person: str = "") -> AnnotatorPage:
        page = AnnotatorPage(session_id, send, self, person)
        self._pages.append(page)
        return page

    def _poll(self) -> None:
        """Send changes of other processes to the open pages."""
        while not self._closing.wait(POLL_EVERY_S):
            for follow in (
                self._refresh_map,
                self._send_health,
                self._follow_classes,
                self._follow_people,
                self._follow_poses,
                self._send_updates,
            ):
                with contextlib.suppress(sqlite3.Error, LabelFileError):  # the pages know it
                    follow()

    def _refresh_map(self) -> None:
        with self.lock:
            self.session.map_work.refresh()

    def _flush(self) -> None:
        """Send updates page by page, so that edits come between; many edits are one update."""
        while not self._closing.is_set():
            self.updates_queued.wait()
            self.updates_queued.clear()
            self._flushed = time.monotonic()
            for page in self.pages:
                with contextlib.suppress(sqlite3.Error, LabelFileError), self.lock:
                    page.send_update()
            self._closing.wait(FLUSH_EVERY_S + FLUSH_PAGE_S * len(self._pages))

    def _follow_people(self) -> None:
        """Tell all pages who is where, and end the sessions of those who may no longer enter."""
        try:
            people = self.people.by_name()
        except SemvizError:  # damaged: nobody enters, and who is asked says so
            return
        for person in {page.person for page in self.pages} - {"", *people}:
            self._sessions.end_of(person)
        pages = [(page.author, page.frame, page.selected_name) for page in self.pages]
        views = people_views(people, self.session.author, pages)
        if views == self._sent_people and not self._people_changed.is_set():
            return
        self._people_changed.clear()
        self._sent_people = views
        for page in self.pages:
            page.send_people(views)

    def _follow_classes(self) -> None:
        """Tell all pages which classes and attributes are declared, if that has changed."""
        with self.lock:
            labels = self.session.labels
            declared = labels.classes, attribute_types(labels)
            if declared != self._sent_classes:
                self._sent_classes = declared
                for page in self.pages:
                    page.restart()

    def _send_health(self) -> None:
        health = self.session.health()
        if health != self._sent_health:
            self._sent_health = health
            for page in self.pages:
                page.send_health(health)

    def _follow_poses(self) -> None:
        """Use choices that another process made, and send how far the comparison is."""
        with contextlib.suppress(SemvizError):  # the file is damaged: the session stays
            if self.session.workspace.pose_choices() != self.session.choices:
                self.use_chosen_poses()
        if self.pose_work.version != self._sent_poses:
            self._sent_poses = self.pose_work.version
            for page in self.pages:
                page.send_poses()

    def _analyze(self) -> None:
        """Analyze all frames, a few at a time, because edits come first."""
        done, sent = True, time.monotonic()
        while not self._closing.wait(POLL_EVERY_S if done else self._pause_s):
            with contextlib.suppress(sqlite3.Error, LabelFileError), self.lock:
                done = self.session.analyze(ANALYZE_S)
                if done or time.monotonic() > sent + SEND_EVERY_S:
                    self._send_analyzed()
                    sent = time.monotonic()

    def _send_analyzed(self) -> None:
        """Send what was analyzed. The caller holds the lock: a newer state must not go first."""
        frames, rows = self.session.take_assessed(), self.session.tracks.take_collected()
        if not (frames or rows):
            return
        expected = self.session.tracks.frames([frame.index for frame in frames])
        for page in self.pages:
            page.send_tracks(rows, expected)
            if frames:
                page.send_frame_list(frames)

    @property
    def _pause_s(self) -> float:
        is_busy = time.monotonic() < self._flushed + BUSY_S
        return BUSY_PAUSE_S if is_busy else PAUSE_S

    def _send_updates(self) -> None:
        with self.lock:
            if self._pages and self.session.has_updates():
                labels = self.session.updates()
                rows = self.session.tracks.changed()
                for page in self.pages:
                    page.send_tracks(rows)
                    page.queue_update(labels)

    async def _index(self, request: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _image(self, request: web.Request) -> web.StreamResponse:
        side: Side = "left" if request.match_info["side"] == "left" else "right"
        frame = int(request.match_info["frame"])
        return await _picture(lambda: self.session.images.shown(frame, side), "image/png")

    async def _thumbnail(self, request: web.Request) -> web.StreamResponse:
        frame = int(request.match_info["frame"])
        return await _picture(lambda: self.session.images.thumbnail(frame), "image/jpeg")


async def _picture(found: "Callable[[], Future[P]]", kind: str) -> web.StreamResponse:
    """Return an image that the browser keeps; of a file it asks later whether that has changed."""
    try:
        image = await _uncancelled(found)
    except SemvizError as error:
        raise web.HTTPNotFound(text=str(error)) from None
    headers = {"Cache-Control": KEEP_IMAGE}
    if isinstance(image, bytes):
        return web.Response(body=image, content_type=kind, headers=headers)
    if not image.is_file():
        raise web.HTTPNotFound(text=f"{image}: no such image; copy it there again")
    return web.FileResponse(image, headers=headers)


async def _uncancelled(found: "Callable[[], Future[P]]") -> P:
    """Return an image; ask again if it was cancelled in favour of others."""
    while True:
        future = found()
        try:
            return await asyncio.shield(asyncio.wrap_future(future))  # others may await it too
        except asyncio.CancelledError:
            if not future.cancelled():
                raise
