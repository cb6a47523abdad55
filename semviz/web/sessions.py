"""A session is one opened page: its state lives here, its websocket may come and go."""

import asyncio
import contextlib
import json
import logging
import secrets
from collections.abc import Callable
from typing import Any, Protocol

from aiohttp import WSMsgType, web

from semviz.web.sockets import accept_socket
from semviz_core.errors import SemvizError

LINGER_S = 30.0
"""How long a session outlives its websocket: a short break finds everything as it was."""

Message = dict[str, Any]
Send = Callable[[Message], None]


class PageSession(Protocol):
    """The server's side of one opened page, called one method at a time in a worker thread."""

    def connected(self) -> None:
        """The page has just opened or come back; it knows nothing yet."""
        ...

    def receive(self, message: Message) -> None:
        """One JSON object from the page. A SemvizError is shown there as it is."""
        ...

    def close(self) -> None:
        """The page has been gone for ``LINGER_S``, or the tool stops."""
        ...


class Sessions:
    """Makes a session for every page that opens a websocket, and finds it when the page is back.

    The page opens ``/socket?session=ID`` (no ID the first time), gets ``{"type": "session",
    "id": ID}`` first, and whatever the session sends after that. ``send`` may be called from any
    thread; what is sent while the page is away is dropped, since ``connected`` tells it all again.
    """

    def __init__(self, make: Callable[[str, Send], PageSession]) -> None:
        self._make = make
        self._held: dict[str, _Held] = {}

    def routes(self) -> list[web.AbstractRouteDef]:
        return [web.get("/socket", self._serve)]

    async def _serve(self, request: web.Request) -> web.WebSocketResponse:
        socket = await accept_socket(request, heartbeat=20.0, max_msg_size=4 * 2**20)
        held = await self._find(request.query.get("session", ""))
        outbox: asyncio.Queue[str] = asyncio.Queue()
        held.outbox = outbox
        if held.end is not None:
            held.end.cancel()
        outbox.put_nowait(json.dumps({"type": "session", "id": held.id}))
        writer = asyncio.create_task(_write(socket, outbox))
        try:
            await held.do(held.session.connected)
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    await held.take(message.data)
        finally:
            writer.cancel()
            if held.outbox is outbox:  # unless the page is back already
                held.outbox = None
                held.end = asyncio.create_task(self._end(held))
        return socket

    async def _find(self, session_id: str) -> "_Held":
        if session_id not in self._held:
            held = _Held(secrets.token_urlsafe(12), asyncio.get_running_loop())
            held.session = await asyncio.to_thread(self._make, held.id, held.send)
            self._held[held.id] = held
            return held
        return self._held[session_id]

    async def _end(self, held: "_Held") -> None:
        await asyncio.sleep(LINGER_S)
        del self._held[held.id]
        await held.do(held.session.close)


class _Held:
    """A session and the way to its page."""

    session: PageSession

    def __init__(self, session_id: str, loop: asyncio.AbstractEventLoop) -> None:
        self.id = session_id
        self.outbox: asyncio.Queue[str] | None = None
        self.end: asyncio.Task[None] | None = None
        self._loop = loop
        self._turn = asyncio.Lock()

    def send(self, message: Message) -> None:
        text = json.dumps(message, allow_nan=False)
        with contextlib.suppress(RuntimeError):  # the loop is closed: the tool stops
            self._loop.call_soon_threadsafe(self._queue, text)

    def _queue(self, text: str) -> None:
        if self.outbox is not None:
            self.outbox.put_nowait(text)

    async def take(self, text: str) -> None:
        try:
            message = json.loads(text)
        except ValueError:
            message = None
        if isinstance(message, dict):
            await self.do(lambda: self.session.receive(message))
        else:
            self.send({"type": "error", "text": "the page sent something that is not an object"})

    async def do(self, action: Callable[[], None]) -> None:
        """Runs ``action`` off the event loop, after those before it; errors go to the page."""
        async with self._turn:
            try:
                await asyncio.to_thread(action)
            except SemvizError as error:
                self.send({"type": "error", "text": str(error)})
            except Exception as error:  # a fault of ours must be seen, not end the page
                logging.getLogger(__name__).exception("a page's request failed")
                text = f"Internal error: {type(error).__name__}: {error}. The terminal has more."
                self.send({"type": "error", "text": text})


async def _write(socket: web.WebSocketResponse, outbox: "asyncio.Queue[str]") -> None:
    while True:
        text = await outbox.get()
        try:
            await socket.send_str(text)
        except ConnectionError:
            return  # the page is gone; the reader notices too
