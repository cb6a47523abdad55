"""What a drive costs: processor time, memory and storage of each command, on one core.

    python bench/drive_cost.py --kitti /data/kitti

Each command runs as people run it, in a process of its own, on few and on many frames of KITTI 02:
*start* is what it takes before its first frame, *ms* and *kB* are of each frame.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import tyro

from semviz.commands.parsing import ONE_THREAD

HEAD = f"{'command':<32}{'start s':>9}{'ms':>7}{'peak MB':>9}{'kB':>8}"


@dataclass(frozen=True)
class Options:
    kitti: Path
    few: int = 4
    many: int = 20


class Cost(NamedTuple):
    """Of a command."""

    seconds: float
    """Of a processor."""
    peak_mb: float
    kb: float
    """Of what it wrote."""


def main(options: Options) -> None:
    dict(costs(options.kitti, options.few))  # compiles, once only
    few, many = (dict(costs(options.kitti, frames)) for frames in (options.few, options.many))
    print(HEAD)
    for name, cost in many.items():
        frames = options.many - options.few
        slope_s = max(cost.seconds - few[name].seconds, 0.0) / frames
        start_s = cost.seconds - slope_s * options.many
        kb = (cost.kb - few[name].kb) / frames
        print(f"{name:<32}{start_s:>9.1f}{1e3 * slope_s:>7.0f}{cost.peak_mb:>9.0f}{kb:>8.1f}")


def costs(kitti: Path, frames: int) -> Iterator[tuple[str, Cost]]:
    """Yield the cost of each command on a drive of so many frames."""
    with tempfile.TemporaryDirectory() as folder:
        for name, arguments, written in commands(kitti, Path(folder) / "drive", frames):
            yield name, cost_of([sys.executable, "-m", "semviz", *arguments], written)


def cost_of(command: list[str], written: Path) -> Cost:
    process = subprocess.Popen(
        command,
        env=os.environ | ONE_THREAD,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{command}: exit status {os.waitstatus_to_exitcode(status)}")
    kb = written.stat().st_size / 1e3
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3, kb)


def commands(kitti: Path, drive: Path, frames: int) -> Iterator[tuple[str, list[str], Path]]:
    """Yield the name of each command, its arguments, and the file that it writes."""
    source = ["--kitti", str(kitti), "--frames", f"0:{frames}"]
    yield "new", ["new", str(drive), *source], drive / "semviz.toml"
    yield (
        "detect --sides left",
        ["detect", str(drive), "--sides", "left"],
        drive / "proposals.parquet",
    )
    name, run = "from-detections", drive / "runs" / "search.rrd"
    built = drive / "maps" / f"{name}.parquet"
    yield "map build --from detections", ["map", "build", str(drive), "--from", "detections"], built
    localize = ["localize", str(drive), "--observations", "detected", "--map", name]
    yield "localize", localize, run
    yield "localize --images none", [*localize, "--images", "none"], run
    yield "evaluate", ["evaluate", str(run)], Path(os.devnull)


if __name__ == "__main__":
    main(tyro.cli(Options))
