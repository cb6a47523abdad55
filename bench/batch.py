"""A batch on a Ray cluster whose machines are processes of this one: overhead, stragglers, losses.

    python bench/batch.py

Drives only wait, so that several machines fit on one. Most take a second, one in 20 takes ten
(*stragglers*). *Lost* machines are killed while they work, each replaced by a new one. *Best*: the
time if the waiting were shared evenly among all cores, or the longest drive if that is longer.
*Twice*: seconds of drives that were begun again. *Overhead*: seconds beyond the best, of a drive.
"""

import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from semviz.batch.batch import BatchCommand, DriveBatch, Plan
from semviz.batch.cluster import Cluster
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive

HEAD = "drives  stragglers  lost    best  took s  twice  done  begun again  overhead ms"


@dataclass(frozen=True)
class Options:
    machines: int = 4
    cores: int = 2
    """Of each machine."""
    drives: int = 200
    straggler_s: float = 10.0
    seed: int = 0


def waiting_command(command: BatchCommand, arguments: list[str]) -> int:
    """Wait as long as the name of the drive says."""
    out = Path(arguments[arguments.index("--out") + 1])
    seconds = float(out.stem.split("-")[1])
    time.sleep(seconds)
    out.write_bytes(b"run")
    print(json.dumps({"run": str(out), "seconds": seconds}))
    return 0


def main(options: Options) -> None:
    from ray.cluster_utils import Cluster as Machines

    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # of the workers
    machines = Machines(head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(options.machines):
        machines.add_node(num_cpus=options.cores)
    rng = np.random.default_rng(options.seed)
    usual = np.ones(options.drives)
    slow = np.where(rng.random(options.drives) < 0.05, options.straggler_s, usual)
    try:
        print(HEAD)
        done(machines, options, 0.0 * usual, 0)  # starts the workers
        for seconds, losses in ((0.0 * usual, 0), (usual, 0), (slow, 0), (slow, 1), (slow, 3)):
            print(done(machines, options, seconds, losses), flush=True)
    finally:
        machines.shutdown()


def done(machines: Any, options: Options, seconds: Sequence[float], losses: int) -> str:
    """Return the row of a batch of drives that take so many seconds."""
    drives = [Drive(f"d{n:04}-{s}", "/nowhere") for n, s in enumerate(seconds)]
    cores = options.machines * options.cores
    best_s = max(float(np.sum(seconds)) / cores, max(seconds))
    again: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        collection = Collection.create(Path(folder) / "city")
        batch = DriveBatch.begin(collection, "june", Plan("localize"))
        work, start_s = Work(collection.where, "june", waiting_command), time.monotonic()
        outcomes = Cluster(machines.address).run(work, drives, again.append)
        for ended, _ in enumerate(outcomes, start=1):
            if losses and ended % (len(drives) // (losses + 1)) == 0 and ended < len(drives):
                lose_one(machines, options.cores)
        took_s = time.monotonic() - start_s
        whole = len(batch.done_before())
    twice_s = sum(float(line.split(":")[0].split("-")[1]) for line in again)
    overhead_ms = 1e3 * (took_s - best_s) * cores / len(drives)
    slow = sum(s > 1.0 for s in seconds)
    return (
        f"{len(drives):>6}{slow:>12}{losses:>6}{best_s:>8.1f}{took_s:>8.1f}{twice_s:>7.0f}"
        f"{whole:>6}{len(again):>13}{overhead_ms:>13.0f}"
    )


def lose_one(machines: Any, cores: int) -> None:
    """Kill a machine that works, and start another."""
    worker = next(node for node in machines.list_all_nodes() if node != machines.head_node)
    machines.remove_node(worker, allow_graceful=False)
    machines.add_node(num_cpus=cores)


if __name__ == "__main__":
    main(tyro.cli(Options))
