"""Make the golden values, or check the code against them."""

import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from time import perf_counter
from typing import Any

from golden.files import EXPECTED

GOLDEN = {
    "G1": "localizing",
    "G2": "recordings",
    "G3": "label_log",
    "G4": "maps",
    "G5": "commands",
    "G6": "addresses",
    "G7": "training",
    "G8": "detecting",
    "G9": "exports",
}
"""Module of each set, beside this one."""
WORDS = "words: "
"""Prefix of the keys of wordings, which may change on purpose."""
SHOWN = 4
"""Maximum number of differences to print, of values and of wordings each."""


def main() -> None:
    """Run ``make``, ``check`` or ``fixtures`` for the named sets (default: all). Exit status 1 if a
    set differs."""
    action, *names = sys.argv[1:] or [""]
    names = names or list(GOLDEN)
    if action == "fixtures":
        from golden.fixtures import make

        in_new_folder(make)
    elif action in ("make", "check") and set(names) <= GOLDEN.keys():
        same = [(make_set if action == "make" else check_set)(name) for name in names]
        sys.exit(0 if all(same) else 1)
    else:
        sys.exit(f"python -m golden make|check|fixtures [{' '.join(GOLDEN)}]")


def make_set(name: str) -> bool:
    """Write the present values as the expected ones."""
    start = perf_counter()
    values = golden_values(name)
    EXPECTED.mkdir(exist_ok=True)
    lines = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in sorted(values.items()))
    _path(name).write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(f"{name} made: {len(values)} values, {perf_counter() - start:.0f} s", flush=True)
    return True


def check_set(name: str) -> bool:
    """Compare a set with the expected values; print one line with the differences."""
    start = perf_counter()
    expected, actual = expected_of(name), golden_values(name)
    different = list(differences(expected, actual))
    words = [name for name in different if name.startswith(WORDS)]
    values = [name for name in different if not name.startswith(WORDS)]
    result = "same" if not different else f"differs in {len(values)} values, {len(words)} wordings"
    head = f"{name} {result} ({perf_counter() - start:.0f} s)"
    print("; ".join([head, *values[:SHOWN], *words[:SHOWN]]), flush=True)
    return not different


def expected_of(name: str) -> dict[str, Any]:
    """Return the committed values of a set."""
    loaded: dict[str, Any] = json.loads(_path(name).read_text(encoding="utf-8"))
    return loaded


def golden_values(name: str) -> dict[str, Any]:
    """Return the present values of a set, after a round trip through JSON."""
    module = import_module(f"golden.{GOLDEN[name]}")
    with redirect_stdout(sys.stderr):  # viser draws a box for each server
        values: dict[str, Any] = json.loads(json.dumps(in_new_folder(module.golden_values)))
    return values


def in_new_folder(action: Callable[[Path], Any]) -> Any:
    """Return the result of ``action`` for a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="golden-") as folder:
        return action(Path(folder).resolve())


def differences(expected: Any, actual: Any, where: str = "") -> Iterator[str]:
    """Yield the differences of two JSON values."""
    if isinstance(expected, dict) and isinstance(actual, dict):
        for name in sorted(expected.keys() | actual.keys()):
            inner = f"{where}/{name}" if where else name
            yield from differences(expected.get(name), actual.get(name), inner)
    elif isinstance(expected, list) and isinstance(actual, list):
        for number, pair in enumerate(zip_longest(expected, actual)):
            yield from differences(*pair, f"{where}[{number}]")
    elif expected != actual:
        yield f"{where}: {expected} -> {actual}"


def _path(name: str) -> Path:
    return EXPECTED / f"{name}.json"
