"""Engines that could run a batch, on this machine: start, memory, cost of a task, a shuffle.

    pip install ray 'dask[distributed]' pyspark    # and a Java runtime, for Spark
    python bench/engines.py

Each engine runs in a process of its own with two workers. *start*: from its import to the first
result. *memory*: of all its processes with idle workers (PSS). *task*: 2,000 tasks that do nothing.
*shuffle*: 40 parts of 4 MB, each cut in 40, go to 40 tasks that each join one cut of every part.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import psutil

WORKERS, TASKS, PARTS, VALUES = 2, 2000, 40, 500_000


class Engine(Protocol):
    """What a batch needs of an engine."""

    def map(self, work: Callable[[int], Any], items: Sequence[int]) -> list[Any]:
        """Return the results of some work, from the workers."""

    def shuffle(self) -> list[float]:
        """Return the sum of each of the joined parts."""


def nothing(number: int) -> int:
    return number


def part(number: int) -> list[Any]:
    values = np.random.default_rng(number).random(VALUES)
    return np.array_split(values, PARTS)


def total(*cuts: Any) -> float:
    return float(np.concatenate(cuts).sum())


class Ray:
    def __init__(self) -> None:
        import ray

        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        ray.init(num_cpus=WORKERS, include_dashboard=False, log_to_driver=False)
        self.ray = ray

    def map(self, work: Callable[[int], Any], items: Sequence[int]) -> list[Any]:
        remote = self.ray.remote(work)
        return list(self.ray.get([remote.remote(item) for item in items]))

    def shuffle(self) -> list[float]:
        cut = self.ray.remote(num_returns=PARTS)(part)
        join = self.ray.remote(total)
        parts = [cut.remote(number) for number in range(PARTS)]
        columns = [[row[column] for row in parts] for column in range(PARTS)]
        return list(self.ray.get([join.remote(*column) for column in columns]))


class Dask:
    def __init__(self) -> None:
        from distributed import Client

        self.client = Client(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None)

    def map(self, work: Callable[[int], Any], items: Sequence[int]) -> list[Any]:
        return list(self.client.gather(self.client.map(work, items, pure=False)))

    def shuffle(self) -> list[float]:
        import dask

        cut, join = dask.delayed(part, nout=PARTS), dask.delayed(total)
        parts = [list(cut(number)) for number in range(PARTS)]
        columns = [[row[column] for row in parts] for column in range(PARTS)]
        return list(dask.compute(*[join(*column) for column in columns]))


class Spark:
    def __init__(self) -> None:
        from pyspark import SparkConf, SparkContext

        os.environ["PYSPARK_PYTHON"] = sys.executable
        settings = SparkConf().set("spark.ui.enabled", "false").set("spark.driver.memory", "2g")
        self.context = SparkContext(f"local[{WORKERS}]", conf=settings)
        self.context.setLogLevel("ERROR")

    def map(self, work: Callable[[int], Any], items: Sequence[int]) -> list[Any]:
        return list(self.context.parallelize(items, len(items)).map(work).collect())

    def shuffle(self) -> list[float]:
        parts = self.context.parallelize(range(PARTS), PARTS)
        cuts = parts.flatMap(lambda number: enumerate(part(number)))
        joined = cuts.groupByKey(PARTS).mapValues(lambda found: total(*found))
        return [value for _, value in sorted(joined.collect())]


ENGINES: dict[str, type[Engine]] = {"ray": Ray, "dask": Dask, "spark": Spark}


def main() -> None:
    """Print a row for the engine that is named, or for all, each in a process of its own."""
    if len(sys.argv) > 1:
        print(row(sys.argv[1]))
        return
    print(f"{'engine':<8}{'start s':>9}{'memory MB':>11}{'task ms':>9}{'shuffle s':>11}")
    for name in ENGINES:
        command = [sys.executable, __file__, name]
        found = subprocess.run(command, capture_output=True, text=True)
        lines = (found.stdout if found.returncode == 0 else found.stderr).splitlines()
        print(lines[-1] if lines else f"{name}: exit status {found.returncode}", flush=True)


def row(name: str) -> str:
    """Return the measurements of an engine."""
    started_s = time.perf_counter()
    engine = ENGINES[name]()
    engine.map(nothing, range(WORKERS))
    start_s = time.perf_counter() - started_s
    engine.map(nothing, range(100))
    memory_mb = memory() / 1e6
    task_s, _ = timed(lambda: engine.map(nothing, range(TASKS)))
    shuffle_s, sums = timed(engine.shuffle)
    assert len(sums) == PARTS
    task_ms = 1e3 * task_s / TASKS
    return f"{name:<8}{start_s:>9.1f}{memory_mb:>11.0f}{task_ms:>9.2f}{shuffle_s:>11.1f}"


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start_s = time.perf_counter()
    found = work()
    return time.perf_counter() - start_s, found


def memory() -> int:
    """Return the bytes of this process and of all that it started, shared pages counted once."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    return sum(int(one.memory_full_info().pss) for one in processes)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main()
