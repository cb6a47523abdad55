"""A session is one opened page: its state lives on the server, its websocket may reconnect.

A session outlives its websocket for a while, so a short break loses nothing. Websockets end
with the gateway: an open page must not delay Ctrl-C.
"""

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias
from weakref import WeakSet

from aiohttp import WSCloseCode, WSMsgType, web

from semviz.web import protocol
from semviz.web.access import PERSON
from semviz_core.common.errors import SemvizError

OPEN_SOCKETS: web.AppKey[WeakSet[web.WebSocketResponse]] = web.AppKey("open_sockets", WeakSet)


async def accept_socket(request: web.Request, **options: Any) -> web.WebSocketResponse:
    """Upgrade ``request`` and return its websocket; ``options`` are those of aiohttp's.

    Nothing is compressed: that costs more time than it saves on one machine or a local network.
    """
    socket = web.WebSocketResponse(compress=False, **options)
    await socket.prepare(request)
    request.app[OPEN_SOCKETS].add(socket)
    return socket


async def close_sockets(app: web.Application) -> None:
    """Close all open websockets; an aiohttp ``on_shutdown`` signal."""
    sockets = app[OPEN_SOCKETS]
    for socket in list(sockets):
        await socket.close(code=WSCloseCode.GOING_AWAY)


LINGER_S = 30.0
"""How long a session outlives its websocket, so that a short break loses nothing."""
MAX_PAGES = 32
"""Pages that one client (one address) may have open; each has a 3D scene with threads."""
MAX_REQUEST = 4 * 2**20
"""Largest request of a page, bytes."""

Send = Callable[[protocol.Event], None]
Decode = Callable[[str], protocol.Request]
Outbox: TypeAlias = "asyncio.Queue[str | None]"
"""Messages to a page; None closes its websocket."""


class PageSession(Protocol):
    """The server's side of one opened page, called one method at a time in a worker thread."""

    def connected(self) -> None:
        """The page has opened or reconnected; it knows nothing yet."""
        ...

    def receive(self, request: protocol.Request) -> None:
        """Handle one request. The page shows a SemvizError as it is."""
        ...

    def close(self) -> None:
        """The page has been disconnected for ``LINGER_S``, or the tool stops."""
        ...


class Sessions:
    """Starts a session for every page that opens a websocket, and resumes it after a break.

    The page opens ``/socket?session=ID`` (no ID the first time). A ``HelloEvent`` with its ID comes
    first, then the session's events. ``send`` may be called from any thread. Events for a
    disconnected page are dropped, because ``connected`` sends everything again.
    """

    def __init__(self, make: Callable[[str, Send, str], PageSession], decode: Decode) -> None:
        """``make`` gets an id, ``send`` and the name of the guest, see ``access.PERSON``.

        ``decode`` decodes a request of the tool, for example ``Handlers.decode``.
        """
        self._make = make
        self._decode = decode
        self._connections: dict[str, _Connection] = {}
        self._opening = asyncio.Lock()

    def routes(self) -> list[web.AbstractRouteDef]:
        return [web.get("/socket", self._serve)]

    async def _serve(self, request: web.Request) -> web.WebSocketResponse:
        socket = await accept_socket(request, heartbeat=20.0, max_msg_size=MAX_REQUEST)
        try:
            connection = await self._connection(request)
        except protocol.RefusedError as error:
            await socket.send_str(protocol.encode(protocol.error_event(error, None)))
            await socket.close(code=WSCloseCode.TRY_AGAIN_LATER)
            return socket
        outbox: Outbox = asyncio.Queue()
        connection.outbox = outbox
        connection.keep()
        outbox.put_nowait(protocol.encode(protocol.HelloEvent(session=connection.id)))
        writer = asyncio.create_task(_write(socket, outbox))
        try:
            await connection.run(connection.session.connected)
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    await connection.receive(message.data)
        finally:
            writer.cancel()
            if connection.outbox is outbox:  # unless the page has reconnected already
                connection.outbox = None
                connection.end = asyncio.create_task(self._end(connection))
        return socket

    async def _connection(self, request: web.Request) -> "_Connection":
        """Return the connection of a page. Raise RefusedError if its client has too many."""
        session_id, client = request.query.get("session", ""), request.remote or ""
        person = request.get(PERSON, "")
        async with self._opening:
            known = self._connections.get(session_id)
            if known is not None and known.person == person:
                return known
            await self._make_room(client)
            loop = asyncio.get_running_loop()
            id_ = secrets.token_urlsafe(12)
            connection = _Connection(id_, client, person, loop, self._decode)
            connection.session = await asyncio.to_thread(self._make, id_, connection.send, person)
            self._connections[id_] = connection
            return connection

    def end_of(self, person: str) -> None:
        """End the sessions of a guest, from any thread: their pages cannot connect again."""
        for connection in list(self._connections.values()):
            if connection.person == person:
                connection.hang_up()

    async def _make_room(self, client: str) -> None:
        """End the client's session that waits longest for its page, if it has too many."""
        pages = [page for page in self._connections.values() if page.client == client]
        if len(pages) < MAX_PAGES:
            return
        waiting = next((page for page in pages if page.end is not None), None)
        if waiting is None:
            text = f"{MAX_PAGES} pages are open already; close one, and this one opens"
            raise protocol.RefusedError("busy", text)
        waiting.keep()
        await self._close(waiting)

    async def _end(self, connection: "_Connection") -> None:
        await asyncio.sleep(LINGER_S)
        await self._close(connection)

    async def _close(self, connection: "_Connection") -> None:
        del self._connections[connection.id]
        await connection.run(connection.session.close)


class _Connection:
    """A session and the queue of events for its page; the queue is None while disconnected."""

    session: PageSession

    def __init__(
        self,
        session_id: str,
        client: str,
        person: str,
        loop: asyncio.AbstractEventLoop,
        decode: Decode,
    ) -> None:
        self.id = session_id
        self.client = client
        self.person = person
        self.loop = loop
        self.outbox: Outbox | None = None
        self.end: asyncio.Task[None] | None = None
        """Ends the session, while its page is disconnected."""
        self._decode = decode
        self._turn = asyncio.Lock()

    def hang_up(self) -> None:
        """Close the websocket, after what was sent before; from any thread."""
        self._queue(None)

    def keep(self) -> None:
        """Do not end the session."""
        if self.end is not None:
            self.end.cancel()
            self.end = None

    def send(self, event: protocol.Event) -> None:
        self._queue(protocol.encode(event))

    def _queue(self, text: str | None) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the tool stops
            self.loop.call_soon_threadsafe(self._put, text)

    def _put(self, text: str | None) -> None:
        if self.outbox is not None:
            self.outbox.put_nowait(text)

    async def receive(self, text: str) -> None:
        try:
            request = self._decode(text)
        except protocol.MalformedRequestError as error:
            self.send(protocol.error_event(error, error.request_id))
        else:
            await self.run(lambda: self.session.receive(request), request.id)

    async def run(self, action: Callable[[], None], request_id: str | None = None) -> None:
        """Run ``action`` off the event loop, after earlier ones; errors go to the page."""
        async with self._turn:
            try:
                await asyncio.to_thread(action)
            except SemvizError as error:
                self.send(protocol.error_event(error, request_id))
            except Exception as error:  # report our own bugs; the page goes on
                logging.getLogger(__name__).exception("a page's request failed")
                text = f"Internal error: {type(error).__name__}: {error}. The terminal has more."
                self.send(protocol.ErrorEvent(reply_to=request_id, code="internal", text=text))


async def _write(socket: web.WebSocketResponse, outbox: Outbox) -> None:
    while True:
        text = await outbox.get()
        if text is None:
            await socket.close(code=WSCloseCode.POLICY_VIOLATION)
            return
        try:
            await socket.send_str(text)
        except ConnectionError:
            return  # the page has disconnected; the reader notices too
