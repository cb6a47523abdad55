"""Open a page in the browser without showing its token to other users."""

import contextlib
import html
import os
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path

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
