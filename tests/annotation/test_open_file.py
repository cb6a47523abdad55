"""An edit is confirmed only if the open label file is still the one at its path."""

import os
import shutil
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from random_edits import pole

from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.backup import backup_labels, check_labels, restore_labels
from semviz_annotation.storage.label_file import LabelFileError, NotSavedError, OpenFile
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

EARLIER, LATER = 5, 3


@pytest.fixture
def backup(path: Path) -> Path:
    """A backup of five operations; the label file has three more."""
    backup = path.with_name("backup.db")
    with LabelStore.open(path) as store:
        for frame in range(EARLIER):
            store.apply(pole(frame), "ann")
    backup_labels(path, backup)
    with LabelStore.open(path) as store:
        for frame in range(LATER):
            store.apply(pole(10 + frame), "ann")
    return backup


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semviz_annotation.storage.label_file.CHECKPOINT_S", 0.1)


def remove(path: Path, backup: Path) -> None:
    for name in path.parent.glob(f"{path.name}*"):
        name.unlink()


def remove_only_the_file(path: Path, backup: Path) -> None:
    path.unlink()


def remove_only_the_journal(path: Path, backup: Path) -> None:
    path.with_name(f"{path.name}-wal").unlink()


def move_away(path: Path, backup: Path) -> None:
    path.rename(path.with_name("elsewhere.db"))


def move_over(path: Path, backup: Path) -> None:
    backup.rename(path)


def copy_over(path: Path, backup: Path) -> None:
    shutil.copyfile(backup, path)  # the same inode, like cp


def copy_over_with_journal(path: Path, backup: Path) -> None:
    shutil.copyfile(backup, path)
    os.truncate(f"{path}-wal", 0)


def empty(path: Path, backup: Path) -> None:
    os.truncate(path, 0)


FAULTS = (
    remove, remove_only_the_file, remove_only_the_journal, move_away, move_over, copy_over,
    copy_over_with_journal, empty,
)  # fmt: skip


@pytest.mark.parametrize("checkpointed", [False, True])
@pytest.mark.parametrize("fault", FAULTS)
def test_no_edit_is_confirmed_into_a_file_that_is_not_there(path, backup, fault, checkpointed):
    with LabelStore.open(path) as store:
        store.apply(pole(20), "ann")
        if checkpointed:
            store._file.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        before = store.labels
        fault(path, backup)
        there = {file: file.read_bytes() for file in path.parent.iterdir() if file.suffix == ".db"}
        for _ in range(2):
            with pytest.raises(NotSavedError, match=r"^Not saved: labels\.db") as caught:
                store.apply(pole(30), "ann")
            assert "\n" not in str(caught.value)
        assert store.labels == before
    if fault is remove_only_the_journal:  # the file is still the opened one
        assert check_labels(path).operations == EARLIER + LATER + 1
    else:
        assert {file: file.read_bytes() for file in there} == there, "closing wrote into it"


@pytest.mark.parametrize("fault", [remove, move_over])
def test_an_edit_whose_file_goes_while_it_is_written_is_not_confirmed(
    path, backup, fault, monkeypatch
):
    with LabelStore.open(path) as store:
        append = store._file.append

        def append_and_lose(*arguments: object) -> None:
            append(*arguments)
            fault(path, backup)

        monkeypatch.setattr(store._file, "append", append_and_lose)
        with pytest.raises(NotSavedError, match="while it was open"):
            store.apply(pole(30), "ann")


def test_a_file_that_comes_back_takes_the_edit_once(path, backup):
    with LabelStore.open(path) as store:
        names = [path, path.with_name("labels.db-wal"), path.with_name("labels.db-shm")]
        for name in names:
            name.rename(name.with_name(f"kept-{name.name}"))
        request = new_id()
        with pytest.raises(NotSavedError, match=r"labels.db was removed while it was open"):
            store.apply(pole(30), "ann", request)
        for name in names:
            name.with_name(f"kept-{name.name}").rename(name)
        assert store.apply(pole(30), "ann", request).number == EARLIER + LATER + 1
    assert check_labels(path).operations == EARLIER + LATER + 1


def test_checkpoints_of_any_process_and_restored_backups_are_no_faults(path, backup):
    with LabelStore.open(path) as store, LabelStore.open(path) as other:
        for turn in range(20):
            (store if turn % 3 else other).apply(pole(turn), "ann")
            outside = sqlite3.connect(path)
            outside.execute(f"PRAGMA wal_checkpoint({('PASSIVE', 'TRUNCATE')[turn % 2]})")
            outside.close()
            os.utime(path, ns=(time.time_ns(), time.time_ns() + turn))
        restore_labels(path, backup)
        store.apply(pole(50), "ann")
        other.apply(pole(51), "ann")
        assert other.last_operation == EARLIER + 2
    assert check_labels(path).operations == EARLIER + 2


def test_a_linked_file_is_checked_where_its_journal_is(path, backup, tmp_path):
    folder = tmp_path / "workspace"
    folder.mkdir()
    (folder / "labels.db").symlink_to(path)
    with LabelStore.open(folder / "labels.db") as store:
        store.apply(pole(30), "ann")
        (folder / "labels.db").unlink()
        with pytest.raises(NotSavedError, match="removed"):
            store.apply(pole(31), "ann")


def test_the_check_is_cheap(path, backup):
    """20 µs on a quiet machine; a busy one may take three times as long."""
    with LabelStore.open(path):
        file = OpenFile(path)
        costs = []
        for _ in range(20):
            start = time.perf_counter()
            for _ in range(100):
                file.check()
            costs.append((time.perf_counter() - start) / 100)
    assert min(costs) < 60e-6


@pytest.mark.parametrize("look", [LabelStore.open, check_labels])
def test_an_empty_file_is_no_new_database(path, look):
    path.touch()
    with pytest.raises(SemvizError, match="an empty file, not labels of semviz; restore a backup"):
        look(path)
    assert path.read_bytes() == b""


def test_a_journal_without_its_file_is_no_new_database(path, backup):
    with LabelStore.open(path) as store:
        store.apply(pole(), "ann")
        shutil.copy(f"{path}-wal", path.with_name("kept"))
    path.unlink()
    journal = path.with_name("labels.db-wal")
    path.with_name("kept").rename(journal)
    with pytest.raises(SemvizError, match=r"is missing, but its journal labels.db-wal is there"):
        LabelStore.open(path)
    assert journal.stat().st_size
    assert not path.exists()


def meddle(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def test_a_file_damaged_before_catching_up_keeps_the_edit(path, backup):
    """The edit is not to blame: the page must keep it."""
    with LabelStore.open(path) as store:
        outside = sqlite3.connect(path, isolation_level=None)
        outside.execute("UPDATE observations SET anchor_u = 7 WHERE frame_index = 1")
        outside.execute("INSERT INTO counters VALUES ('x', 1)")
        outside.execute("DROP TRIGGER operations_stay")
        outside.execute("UPDATE operations SET hash = 'x' WHERE number = (SELECT max(number) "
                        "FROM operations)")  # fmt: skip
        outside.close()
        with pytest.raises(NotSavedError, match="the label file is damaged"):
            store.apply(pole(), "ann")
        with pytest.raises(LabelFileError, match="the label file is damaged"):
            _ = store.labels


def test_an_overwritten_file_that_reads_as_damaged_is_called_overwritten(path, backup, monkeypatch):
    def malformed() -> None:
        raise sqlite3.DatabaseError("database disk image is malformed")

    with LabelStore.open(path) as store:
        store.apply(pole(20), "ann")
        copy_over(path, backup)
        monkeypatch.setattr(store._file, "_follow_or_load", malformed)
        store._file._data_version = None
        with pytest.raises(NotSavedError, match="was overwritten while it was open"):
            store.apply(pole(30), "ann")
