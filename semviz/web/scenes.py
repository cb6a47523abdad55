"""A viser server of its own for every opened page."""

import contextlib
import gc
import secrets
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

import rich

if TYPE_CHECKING:
    import viser

_console_lock = threading.Lock()


class Scenes:
    """The viser servers of one tool, by session; each on loopback with a port of its own.

    Thread-safe. ``scene`` makes a session's server at the first asking (0.1 s, and 1 s for the
    import before the very first: call it off the event loop); ``close`` stops one.
    """

    def __init__(self) -> None:
        self._servers: dict[str, viser.ViserServer] = {}
        self._lock = threading.Lock()

    def scene(self, session: str) -> "viser.ViserServer":
        """The viser server of ``session``, with its own panels, logo and sharing off."""
        with self._lock:
            if session not in self._servers:
                self._servers[session] = _start_server()
            return self._servers[session]

    def address(self, session: str) -> str | None:
        """``host:port`` of the session's viser server; None where it has none."""
        with self._lock:
            server = self._servers.get(session)
        return None if server is None else f"{server.get_host()}:{server.get_port()}"

    def close(self, session: str) -> None:
        """Stops the session's viser server; nothing where it has none."""
        with self._lock:
            server = self._servers.pop(session, None)
        if server is not None:
            with _quiet_console():
                server.stop()

    def close_all(self) -> None:
        for session in tuple(self._servers):
            self.close(session)


def _start_server() -> "viser.ViserServer":
    from semviz.web.private_server import PrivateServer

    with _quiet_console():
        server = PrivateServer(host=_loopback_address(), port=0, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    gc.freeze()  # what is imported by now stays: the search for garbage took 0.1 s each time
    return server


def _loopback_address() -> str:
    """An address that only this machine reaches, and that other sites' pages cannot guess.

    viser checks neither Origin nor token, so a page open in the same browser could talk to it
    behind the door's back. All of 127.0.0.0/8 is loopback, but macOS answers on 127.0.0.1 only.
    """
    if sys.platform == "darwin":
        return "127.0.0.1"
    return ".".join(["127"] + [str(secrets.randbelow(254) + 1) for _ in range(3)])


@contextlib.contextmanager
def _quiet_console() -> Iterator[None]:
    """viser prints banners through rich's shared console, whatever ``verbose`` says."""
    console = rich.get_console()
    with _console_lock:
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before
