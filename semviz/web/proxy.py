"""The way through the door to servers that only this machine reaches."""

import asyncio
from collections.abc import Callable
from typing import TypeAlias

from aiohttp import ClientError, ClientSession, ClientWebSocketResponse, WSMsgType, web

from semviz.web.sockets import accept_socket

FORWARDED = ("Content-Type", "Content-Encoding")

Socket: TypeAlias = web.WebSocketResponse | ClientWebSocketResponse


class Proxy:
    """Hands ``/PREFIX/NAME/...``, GET and websocket, to the server at ``address(NAME)``.

    ``gone`` is what people read where there is none.
    """

    def __init__(self, prefix: str, address: Callable[[str], str | None], gone: str) -> None:
        self._prefix = prefix
        self._address = address
        self._gone = gone

    def routes(self) -> list[web.AbstractRouteDef]:
        # viser's client asks for its websocket at its page's path without the slash
        return [
            web.get(f"/{self._prefix}/{{name}}", self._handle),
            web.get(f"/{self._prefix}/{{name}}/{{path:.*}}", self._handle),
        ]

    async def _handle(self, request: web.Request) -> web.StreamResponse:
        address = self._address(request.match_info["name"])
        if address is None:
            raise web.HTTPNotFound(text=f"{self._gone}\n")
        target = f"{address}/{request.match_info.get('path', '')}"
        if request.query_string:
            target += f"?{request.query_string}"
        try:
            async with ClientSession(auto_decompress=False) as client:
                if request.headers.get("Upgrade", "").lower() == "websocket":
                    return await _forward_socket(request, client, f"ws://{target}")
                if "path" not in request.match_info:
                    raise web.HTTPFound(request.path + "/")
                return await _forward_page(request, client, f"http://{target}")
        except ClientError as error:
            raise web.HTTPBadGateway(text=f"{self._prefix} does not answer: {error}\n") from None


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
