"""The benches import: names that they use are not lost when code moves."""

import subprocess
import sys
from pathlib import Path

BENCH = Path(__file__).parents[1] / "bench"
IMPORT_ALL = """
import importlib, pathlib, sys
sys.path.insert(0, ".")
for path in sorted(pathlib.Path(".").glob("*.py")):
    try:
        importlib.import_module(path.stem)
    except ModuleNotFoundError as error:  # a library of an extra
        if error.name.startswith("semviz") or pathlib.Path(f"{error.name}.py").exists():
            print(path.name, error)
    except ImportError as error:
        print(path.name, error)
"""


def test_every_bench_imports() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], cwd=BENCH, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
