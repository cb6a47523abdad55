"""What was acknowledged is there: after kill -9, on a torn file, on a full disk."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from random_edits import pole, random_edit

from semviz_annotation.labels.labels import Labels
from semviz_annotation.storage.backup import check_labels
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

NURSERY = Path(__file__).with_name("writer_processes.py")
KILLS = 200
KILLS_A_FILE = 25
PAGE = 4096
NAMED = r"labels\.db: (the label file is damaged|not a label file)"


@contextmanager
def nursery() -> "Iterator[subprocess.Popen[str]]":
    paths = os.pathsep.join([str(NURSERY.parents[1]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, str(NURSERY)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    with process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


def killed(process: "subprocess.Popen[str]", path: Path, rng: np.random.Generator) -> list[str]:
    """What a writer acknowledged before it was killed, at a random moment."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(f"{path} {rng.integers(2**32)}\n")
    process.stdin.flush()
    pid, acknowledged = 0, []
    wanted = int(rng.integers(0, 10))
    while not pid or len(acknowledged) < wanted:
        line = process.stdout.readline()
        if line.startswith("born"):
            pid = int(line.split()[1])
        else:
            acknowledged.append(line)
    time.sleep(rng.uniform(0.0, 0.008))
    os.kill(pid, signal.SIGKILL)
    while (line := process.stdout.readline()) != "gone\n":
        acknowledged.append(line)
    return acknowledged


def test_two_hundred_kills_lose_nothing_acknowledged(tmp_path):
    rng = np.random.default_rng(9)
    total = 0
    with nursery() as process:
        for kill in range(KILLS):
            path = tmp_path / f"{kill // KILLS_A_FILE}.db"
            acknowledged = killed(process, path, rng)
            with LabelStore.open(path) as store:
                log = {operation.request_id: operation.number for operation in store.operations()}
            for line in acknowledged:
                number, request_id = line.split()
                assert log[request_id] == int(number)
            total += len(acknowledged)
            if kill % KILLS_A_FILE == KILLS_A_FILE - 1:
                assert check_labels(path).operations == len(log)
    assert total > KILLS


@pytest.fixture
def torn(tmp_path: Path) -> tuple[Path, list[Labels]]:
    """A label file with all of its operations in the write-ahead log, and every former state."""
    rng = np.random.default_rng(1)
    path = tmp_path / "whole" / "labels.db"
    path.parent.mkdir()
    LabelStore.open(path).close()
    states = [Labels()]
    with LabelStore.open(path) as store:
        store._file.connection.execute("PRAGMA wal_autocheckpoint = 0")
        while len(states) < 40:
            try:
                store.apply(random_edit(store.labels, rng), "ann")
            except SemvizError:
                continue
            states.append(store.labels)
        for end in ("", "-wal"):
            shutil.copy(f"{path}{end}", tmp_path / f"labels.db{end}")
    return tmp_path / "labels.db", states


@pytest.mark.parametrize("fault", ["cut", "one byte", "zeros to the end"])
def test_a_torn_tail_leaves_the_state_of_an_operation(torn, tmp_path, fault):
    path, states = torn
    whole = Path(f"{path}-wal").read_bytes()
    rng = np.random.default_rng(2)
    lengths = set()
    for trial in range(20):
        at = int(rng.integers(len(whole)))
        damaged = {
            "cut": whole[:at],
            "one byte": whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :],
            "zeros to the end": whole[:at] + bytes(len(whole) - at),
        }[fault]
        copy = tmp_path / f"{trial}.db"
        shutil.copy(path, copy)
        Path(f"{copy}-wal").write_bytes(damaged)
        with LabelStore.open(copy) as store:
            assert store.labels == states[store.last_operation]
            lengths.add(store.last_operation)
            store.apply(pole(), "ann")
        assert check_labels(copy).operations in {length + 1 for length in lengths}
    assert len(lengths) > 5


def test_a_database_that_was_cut_is_named_in_one_line(path):
    with LabelStore.open(path) as store:
        for frame in range(30):
            store.apply(pole(frame), "ann")
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for length in (99, 100, 511, len(whole) - 1, *rng.integers(100, len(whole), 20)):
        path.write_bytes(whole[: int(length)])
        looks = [check_labels]
        if length < len(whole) - PAGE:  # nobody but a check misses the end of the last page
            looks.append(LabelStore.open)
        for look in looks:
            with pytest.raises(SemvizError, match=NAMED) as caught:
                look(path)
            assert "\n" not in str(caught.value)
        assert path.read_bytes() == whole[: int(length)]
    path.write_bytes(whole)
    assert check_labels(path).operations == 30


def test_a_disk_that_is_full_refuses_and_goes_on_when_there_is_room(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "none", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root can make a small disk")
    try:
        filling = disk / "other"
        filling.write_bytes(bytes(200_000))
        with LabelStore.open(disk / "labels.db") as store:
            states = [store.labels]

            def fill() -> None:
                for frame in range(10_000):
                    store.apply(pole(frame), "ann")
                    states.append(store.labels)

            with pytest.raises(SemvizError, match=r"^Not saved: disk full\.$"):
                fill()
            assert store.labels == states[-1]
            with pytest.raises(SemvizError, match="disk full"):
                store.apply(pole(), "ann")
            filling.unlink()
            store.undo("ann")
            assert store.labels == states[-2]
            expected = store.last_operation
        assert check_labels(disk / "labels.db").operations == expected == len(states)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_file_that_stays_locked_is_named_after_waiting(path, monkeypatch):
    LabelStore.open(path).close()
    monkeypatch.setattr("semviz_annotation.storage.database.WAIT_S", 0.05)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(SemvizError, match=r"Not opened: another program keeps .*labels.db locked"):
        LabelStore.open(path)
    other.execute("ROLLBACK")
    LabelStore.open(path).close()
