"""What people are told while they wait."""

import os
import subprocess
import sys
from pathlib import Path

SUMS = """
from semviz_core.common.jit import compiled

@compiled
def twice(number):
    return number + number

@compiled
def four_times(number):
    return twice(twice(number))
"""
FIRST_CALL = """
from semviz.presentation.terminal import announce_compiling
announce_compiling()
announce_compiling()
from sums import four_times
print(four_times(2), four_times(2.5))
"""


def test_compiling_is_told_once_and_only_where_it_happens(tmp_path: Path) -> None:
    (tmp_path / "sums.py").write_text(SUMS)
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def told() -> str:
        command = [sys.executable, "-c", FIRST_CALL]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout == "8 10.0\n"
        return done.stderr

    first = told()
    assert first.startswith("compiling the solver")
    assert first.count("\n") == 1
    assert told() == ""
