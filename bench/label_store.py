"""The label file at 100,000 observations over 10,000 frames: opening, editing, history.

    python bench/label_store.py
    python bench/label_store.py --elements 600 --frames 1000

One run on a synthetic file (see big_labels.py) in the folder for temporary files. The time of an
edit includes writing it to disk; the time of the disk alone is measured as well.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from big_labels import make_big_labels

from semviz_annotation.labels.edits import AddMany, AddObservation, MoveObservation
from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.backup import (
    backup_labels,
    check_labels,
    export_operations,
    restore_labels,
)
from semviz_annotation.storage.store import LabelStore

AUTHOR = "ann"
OPENINGS = 5


@dataclass(frozen=True)
class Options:
    elements: int = 6000
    frames: int = 10_000
    edits: int = 500
    """Of each kind."""
    seed: int = 0


def main(options: Options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "labels.db"
        seconds = timed(
            lambda: make_big_labels(path, options.elements, options.frames, options.seed)
        )
        check = check_labels(path)
        print(
            f"{check.observations:,} observations of {check.elements:,} elements, "
            f"{check.operations:,} operations, {path.stat().st_size / 1e6:.0f} MB, "
            f"made in {seconds:.1f} s"
        )
        report("open", [timed(lambda: LabelStore.open(path).close()) for _ in range(OPENINGS)])
        report("fsync of 4 kB, for comparison", fsyncs(Path(folder) / "fsync", options.edits))
        with LabelStore.open(path) as store, LabelStore.open(path) as other:
            editing(store, other, options)
            looking_back(store, np.random.default_rng(options.seed))
            report(
                "export as JSON lines",
                [timed(lambda: export_operations(store, path.with_suffix(".jsonl")))],
            )
            keeping_safe(path)
            report("catch up with a restored backup", [timed(lambda: store.labels)])


def editing(store: LabelStore, other: LabelStore, options: Options) -> None:
    rng = np.random.default_rng(options.seed)
    ids = sorted(store.labels.observations)
    moved = [MoveObservation(ids[i], point(rng)) for i in rng.integers(0, len(ids), options.edits)]
    report("apply: move", [timed(lambda edit=edit: store.apply(edit, AUTHOR)) for edit in moved])
    drawn = [drawing(int(frame), rng) for frame in rng.integers(0, options.frames, options.edits)]
    report(
        "apply: draw one", [timed(lambda edit=edit: store.apply(edit, AUTHOR)) for edit in drawn]
    )
    many = [
        AddMany(tuple(drawing(int(frame) + k, rng) for k in range(8)))
        for frame in rng.integers(0, options.frames, options.edits)
    ]
    report(
        "apply: accept eight", [timed(lambda edit=edit: store.apply(edit, AUTHOR)) for edit in many]
    )
    report("undo", [timed(lambda: store.undo(AUTHOR)) for _ in range(options.edits)])
    report("redo", [timed(lambda: store.redo(AUTHOR)) for _ in range(options.edits)])
    report("labels, nothing new", [timed(lambda: store.labels) for _ in range(options.edits)])
    seconds = []
    for edit in moved:
        store.apply(edit, AUTHOR)
        seconds.append(timed(lambda: other.labels))
    report("labels, one edit of another process", seconds)


def looking_back(store: LabelStore, rng: np.random.Generator) -> None:
    last = store.last_operation
    numbers = rng.integers(0, last, 200)
    report(
        "100 operations from anywhere",
        [timed(lambda n=n: store.operations(before=int(n), limit=100)) for n in numbers],
    )
    ids = sorted(store.labels.observations)[:20]
    report("who wrote 20 observations", [timed(lambda: store.last_writers(ids)) for _ in numbers])
    report(
        "state 100 operations ago", [timed(lambda: store.labels_at(last - 100)) for _ in range(20)]
    )
    report(
        "state half-way, the slowest", [timed(lambda: store.labels_at(last // 2)) for _ in range(3)]
    )
    report("restore 100 operations ago", [timed(lambda: store.restore(last - 100, AUTHOR))])


def keeping_safe(path: Path) -> None:
    backup = path.with_name("backup.db")
    report("check", [timed(lambda: check_labels(path))])
    report("backup, checked", [timed(lambda: backup_labels(path, backup))])
    report("restore of the backup", [timed(lambda: restore_labels(path, backup))])


def drawing(frame: int, rng: np.random.Generator) -> AddObservation:
    return AddObservation(new_id(), new_id(), frame, "left", point(rng), point(rng), class_id=0)


def point(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0.0, 1240.0)), float(rng.uniform(0.0, 375.0))


def fsyncs(path: Path, count: int) -> list[float]:
    with path.open("wb", buffering=0) as file:

        def write() -> None:
            file.write(bytes(4096))
            os.fsync(file.fileno())

        return [timed(write) for _ in range(count)]


def timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def report(name: str, seconds: Iterable[float]) -> None:
    median, p95 = np.percentile(list(seconds), [50, 95]) * 1e3
    print(f"{name:<38} median {median:9.2f} ms, p95 {p95:9.2f} ms")


if __name__ == "__main__":
    main(tyro.cli(Options))
