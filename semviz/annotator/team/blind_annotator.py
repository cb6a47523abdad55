"""The annotator with those of the people who label frames blind, under ``/blind/NUMBER/``.

Each is an annotator of its own, on the person's own label file, and only this person may enter.
"""

import threading
from contextlib import ExitStack

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from semviz.annotator.server import Annotator
from semviz.web.access import PERSON
from semviz.web.protocol import RefusedError
from semviz.web.tool import InnerTools
from semviz.workspace.blind import BlindWorkspace, blind_workspace
from semviz.workspace.people import Role
from semviz.workspace.workspace import Workspace


class TeamAnnotator(Annotator):
    """The labelling tool for one workspace, as ``semviz annotate`` serves it."""

    def __init__(self, workspace: Workspace, author: str | None = None) -> None:
        super().__init__(workspace, author)
        self._tools = InnerTools("blind")
        self._blind: dict[str, BlindAnnotator] = {}
        """By the name of the person."""
        self._opening = threading.Lock()
        self._closing_blind = ExitStack()

    def routes(self) -> list[web.AbstractRouteDef]:
        return [*super().routes(), self._tools]

    def close(self) -> None:
        self._tools.clear()
        self._closing_blind.close()
        super().close()

    def blind_address(self, name: str) -> str:
        """Return where a person labels blind; the annotator there starts on first use."""
        if not self.shares.of_person(name):
            raise RefusedError("not_found", "no frames are yours to label blind")
        with self._opening:
            if name not in self._blind:
                annotator = BlindAnnotator(self, blind_workspace(self.session.workspace, name))
                self._closing_blind.callback(annotator.close)
                self._closing_blind.callback(annotator.scenes.close_all)
                number = str(len(self._blind) + 1)
                person = "" if name == self.session.author else name
                self._tools.add(number, annotator, middlewares=[_only(person)])
                self._blind[name] = annotator
            return f"blind/{[*self._blind].index(name) + 1}/"

    def shares_changed(self) -> None:
        with self._opening:
            for annotator in self._blind.values():
                annotator.use_chosen_poses()


class BlindAnnotator(Annotator):
    """The annotator of one person's own label file."""

    def __init__(self, outer: Annotator, workspace: BlindWorkspace) -> None:
        self._outer = outer
        super().__init__(workspace, workspace.person)
        self.people = outer.people
        self._close_compared()

    def role_of(self, person: str) -> Role | None:
        role = self._outer.role_of(person)
        return "annotate" if role == "review" else role

    def use_chosen_poses(self) -> None:
        """As that of the annotator; the frames may be others, too."""
        super().use_chosen_poses()
        self._close_compared()

    def _close_compared(self) -> None:
        self.session.team.store.closed = self._outer.shares.why_closed_to(self.session.author)


def _only(person: str) -> Middleware:
    """Return the middleware that lets one person in; "" is who started the server."""

    @web.middleware
    async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.get(PERSON, "") != person:
            raise web.HTTPForbidden(text="somebody else labels these frames blind")
        return await handler(request)

    return guarded
