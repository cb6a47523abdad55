"""Compile functions to machine code with numba, run them on threads, and time them.

Compiled code is cached on disk, so only the first run waits. Compiled functions release Python's
global lock. Work on several threads returns its results in the order of the items. A stopwatch
measures the wall time of a method's stages.
"""

import hashlib
import itertools
import os
import re
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import IO, Any, TypeVar

import numba
from numba.core import event
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import CacheImpl, _CacheLocator
from platformdirs import user_cache_path

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])


def name_code_uniquely() -> None:
    """Count the code that this process compiles from a random number.

    Numba puts the count into the names of machine code, and starts it at 1 in every process. Code
    loaded from disk then carries the names of other code compiled here, the linker keeps one of
    the two, and calls reach the wrong function: a wrong result or a crash (numba #10486).
    """
    FunctionIdentity._unique_ids = itertools.count(secrets.randbits(64))


name_code_uniquely()
if hasattr(os, "register_at_fork"):  # a fork inherits the count
    os.register_at_fork(after_in_child=name_code_uniquely)


def compiled(function: Function) -> Function:
    """Return ``function``, compiled on its first call with new types, without Python's lock."""
    return _compiled(function)


def compiled_leaf(function: Function) -> Function:
    """Return ``function``, compiled like ``compiled``; it must not allocate arrays.

    Other functions count a reference to each array of their arguments when they start and end. For
    the arrays of a problem that takes 70 ns, longer than most leaves of the call graph.
    """
    return _compiled(function, _nrt=False)


def _compiled(function: Function, **options: bool) -> Function:
    dispatcher: Function = numba.njit(
        cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options
    )(function)
    locked = _in_one_process(dispatcher.compile, function)  # type: ignore[attr-defined]
    dispatcher.compile = locked  # type: ignore[attr-defined]
    return dispatcher


class _SourcesLocator(_CacheLocator):  # type: ignore[misc]  # numba's types are not read
    """Where numba keeps compiled code: in a folder of these sources, wherever they are installed.

    Numba itself takes the folder from the path of the file, so each environment would compile anew.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._line = function.__code__.co_firstlineno
        self._path = Path(_cache_folder(), function.__module__)

    @classmethod
    def from_function(cls, function: Callable[..., Any], _file: str) -> "_SourcesLocator | None":
        """Return None for another project's function, and without a home: numba then chooses."""
        if not function.__module__.startswith("semviz") or not _cache_folder():
            return None
        locator = cls(function)
        locator.ensure_cache_path()
        return locator

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return ""  # the folder is of these sources alone

    def get_disambiguator(self) -> str:
        return str(self._line)


CacheImpl._locator_classes = [_SourcesLocator, *CacheImpl._locator_classes]


def _in_one_process(compile_: Callable[..., Any], function: Function) -> Callable[..., Any]:
    """Return ``compile_`` (load from disk, or compile and save) under the function's lock.

    Numba does not expect two processes that compile one function into one folder at the same time
    (numba #10128). With the lock, the second process loads what the first one compiled.
    """
    lock = _CompileLock(f"{function.__qualname__}.lock", Path(function.__module__))

    def compile_locked(*arguments: Any) -> Any:
        with lock:
            return compile_(*arguments)

    return compile_locked


class _CompileLock(AbstractContextManager[None]):
    """A re-entrant lock of one function between processes; threads compile one at a time.

    Processes may compile different functions at once. They take the locks in the order of calls,
    so none waits for another that waits for it.
    """

    _thread = RLock()

    def __init__(self, name: str, folder: Path = Path()) -> None:
        self._name, self._folder = name, folder
        self._depth = 0
        self._file: IO[str] | None = None

    def __enter__(self) -> None:
        self._thread.acquire()
        self._depth += 1
        if self._depth == 1 and fcntl is not None and _cache_folder():
            folder = Path(_cache_folder(), self._folder)
            with suppress(OSError):  # a read-only folder needs no lock
                folder.mkdir(exist_ok=True)
                self._file = (folder / self._name).open("w")
                fcntl.flock(self._file, fcntl.LOCK_EX)

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0 and self._file is not None:
            self._file.close()  # releases the lock
            self._file = None
        self._thread.release()


def notify_before_compiling(notify: Callable[[], None]) -> None:
    """Call ``notify`` once, before the first function is compiled that is not yet on disk."""
    event.register("numba:compile", _FirstCompileListener(notify))


class _FirstCompileListener(event.Listener):  # type: ignore[misc]  # numba's types are not read
    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify: Callable[[], None] | None = notify

    def on_start(self, _: object) -> None:
        if self._notify is not None:
            self._notify()
            self._notify = None

    def on_end(self, _: object) -> None:
        pass


@contextmanager
def count_compiled(tell: Callable[[int], None]) -> Iterator[None]:
    """Within it, call ``tell`` with the number of functions compiled so far, after each of them.

    Functions that are loaded from disk do not count.
    """
    listener = _CountingListener(tell)
    with event.install_listener("numba:compile", listener):
        yield


class _CountingListener(event.Listener):  # type: ignore[misc]  # numba's types are not read
    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell, self._count = tell, 0

    def on_start(self, _: object) -> None:
        pass

    def on_end(self, _: object) -> None:
        self._count += 1
        self._tell(self._count)


@cache
def _cache_folder() -> str:
    """Return one folder for each state of the sources, or an empty string without a home.

    Numba itself checks only the file of the called function, not those of the functions it calls,
    nor those of the constants that both read. So the folder's name is a digest of all files that
    compile, and of those that they import.
    """
    parts = [find_spec(name) for name in ("semviz_core", "semviz_annotation")]
    roots = [Path(part.origin).parent for part in parts if part is not None and part.origin]
    sources = {
        ".".join([root.name, *path.relative_to(root).with_suffix("").parts]): path.read_bytes()
        for root in roots
        for path in sorted(root.rglob("*.py"))
    }
    compiling = {name: source for name, source in sources.items() if b"@compiled" in source}
    read = compiling.keys() | {
        module.decode()
        for source in compiling.values()
        for module in re.findall(rb"^from (semviz[\w.]*) import", source, re.MULTILINE)
    }
    contents = (source for name, source in sources.items() if name in read)
    digest = hashlib.sha256(b"".join(contents)).hexdigest()
    folder = user_cache_path("semviz") / "compiled" / digest[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # without a home, numba chooses its own folder
        return ""
    return str(folder)


Item = TypeVar("Item")
Result = TypeVar("Result")

QUEUED_PER_THREAD = 2
"""Items that are submitted for each thread before the first result is awaited."""


def in_order(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int
) -> Iterator[Result]:
    """Yield ``function(item)`` of each item, in the items' order; the first error is raised.

    Items are consumed as needed, so they may be endless.
    """
    if threads == 1:
        yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) == QUEUED_PER_THREAD * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class Stopwatch:
    """Wall time of a method's stages."""

    time_ms: dict[str, float] = field(default_factory=dict)
    """By stage, in order."""

    def time(self, stage: str, action: Callable[[], Result]) -> Result:
        """Return ``action()`` and store its wall time under ``stage``."""
        start = perf_counter()
        result = action()
        self.time_ms[stage] = (perf_counter() - start) * 1e3
        return result
