"""The one public port of a web tool: its page, JSON and websocket, and the way to its 3D scenes."""

import asyncio
import contextlib
import errno
import os
import secrets
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol
from weakref import WeakSet

from aiohttp import web

from semviz.web.guard import Guard, add_headers, is_loopback
from semviz.web.proxy import Proxy
from semviz.web.scenes import Scenes
from semviz.web.sockets import OPEN_SOCKETS, close_sockets
from semviz_core.errors import SemvizError

STATIC = Path(__file__).parent / "static"
"""Style sheet and ES modules that both tools' pages share, served under ``/static/``."""
CLOSING_S = 5.0
"""How long closing may take after Ctrl-C."""


class Tool(Protocol):
    """A web tool, as the door sees it."""

    @property
    def title(self) -> str:
        """What the terminal calls it."""
        ...

    @property
    def scenes(self) -> Scenes:
        """Its 3D scenes; the door proxies ``/view/SESSION/`` to them and closes them at the end."""
        ...

    def routes(self) -> list[web.AbstractRouteDef]:
        """Its page, JSON and websocket; ``/static/`` and ``/view/`` are the door's."""
        ...


class Door:
    """Serves one tool on one port.

    ``port`` 0 takes a free one. Any ``host`` but loopback demands a token, which is made up where
    none is given. Raises SemvizError for a busy port or an impossible host.
    """

    def __init__(
        self, tool: Tool, host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ) -> None:
        if token == "":
            raise SemvizError("the token is empty; leave --token out to have one made up")
        self._tool = tool
        self._host = host
        self._port = port
        self._token = token or (None if is_loopback(host) else secrets.token_urlsafe(16))

    def run(self, open_browser: bool = True) -> None:
        """Serves until Ctrl-C (or SIGTERM); prints the address, and opens it where it can."""
        with self.running() as url, _until_told() as told:
            print(f"{self._tool.title}: {url}\nCtrl-C stops it.", flush=True)
            if open_browser:
                _open_browser(url)
            told.recv(1)
            _end_within(CLOSING_S)

    @contextlib.contextmanager
    def running(self) -> Iterator[str]:
        """Serves in a thread of its own while the block runs; gives the address, token included."""
        with _bound(self._host, self._port) as listener:
            port = int(listener.getsockname()[1])
            loop = asyncio.new_event_loop()
            thread = threading.Thread(target=loop.run_forever, name="semviz-door", daemon=True)
            thread.start()
            runner = web.AppRunner(self._app(port), access_log=None, shutdown_timeout=1.0)
            try:
                asyncio.run_coroutine_threadsafe(_serve(runner, listener), loop).result()
                yield self._url(port)
            finally:
                asyncio.run_coroutine_threadsafe(_end(runner), loop).result(timeout=10)
                loop.call_soon_threadsafe(loop.stop)
                thread.join(timeout=5)
                loop.close()
                self._tool.scenes.close_all()

    def _app(self, port: int) -> web.Application:
        guard = Guard(is_loopback(self._host), self._token, cookie=f"semviz-{port}")
        app = web.Application(middlewares=[guard.middleware()], client_max_size=16 * 2**20)
        app.add_routes(self._tool.routes())
        closed = "this page's 3D scene has been closed; reload the page"
        app.add_routes(Proxy("view", self._tool.scenes.address, closed).routes())
        app.router.add_static("/static/", STATIC)
        app.on_response_prepare.append(add_headers)
        app[OPEN_SOCKETS] = WeakSet()
        app.on_shutdown.append(close_sockets)
        return app

    def _url(self, port: int) -> str:
        name = socket.gethostname() if self._host in ("0.0.0.0", "::", "") else self._host
        shown = f"[{name}]" if ":" in name else name
        token = f"?token={self._token}" if self._token else ""
        return f"http://{shown}:{port}/{token}"


async def _serve(runner: web.AppRunner, listener: socket.socket) -> None:
    await runner.setup()
    await web.SockSite(runner, listener).start()


async def _end(runner: web.AppRunner) -> None:
    """Closes the port and what is connected; sessions that wait for their page wait no longer."""
    await runner.cleanup()
    waiting = asyncio.all_tasks() - {asyncio.current_task()}
    for task in waiting:
        task.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)


def _bound(host: str, port: int) -> socket.socket:
    """A listening socket; SemvizError says what to do where there is none to have."""
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
def _until_told() -> Iterator[socket.socket]:
    """A socket that gets a byte at Ctrl-C and SIGTERM; the handlers before are put back.

    Python's own handlers run in the main thread, and only between two of its steps: one that waits
    for a lock is not woken by a signal that came just before, or to another thread. The byte comes
    from the signal itself and stays until it is read.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    told, teller = socket.socketpair()
    with told, teller:
        teller.setblocking(False)
        before = [signal.signal(number, lambda *_: None) for number in numbers]
        woken_before = signal.set_wakeup_fd(teller.fileno(), warn_on_full_buffer=False)
        try:
            yield told
        finally:
            signal.set_wakeup_fd(woken_before)
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)


def _end_within(seconds: float) -> None:
    """Ends the process if closing takes longer.

    viser's threads can wait for a browser that has gone. Nothing is lost: what a page calls saved
    is on disk.
    """
    timer = threading.Timer(seconds, os._exit, args=(0,))
    timer.daemon = True
    timer.start()


def _open_browser(url: str) -> None:
    """Opens the default browser; nothing where there is no screen to show it on."""
    screenless = sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    if not screenless:
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
