"""Serve one web tool on one port, and open its address in a browser.

Other users of the machine do not see the page's token. Connections that do not soon make a request
that is allowed are ended: anybody who reaches the port can connect and stay silent. Each connection
takes a file of the process, of which there often are 1,024: no page would open any more, and no
label could be saved.
"""

import asyncio
import contextlib
import errno
import html
import os
import secrets
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from urllib.parse import quote

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from semviz.web.access import AccessPolicy, add_headers, http_log, is_loopback, nobody
from semviz.web.sessions import close_sockets
from semviz.web.tool import Tool, tool_application
from semviz_core.common.errors import SemvizError

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


FORWARD = """<!doctype html>
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}">
<title>semviz</title>
<a href="{url}">Open semviz</a>
"""


@contextlib.contextmanager
def opened(url: str) -> Iterator[None]:
    """Open the default browser, if there is a display; remove the file that leads there at the end.

    On Linux every user can read a browser's command line, so it gets the name of a private file
    that forwards to ``url``.
    """
    if not sys.platform.startswith("linux"):
        _start(url)
        yield
    elif os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        file = _forwarding_file(url)
        try:
            _start(file.as_uri())
            yield
        finally:
            file.unlink(missing_ok=True)
    else:
        yield


def _forwarding_file(url: str) -> Path:
    """Return a file that only this user can read. Browsers in a sandbox read the home folder only,
    without its hidden files."""
    home = Path.home()
    folder = home if os.access(home, os.W_OK) else Path(tempfile.gettempdir())
    handle, name = tempfile.mkstemp(prefix="semviz-", suffix=".html", dir=folder)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(FORWARD.format(url=html.escape(url)))
    return Path(name)


def _start(url: str) -> None:
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


CLOSING_S = 5.0
"""Longest time for closing after Ctrl-C."""


class Gateway:
    """Serves one tool on one port.

    ``port`` 0 chooses a free port. ``token`` None generates one; ``with_token`` False serves
    without, on loopback only. ``guests`` are names by the SHA-256 of their tokens. Raise
    SemvizError for a busy port or an impossible host.
    """

    def __init__(
        self,
        tool: Tool,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        with_token: bool = True,
        guests: Callable[[], Mapping[str, str]] = nobody,
    ) -> None:
        if token == "":
            raise SemvizError("the token is empty; omit --token to generate one")
        if not with_token and token is not None:
            raise SemvizError("give either --token or --no-token")
        if not with_token and not is_loopback(host):
            raise SemvizError(f"--no-token needs a loopback address; others reach --host {host}")
        self._tool = tool
        self._host = host
        self._port = port
        self._guests = guests
        self._token = (token or secrets.token_urlsafe(16)) if with_token else None

    def run(self, open_browser: bool = True) -> None:
        """Serve until Ctrl-C or SIGTERM; print the address and open it in a browser."""
        with self.running() as url, _stop_signal() as stopped:
            print(f"{self._tool.title}: {url}\nCtrl-C stops it.", flush=True)
            with opened(url) if open_browser else contextlib.nullcontext():
                stopped.recv(1)
            _end_within(CLOSING_S)

    @contextlib.contextmanager
    def running(self) -> Iterator[str]:
        """Serve in a thread while the block runs; yield the address, with the token."""
        with _bound(self._host, self._port) as listener:
            port = int(listener.getsockname()[1])
            loop = asyncio.new_event_loop()
            thread = threading.Thread(target=loop.run_forever, name="semviz-gateway", daemon=True)
            thread.start()
            connections = Connections(listener)
            app = self._app(port, connections.middleware())
            runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, logger=http_log())
            try:
                asyncio.run_coroutine_threadsafe(_serve(runner, connections), loop).result()
                yield self._url(port)
            finally:
                ending = _end(runner, connections)
                asyncio.run_coroutine_threadsafe(ending, loop).result(timeout=10)
                loop.call_soon_threadsafe(loop.stop)
                thread.join(timeout=5)
                loop.close()
                self._tool.scenes.close_all()

    def _app(self, port: int, admitting: Middleware) -> web.Application:
        policy = AccessPolicy(is_loopback(self._host), self._token, port, self._guests)
        app = tool_application(self._tool, middlewares=[policy.middleware(), admitting])
        app.on_response_prepare.append(add_headers)
        app.on_shutdown.append(close_sockets)
        return app

    def _url(self, port: int) -> str:
        name = socket.gethostname() if self._host in ("0.0.0.0", "::", "") else self._host
        shown = f"[{name}]" if ":" in name else name
        token = f"?token={quote(self._token, safe='')}" if self._token else ""
        return f"http://{shown}:{port}/{token}"


async def _serve(runner: web.AppRunner, connections: Connections) -> None:
    await runner.setup()
    assert runner.server is not None
    connections.start(runner.server)


async def _end(runner: web.AppRunner, connections: Connections) -> None:
    """Close the port and all connections, and stop waiting for disconnected pages."""
    connections.stop()
    await runner.cleanup()
    waiting = asyncio.all_tasks() - {asyncio.current_task()}
    for task in waiting:
        task.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)


def _bound(host: str, port: int) -> socket.socket:
    """Return a listening socket. Raise SemvizError if the address cannot be bound."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OverflowError:
        raise SemvizError(f"port {port} does not exist; choose one from 1 to 65535") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            advice = "choose another with --port or stop the other one"
            raise SemvizError(f"port {port} is in use; {advice}") from None
        if error.errno == errno.EACCES:
            raise SemvizError(f"port {port} is reserved; choose one above 1023") from None
        raise SemvizError(f"cannot serve on {host}:{port}: {error.strerror or error}") from None


@contextlib.contextmanager
def _stop_signal() -> Iterator[socket.socket]:
    """Yield a socket that receives a byte on Ctrl-C or SIGTERM; restore the handlers at the end.

    Python's own handlers run in the main thread, and only between two bytecodes: a main thread that
    waits for a lock misses a signal that came just before, or to another thread. The byte is
    written by the signal itself and stays until it is read.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    receiver, sender = socket.socketpair()
    with receiver, sender:
        sender.setblocking(False)
        handlers = [signal.signal(number, lambda *_: None) for number in numbers]
        wakeup_before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        try:
            yield receiver
        finally:
            signal.set_wakeup_fd(wakeup_before)
            for number, handler in zip(numbers, handlers, strict=True):
                signal.signal(number, handler)


def _end_within(seconds: float) -> None:
    """End the process if closing takes longer.

    viser's threads can wait for a browser that has disconnected. Nothing is lost: every edit that a
    page shows as saved is on disk.
    """
    timer = threading.Timer(seconds, os._exit, args=(0,))
    timer.daemon = True
    timer.start()
