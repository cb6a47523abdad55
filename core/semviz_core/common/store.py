"""A store of files that are written once: a folder, or a place in an object store.

A file appears whole or not at all, and is never changed. Of several processes that write
one key at once, one succeeds: in a folder by a hard link, in S3 by a conditional request
(``If-None-Match``). Keys are paths in the store, such as ``drives/may.json``.
"""

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import sleep
from typing import Any, TypeVar

from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.files import create_file, replacing
from semviz_core.common.limits import first_line, read_limited, shown

Result = TypeVar("Result")
S3 = "s3://"
MOST_BYTES = 2**30
"""Of a file that is read into memory."""
CONFLICT_TRIES, CONFLICT_WAIT_S = 10, 0.3
"""S3 may refuse a new object while another process writes it: neither yes nor no."""


class Store(ABC):
    """A place for files; get one from ``at``. It can be pickled.

    Raise SemvizError if something is missing, not permitted, cannot be reached, or the disk is
    full.
    """

    where: str
    """Path of the folder, or URL."""

    @staticmethod
    def at(where: Path | str, *, make: bool = False) -> "Store":
        """Return the store in a folder, or at a URL ``s3://bucket/prefix``.

        The folder or bucket must exist; ``make`` makes a folder.
        """
        where = str(where)
        if where.startswith(S3):
            require_extra(where, "s3fs", "cloud")
            objects = ObjectStore(S3 + where.removeprefix(S3).strip("/"))
            objects.check()
            return objects
        if "://" in where:
            raise SemvizError(f"{shown(where)}: give a folder, or s3://BUCKET/PREFIX")
        folder = FolderStore(where)
        folder.check(make)
        return folder

    @abstractmethod
    def read(self, key: str) -> bytes:
        """Return the content of a file."""

    @abstractmethod
    def fetch(self, key: str, path: Path) -> None:
        """Copy a file to ``path``, which is replaced by the whole of it."""

    @abstractmethod
    def write_new(self, key: str, data: bytes) -> bool:
        """Write a new file and return True; if ``key`` exists, it stays, and return False."""

    @abstractmethod
    def put_file_new(self, key: str, path: Path) -> bool:
        """Write a copy of the file ``path``, as ``write_new`` does."""

    @abstractmethod
    def remove(self, key: str) -> None:
        """Remove a file, if it exists."""

    @abstractmethod
    def exists(self, key: str) -> bool:
        """Whether there is a file ``key``."""

    @abstractmethod
    def keys(self, prefix: str = "") -> list[str]:
        """Return the keys that begin with ``prefix``, sorted."""


@dataclass(frozen=True)
class FolderStore(Store):
    """A store in a folder.

    Names that begin with a dot are no keys, but files that are being written; a killed process
    leaves them, and they can be deleted.
    """

    where: str

    def check(self, make: bool) -> None:
        """Raise SemvizError if there is no such folder; ``make`` it before."""
        with self._reporting(""):
            if make:
                self._root.mkdir(parents=True, exist_ok=True)
            if not self._root.is_dir():
                raise SemvizError(f"{shown(self.where)}: no such folder")

    def read(self, key: str) -> bytes:
        if not self.exists(key):
            raise SemvizError(f"{shown(self._path(key))}: no such file")
        return read_limited(self._path(key), MOST_BYTES)

    def fetch(self, key: str, path: Path) -> None:
        with replacing(path) as copy, self._reporting(key):
            shutil.copyfile(self._path(key), copy)

    def write_new(self, key: str, data: bytes) -> bool:
        return self._create(key, lambda temporary: temporary.write_bytes(data))

    def put_file_new(self, key: str, path: Path) -> bool:
        return self._create(key, lambda temporary: shutil.copyfile(path, temporary))

    def remove(self, key: str) -> None:
        with self._reporting(key, "removed"):
            self._path(key).unlink(missing_ok=True)

    def exists(self, key: str) -> bool:
        with self._reporting(key):
            return self._path(key).is_file()

    def keys(self, prefix: str = "") -> list[str]:
        folder = self._root / prefix.rpartition("/")[0]
        with self._reporting(prefix):
            files = [path for path in folder.rglob("*") if path.is_file()]
        found = (path.relative_to(self._root) for path in files)
        keys = (path.as_posix() for path in found if not _is_hidden(path.parts))
        return sorted(key for key in keys if key.startswith(prefix))

    def _create(self, key: str, fill: Callable[[Path], object]) -> bool:
        with self._reporting(key, "written"):
            return create_file(self._path(key), fill)

    @property
    def _root(self) -> Path:
        return Path(self.where)

    def _path(self, key: str) -> Path:
        return self._root / _checked(key)

    @contextmanager
    def _reporting(self, key: str, done: str = "read") -> Iterator[None]:
        try:
            yield
        except FileNotFoundError as error:
            raise SemvizError(f"{shown(error.filename)}: no such file") from None
        except OSError as error:
            cause = error.strerror or first_line(error)
            raise SemvizError(f"{shown(self.where)}/{key}: cannot be {done} ({cause})") from None


@dataclass(frozen=True)
class ObjectStore(Store):
    """A store in S3, or in a server that speaks its protocol. Region, endpoint and credentials are
    found as by AWS's own tools: ``AWS_ENDPOINT_URL``, ``AWS_PROFILE``, ``~/.aws``."""

    where: str

    def check(self) -> None:
        """Raise SemvizError if there is no such bucket, or it cannot be listed."""
        bucket = self._root.partition("/")[0]
        if not bucket:
            raise SemvizError(f"{shown(self.where)}: write s3://BUCKET/PREFIX")
        self._asked("", lambda files: files.call_s3("head_bucket", Bucket=bucket))

    def read(self, key: str) -> bytes:
        data = self._asked(key, lambda files: _start_of(files, self._path(key)))
        if len(data) > MOST_BYTES:
            raise SemvizError(f"{shown(self.where)}/{key}: more than {MOST_BYTES / 2**20:g} MB")
        return data

    def fetch(self, key: str, path: Path) -> None:
        with replacing(path) as copy:
            self._asked(key, lambda files: files.get_file(self._path(key), str(copy)))

    def write_new(self, key: str, data: bytes) -> bool:
        return self._create(
            key, lambda files: files.pipe_file(self._path(key), data, mode="create")
        )

    def put_file_new(self, key: str, path: Path) -> bool:
        return self._create(
            key, lambda files: files.put_file(str(path), self._path(key), mode="create")
        )

    def remove(self, key: str) -> None:
        if self.exists(key):
            self._asked(key, lambda files: files.rm_file(self._path(key)), "removed")

    def exists(self, key: str) -> bool:
        return bool(self._asked(key, lambda files: files.isfile(self._path(key))))

    def keys(self, prefix: str = "") -> list[str]:
        start = len(self._root) + 1
        found = self._asked(prefix, lambda files: files.find(self._root, prefix=prefix))
        return sorted(name[start:] for name in found)

    def _create(self, key: str, put: Callable[[Any], object]) -> bool:
        """Return whether ``put`` made a new object, or raise what ``_asked`` does."""

        def created(files: Any) -> bool:
            for _ in range(CONFLICT_TRIES):
                try:
                    put(files)
                except OSError as error:
                    code = _code(error)
                    if code == "PreconditionFailed":
                        return False
                    if code != "ConditionalRequestConflict":
                        raise
                    conflict = error
                    sleep(CONFLICT_WAIT_S)
                else:
                    return True
            raise conflict

        return self._asked(key, created, "written")

    def _asked(self, key: str, ask: Callable[[Any], Result], done: str = "read") -> Result:
        """Return the answer of s3fs. Raise SemvizError that names the object instead of others'."""
        from botocore.exceptions import BotoCoreError

        place = f"{shown(self.where)}/{key}".rstrip("/")
        try:
            return ask(self._files)
        except FileNotFoundError:
            what = "no such file" if key else "no such bucket"
            raise SemvizError(f"{place}: {what}") from None
        except (OSError, BotoCoreError) as error:
            raise SemvizError(f"{place}: cannot be {done} ({first_line(error)})") from None

    @cached_property
    def _files(self) -> Any:
        import s3fs

        return s3fs.S3FileSystem(use_listings_cache=False, skip_instance_cache=True)

    @property
    def _root(self) -> str:
        return self.where.removeprefix(S3)

    def _path(self, key: str) -> str:
        return f"{self._root}/{_checked(key)}"


def _start_of(files: Any, path: str) -> bytes:
    """Return an object, or the first bytes of one that is too large."""
    try:
        return bytes(files.cat_file(path, start=0, end=MOST_BYTES + 1))
    except OSError as error:
        if _code(error) == "InvalidRange":  # it is empty
            return b""
        raise


def _code(error: OSError) -> str:
    """Return S3's name of an error."""
    response = getattr(error.__cause__, "response", None) or {}
    return str(response.get("Error", {}).get("Code", ""))


def _checked(key: str) -> str:
    """Return a key. Raise SemvizError if it could leave the store, or names a hidden file."""
    parts = key.split("/")
    if not all(parts) or _is_hidden(parts) or not key.isprintable() or "\\" in key:
        raise SemvizError(f"{shown(key)!r} cannot be a file of a store")
    return key


def _is_hidden(parts: Iterable[str]) -> bool:
    return any(part.startswith(".") for part in parts)
