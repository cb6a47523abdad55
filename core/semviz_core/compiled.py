"""Functions compiled to machine code (numba), kept on disk so that only the first run waits."""

import hashlib
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from functools import cache
from pathlib import Path
from threading import RLock
from typing import IO, Any, TypeVar

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
    made.compile = _one_process_at_a_time(made.compile)  # type: ignore[attr-defined]
    return made


def _one_process_at_a_time(compile_: Callable[..., Any]) -> Callable[..., Any]:
    """``compile_``, which loads from disk or compiles and saves, while no other process does.

    Numba names code by the order in which its process compiled it: what two processes compile at
    the same time and put into one folder can take each other's code, and crash (numba #10128). And
    the second one has nothing to do once the first is done.
    """

    def compiled_alone(*arguments: Any) -> Any:
        with _alone:
            return compile_(*arguments)

    return compiled_alone


class _Alone(AbstractContextManager[None]):
    """A lock between processes and threads; who holds it may take it again."""

    def __init__(self) -> None:
        self._thread = RLock()
        self._depth = 0
        self._file: IO[str] | None = None

    def __enter__(self) -> None:
        self._thread.acquire()
        self._depth += 1
        folder = _cache_folder()
        if self._depth == 1 and fcntl is not None and folder:
            with suppress(OSError):  # a folder that nobody can write into needs no lock
                self._file = (Path(folder) / "lock").open("w")
                fcntl.flock(self._file, fcntl.LOCK_EX)

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0 and self._file is not None:
            self._file.close()  # and so given back
            self._file = None
        self._thread.release()


_alone = _Alone()


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
