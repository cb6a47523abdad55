"""Handle the requests of a page about the team: who has what, and the frames that wait."""

import threading
from collections.abc import Callable
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.session import LabelSession
from semviz.annotator.team_view import AssignFramesRequest, ShowTeamRequest, TeamEvent
from semviz.web import protocol
from semviz.web.protocol import RefusedError
from semviz.workspace.people import People
from semviz_annotation.labels.edits import AcceptFrame, SendBackFrame
from semviz_annotation.storage.teamwork import assignment_text


def needs_review(request: protocol.Request) -> bool:
    """Return whether a request needs the right to review."""
    if isinstance(request, messages.ApplyEditRequest):
        return isinstance(request.edit, AcceptFrame | SendBackFrame)
    return isinstance(request, AssignFramesRequest)


class TeamServices(Protocol):
    """Services that all opened pages of a workspace share."""

    @property
    def session(self) -> LabelSession: ...

    @property
    def lock(self) -> threading.RLock: ...

    @property
    def people(self) -> People: ...


class TeamRequests:
    """Those of one opened page."""

    def __init__(
        self,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: TeamServices,
        author: str,
    ) -> None:
        self._send = send
        self._shared = shared
        self._author = author

    @protocol.handles(ShowTeamRequest)
    def _show_team(self, request: ShowTeamRequest) -> None:
        people = self._shared.people.by_name()
        with self._shared.lock:
            session = self._shared.session
            team = session.team.view(people, session.author)
        self._send(TeamEvent(reply_to=request.id, team=team))

    @protocol.handles(AssignFramesRequest)
    def _assign_frames(self, request: AssignFramesRequest) -> None:
        session = self._shared.session
        if request.person not in {session.author, *self._shared.people.by_name()}:
            raise RefusedError("not_found", f"nobody named '{request.person}' is invited")
        with self._shared.lock:
            frames = session.team.checked(request.frames)
            text = assignment_text(request.person, frames)
            session.team.store.state("assign", text, self._author)
        self._show_team(ShowTeamRequest(id=request.id))
