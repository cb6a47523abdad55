"""Do the work of a batch on a Ray cluster: https://docs.ray.io, extra ``ray``.

Ray places the drives on its workers and tells which were lost with a worker or a machine; these are
done again. It keeps nothing of ours: what is done is in the collection.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from semviz.batch.batch import DriveOutcome
from semviz.collection.collection import Drive
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line

MOST_WAITING = 1000
"""Drives that Ray is given at once: enough to keep a thousand cores busy, few for its memory."""
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # tell nobody
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}
STARTS = 3
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Cluster:
    """Where the work is done."""

    address: str | None = None
    """Of the head of a Ray cluster; None for one on this machine, while the batch takes."""
    cpus: float = 1.0
    """Cores of a drive."""
    gpus: float = 0.0
    """GPUs of a drive, perhaps a share of one."""
    tries: int = 4
    """How often a drive is begun whose worker dies."""

    def run(
        self, work: Callable[[Drive], DriveOutcome], drives: Sequence[Drive], tell: Tell
    ) -> Iterator[DriveOutcome]:
        """Yield what comes of each drive, as they end; ``tell`` of those that are done again.

        Raise SemvizError if the cluster cannot be reached, or is lost meanwhile.
        """
        with self._connected() as ray:
            remote = ray.remote(_call).options(
                num_cpus=self.cpus, num_gpus=self.gpus, max_retries=0
            )
            yield from _Round(ray, lambda drive: remote.remote(work, drive), self.tries, tell).run(
                drives
            )

    @contextmanager
    def _connected(self) -> Iterator[Any]:
        """Yield the module of Ray, connected. What it prints meanwhile is in its own logs, too."""
        settings = dict(_SETTINGS)
        if self.address and _has_token():
            settings["RAY_AUTH_MODE"] = "token"  # as 'ray start' does
        for name, value in settings.items():
            os.environ.setdefault(name, value)
        import ray

        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            self._connect(ray)
            try:
                yield ray
            except ray.exceptions.RayError as error:
                raise SemvizError(
                    f"the cluster was lost ({first_line(error)}); the same command goes on"
                ) from None
            finally:
                ray.shutdown()

    def _connect(self, ray: Any) -> None:
        """Connect to the cluster, or start one, which may take several tries if the machine is
        busy: Ray waits for 30 s."""
        dashboard = None if self.address else False
        for tries_left in reversed(range(1 if self.address else STARTS)):
            try:
                ray.init(
                    self.address,
                    include_dashboard=dashboard,
                    logging_level=logging.ERROR,
                    log_to_driver=False,
                )
            except Exception as error:  # Ray raises Exception itself, too
                ray.shutdown()
                if not tries_left:
                    where = self.address or "this machine"
                    raise SemvizError(f"no Ray cluster on {where}: {first_line(error)}") from None
            else:
                return


def _has_token() -> bool:
    """Whether there is a token with which clusters of this user are entered."""
    named = os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH")
    return bool(named) or (Path.home() / ".ray" / "auth_token").is_file()


def _call(work: Callable[[Drive], DriveOutcome], drive: Drive) -> DriveOutcome:
    return work(drive)


@dataclass
class _Round:
    """Drives on their way through the cluster."""

    ray: Any
    submit: Callable[[Drive], Any]
    tries: int
    tell: Tell
    _waiting: dict[Any, Drive] = field(default_factory=dict)
    """The drives that Ray has, by its references."""
    _begun: Counter[str] = field(default_factory=Counter)

    def run(self, drives: Sequence[Drive]) -> Iterator[DriveOutcome]:
        left = iter(drives)
        while True:
            for drive in islice(left, MOST_WAITING - len(self._waiting)):
                self._begin(drive)
            if not self._waiting:
                return
            (ended,), _ = self.ray.wait(list(self._waiting))
            outcome = self._outcome(ended, self._waiting.pop(ended))
            if outcome is not None:
                yield outcome

    def _begin(self, drive: Drive) -> None:
        self._begun[drive.name] += 1
        self._waiting[self.submit(drive)] = drive

    def _outcome(self, ended: Any, drive: Drive) -> DriveOutcome | None:
        """Return what came of a drive; None if it is begun again."""
        lost = self.ray.exceptions
        try:
            outcome: DriveOutcome = self.ray.get(ended)
        except lost.RayTaskError as error:
            return DriveOutcome(
                drive.name, f"the worker failed: {first_line(error.cause or error)}"
            )
        except lost.NodeDiedError:
            return self._again(drive, "its machine was lost")
        except (lost.WorkerCrashedError, lost.OutOfMemoryError):
            return self._again(drive, "its worker died (out of memory?)")
        return outcome

    def _again(self, drive: Drive, cause: str) -> DriveOutcome | None:
        """Begin a drive again, and return None, or that it failed if that was its last try."""
        begun = self._begun[drive.name]
        if begun == self.tries:
            return DriveOutcome(drive.name, f"{cause}, {begun} times")
        self.tell(f"{drive.name}: {cause}; begun again")
        self._begin(drive)
        return None
