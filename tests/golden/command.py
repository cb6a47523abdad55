"""Run the ``semviz`` command, in this process or in a new one."""

import os
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from semviz.cli import main

LIMIT_S = 600


class CommandResult(NamedTuple):
    """Exit status, output and error output of a command."""

    status: int
    output: str
    errors: str


def call(folder: Path, *arguments: object) -> str:
    """Return the output of a command run in ``folder`` in this process. Raise RuntimeError if it
    fails."""
    output, errors = StringIO(), StringIO()
    status: object = 0
    with chdir(folder), redirect_stdout(output), redirect_stderr(errors):
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as ended:
            status = ended.code or 0
    if status:
        raise RuntimeError(f"semviz {arguments}: status {status}, {errors.getvalue()}")
    return output.getvalue()


def run(folder: Path, *arguments: object) -> CommandResult:
    """Run a command in ``folder`` in a new process, on one core."""
    command = [sys.executable, "-m", "semviz.cli", *map(str, arguments)]
    ended = subprocess.run(
        command, cwd=folder, env=one_core(), capture_output=True, text=True, timeout=LIMIT_S
    )
    return CommandResult(ended.returncode, ended.stdout, ended.stderr)


def one_core() -> dict[str, str]:
    """Return the environment of a process on one core, whose sums always have the same order."""
    libraries = ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB")
    threads = {f"{library}_NUM_THREADS": "1" for library in libraries}
    return {**os.environ, **threads, "COLUMNS": "100", "NO_COLOR": "1"}
