"""Files of decisions in a workspace: one JSON object with a checksum, written as a whole."""

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, first_line, read_limited

try:
    import fcntl
except ImportError:  # not on Windows: there one process at a time may choose
    fcntl = None  # type: ignore[assignment]


class CheckedModel(BaseModel):
    """The content of such a file, or a part of it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Content = TypeVar("Content", bound=CheckedModel)


def read_checked(path: Path, kind: type[Content], what: str, without: str) -> Content:
    """Return the content of the file ``path``; ``kind()`` if there is no such file.

    Raise SemvizError if it is damaged or of a newer version; it says that the file holds ``what``,
    and what follows if it is deleted: ``without``.
    """
    if not path.exists():
        return kind()
    data = read_limited(path, MOST_TEXT_BYTES)
    head, _, content = data.partition(b",")
    if head != b'{"crc32":%d' % zlib.crc32(content):
        raise SemvizError(
            f"{path}: not as it was written (its checksum differs); restore it from a copy, or "
            f"delete it: {without}"
        )
    try:
        return kind.model_validate_json(b"{" + content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        fault = first_line(f"{where}: {first['msg']}")
        raise SemvizError(
            f"{path}: not {what} that this semviz reads ({fault}); update semviz, or delete the "
            f"file: {without}"
        ) from None


def write_checked(path: Path, content: CheckedModel) -> None:
    """Replace the file ``path``. Raise SemvizError if it cannot be written."""
    text = content.model_dump_json().encode()[1:]
    with replacing(path) as temporary:
        temporary.write_bytes(b'{"crc32":%d,' % zlib.crc32(text) + text)


@contextmanager
def changing(path: Path) -> Iterator[None]:
    """Keep other processes from changing the file ``path``: none of two decisions is lost."""
    if fcntl is None:
        yield
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)  # releases the lock
