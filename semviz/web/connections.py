"""Accept connections, and end those that do not soon make a request that is allowed.

Anybody who reaches the port can connect and stay silent. Each connection takes a file of the
process, of which there often are 1,024: no page would open any more, and no label could be saved.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

MOST_STRANGERS = 64
"""Connections without an allowed request; one more ends the oldest."""
STRANGER_S = 10.0
"""How long each of them may stay."""
_PAUSE_S = 0.1


class Connections:
    """The connections of a port that ``listener`` listens on."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._strangers: dict[asyncio.BaseTransport, asyncio.TimerHandle] = {}
        self._accepting: asyncio.Task[None] | None = None

    def start(self, protocol: Callable[[], asyncio.BaseProtocol]) -> None:
        """Accept connections from now on, each with a ``protocol`` of its own."""
        self._accepting = asyncio.get_running_loop().create_task(self._accept(protocol))

    def stop(self) -> None:
        """Accept no more."""
        if self._accepting is not None:
            self._accepting.cancel()

    async def _accept(self, protocol: Callable[[], asyncio.BaseProtocol]) -> None:
        loop = asyncio.get_running_loop()
        self._listener.setblocking(False)
        while True:
            try:
                connection, _ = await loop.sock_accept(self._listener)
                transport, _ = await loop.connect_accepted_socket(protocol, connection)
            except OSError:  # it has gone, or the process has no file left
                self._end_oldest()
                await asyncio.sleep(_PAUSE_S)
                continue
            self._strangers[transport] = loop.call_later(STRANGER_S, self._end, transport)
            if len(self._strangers) > MOST_STRANGERS:
                self._end_oldest()

    def middleware(self) -> Middleware:
        """Return the aiohttp middleware that lets a connection stay; it comes after the policy."""

        @web.middleware
        async def known(request: web.Request, handler: Handler) -> web.StreamResponse:
            transport = request.transport
            timer = None if transport is None else self._strangers.pop(transport, None)
            if timer is not None:
                timer.cancel()
            return await handler(request)

        return known

    def _end_oldest(self) -> None:
        with contextlib.suppress(StopIteration):
            self._end(next(iter(self._strangers)))

    def _end(self, transport: asyncio.BaseTransport) -> None:
        self._strangers.pop(transport).cancel()
        if isinstance(transport, asyncio.Transport):
            transport.abort()
