"""The label file loses nothing, undoes exactly, and says what is wrong."""

import os
import sqlite3
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_edits import pole, random_edit

from semviz_annotation.labels.edits import AddObservation, Edit, MoveObservation
from semviz_annotation.labels.labels import LabelElement, Labels, new_id
from semviz_annotation.storage.store import LabelStore, Operation
from semviz_core.common.errors import SemvizError

WORKER = Path(__file__).with_name("label_writer.py")


def try_apply(store: LabelStore, edit: Edit, author: str) -> Operation | None:
    try:
        return store.apply(edit, author)
    except SemvizError:
        return None


def replayed(store: LabelStore) -> Labels:
    labels = Labels()
    for operation in store.operations():
        labels = labels.changed(operation.changes)
    return labels


def reopened(store: LabelStore) -> Labels:
    with LabelStore.open(store.path) as again:
        return again.labels


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_undoing_all_gives_every_former_state_and_redoing_brings_it_back(seed):
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder, LabelStore.open(Path(folder) / "l.db") as store:
        states = [store.labels]
        for _ in range(40):
            if try_apply(store, random_edit(store.labels, rng), "ann"):
                states.append(store.labels)
        for former in states[-2::-1]:
            store.undo("ann")
            assert store.labels == former
        assert store.labels == Labels()
        with pytest.raises(SemvizError, match="Nothing to undo"):
            store.undo("ann")
        for later in states[1:]:
            store.redo("ann")
            assert store.labels == later
        with pytest.raises(SemvizError, match="Nothing to redo"):
            store.redo("ann")
        assert replayed(store) == reopened(store) == states[-1]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_log_tables_and_state_agree_whatever_several_people_do(seed):
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder, LabelStore.open(Path(folder) / "l.db") as store:
        refused = 0
        for _ in range(60):
            before = store.labels
            author, what = ("ann", "bea")[rng.integers(2)], rng.integers(6)
            try:
                if what == 0:
                    store.undo(author)
                elif what == 1:
                    store.redo(author)
                else:
                    store.apply(random_edit(before, rng), author)
            except SemvizError:
                refused += 1
                assert store.labels == before
        assert replayed(store) == reopened(store) == store.labels
        with LabelStore.open(store.path) as again:
            assert again.labels.next_number == store.labels.next_number
        operations = store.operations()
        assert [operation.number for operation in operations] == list(range(1, len(operations) + 1))
        assert store.last_operation == len(operations) == store.labels.operation
        owner: dict[int, str] = {}
        for change in (change for operation in operations for change in operation.changes):
            if isinstance(change.after, LabelElement):
                assert owner.setdefault(change.after.number, change.after.id) == change.after.id
        assert refused < 60


def test_undo_and_redo_are_per_person_and_survive_a_restart(path):
    with LabelStore.open(path) as store:
        first = store.apply(pole(0), "ann")
        store.apply(pole(1), "bea")
        undo = store.undo("ann")
        assert (undo.undoes, undo.kind, undo.author) == (first.number, "undo", "ann")
    with LabelStore.open(path) as store:
        assert store.labels.frames == (1,)
        assert (store.undoable("ann"), store.redoable("ann")) == (None, first.number)
        assert store.redo("ann").redoes == first.number
        assert store.labels.frames == (0, 1)
        store.undo("ann")
        store.apply(pole(2), "ann")
        with pytest.raises(SemvizError, match="Nothing to redo"):
            store.redo("ann")
        assert store.labels.frames == (1, 2)


def test_a_refused_undo_names_what_who_and_which_operation(store):
    edit = pole()
    store.apply(edit, "ann")
    store.apply(MoveObservation(edit.observation_id, (9.0, 9.0)), "bea")
    with pytest.raises(SemvizError) as caught:
        store.undo("ann")
    assert str(caught.value) == (
        "Cannot undo operation 1 (add): bea changed P-01 in the left image of frame 0 since "
        "(operation 2, move)."
    )
    store.undo("bea")
    store.apply(
        AddObservation(new_id(), edit.element_id, 1, "left", (1.0, 2.0), (3.0, 40.0)), "bea"
    )
    with pytest.raises(SemvizError, match=r"P-01 in the left image of frame 1 .*operation 4, add"):
        store.undo("ann")
    store.undo("bea")
    store.undo("ann")
    assert store.labels == Labels()


def test_the_same_request_is_done_once(store):
    edit, request = pole(), new_id()
    first = store.apply(edit, "ann", request)
    assert store.apply(edit, "ann", request) == first
    undo = new_id()
    assert store.undo("ann", undo) == store.undo("ann", undo)
    assert store.last_operation == 2
    with pytest.raises(SemvizError, match="request id was used"):
        store.apply(pole(), "bea", request)
    assert first.origin == "human"
    assert store.apply(pole(), "detector", origin="machine").origin == "machine"


def test_threads_share_a_store(store):
    def work(author: str) -> None:
        for frame in range(15):
            store.apply(pole(frame), author)

    threads = [threading.Thread(target=work, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.last_operation == len(store.labels.observations) == 60
    assert replayed(store) == reopened(store) == store.labels


def test_many_open_the_same_new_file_at_once(tmp_path):
    for round_ in range(20):
        path, barrier = tmp_path / f"{round_}.db", threading.Barrier(4)
        opened: list[LabelStore] = []

        def work(path: Path, barrier: threading.Barrier, opened: list[LabelStore]) -> None:
            barrier.wait()
            opened.append(LabelStore.open(path))

        threads = [threading.Thread(target=work, args=(path, barrier, opened)) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(opened) == 4
        opened[0].apply(pole(), "ann")
        assert [len(store.labels.elements) for store in opened] == [1] * 4
        for store in opened:
            store.close()


def start(path: Path, author: str, count: int) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, str(WORKER), str(path), author, str(count)],
        stdout=subprocess.PIPE,
        text=True,
    )


def test_two_processes_write_the_same_new_file(path):
    workers = [start(path, name, 30) for name in ("ann", "bea")]
    acknowledged = [
        line for worker in workers for line in worker.communicate()[0].split("\n")[1:-1]
    ]
    with LabelStore.open(path) as store:
        assert sorted(int(line.split()[0]) for line in acknowledged) == list(range(1, 61))
        assert replayed(store) == store.labels
        start(path, "cat", 5).communicate()
        assert store.last_operation == 65
        assert len(store.labels.observations) == 65
        store.undo("cat")
        assert replayed(store) == reopened(store) == store.labels


def test_disk_full_changes_nothing_and_passes_when_there_is_room(store):
    store.apply(pole(), "ann")
    connection = store._file.connection
    pages = connection.execute("PRAGMA page_count").fetchone()[0]
    connection.execute(f"PRAGMA max_page_count = {pages}")

    def fill() -> None:
        for frame in range(1, 1000):
            store.apply(pole(frame), "ann")

    with pytest.raises(SemvizError, match=r"^Not saved: disk full\.$"):
        fill()
    assert store.last_operation == len(store.operations()) == len(store.labels.observations)
    assert replayed(store) == reopened(store) == store.labels
    connection.execute("PRAGMA max_page_count = 100000")
    store.apply(pole(2000), "ann")
    assert replayed(store) == reopened(store) == store.labels


def test_a_busy_file_is_named(store):
    other = sqlite3.connect(store.path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    store._file.connection.execute("PRAGMA busy_timeout = 50")
    with pytest.raises(SemvizError, match=r"Not saved: another program keeps .* locked"):
        store.apply(pole(), "ann")
    other.execute("ROLLBACK")
    store.apply(pole(), "ann")


def test_the_log_cannot_be_rewritten(store):
    store.apply(pole(), "ann")
    with sqlite3.connect(store.path) as other:
        for sql in ("DELETE FROM operations", "UPDATE operations SET author = 'bea'"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                other.execute(sql)


def test_what_is_not_a_label_file_is_named(tmp_path, path):
    text = tmp_path / "notes.txt"
    text.write_text("poles and signs\n" * 100)
    with pytest.raises(SemvizError, match=r"notes.txt: not a label file"):
        LabelStore.open(text)
    foreign = tmp_path / "foreign.db"
    with sqlite3.connect(foreign) as other:
        other.execute("CREATE TABLE mine (a)")
    with pytest.raises(SemvizError, match=r"foreign.db: a SQLite file, but not labels"):
        LabelStore.open(foreign)
    with pytest.raises(SemvizError, match="no such folder"):
        LabelStore.open(tmp_path / "nowhere" / "labels.db")
    LabelStore.open(path).close()
    with sqlite3.connect(path) as other:
        other.execute("PRAGMA user_version = 99")
    with pytest.raises(SemvizError, match="labels of version 99, this semviz reads up to 8"):
        LabelStore.open(path)
    assert text.read_text().startswith("poles and signs")


def test_a_damaged_file_is_named(path):
    with LabelStore.open(path) as store:
        for frame in range(50):
            store.apply(pole(frame), "ann")
    content = bytearray(path.read_bytes())
    content[4096:] = b"\xaa" * (len(content) - 4096)
    path.write_bytes(content)
    with pytest.raises(SemvizError, match="damaged"):
        LabelStore.open(path)


def test_a_read_only_folder_is_named(tmp_path, path):
    LabelStore.open(path).close()
    tmp_path.chmod(0o555)
    path.chmod(0o444)
    try:
        if os.geteuid() == 0:  # root may write anywhere, but not on a read-only file system
            place = Path("/proc/self/labels.db")
            if not place.parent.is_dir():
                pytest.skip("root without /proc can write everywhere")
        else:
            place = path
        with pytest.raises(SemvizError, match="cannot be written; make it writable"):
            LabelStore.open(place)
    finally:
        tmp_path.chmod(0o755)


@pytest.mark.parametrize(
    "damage",
    [
        "INSERT INTO elements VALUES ('lonely', 7, 0)",
        "INSERT INTO operations VALUES (2, 'r', 'a', 'human', 't', 'add', NULL, NULL, '', '', '{')",
    ],
)
def test_damage_inside_is_named_with_its_file(path: Path, damage: str) -> None:
    with LabelStore.open(path) as store:
        store.apply(pole(), "ann")
    connection = sqlite3.connect(path)
    connection.execute(damage)
    connection.commit()
    connection.close()
    damaged = pytest.raises(SemvizError, match=r"labels\.db: the label file is damaged")
    with damaged, LabelStore.open(path) as store:
        store.operations()


@pytest.mark.parametrize("number", [int, np.float64])
def test_numbers_of_other_types_are_kept_as_those_that_are_read_back(tmp_path, number):
    """A program may give pixels as whole numbers, or as NumPy's."""
    path = tmp_path / "labels.db"
    edit = AddObservation(
        observation_id=new_id(), element_id=new_id(), frame_index=3, side="left",
        anchor_px=(number(100), number(50)), end_px=(number(100), number(200)), class_id=0,
    )  # fmt: skip
    with LabelStore.open(path) as store:
        store.apply(edit, "ann")
        labels = store.labels
    with LabelStore.open(path) as again:
        assert again.labels == labels
