"""Functions compiled to machine code (numba), kept on disk so that only the first run waits."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event
from platformdirs import user_cache_path

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """``function`` compiled when first called with new types; it holds no lock of Python's."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _cache_folder()
    try:
        made: Function = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = before
    made._cache.save_overload = _one_at_a_time(made._cache.save_overload)  # type: ignore[attr-defined]
    return made


def _one_at_a_time(save: Callable[..., None]) -> Callable[..., None]:
    """``save`` under a lock between processes. Numba reads its index, adds to it and writes it
    back: two processes at once can leave the code for some types under the name of others."""

    def saved(*arguments: Any) -> None:
        folder = _cache_folder()
        if fcntl is None or not folder:
            return save(*arguments)
        with (Path(folder) / "lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # until the file is closed
            return save(*arguments)

    return saved


def tell_when_compiling(tell: Callable[[], None]) -> None:
    """Have ``tell`` called once, before the first function is compiled that is not on disk yet."""
    event.register("numba:compile", _Teller(tell))


class _Teller(event.Listener):  # type: ignore[misc]  # numba's types are not read
    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, _: object) -> None:
        if self._tell is not None:
            self._tell()
            self._tell = None

    def on_end(self, _: object) -> None:
        pass


@cache
def _cache_folder() -> str:
    """One folder for each state of the sources: numba itself only looks at the file of the
    function that is called, not at those of the functions it calls in turn."""
    sources = (one.read_bytes() for one in sorted(Path(__file__).parent.rglob("*.py")))
    digest = hashlib.sha256(b"".join(one for one in sources if b"@compiled" in one)).hexdigest()
    folder = user_cache_path("semviz") / "compiled" / digest[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a machine without a home: numba then looks for a place of its own
        return ""
    return str(folder)
