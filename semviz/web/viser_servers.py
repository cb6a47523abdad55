"""A private viser server for each opened page, which answers the gateway only.

viser 1.1.1 checks nothing, and listens on a port. A secret header, which the gateway's proxy adds,
is checked in each handshake and HTTP request; viser's public tunnel is disabled. Importing this
imports viser (1 s).
"""

import contextlib
import functools
import gc
import hmac
import http
import logging
import secrets
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import rich
import viser
import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

SECRET_HEADER = "X-Semviz-Secret"

_start_lock = threading.Lock()


class ViserServers:
    """The viser servers of one tool, by session; each on loopback with a port of its own.

    Thread-safe. The first ``scene`` of a session starts its server, which takes 0.1 s (the first
    of all 1 s, for the import): call it off the event loop.
    """

    def __init__(self) -> None:
        self._servers: dict[str, viser.ViserServer] = {}
        self._lock = threading.Lock()
        self._secret = secrets.token_urlsafe(32)

    @property
    def secret_header(self) -> dict[str, str]:
        """The header without which these servers refuse a request."""
        return {SECRET_HEADER: self._secret}

    def scene(self, session: str) -> viser.ViserServer:
        """Return the session's viser server, without panels, logo and sharing."""
        with self._lock:
            if session not in self._servers:
                self._servers[session] = _start_server(self._secret)
            return self._servers[session]

    @property
    def count(self) -> int:
        """Number of running servers."""
        return len(self._servers)

    def address(self, session: str) -> str | None:
        """Return ``host:port`` of the session's viser server; None if it has none."""
        with self._lock:
            server = self._servers.get(session)
        return None if server is None else f"{server.get_host()}:{server.get_port()}"

    def close(self, session: str) -> None:
        """Stop the session's viser server, if it has one."""
        with self._lock:
            server = self._servers.pop(session, None)
        if server is not None:
            with _start_lock, _quiet_console():
                server.stop()
            del server
            gc.collect()  # a server consists of reference cycles

    def close_all(self) -> None:
        for session in tuple(self._servers):
            self.close(session)


def _start_server(secret: str) -> viser.ViserServer:
    _freeze_modules()
    with _start_lock, _quiet_console(), _guarded(secret) as is_guarded:
        server = PrivateServer(host=_loopback_address(), port=0, verbose=False)
        if not is_guarded.is_set():
            server.stop()
            raise RuntimeError(f"viser {viser.__version__} starts its server unguarded")
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    return server


@functools.cache
def _freeze_modules() -> None:
    """Leave imported modules out of garbage collections, each of which took 0.1 s with them.

    Only once, before the first server: a frozen server would never be freed.
    """
    gc.freeze()


Check = Callable[[ServerConnection, Request], Response | None]


@contextlib.contextmanager
def _guarded(secret: str) -> Iterator[threading.Event]:
    """Guard the server that viser starts meanwhile; yield whether it did.

    viser has no hook for this. It starts its server by ``websockets.asyncio.server.serve`` and
    gives it one function, ``process_request``, that sees every request before its handshake.
    """
    unguarded, is_guarded = websocket_server.serve, threading.Event()

    def serve(*args: Any, process_request: Check, **options: Any) -> websocket_server.serve:
        is_guarded.set()
        check = _checked(secret, process_request)
        return unguarded(*args, process_request=check, logger=_log(), **options)

    websocket_server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield is_guarded
    finally:
        websocket_server.serve = unguarded  # type: ignore[misc]


def _checked(secret: str, process_request: Check) -> Check:
    def check(connection: ServerConnection, request: Request) -> Response | None:
        given = " ".join(request.headers.get_all(SECRET_HEADER))
        if not hmac.compare_digest(given.encode(errors="backslashreplace"), secret.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "403: open semviz's own address\n")
        return process_request(connection, request)

    return check


def _log() -> logging.Logger:
    """A log of one server, which viser adds a filter to; it says in one line what went wrong."""
    log = logging.Logger("semviz.web.scenes")
    log.parent = logging.getLogger("semviz.web")
    log.addFilter(_without_trace)
    return log


def _without_trace(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    if error is not None:
        record.msg = f"3D scene: {record.getMessage()}: {str(error)[:120]!a}"
        record.args, record.exc_info = (), None
    return True


def _loopback_address() -> str:
    """An address that only this machine reaches, and that other sites' pages cannot guess.

    All of 127.0.0.0/8 is loopback, but macOS answers on 127.0.0.1 only.
    """
    if sys.platform == "darwin":
        return "127.0.0.1"
    return ".".join(["127"] + [str(secrets.randbelow(254) + 1) for _ in range(3)])


@contextlib.contextmanager
def _quiet_console() -> Iterator[None]:
    """Silence rich's shared console: viser prints banners there, whatever ``verbose`` is."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


class PrivateServer(viser.ViserServer):
    """A server whose clients cannot open a public tunnel, as viser would let them."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None
