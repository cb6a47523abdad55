"""The built-in demo, made once and kept in the user's cache folder."""

import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import platformdirs

from semviz_core.errors import SemvizError


def ensure_demo() -> Path:
    """The demo's workspace in the user's cache folder; made with a progress bar if need be."""
    cache = platformdirs.user_cache_path("semviz")
    folder = cache / f"demo-{version('semviz')}"
    if folder.is_dir():
        return folder
    from semviz.demo_street import make_demo  # half a second that an existing demo does not need

    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix=".demo-") as unfinished:
            make_demo(Path(unfinished) / "demo")
            shutil.move(Path(unfinished) / "demo", folder)  # whole or absent, also when interrupted
    except OSError as error:
        raise SemvizError(f"{cache}: the demo cannot be kept there ({error.strerror})") from None
    return folder
