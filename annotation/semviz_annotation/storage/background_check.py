"""Check an open label file in the background, slowly, so that no edit waits."""

import threading
import time
from dataclasses import dataclass
from typing import Literal, TypeAlias

from semviz_annotation.storage.database import DamagedError
from semviz_annotation.storage.integrity import check_labels
from semviz_annotation.storage.label_file import LabelFile, LabelFileError, NotSavedError
from semviz_core.common.errors import SemvizError

HealthState: TypeAlias = Literal["checking", "sound", "damaged", "missing"]


@dataclass(frozen=True)
class Health:
    """What is known about an open label file."""

    state: HealthState
    """``missing``: removed or replaced while open; ``damaged`` and ``missing`` accept no edits."""
    text: str
    """One line for people; empty while all is well."""


WORK_S, REST_S = 0.003, 0.009
"""The check works a quarter of the time, a few milliseconds at once."""
RETRY_S = 5.0


class BackgroundCheck:
    """Checks a label file completely in a thread: when opened, and when a backup was restored."""

    def __init__(self, file: LabelFile) -> None:
        self._file = file
        self._closing = threading.Event()
        self._since = time.monotonic()
        self._checked = -1
        """The version of the file that was found sound."""
        self._thread = threading.Thread(target=self._run, name="semviz-check", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def health(self) -> Health:
        """Return what is known now; it costs 20 µs."""
        try:
            self._file.check_usable()
        except NotSavedError as error:
            return Health("damaged" if self._file.damage else "missing", str(error))
        except LabelFileError as error:
            return Health("damaged", str(error))
        return Health("sound" if self._checked == self._file.version else "checking", "")

    def _run(self) -> None:
        while not self._closing.is_set():
            version = self._file.version
            if version != self._checked and not self._file.damage:
                self._check(version)
            self._closing.wait(RETRY_S if version != self._checked else 0.2)

    def _check(self, version: int) -> None:
        try:
            found = check_labels(self._file.path, self._pace)
            if self._file.contains(found.operations, found.hash):
                self._checked = version
        except DamagedError as error:
            self._file.report_damage(str(error), version)
        except (SemvizError, _StoppedError):
            pass  # locked or closed

    def _pace(self) -> None:
        if time.monotonic() - self._since > WORK_S:
            if self._closing.wait(REST_S):
                raise _StoppedError
            self._since = time.monotonic()


class _StoppedError(Exception):
    """The file is closed."""
