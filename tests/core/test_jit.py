"""Code is compiled by one process at a time, under names that no other process gives."""

import os
import subprocess
import sys
from threading import Event, Thread

import pytest

from semviz_core.common import jit

HOLD = """
import sys
from semviz_core.common import jit
with jit._compile_lock:
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_processes_take_turns() -> None:
    taken = Event()

    def take() -> None:
        with jit._compile_lock, jit._compile_lock:  # who has it may take it again
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


NAMES = """
import os
import numba
from semviz_core.common import jit

def name_of_new_code():
    double = numba.njit(lambda x: 2 * x)
    double(2)
    (kernel,) = double.overloads.values()
    return kernel.fndesc.mangled_name

if os.fork() == 0:
    print(name_of_new_code(), flush=True)
    os._exit(0)
os.wait()
print(name_of_new_code())
"""


def code_names() -> set[str]:
    """Names that a fresh process and its fork give to functions of the same name and type."""
    done = subprocess.run([sys.executable, "-c", NAMES], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks on this system")
def test_no_two_processes_give_machine_code_the_same_name() -> None:
    """Numba counts from 1 in every process, and links code of one name as if it were the same."""
    assert len(code_names() | code_names()) == 4
