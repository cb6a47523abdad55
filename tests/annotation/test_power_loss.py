"""A power cut loses no confirmed edit, whichever of the writes that were not synced reach the disk.

The writes and syncs of a real process are recorded (LD_PRELOAD). Then the power is cut after any of
them: of the writes since a file's last sync, some sectors are kept and others are lost.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from conftest import skip_or_fail

from semviz_annotation.storage.backup import check_labels
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

SOURCE = Path(__file__).with_name("record_writes.c")
SECTOR = 512
CUTS = 150
WRITER = """
import os, sys
from pathlib import Path
from random_edits import pole
from semviz_annotation.storage.store import LabelStore

path, synchronous = Path(sys.argv[1]), sys.argv[2]
said = os.open(path.with_name("said"), os.O_WRONLY | os.O_CREAT)
with LabelStore.open(path) as store:
    store._file.connection.execute("PRAGMA wal_autocheckpoint = 16")
    store._file.connection.execute(f"PRAGMA synchronous = {synchronous}")
    for frame in range(40):
        os.write(said, f"{store.apply(pole(frame), 'ann').number}".encode())
"""


@dataclass(frozen=True)
class Record:
    kind: str
    name: str
    offset: int
    data: bytes


@dataclass
class Disk:
    """One file: its content that is certain to be on disk, and what was done to it since."""

    synced: bytes = b""
    since: list[Record] = field(default_factory=list)

    def sync(self) -> None:
        for record in self.since:
            self.synced = after(self.synced, record)
        self.since = []

    def cut(self, rng: np.random.Generator) -> bytes:
        """The content after a power cut."""
        content = self.synced
        for record in self.since:
            for part in sectors(record):
                if rng.random() < 0.5:
                    content = after(content, part)
        return content


def sectors(record: Record) -> Iterator[Record]:
    if record.kind != "write":
        yield record
        return
    for start in range(0, len(record.data), SECTOR):
        data = record.data[start : start + SECTOR]
        yield Record("write", record.name, record.offset + start, data)


def after(content: bytes, record: Record) -> bytes:
    match record.kind:
        case "write":
            padded = content.ljust(record.offset, b"\0")
            return (
                padded[: record.offset] + record.data + padded[record.offset + len(record.data) :]
            )
        case "truncate":
            return content[: record.offset].ljust(record.offset, b"\0")
    return b""  # removed


def recorded(path: Path) -> Iterator[Record]:
    content, at = path.read_bytes(), 0
    while at < len(content):
        end = content.index(b"\n", at)
        kind, offset, length, name = content[at:end].decode().split(" ", 3)
        at = end + 1 + int(length)
        yield Record(kind, name, int(offset), content[end + 1 : at])


def record(tmp_path: Path, synchronous: str) -> tuple[bytes, list[Record]]:
    """The label file before, and all that a writer then did."""
    if shutil.which("gcc") is None or not sys.platform.startswith("linux"):
        skip_or_fail("recording writes needs gcc on Linux")
    library = tmp_path / "record.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    folder = tmp_path / "disk"
    folder.mkdir()
    LabelStore.open(folder / "labels.db").close()
    before = (folder / "labels.db").read_bytes()
    paths = os.pathsep.join([str(SOURCE.parents[1]), os.environ.get("PYTHONPATH", "")])
    subprocess.run(
        [sys.executable, "-c", WRITER, folder / "labels.db", synchronous],
        check=True,
        env=os.environ
        | {
            "LD_PRELOAD": str(library),
            "RECORD_FOLDER": str(folder),
            "RECORD_FILE": str(tmp_path / "records"),
            "PYTHONPATH": paths,
        },
    )
    return before, list(recorded(tmp_path / "records"))


def lost(before: bytes, records: list[Record], folder: Path) -> int:
    """How many of the power cuts lost a confirmed edit, or left a file that is not sound."""
    rng = np.random.default_rng(3)
    result = 0
    for cut in sorted(rng.choice(len(records), min(CUTS, len(records)), replace=False)):
        disks = {"labels.db": Disk(before), "labels.db-wal": Disk()}
        confirmed = 0
        for record in records[: int(cut)]:
            if record.kind == "say":
                confirmed = int(record.data)
            elif record.name in disks and record.kind == "sync":
                disks[record.name].sync()
            elif record.name in disks:
                disks[record.name].since.append(record)
        path = folder / f"{cut}" / "labels.db"
        path.parent.mkdir()
        for name, disk in disks.items():
            path.with_name(name).write_bytes(disk.cut(rng))
        try:
            with LabelStore.open(path) as store:
                result += store.last_operation < confirmed
            check_labels(path)
        except SemvizError:
            result += 1
    return result


def test_a_power_cut_loses_no_confirmed_edit(tmp_path):
    before, records = record(tmp_path, "FULL")
    assert sum(record.kind == "say" for record in records) == 40
    assert sum(record.kind == "sync" for record in records) > 40
    (tmp_path / "cuts").mkdir()
    assert lost(before, records, tmp_path / "cuts") == 0


def test_without_syncs_the_same_cuts_lose_edits(tmp_path):
    """The test above can fail."""
    before, records = record(tmp_path, "OFF")
    (tmp_path / "cuts").mkdir()
    assert lost(before, records, tmp_path / "cuts") > CUTS // 4
