"""Forward ``/view/SESSION/...`` to the viser server of a page, pages and websocket."""

import asyncio
import re
from collections import Counter
from typing import TypeAlias

from aiohttp import ClientError, ClientSession, ClientWebSocketResponse, WSMsgType, web

from semviz.web.sessions import accept_socket
from semviz.web.viser_servers import ViserServers

FORWARDED = ("Content-Type", "Content-Encoding")
MAX_MESSAGE = 50 * 2**20
"""Largest message from a browser, bytes; viser's own limit. Images that it renders are largest."""
MAX_SOCKETS = 8
"""Open websockets of one page's scene; the page needs one, and one more while it reconnects."""
HEARTBEAT_S = 20.0
MISSING = "this page's 3D scene has been closed; reload the page\n"
SAFE_PATH = re.compile(r"[\w./-]*", re.ASCII)
"""Paths of viser's client; nothing else is passed on."""

Socket: TypeAlias = web.WebSocketResponse | ClientWebSocketResponse


class SceneProxy:
    """The only client of viser's servers: adds the secret without which they refuse a request."""

    def __init__(self, scenes: ViserServers) -> None:
        self._scenes = scenes
        self._sockets: Counter[str] = Counter()

    def routes(self) -> list[web.AbstractRouteDef]:
        # viser's client opens its websocket at its page's path without the slash
        return [
            web.get("/view/{session}", self._handle),
            web.get("/view/{session}/{path:.*}", self._handle),
        ]

    async def _handle(self, request: web.Request) -> web.StreamResponse:
        session, path = request.match_info["session"], request.match_info.get("path", "")
        address = self._scenes.address(session)
        if address is None or not SAFE_PATH.fullmatch(path):
            raise web.HTTPNotFound(text=MISSING)
        target = f"{address}/{path}"
        try:
            async with ClientSession(
                auto_decompress=False, headers=self._scenes.secret_header
            ) as client:
                if request.headers.get("Upgrade", "").lower() == "websocket":
                    return await self._socket(request, client, f"ws://{target}", session)
                if "path" not in request.match_info:
                    raise web.HTTPFound(request.path + "/")
                return await _forward_page(request, client, f"http://{target}")
        except ClientError as error:
            raise web.HTTPBadGateway(text=f"the 3D scene does not answer: {error}\n") from None

    async def _socket(
        self, request: web.Request, client: ClientSession, url: str, session: str
    ) -> web.WebSocketResponse:
        if self._sockets[session] >= MAX_SOCKETS:
            raise web.HTTPTooManyRequests(text="this page's 3D scene is open too often\n")
        self._sockets[session] += 1
        try:
            return await _forward_socket(request, client, url)
        finally:
            self._sockets[session] -= 1
            self._sockets += Counter()  # forget sessions without sockets


async def _forward_page(request: web.Request, client: ClientSession, url: str) -> web.Response:
    accepted = {"Accept-Encoding": request.headers.get("Accept-Encoding", "")}
    async with client.get(url, headers=accepted) as response:
        headers = {name: response.headers[name] for name in FORWARDED if name in response.headers}
        return web.Response(status=response.status, body=await response.read(), headers=headers)


async def _forward_socket(
    request: web.Request, client: ClientSession, url: str
) -> web.WebSocketResponse:
    names = request.headers.get("Sec-WebSocket-Protocol", "")
    protocols = [name.strip() for name in names.split(",") if name.strip()]
    front = await accept_socket(
        request, protocols=protocols, max_msg_size=MAX_MESSAGE, heartbeat=HEARTBEAT_S
    )
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
