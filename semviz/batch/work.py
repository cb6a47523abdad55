"""What a worker does for one drive: run the command there, and store what came of it."""

import io
import json
import socket
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, TypeAlias

from semviz.batch.batch import BatchCommand, DriveBatch, DriveOutcome, Output, Plan
from semviz.batch.inputs import changed_inputs, inputs_of
from semviz.collection.collection import Collection, Drive
from semviz_core.common.errors import SemvizError, file_error_text
from semviz_core.common.limits import first_line

RunCommand: TypeAlias = Callable[[BatchCommand, list[str]], int]
"""Runs a command of semviz with arguments, prints a JSON object, and returns an exit status. Raise
SemvizError."""


@dataclass(frozen=True)
class Work:
    """The work of a batch for any drive; workers get it pickled."""

    where: str
    """The collection."""
    batch: str
    run_command: RunCommand

    def __call__(self, drive: Drive) -> DriveOutcome:
        """Run the command for a drive, unless that is done. What fails is told, never raised."""

        def done() -> DriveOutcome:
            batch = DriveBatch.open(Collection.open(self.where), self.batch)
            return batch.outcome(drive.name) or self._done(batch, drive)

        return told(drive.name, done)

    def _done(self, batch: DriveBatch, drive: Drive) -> DriveOutcome:
        _check_version(batch.plan)
        inputs = inputs_of(batch.plan, drive)
        with tempfile.TemporaryDirectory(prefix="semviz-batch-") as folder:
            start_s = perf_counter()
            arguments = _arguments(batch, drive, self.where, Path(folder))
            printed, notes = _printed(self.run_command, batch.plan.command, arguments)
            seconds = perf_counter() - start_s
            changed = changed_inputs(inputs, inputs_of(batch.plan, drive))
            if changed:
                raise SemvizError(f"{', '.join(changed)} changed meanwhile; run the command again")
            done = DriveOutcome(drive.name, "", printed, tuple(notes), seconds, inputs)
            return batch.finish(done, _outputs(batch.plan.command, printed))


def told(drive: str, work: Callable[[], DriveOutcome]) -> DriveOutcome:
    """Return what ``work`` returns, or why it failed."""
    try:
        return work()
    except SemvizError as error:
        reason = str(error)
    except OSError as error:
        reason = file_error_text(error)
    except MemoryError:
        reason = "out of memory"
    except Exception as error:  # a fault of semviz, which must not end the batch
        reason = f"unexpected {type(error).__name__}: {first_line(error)}"
    return DriveOutcome(drive, f"{reason} (on {socket.gethostname()})")


def _check_version(plan: Plan) -> None:
    """Raise SemvizError if this machine has another semviz than the batch was begun with."""
    if (own := version("semviz")) != plan.semviz:
        raise SemvizError(f"semviz {own} is installed, the batch was begun with {plan.semviz}")


def _arguments(batch: DriveBatch, drive: Drive, where: str, folder: Path) -> list[str]:
    """Return the arguments of the command for a drive; its own files are made in ``folder``."""
    plan = batch.plan
    arguments = [drive.workspace, *plan.options_for(drive), "--json"]
    if plan.command == "localize":
        arguments += ["--out", str(folder / f"{drive.name}.rrd")]
        if plan.map_version is not None:
            arguments += ["--collection", where, "--map-version", str(plan.map_version)]
    return arguments


def _printed(
    run_command: RunCommand, command: BatchCommand, arguments: list[str]
) -> tuple[dict[str, Any], list[str]]:
    """Run a command. Return the JSON object that it prints, and its other lines."""
    output, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        status = run_command(command, arguments)
    notes = errors.getvalue().splitlines()
    if status:
        raise SemvizError(f"exit status {status}: {notes[-1] if notes else 'no message'}")
    return json.loads(output.getvalue()), notes


def _outputs(command: BatchCommand, printed: dict[str, Any]) -> dict[Output, Path]:
    """Return the files that a command says it has written, and that the batch keeps."""
    if command == "localize":
        return {"runs": Path(printed["run"])}
    if command == "map":
        return {"maps": Path(printed["map"])}
    return {}
