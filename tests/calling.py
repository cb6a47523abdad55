"""``semviz`` called as people call it, but in this process."""

from collections.abc import Callable

import pytest

from semviz.cli import main

Call = Callable[..., tuple[int, str, str]]


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, output and error output of one command."""
    with pytest.raises(SystemExit) as ended:
        main([str(one) for one in arguments])
    output, errors = capsys.readouterr()
    return int(ended.value.code or 0), output, errors
