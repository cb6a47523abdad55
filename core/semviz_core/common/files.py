"""Write files and folders that are either complete or absent, and CSV without formulas.

A temporary path beside the target is written, fsynced and renamed, so an interrupted write
leaves the old file untouched.
"""

import csv
import io
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock

from semviz_core.common.errors import SemvizError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it is fsynced and replaces ``path``.

    On an exception ``path`` stays as it was. Raise SemvizError if it cannot be written: the
    folder is not writable, the disk is full, or ``path`` is a folder or a device.
    """
    check_replaceable(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _temporary(path) as temporary:
            yield temporary
            _fsync(temporary)
            temporary.replace(path)
            _fsync(path.parent)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror or error})") from None


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path; on success it becomes ``path``, unless another process made that.

    Raise OSError if it cannot be written.
    """
    with _temporary(path) as temporary:
        yield temporary
        _fsync(temporary)
        _link(temporary, path)
        _fsync(path.parent)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yield an empty file beside ``path``; at the end it is removed if it is still there."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    temporary = Path(name)
    try:
        temporary.chmod(0o666 & ~_umask())  # mkstemp's own mode excludes other users
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def create_file(path: Path, fill: Callable[[Path], object]) -> bool:
    """Write a new file whole by ``fill``, and return True; if ``path`` exists, return False.

    Of several processes that do so at once, one gets True. Raise OSError if it cannot be written,
    or the file system has no hard links.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        return False
    with _temporary(path) as temporary:
        fill(temporary)
        _fsync(temporary)
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            return False
        _fsync(path.parent)
    return True


def _link(temporary: Path, path: Path) -> None:
    """Give a file a second name, unless that is taken."""
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        pass
    except OSError:  # a file system without links
        if not path.exists():
            temporary.replace(path)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder; on success it becomes ``path``, which must be absent or empty.

    Raise SemvizError if ``path`` exists and is not empty, or cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise SemvizError(f"{path}: already exists; choose a new folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        try:
            inner = temporary / "inner"  # mkdtemp's own folder excludes other users
            inner.mkdir()
            yield inner
            inner.replace(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror or error})") from None


HEAD_BYTES = 4096
IsOurs = Callable[[bytes], bool]
"""Tells from the first HEAD_BYTES of a file whether it is of the kind that is to be written."""


def check_output(
    path: Path, is_ours: IsOurs, *, force: bool = False, can_force: bool = True
) -> None:
    """Raise SemvizError unless ``path`` is absent, empty, or a file of ours to be replaced.

    ``force`` accepts any other file, but never a folder or a device; ``can_force`` says whether
    there is an option for it.
    """
    check_replaceable(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except FileNotFoundError:
        return
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None
    if head and not force and not is_ours(head):
        or_force = ", or add --force to replace it" if can_force else ""
        raise SemvizError(
            f"{path}: exists, and this command did not write it; choose another name{or_force}"
        )


def check_replaceable(path: Path) -> None:
    """Raise SemvizError if ``path`` is a folder or a device, which a file must not replace."""
    try:
        replaceable = path.is_file() or not path.exists()
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None
    if not replaceable:
        raise SemvizError(f"{path}: a folder or a device, not a file; choose another name")


_READING_UMASK = Lock()


def _umask() -> int:
    """Return the process's umask, which can only be read by setting it."""
    with _READING_UMASK:
        mask = os.umask(0o022)
        os.umask(mask)
    return mask


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
"""Spreadsheets take a cell that begins with one of these for a formula; some skip white space."""


def csv_text(rows: Iterable[Sequence[object]], line_end: str = "\n") -> str:
    """Return rows as CSV: None as an empty cell, floats exactly, as ``repr`` writes them.

    Names come from files of others: a text that a spreadsheet would take for a formula stands
    behind an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator=line_end)  # noqa: TID251
    writer.writerows([_guarded(cell) for cell in row] for row in rows)
    return text.getvalue()


def cell_text(cell: str) -> str:
    """Return the text from which ``csv_text`` made a cell."""
    return cell[1:] if cell.startswith("'") and _is_formula(cell) else cell


def _guarded(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and _is_formula(cell) else cell


def _is_formula(text: str) -> bool:
    return text.lstrip("' ").startswith(_FORMULA)
