"""Compare the runtimes of two checkouts in one run.

    python bench/before_after.py --before PATH [--after PATH] [--rounds 5]

Each round measures before, after, before, after, so that other load on the machine affects both.
Figures are medians over the rounds; for frames, the median and the 95th percentile of all frames.
Both use the Python that runs this script and its packages; only semviz is that of the checkout.
Only the command and the public names of ``semviz`` are used.
"""

import argparse
import gzip
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
FRAMES, WARM = 24, 2
STREET = ("--simulate", "7", "--frames", f"0:{FRAMES}")
REPEATED = 8
"""So often each frame is localized in a process."""
THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}

IMPORT = """
import time; start = time.perf_counter()
import semviz
semviz.Localizer, semviz.load_map, semviz.load_run, semviz.Workspace
print(time.perf_counter() - start)
"""
OPEN = """
import sys, time; from semviz import load_run
start = time.perf_counter(); load_run(sys.argv[1])
print(time.perf_counter() - start)
"""
LOCALIZE = """
import json, sys, time
from semviz import Localizer, load_run
run, warm, repeated = load_run(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
frames = [(one.observed, one.submap, one.camera, one.prior) for one in run.localizations]
localizer = Localizer("search")
for frame in frames * warm:
    localizer.localize(*frame)
times = []
for frame in frames * repeated:
    start = time.perf_counter()
    localizer.localize(*frame)
    times.append(time.perf_counter() - start)
print(json.dumps(times))
"""


class Checkout:
    """One state of the code, and a workspace of its own to work in."""

    def __init__(self, name: str, path: Path, folder: Path) -> None:
        self.name = name
        self.path = path.resolve()
        self.folder = folder / name
        self.folder.mkdir()
        roots = [self.path, self.path / "core", self.path / "annotation"]
        self._environment = {
            **os.environ, **THREADS, "PYTHONPATH": os.pathsep.join(map(str, roots)),
        }  # fmt: skip
        self._check()

    def _check(self) -> None:
        where = Path(self.python("import semviz; print(semviz.__file__)").strip())
        if not where.is_relative_to(self.path):
            sys.exit(
                f"{self.path}: Python takes semviz from {where}; is this a checkout of semviz?"
            )

    def python(self, code: str, *arguments: object) -> str:
        """What a piece of Python prints."""
        return self._run([sys.executable, "-c", code, *map(str, arguments)])

    def semviz(self, *arguments: object) -> float:
        """Seconds that a command takes."""
        start = time.perf_counter()
        self._run([sys.executable, "-m", "semviz.cli", *map(str, arguments)])
        return time.perf_counter() - start

    def _run(self, command: list[str]) -> str:
        done = subprocess.run(
            command, cwd=self.folder, env=self._environment, capture_output=True, text=True
        )
        if done.returncode:
            sys.exit(f"{self.name}: {' '.join(command[1:4])} failed: {done.stderr[-2000:]}")
        return done.stdout


def prepare(checkout: Checkout, labels: Path, run: Path) -> None:
    """A small drive with labels; what has to be compiled is compiled."""
    checkout.semviz("new", "town", *STREET)
    checkout.semviz("labels", "import", "town", labels)
    checkout.python(LOCALIZE, run, 1, 1)


def measure(checkout: Checkout, run: Path) -> dict[str, list[float]]:
    """Seconds, by what was done."""
    return {
        "semviz --help": [checkout.semviz("--help")],
        "import of the public names": [float(checkout.python(IMPORT))],
        "map build": [checkout.semviz("map", "build", "town")],
        "opening a run": [float(checkout.python(OPEN, run))],
        "a frame, search": json.loads(checkout.python(LOCALIZE, run, WARM, REPEATED)),
    }


def shared_input(first: Checkout) -> tuple[Path, Path]:
    """Labels and a run that the first checkout makes, for both to read."""
    first.semviz("new", "shared", *STREET)
    first.semviz("localize", "shared", "--map", "truth", "--images", "none", "--out", "run.rrd")
    labels = HERE / "tests" / "golden" / "fixtures" / "town.jsonl.gz"
    log = first.folder / "labels.jsonl"
    log.write_bytes(gzip.decompress(labels.read_bytes()))
    return log, first.folder / "run.rrd"


def table(times: dict[str, dict[str, list[float]]]) -> str:
    """Before, after and their ratio, in milliseconds."""
    lines = [f"{'ms':32}{'before':>10}{'after':>10}{'ratio':>8}"]
    for what, by_name in times.items():
        statistics_of = {"median": statistics.median}
        if what.startswith("a frame"):
            statistics_of["p95"] = lambda values: statistics.quantiles(values, n=20)[-1]
        for name, statistic in statistics_of.items():
            before, after = (statistic(by_name[version]) * 1e3 for version in ("before", "after"))
            title = what if name == "median" else f"{what}, {name}"
            lines.append(f"{title:32}{before:10.2f}{after:10.2f}{after / before:8.2f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="a checkout")
    parser.add_argument("--after", type=Path, default=HERE, help="another; this one if not given")
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    times: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        before = Checkout("before", asked.before, folder)
        after = Checkout("after", asked.after, folder)
        labels, run = shared_input(before)
        for version in (before, after):
            prepare(version, labels, run)
        for number in range(asked.rounds):
            for version in (before, after):
                for what, seconds in measure(version, run).items():
                    times[what][version.name] += seconds
            print(f"round {number + 1} of {asked.rounds}", file=sys.stderr, flush=True)
    print(table(times))


if __name__ == "__main__":
    main()
