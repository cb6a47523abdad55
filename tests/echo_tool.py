"""A small web tool behind the gateway, and how people and strangers ask it."""

import asyncio
import http.client
import time
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, TypeVar
from urllib.parse import urlsplit

from aiohttp import web

from semviz.web.protocol import Event, Handlers, Request, handles
from semviz.web.sessions import Send, Sessions
from semviz.web.viser_servers import ViserServers
from semviz_core.common.errors import SemvizError

Result = TypeVar("Result")

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


class EchoRequest(Request):
    type: Literal["echo"] = "echo"
    number: int = 0
    slow: bool = False
    fault: str = ""
    bug: bool = False


class EchoEvent(Event):
    type: Literal["echo"] = "echo"
    number: int


class EchoSession:
    def __init__(self, send: Send) -> None:
        self._send = send
        self.receive = HANDLERS.bound_to(self)
        self.closed = False

    def connected(self) -> None:
        self._send(EchoEvent(number=-1))

    @handles(EchoRequest)
    def _echo(self, request: EchoRequest) -> None:
        if request.fault:
            raise SemvizError(request.fault)
        if request.bug:
            raise KeyError("number")
        if request.slow:
            time.sleep(0.1)
        self._send(EchoEvent(reply_to=request.id, number=request.number))

    def close(self) -> None:
        self.closed = True


HANDLERS = Handlers(EchoRequest, EchoSession)


class EchoTool:
    title = "echo"

    def __init__(self) -> None:
        self.scenes = ViserServers()
        self.made: list[str] = []
        self._sessions = Sessions(self._make, HANDLERS.decode)

    def _make(self, session_id: str, send: Send, _: str) -> EchoSession:
        self.made.append(session_id)
        return EchoSession(send)

    def routes(self) -> list[web.AbstractRouteDef]:
        async def page(_: web.Request) -> web.Response:
            return web.Response(text="a page")

        return [web.get("/", page), web.post("/", page), *self._sessions.routes()]


def finished(work: Coroutine[Any, Any, Result]) -> Result:
    """Runs in a thread: Playwright's fixtures leave a running event loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def ask(
    url: str, path: str = "/", method: str = "GET", headers: dict[str, str] | None = None
) -> http.client.HTTPResponse:
    """The answer to whoever has the cookie that ``url`` gives."""
    parts = urlsplit(url)
    given = connected(parts.port, "GET", f"/?{parts.query}", {}).headers["Set-Cookie"]
    cookie = {} if given is None else {"Cookie": given.split(";")[0]}
    return connected(parts.port, method, path, cookie | (headers or {}))


def stranger(
    url: str, path: str = "/", headers: dict[str, str] | None = None
) -> http.client.HTTPResponse:
    """The answer to whoever knows the port only."""
    return connected(urlsplit(url).port, "GET", path, headers or {})


def connected(
    port: int | None, method: str, path: str, headers: dict[str, str]
) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port or 80, timeout=10)
    connection.request(method, path, headers=headers)
    return connection.getresponse()
