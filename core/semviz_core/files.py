"""Files that are whole or absent."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semviz_core.errors import SemvizError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it is fsynced and takes its place.

    On an exception ``path`` stays as it was. Raises SemvizError where it cannot be written: the
    folder is not writable, the disk is full, or ``path`` is a folder or a device.
    """
    check_replaceable(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None
    os.close(handle)
    temporary = Path(name)
    temporary.chmod(0o666 & ~_umask())  # mkstemp's own mode would keep colleagues out
    try:
        yield temporary
        _fsync(temporary)
        temporary.replace(path)
        _fsync(path.parent)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder; on success it becomes ``path``, which is not there, or empty.

    Raises SemvizError where something is there already, or it cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise SemvizError(f"{path}: is there already; choose a new folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        try:
            inner = temporary / "inner"  # mkdtemp's own folder would be closed to others
            inner.mkdir()
            yield inner
            inner.replace(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror or error})") from None


def check_replaceable(path: Path) -> None:
    """SemvizError where ``path`` is something that a file must not take the place of."""
    try:
        free = path.is_file() or not path.exists()
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None
    if not free:
        raise SemvizError(f"{path}: a folder or a device, not a file; choose another name")


def _umask() -> int:
    """The process's umask, which can only be read by setting it."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
