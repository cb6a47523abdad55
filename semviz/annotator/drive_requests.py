"""Handle the requests of a page about the view "Your drive"."""

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.drive_view import drive_matches, drive_view
from semviz.annotator.session import LabelSession
from semviz.web import protocol
from semviz.web.protocol import RefusedError
from semviz_core.common.errors import SemvizError


class DriveServices(Protocol):
    """Services that all opened pages of a workspace share."""

    @property
    def session(self) -> LabelSession: ...

    @property
    def lock(self) -> threading.RLock: ...

    @property
    def search_thread(self) -> Executor: ...


class DriveRequests:
    """The requests of one opened page about its drive."""

    def __init__(
        self, send: Callable[[messages.AnnotatorEvent], None], shared: DriveServices
    ) -> None:
        self._send = send
        self._shared = shared
        self._wanted: int | None = None

    @protocol.handles(messages.ShowDriveRequest)
    def _show_drive(self, request: messages.ShowDriveRequest) -> None:
        session = self._shared.session
        with self._shared.lock:
            try:
                view = drive_view(session.workspace, session.source)
            except SemvizError as error:
                raise RefusedError("invalid", str(error)) from None
        self._send(messages.DriveEvent(reply_to=request.id, drive=view))

    @protocol.handles(messages.ShowDriveFrameRequest)
    def _show_drive_frame(self, request: messages.ShowDriveFrameRequest) -> None:
        """Match the images in the background; the latest request wins."""
        if request.frame not in self._shared.session.frames:
            raise RefusedError("not_found", f"frame {request.frame} is not in this sequence")
        self._wanted = request.frame
        self._shared.search_thread.submit(self._match, request.frame)

    def _match(self, index: int) -> None:
        if index != self._wanted:
            return
        try:
            second, matches = drive_matches(self._shared.session.source, index)
            note = ""
        except SemvizError as error:
            second, matches, note = index, [], str(error)
        self._send(messages.DriveFrameEvent(frame=index, second=second, matches=matches, note=note))
