"""Whether an open label file and its journal are still the ones at their paths."""

import os
from pathlib import Path
from typing import TypeAlias

from semviz_core.common.errors import SemvizError

_Identity: TypeAlias = tuple[int, int]
"""Device and inode."""
Content: TypeAlias = tuple[int, int]


class OpenFile:
    """The files of an open database, as they were when it was opened.

    SQLite writes on into files that were removed, renamed or replaced; what it writes there is
    lost. A check costs 10 µs.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        real = path.resolve()  # SQLite writes its journal beside the target of a link
        files = [path, *(real.with_name(real.name + end) for end in ("-wal", "-shm"))]
        self._identities = [(str(file), _identity(file.stat())) for file in files]
        self._accepted = self.content()

    def check(self) -> None:
        """Raise SemvizError if one of the files is not the opened one any more."""
        for file, identity in self._identities:
            try:
                now = _identity(os.stat(file))  # noqa: PTH116 (a third of the time of Path.stat)
            except OSError:
                raise SemvizError(f"{Path(file).name} was removed while it was open") from None
            if now != identity:
                raise SemvizError(f"{Path(file).name} was replaced while it was open")

    def content(self) -> Content:
        """Return time and size of the last change of the file. Raise OSError if it is missing."""
        status = os.stat(self._path)  # noqa: PTH116
        return status.st_mtime_ns, status.st_size

    def has_new_content(self) -> bool:
        """Whether the file was written since ``accept_content``: by a checkpoint, or from outside.

        Raise OSError if it is missing.
        """
        return self.content() != self._accepted

    def accept_content(self) -> None:
        """Take the file's content as it is now for the database's own."""
        self._accepted = self.content()


def _identity(status: os.stat_result) -> _Identity:
    return status.st_dev, status.st_ino
