"""The built-in demo, made once and kept in the user's cache folder."""

import tempfile
from importlib.metadata import version
from pathlib import Path

import platformdirs

from semviz_core.errors import SemvizError

EDITION = 3
"""Goes up where another demo is made, so that nobody is shown an old one."""


def ensure_demo() -> Path:
    """The demo's workspace in the user's cache folder; made with a progress bar if need be."""
    cache = platformdirs.user_cache_path("semviz")
    folder = cache / f"demo-{version('semviz')}-{EDITION}"
    if folder.is_dir():
        return folder
    from semviz.demo_street import make_demo  # half a second that an existing demo does not need

    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix=".demo-") as unfinished:
            make_demo(Path(unfinished) / "demo")
            (Path(unfinished) / "demo").rename(folder)  # whole or absent, also when interrupted
    except OSError as error:
        if folder.is_dir():  # another process was quicker
            return folder
        raise SemvizError(f"{cache}: the demo cannot be kept there ({error.strerror})") from None
    return folder
