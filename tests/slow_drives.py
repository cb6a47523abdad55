"""Commands of a batch that take a while and tell who ran them, for tests that kill workers."""

import json
import os
import signal
import time
from pathlib import Path

from semviz.batch.batch import BatchCommand

SECONDS = 0.2


def slow_command(command: BatchCommand, arguments: list[str]) -> int:
    """Take a while, then write a file if the command is one that does."""
    time.sleep(SECONDS)
    printed: dict[str, object] = {"process": os.getpid(), "images": 1, "proposals": 2}
    if "--out" in arguments:
        path = Path(arguments[arguments.index("--out") + 1])
        path.write_bytes(path.name.encode() * 1000)
        printed["run"] = str(path)
    print(json.dumps(printed))
    return 0


def deadly_command(command: BatchCommand, arguments: list[str]) -> int:
    """Die at drive d01."""
    if arguments[-1].endswith("/d01.rrd"):
        os.kill(os.getpid(), signal.SIGKILL)
    return slow_command(command, arguments)
