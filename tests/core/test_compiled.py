"""Code is compiled by one process at a time."""

import subprocess
import sys
from threading import Event, Thread

from semviz_core import compiled

HOLD = """
import sys
from semviz_core import compiled
with compiled._alone:
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_processes_take_turns() -> None:
    taken = Event()

    def take() -> None:
        with compiled._alone, compiled._alone:  # who has it may take it again
            taken.set()

    other = subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    waiting = Thread(target=take)
    waiting.start()
    assert not taken.wait(0.3)
    other.communicate()  # its input ends, and it goes
    assert taken.wait(30.0)
    waiting.join()
