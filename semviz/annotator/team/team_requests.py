"""Handle the requests of a page about the team: who has what, and the frames that wait."""

from collections.abc import Callable
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.services import PageServices
from semviz.annotator.team import blind_views
from semviz.annotator.team.blind_shares import BlindShares
from semviz.annotator.team.blind_views import TeamEvent
from semviz.annotator.team.team_view import AssignFramesRequest, ShowTeamRequest
from semviz.web import protocol
from semviz.web.protocol import RefusedError
from semviz.workspace.people import People, Role
from semviz_annotation.labels.edits import AcceptFrame, SendBackFrame
from semviz_annotation.storage.teamwork import assignment_text

REVIEWING = (
    AssignFramesRequest,
    blind_views.AssignShareRequest,
    blind_views.EndShareRequest,
)
"""Requests that need the right to review, besides edits."""


def needs_review(request: protocol.Request) -> bool:
    """Return whether a request needs the right to review."""
    if isinstance(request, messages.ApplyEditRequest):
        return isinstance(request.edit, AcceptFrame | SendBackFrame | messages.MergeFrameEdit)
    return isinstance(request, (*REVIEWING, blind_views.ShowComparedRequest))


class TeamServices(PageServices, Protocol):
    """Those for the team."""

    @property
    def people(self) -> People: ...

    @property
    def shares(self) -> BlindShares: ...

    def role_of(self, person: str) -> Role | None:
        """Return what a guest may do, "" being who started the server; None: no longer anything."""
        ...

    def blind_address(self, name: str) -> str:
        """Return where a person labels blind."""
        ...

    def shares_changed(self) -> None:
        """Let those who label blind see what was assigned."""
        ...


class TeamRequests:
    """Those of one opened page."""

    def __init__(
        self,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: TeamServices,
        author: str,
        person: str,
    ) -> None:
        self._send = send
        self._shared = shared
        self._author = author
        self._person = person

    @protocol.handles(ShowTeamRequest)
    def _show_team(self, request: ShowTeamRequest) -> None:
        self._send_team(request.id)

    def _send_team(self, reply_to: str) -> None:
        people = self._shared.people.by_name()
        reviews = self._shared.role_of(self._person) == "review"
        with self._shared.lock:
            session = self._shared.session
            team = session.team.view(people, session.author)
            shares = blind_views.share_views(self._shared.shares, reviews)
        self._send(TeamEvent(reply_to=reply_to, team=team, shares=shares))

    @protocol.handles(AssignFramesRequest)
    def _assign_frames(self, request: AssignFramesRequest) -> None:
        self._check_invited(request.person)
        with self._shared.lock:
            session = self._shared.session
            frames = session.team.checked(request.frames)
            text = assignment_text(request.person, frames)
            session.team.store.state("assign", text, self._author)
        self._send_team(request.id)

    @protocol.handles(blind_views.AssignShareRequest)
    def _assign_share(self, request: blind_views.AssignShareRequest) -> None:
        for name in request.people:
            self._check_invited(name)
        shares = self._shared.shares
        with self._shared.lock:
            shares.assign(request.frames, request.percent, request.people, self._author)
        self._shared.shares_changed()
        self._send_team(request.id)

    @protocol.handles(blind_views.EndShareRequest)
    def _end_share(self, request: blind_views.EndShareRequest) -> None:
        with self._shared.lock:
            self._shared.shares.end(request.number, self._author)
        self._shared.shares_changed()
        self._send_team(request.id)

    @protocol.handles(blind_views.ShowComparedRequest)
    def _show_compared(self, request: blind_views.ShowComparedRequest) -> None:
        with self._shared.lock:
            classes, shares = self._shared.session.classes, self._shared.shares
            self._send(blind_views.compared_event(shares, request.frame, classes, request.id))

    @protocol.handles(blind_views.OpenShareRequest)
    def _open_share(self, request: blind_views.OpenShareRequest) -> None:
        address = self._shared.blind_address(self._author)
        self._send(blind_views.ShareOpenedEvent(reply_to=request.id, address=address))

    def _check_invited(self, name: str) -> None:
        if name not in {self._shared.session.author, *self._shared.people.by_name()}:
            raise RefusedError("not_found", f"nobody named '{name}' is invited")
