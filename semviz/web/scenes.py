"""A viser server of its own for every opened page, and the way to it through the door."""

import asyncio
import contextlib
import secrets
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeAlias

import rich
from aiohttp import ClientError, ClientSession, ClientWebSocketResponse, WSMsgType, web

from semviz.web.sockets import accept_socket

if TYPE_CHECKING:
    import viser

FORWARDED = ("Content-Type", "Content-Encoding")

Socket: TypeAlias = web.WebSocketResponse | ClientWebSocketResponse

_console_lock = threading.Lock()


class Scenes:
    """The viser servers of one tool, by session; each on loopback with a port of its own.

    Thread-safe. ``scene`` makes a session's server at the first asking (0.1 s, and 1 s for the
    import before the very first: call it off the event loop); ``close`` stops one.
    """

    def __init__(self) -> None:
        self._servers: dict[str, viser.ViserServer] = {}
        self._lock = threading.Lock()

    def scene(self, session: str) -> "viser.ViserServer":
        """The viser server of ``session``, with its own panels, logo and sharing off."""
        with self._lock:
            if session not in self._servers:
                self._servers[session] = _start_server()
            return self._servers[session]

    def address(self, session: str) -> str | None:
        """``host:port`` of the session's viser server; None where it has none."""
        with self._lock:
            server = self._servers.get(session)
        return None if server is None else f"{server.get_host()}:{server.get_port()}"

    def close(self, session: str) -> None:
        """Stops the session's viser server; nothing where it has none."""
        with self._lock:
            server = self._servers.pop(session, None)
        if server is not None:
            with _quiet_console():
                server.stop()

    def close_all(self) -> None:
        for session in tuple(self._servers):
            self.close(session)


class Proxy:
    """Hands ``/view/SESSION/...``, HTTP and websocket, to that session's viser server."""

    def __init__(self, scenes: Scenes) -> None:
        self._scenes = scenes

    def routes(self) -> list[web.AbstractRouteDef]:
        # viser's client asks for its websocket at its page's path without the slash
        return [
            web.get("/view/{session}", self._handle),
            web.get("/view/{session}/{path:.*}", self._handle),
        ]

    async def _handle(self, request: web.Request) -> web.StreamResponse:
        address = self._scenes.address(request.match_info["session"])
        if address is None:
            raise web.HTTPNotFound(text="this page's 3D scene has been closed; reload the page\n")
        target = f"{address}/{request.match_info.get('path', '')}"
        try:
            async with ClientSession(auto_decompress=False) as client:
                if request.headers.get("Upgrade", "").lower() == "websocket":
                    return await _forward_socket(request, client, f"ws://{target}")
                if "path" not in request.match_info:
                    raise web.HTTPFound(request.path + "/")
                return await _forward_page(request, client, f"http://{target}")
        except ClientError as error:
            raise web.HTTPBadGateway(text=f"the 3D scene does not answer: {error}\n") from None


async def _forward_page(request: web.Request, client: ClientSession, url: str) -> web.Response:
    accepted = {"Accept-Encoding": request.headers.get("Accept-Encoding", "")}
    async with client.get(url, headers=accepted) as answer:
        headers = {name: answer.headers[name] for name in FORWARDED if name in answer.headers}
        return web.Response(status=answer.status, body=await answer.read(), headers=headers)


async def _forward_socket(
    request: web.Request, client: ClientSession, url: str
) -> web.WebSocketResponse:
    names = request.headers.get("Sec-WebSocket-Protocol", "")
    protocols = [name.strip() for name in names.split(",") if name.strip()]
    front = await accept_socket(request, protocols=protocols, max_msg_size=0)
    async with client.ws_connect(url, protocols=protocols, max_msg_size=0, compress=0) as back:
        pumps = {asyncio.create_task(_pump(front, back)), asyncio.create_task(_pump(back, front))}
        try:
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for pump in pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)
    await front.close()
    return front


async def _pump(source: Socket, target: Socket) -> None:
    async for message in source:
        if message.type is WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await target.send_str(message.data)


def _start_server() -> "viser.ViserServer":
    from semviz.web.private_server import PrivateServer

    with _quiet_console():
        server = PrivateServer(host=_loopback_address(), port=0, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    return server


def _loopback_address() -> str:
    """An address that only this machine reaches, and that other sites' pages cannot guess.

    viser checks neither Origin nor token, so a page open in the same browser could talk to it
    behind the door's back. All of 127.0.0.0/8 is loopback, but macOS answers on 127.0.0.1 only.
    """
    if sys.platform == "darwin":
        return "127.0.0.1"
    return ".".join(["127"] + [str(secrets.randbelow(254) + 1) for _ in range(3)])


@contextlib.contextmanager
def _quiet_console() -> Iterator[None]:
    """viser prints banners through rich's shared console, whatever ``verbose`` says."""
    console = rich.get_console()
    with _console_lock:
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before
