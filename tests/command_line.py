"""``semviz`` called as people call it, but in this process."""

import re
from collections.abc import Callable

import pytest

from semviz.cli import main

Call = Callable[..., tuple[int, str, str]]


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, output and error output of one command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    output, errors = capsys.readouterr()
    # What is compiled first depends on what ran before, on the machine and in this process.
    errors = re.sub(r"^compiling .*\n", "", errors, flags=re.MULTILINE)
    return int(ended.value.code or 0), output, errors
