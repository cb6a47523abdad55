"""Starting the web tools as a person does, by their command, and the addresses that they serve."""

import re
import subprocess
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def serving(
    command: Sequence[str | Path], environment: dict[str, str], folder: Path | None = None
) -> Iterator[str]:
    """The address that ``command`` prints, on a free port and without opening a browser."""
    process = subprocess.Popen(
        [*command, "--no-open", "--port", "0"],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    found = filter(None, (re.search(r"http://\S+", line) for line in process.stdout))
    try:
        address = next(found, None)
        assert address is not None, f"{command}: ended without an address"
        yield address.group()
    finally:
        process.terminate()
        process.wait(timeout=30)


def at(url: str, tail: str) -> str:
    """The address of ``tail``, a path or a query, below the printed ``url``, with its token."""
    base, _, token = url.partition("?")
    separator = "&" if "?" in tail else "?"
    return f"{base}{tail}{separator if token else ''}{token}"


def fetch(url: str) -> bytes:
    """What a browser gets at ``url``: the token becomes a cookie, as in a browser."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with opener.open(url, timeout=30) as answer:
        content: bytes = answer.read()
    return content
