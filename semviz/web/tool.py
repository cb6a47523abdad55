"""A web tool as an application: its routes, the shared files, its 3D scenes, tools inside it.

``/view/SESSION/...`` is forwarded to the viser server of a page, pages and websocket.
"""

import asyncio
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeAlias
from weakref import WeakSet

from aiohttp import ClientError, ClientSession, ClientWebSocketResponse, WSMsgType, web

from semviz.web.sessions import OPEN_SOCKETS, accept_socket
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


STATIC = Path(__file__).parent / "static"
"""Style sheet and ES modules that both tools' pages share, served under ``/static/``."""
MAX_UPLOAD = 16 * 2**20
"""Largest body of a request, bytes."""


class Tool(Protocol):
    """A web tool that the gateway serves."""

    @property
    def title(self) -> str:
        """Name of the tool and its data, for the terminal."""
        ...

    @property
    def scenes(self) -> ViserServers:
        """Its 3D scenes; the gateway proxies ``/view/SESSION/`` to them and finally closes them."""
        ...

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return its routes: page, JSON, websocket; ``/static/`` and ``/view/`` are reserved."""
        ...


def tool_application(tool: Tool, **options: Any) -> web.Application:
    """Return the application of a tool; ``options`` are those of aiohttp's application."""
    app = web.Application(client_max_size=MAX_UPLOAD, **options)
    app.add_routes(tool.routes())
    app.add_routes(SceneProxy(tool.scenes).routes())
    app.router.add_static("/static/", STATIC)
    app[OPEN_SOCKETS] = WeakSet()
    return app


class InnerTools(web.AbstractResource, web.AbstractRouteDef):
    """Tools inside a tool, under ``/PREFIX/NAME/``: same port, same access policy.

    One of the outer tool's routes. Tools may be added from any thread while it is served.
    """

    def __init__(self, prefix: str) -> None:
        super().__init__()
        self._prefix = f"/{prefix}"
        self._tools: dict[str, web.PrefixedSubAppResource] = {}

    def add(self, name: str, tool: Tool, **options: Any) -> None:
        """Serve ``tool`` under ``/PREFIX/NAME/`` from now on; for ``options`` see above."""
        app = tool_application(tool, **options)
        resource = web.PrefixedSubAppResource(f"{self._prefix}/{name}", app)
        app.freeze()
        self._tools[name] = resource

    def clear(self) -> None:
        """Serve none of the tools any more."""
        self._tools.clear()

    def register(self, router: web.UrlDispatcher) -> list[web.AbstractRoute]:
        router.register_resource(self)
        return []

    async def resolve(
        self, request: web.Request
    ) -> tuple[web.UrlMappingMatchInfo | None, set[str]]:
        """Pass a request to the tool that its path names; part of aiohttp's routing."""
        name = request.rel_url.path_safe.removeprefix(f"{self._prefix}/").partition("/")[0]
        resource = self._tools.get(name)
        return (None, set()) if resource is None else await resource.resolve(request)

    @property
    def canonical(self) -> str:
        return self._prefix

    def raw_match(self, path: str) -> bool:
        return path == self._prefix

    def get_info(self) -> Any:
        return {"prefix": self._prefix}

    def add_prefix(self, prefix: str) -> NoReturn:
        raise NotImplementedError("tools inside a tool inside a tool")

    def url_for(self, **_: str) -> NoReturn:
        raise NotImplementedError("a page's address is relative")

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[web.AbstractRoute]:
        return iter(())
