"""Websockets that end with the door: a page left open must not hold up Ctrl-C."""

from typing import Any
from weakref import WeakSet

from aiohttp import WSCloseCode, web

OPEN_SOCKETS: web.AppKey[WeakSet[web.WebSocketResponse]] = web.AppKey("open_sockets", WeakSet)


async def accept_socket(request: web.Request, **options: Any) -> web.WebSocketResponse:
    """Upgrades ``request``; ``options`` are those of aiohttp's WebSocketResponse.

    Nothing is compressed: that costs more time than it saves on this machine or a near network.
    """
    socket = web.WebSocketResponse(compress=False, **options)
    await socket.prepare(request)
    request.app[OPEN_SOCKETS].add(socket)
    return socket


async def close_sockets(app: web.Application) -> None:
    """aiohttp ``on_shutdown`` signal."""
    sockets = app[OPEN_SOCKETS]
    for socket in list(sockets):
        await socket.close(code=WSCloseCode.GOING_AWAY)
