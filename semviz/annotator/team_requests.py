"""Handle the requests of a page about the team: who has what, and the frames that wait."""

from collections.abc import Callable
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.services import PageServices
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


class TeamServices(PageServices, Protocol):
    """Those for the team."""

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
        self._send_team(request.id)

    def _send_team(self, reply_to: str) -> None:
        people = self._shared.people.by_name()
        with self._shared.lock:
            session = self._shared.session
            team = session.team.view(people, session.author)
        self._send(TeamEvent(reply_to=reply_to, team=team))

    @protocol.handles(AssignFramesRequest)
    def _assign_frames(self, request: AssignFramesRequest) -> None:
        session = self._shared.session
        if request.person not in {session.author, *self._shared.people.by_name()}:
            raise RefusedError("not_found", f"nobody named '{request.person}' is invited")
        with self._shared.lock:
            frames = session.team.checked(request.frames)
            text = assignment_text(request.person, frames)
            session.team.store.state("assign", text, self._author)
        self._send_team(request.id)
