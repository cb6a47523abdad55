"""The outcomes of a benchmark on disk: one line each, so that an interrupted run goes on."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import IO, Any

from semviz.benchmark.plan import Key, key
from semviz_core.errors import SemvizError
from semviz_core.evaluation.outcomes import Outcome

SYNC_S = 5.0
"""At most so much work is lost when the machine dies; when only the process does, one line."""


class Results:
    """An append-only file of JSON lines: settings first, then outcomes in the order of arrival.

    Opening reads what is there; a last line that was torn is dropped. Raises SemvizError where
    the file holds results of other settings, which must not be mixed.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path = path
        self.outcomes: dict[Key, Outcome] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = self._read(settings)
        self._file: IO[bytes] = path.open("ab")
        self._file.truncate(whole)
        if not whole:
            self._append(settings)
        self._synced_s = monotonic()

    def add(self, outcomes: list[Outcome]) -> None:
        for outcome in outcomes:
            self._append(asdict(outcome))
            self.outcomes[key(outcome)] = outcome
        if monotonic() - self._synced_s > SYNC_S:
            self._sync()

    def __enter__(self) -> "Results":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._sync()
        self._file.close()

    def _read(self, settings: dict[str, Any]) -> int:
        """Fill ``outcomes``; length in bytes of the whole lines."""
        if not self.path.is_file():
            return 0
        content = self.path.read_bytes()
        whole = content.rfind(b"\n") + 1
        lines = content[:whole].splitlines()
        for number, line in enumerate(lines, 1):
            try:
                values = json.loads(line)
                if number == 1:
                    self._check(values, settings)
                else:
                    outcome = Outcome.from_json(values)
                    self.outcomes[key(outcome)] = outcome
            except (ValueError, TypeError, KeyError, AttributeError):
                raise SemvizError(
                    f"{self.path}, line {number}: not a benchmark's result; give another --out"
                ) from None
        return whole

    def _check(self, found: dict[str, Any], settings: dict[str, Any]) -> None:
        differing = [
            f"{name} was {found.get(name)}, is {value}"
            for name, value in settings.items()
            if found.get(name) != value
        ]
        if differing:
            raise SemvizError(
                f"{self.path} has results of other settings ({'; '.join(differing)}): "
                "give another --out, or delete it"
            )

    def _append(self, values: dict[str, Any]) -> None:
        self._file.write(json.dumps(values).encode() + b"\n")
        self._file.flush()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced_s = monotonic()
