"""``semviz`` called as people call it, but in this process."""

import os
import re
import subprocess
import sys
from collections.abc import Callable

import pytest

from semviz.cli import RUST_LOG, main

Call = Callable[..., tuple[int, str, str]]


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, output and error output of one command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    output, errors = capsys.readouterr()
    # What is compiled first depends on what ran before, on the machine and in this process.
    errors = re.sub(r"^compiling .*\n", "", errors, flags=re.MULTILINE)
    return int(ended.value.code or 0), output, errors


def call_on_a_full_disk(free_bytes: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    """One command in a process of its own, whose files cannot grow beyond a limit."""
    code = (
        "import resource, sys\n"
        "from semviz.cli import main\n"
        "from semviz.runs import writer\n"
        "writer.FLUSH_LIMIT_S = 5.0\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({free_bytes},) * 2)\n"
        "main(sys.argv[1:])"
    )
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=os.environ | {"RUST_LOG": RUST_LOG},  # main sets it too late: rerun is imported here
        capture_output=True,
        text=True,
        timeout=100,
    )
