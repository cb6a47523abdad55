"""A function is compiled by one process at a time, under names that no other process gives."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from numba.core.errors import NumbaError

from semviz_core.common import jit, linalg
from semviz_core.common.arrays import FloatArray

HOLD = """
import sys
from semviz_core.common import jit, linalg
with jit._CompileLock("held"), jit._CompileLock("also held"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_processes_take_turns_with_a_function_and_with_none_else() -> None:
    taken = Event()

    def take() -> None:
        lock = jit._CompileLock("held")
        with jit._CompileLock("free"), lock, lock:  # who has it may take it again
            taken.set()

    other = subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with jit._CompileLock("free"):
        pass
    waiting = Thread(target=take)
    waiting.start()
    assert not taken.wait(0.3)
    other.communicate()  # its input ends, and it goes
    assert taken.wait(30.0)
    waiting.join()


NAMES = """
import os
import shutil
import numba
from semviz_core.common import jit, linalg

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


FOLDER = "from semviz_core.common import jit; print(jit.__file__, jit._cache_folder())"


def compiled_in(installed: Path) -> Path:
    """The folder of compiled code of the copy of the core in a folder."""
    done = subprocess.run(
        [sys.executable, "-c", FOLDER],
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=True,
    )
    file, folder = done.stdout.split()
    assert Path(file).is_relative_to(installed)
    return Path(folder)


def test_compiled_code_belongs_to_the_sources_and_to_the_constants_they_read(
    tmp_path: Path,
) -> None:
    """Two environments share it; a constant of a file that compiles nothing itself parts them."""
    core = Path(jit.__file__).parents[1]
    copies = tmp_path / "one", tmp_path / "two"
    for copy in copies:
        shutil.copytree(core, copy / core.name, ignore=shutil.ignore_patterns("__pycache__"))
    assert compiled_in(copies[0]) == compiled_in(copies[1]) == Path(jit._cache_folder())
    camera = copies[1] / core.name / "base" / "camera.py"
    text = camera.read_text()
    assert "MIN_DEPTH_M = " in text
    assert "@compiled" not in text
    camera.write_text(text.replace("MIN_DEPTH_M = ", "MIN_DEPTH_M = 2 * "))
    assert compiled_in(copies[1]) != compiled_in(copies[0])


def test_code_is_kept_by_module_wherever_it_is_installed() -> None:
    (located,) = {
        jit._SourcesLocator.from_function(linalg.cholesky.py_func, file).get_cache_path()
        for file in ("/one/linalg.py", "/two/linalg.py")
    }
    assert Path(located) == Path(jit._cache_folder()) / linalg.__name__
    assert jit._SourcesLocator.from_function(compiled_in, "here.py") is None, "not ours"


def test_a_leaf_that_allocates_an_array_is_refused() -> None:
    """It counts no references, so nothing would free the array."""

    def doubled(values: FloatArray) -> FloatArray:
        return 2.0 * values

    with pytest.raises(NumbaError):
        jit.compiled_leaf(doubled)(np.ones(3))
