"""A check finds every planted fault and names the operation; backups and what they bring back."""

import multiprocessing
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_edits import pole

from semviz_annotation.labels.edits import (
    AddMany,
    DecideElements,
    Dismiss,
    MoveObservation,
    ReviewFrame,
)
from semviz_annotation.labels.labels import Dismissal, proposal_id
from semviz_annotation.labels.rows import different_elements, review_decision
from semviz_annotation.storage.backup import backup_labels, check_labels, restore_labels
from semviz_annotation.storage.database import make
from semviz_annotation.storage.operations import CHANGES, sealed
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.classes import NEW_CENTER, TriangleCenter
from semviz_core.common.errors import SemvizError


@pytest.fixture
def file(path: Path) -> Path:
    """Eight operations: five edits (4 and 5 on what 1 and 2 made), undo, redo, a name."""
    first, second = pole(0), pole(1)
    down = Dismissal(
        proposal_id(first.element_id, 1, "left"), 1, "left", "absent", first.element_id
    )
    with LabelStore.open(path) as store:
        store.apply(first, "ann")
        store.apply(AddMany((second, pole(2))), "detector", origin="machine")
        store.apply(ReviewFrame(9, "reviewed, empty"), "bea")
        store.apply(Dismiss((down,)), "bea")
        store.apply(MoveObservation(second.observation_id, (7.0, 2.0)), "ann")
        store.undo("ann")
        store.redo("ann")
        store.name_state("all", "ann")
    return path


def meddle(path: Path, *statements: str) -> None:
    """Change a file behind the store's back, leaving its triggers as they were."""
    connection = sqlite3.connect(path, isolation_level=None)
    kept = connection.execute(
        "SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"
    ).fetchall()
    for name, _ in kept:
        connection.execute(f"DROP TRIGGER {name}")
    for statement in statements:
        connection.execute(statement)
    for _, sql in kept:
        connection.execute(sql)
    connection.close()


def refusal(path: Path) -> str:
    with pytest.raises(SemvizError) as caught:
        check_labels(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_a_sound_file_says_what_it_holds(file):
    found = check_labels(file)
    with LabelStore.open(file) as store:
        assert found.hash == store.operations()[-1].hash
    assert (found.operations, found.elements, found.observations) == (8, 3, 3)
    before = file.read_bytes()
    check_labels(file)
    assert file.read_bytes() == before


@pytest.mark.parametrize("number", range(1, 9))
@pytest.mark.parametrize(
    "change",
    [
        "author = 'eve'",
        "time = '1999'",
        "kind = 'restore'",
        "text = text || '!'",
        "origin = CASE origin WHEN 'human' THEN 'machine' ELSE 'human' END",
        "request_id = '01a1fda4-ce72-7ec6-ab2d-ece8376e7e3d'",
        "hash = substr(hash, 2) || '0'",
        "changes = CASE changes WHEN '[]' THEN '[{\"before\":null,\"after\":null}]' ELSE '[]' END",
        "undoes = CASE WHEN undoes IS NULL THEN 1 END",
    ],
)
def test_any_alteration_of_an_operation_is_named(file, number, change):
    meddle(file, f"UPDATE operations SET {change} WHERE number = {number}")
    words = refusal(file)
    assert f"(operation {number}: its hash is wrong" in words


@pytest.mark.parametrize("number", range(1, 8))
def test_a_missing_operation_is_named(file, number):
    meddle(file, f"DELETE FROM operations WHERE number = {number}")
    assert f"operation {number}: missing" in refusal(file)


def test_a_last_operation_that_is_missing_shows_in_the_tables(file):
    meddle(file, "DELETE FROM operations WHERE number >= 5")
    assert "operation 2: the tables hold another Observation than the log" in refusal(file)


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        (
            "UPDATE observations SET anchor_u = 7.5 WHERE anchor_u = 7",
            "operation 7: the tables hold",
        ),
        (
            "UPDATE elements SET class_id = 2 WHERE number = 1",
            "operation 1: the tables hold another L",
        ),
        ("DELETE FROM reviews", "operation 3: the tables hold another Review"),
        ("DELETE FROM dismissals", "operation 4: the tables hold another Dismissal"),
        ("INSERT INTO reviews VALUES (77, 'reviewed')", "(the tables hold another Review"),
        ("DELETE FROM observations WHERE frame_index = 2", "element 3 would be left without"),
        ("UPDATE counters SET value = 9", "next element number"),
        ("UPDATE writers SET by_human = 0", "the last writers of rows"),
        ("DELETE FROM writers WHERE number = 3", "the last writers of rows"),
        ("UPDATE operations SET changes = '[' WHERE number = 5", "operation 5: Invalid JSON"),
        ("DROP INDEX named", "its tables were altered: named"),
        ("CREATE TRIGGER t AFTER INSERT ON reviews BEGIN SELECT 1; END", "were altered: t"),
        ("ALTER TABLE elements ADD COLUMN more", "its tables were altered: elements"),
        ("PRAGMA application_id = 3", "a SQLite file, but not labels"),
        ("PRAGMA user_version = 9", "labels of version 9, this semviz reads up to 8"),
    ],
)
def test_every_planted_fault_is_found(file, statement, words):
    meddle(file, statement)
    assert words in refusal(file)


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM judgements WHERE other_id IS NULL",
        "UPDATE judgements SET verdict = 'leave out' WHERE other_id IS NULL",
    ],
)
def test_a_decision_that_is_not_what_was_said_is_named(file, statement):
    with LabelStore.open(file) as store:
        element, other, third = sorted(store.labels.elements)
        store.apply(
            DecideElements((different_elements(element, other), review_decision(third, "keep"))),
            "ann",
        )
    check_labels(file)
    meddle(file, statement)
    assert "operation 9: the tables hold another ReviewDecision than the log" in refusal(file)


def test_a_lost_trigger_is_found(file):
    with sqlite3.connect(file) as connection:
        connection.execute("DROP TRIGGER operations_last")
    assert "its tables were altered: operations_last" in refusal(file)


def test_a_forged_chain_still_has_to_make_sense(file):
    with LabelStore.open(file) as store:
        operations = store.operations()
    hash_before = operations[3].hash
    for operation in operations[
        4:
    ]:  # the move becomes a second drawing of 1, and all is sealed anew
        changes = operations[0].changes if operation.number == 5 else operation.changes
        forged = sealed(replace(operation, changes=changes), hash_before)
        hash_before = forged.hash
        text = CHANGES.dump_json(changes).decode()
        meddle(
            file,
            f"UPDATE operations SET hash = '{forged.hash}', changes = '{text}' "
            f"WHERE number = {operation.number}",
        )
    assert "operation 5: element 1 was changed by someone else" in refusal(file)


def test_a_page_that_went_bad_is_found(file):
    content = bytearray(file.read_bytes())
    with sqlite3.connect(file) as connection:
        root, size = connection.execute(
            "SELECT rootpage, page_size FROM sqlite_master, pragma_page_size "
            "WHERE name = 'sqlite_autoindex_observations_1'"
        ).fetchone()
    content[(root - 1) * size + 8 : (root - 1) * size + 12] = b"\xff\xff\xff\xff"
    file.write_bytes(content)
    assert "the label file is damaged" in refusal(file)


# -- backups


def edits(path: Path, count: int) -> None:
    with LabelStore.open(path) as store:
        for frame in range(count):
            store.apply(pole(frame), "ann")


def test_a_backup_is_the_labels_in_one_file(file, tmp_path):
    target = tmp_path / "safe" / "backup.db"
    found = backup_labels(file, target)
    assert found == check_labels(file) == check_labels(target)
    assert [path.name for path in target.parent.iterdir()] == ["backup.db"]
    with LabelStore.open(file) as store, LabelStore.open(target) as copy:
        assert copy.operations() == store.operations()
        assert copy.labels == store.labels


def test_a_backup_while_others_write_is_a_state_that_was(path, tmp_path):
    edits(path, 1)
    done = threading.Event()

    def write() -> None:
        with LabelStore.open(path) as store:
            while not done.is_set():
                store.apply(pole(), "ann")

    writer = threading.Thread(target=write)
    writer.start()
    try:
        target = tmp_path / "backup.db"
        counts = [backup_labels(path, target).operations for _ in range(8)]
    finally:
        done.set()
        writer.join()
    assert counts == sorted(counts)
    assert counts[-1] > counts[0]
    with LabelStore.open(path) as store:
        assert LabelStore.open(target).operations() == store.operations()[: counts[-1]]


def test_only_an_earlier_backup_of_the_same_labels_is_replaced(file, tmp_path):
    target, newer, other = (tmp_path / f"{name}.db" for name in ("backup", "newer", "other"))
    backup_labels(file, target)
    early = tmp_path / "early.db"
    shutil.copy(file, early)
    with LabelStore.open(file) as store:
        store.apply(pole(), "ann")
    assert backup_labels(file, target).operations == 9
    backup_labels(file, newer)
    edits(tmp_path / "elsewhere.db", 2)
    backup_labels(tmp_path / "elsewhere.db", other)
    text = tmp_path / "notes.txt"
    text.write_text("poles")
    for path, taken in ((early, newer), (file, other), (file, text), (file, file), (file, early)):
        before = taken.read_bytes()
        with pytest.raises(SemvizError, match="is no earlier backup of these labels; choose"):
            backup_labels(path, taken)
        assert taken.read_bytes() == before


def test_no_damaged_file_is_backed_up(file, tmp_path):
    target = tmp_path / "backup.db"
    backup_labels(file, target)
    before = target.read_bytes()
    meddle(file, "UPDATE operations SET author = 'eve' WHERE number = 3")
    with pytest.raises(SemvizError, match="operation 3: its hash is wrong"):
        backup_labels(file, target)
    assert target.read_bytes() == before
    with pytest.raises(SemvizError, match="there is no such file"):
        backup_labels(tmp_path / "none.db", target)


# -- restoring


def test_what_is_restored_is_seen_by_who_has_the_file_open(file, tmp_path):
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    with LabelStore.open(file) as store, LabelStore.open(backup) as saved:
        for frame in range(20, 23):
            store.apply(pole(frame), "ann")
        before = store.operations()
        found, aside = restore_labels(file, backup)
        assert (found.operations, aside) == (8, tmp_path / "labels-before-restore-11.db")
        assert store.labels == saved.labels
        assert store.operations() == saved.operations()
        assert store.undoable("ann") == saved.undoable("ann")
        store.apply(pole(30), "bea")
        assert store.undo("ann").number == 10
    assert check_labels(file).operations == 10
    with LabelStore.open(aside) as kept:
        assert kept.operations() == before
    assert restore_labels(file, aside)[1] == tmp_path / "labels-before-restore-10.db"
    with LabelStore.open(file) as store:
        assert store.operations() == before


def test_a_longer_other_log_is_not_taken_for_a_continuation(file, tmp_path):
    edits(tmp_path / "other.db", 30)
    backup_labels(tmp_path / "other.db", tmp_path / "backup.db")
    with LabelStore.open(file) as store, LabelStore.open(tmp_path / "other.db") as other:
        assert len(store.labels.elements) == 3
        restore_labels(file, tmp_path / "backup.db")
        assert store.labels == other.labels
        assert store.last_operation == 30


def test_every_restoring_keeps_what_was_there(file, tmp_path):
    backup_labels(file, tmp_path / "backup.db")
    kept = {restore_labels(file, tmp_path / "backup.db")[1] for _ in range(3)}
    assert {path.name for path in kept if path} == {
        "labels-before-restore-8.db",
        "labels-before-restore-8-2.db",
        "labels-before-restore-8-3.db",
    }
    assert {check_labels(path).operations for path in kept if path} == {8}


def test_labels_are_restored_where_there_are_none(file, tmp_path):
    backup_labels(file, tmp_path / "backup.db")
    file.unlink()
    found, aside = restore_labels(file, tmp_path / "backup.db")
    assert (found.operations, aside) == (8, None)
    assert check_labels(file).operations == 8


def test_no_broken_or_foreign_backup_is_taken(file, tmp_path):
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    meddle(backup, "UPDATE reviews SET state = 'reviewed'")
    text = tmp_path / "notes.txt"
    text.write_text("poles and signs" * 100)
    before = check_labels(file)
    for wrong, words in (
        (backup, r"backup.db: the label file is damaged \(operation 3"),
        (text, "notes.txt: not a label file"),
        (tmp_path / "none.db", "none.db: there is no such file"),
        (file, "these are the labels themselves"),
    ):
        with pytest.raises(SemvizError, match=words):
            restore_labels(file, wrong)
    assert check_labels(file) == before
    assert not list(tmp_path.glob("*before-restore*"))


@pytest.mark.parametrize("fault", ["log", "pages", "header"])
def test_a_damaged_file_is_kept_and_replaced(file, tmp_path, fault):
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    if fault == "log":
        meddle(file, "UPDATE operations SET author = 'eve' WHERE number = 3")
    else:
        content = bytearray(file.read_bytes())
        start = 0 if fault == "header" else 4096
        content[start:] = b"\xaa" * (len(content) - start)
        file.write_bytes(content)
    damaged = file.read_bytes()
    found, aside = restore_labels(file, backup)
    assert check_labels(file) == found
    assert aside is not None
    if fault == "log":
        assert "operation 3" in refusal(aside)
    else:
        assert aside.name == "labels-before-restore-damaged.db"
        assert aside.read_bytes() == damaged
    edits(file, 1)


OPEN_IT = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute("SELECT count(*) FROM operations").fetchone()
print("open", flush=True)
sys.stdin.readline()
"""


def test_a_damaged_file_that_is_in_use_is_not_replaced(file, tmp_path):
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    user = subprocess.Popen(
        [sys.executable, "-c", OPEN_IT, str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert user.stdout is not None
    user.stdout.readline()
    content = bytearray(file.read_bytes())
    content[4096:] = b"\xaa" * (len(content) - 4096)
    file.write_bytes(content)
    with pytest.raises(SemvizError, match=r"labels.db is damaged and another program has it open"):
        restore_labels(file, backup)
    assert file.read_bytes() == content
    user.communicate("\n")
    assert restore_labels(file, backup)[0].operations == 8


def test_a_restoring_that_is_killed_is_done_or_not_begun(file, tmp_path):
    rng = np.random.default_rng(4)
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    edits(file, 3)
    later = tmp_path / "later.db"
    backup_labels(file, later)
    known = {check_labels(value) for value in (backup, later)}
    for trial in range(20):
        source = (backup, later)[trial % 2]
        process = multiprocessing.get_context("fork").Process(
            target=restore_labels, args=(file, source)
        )
        process.start()
        time.sleep(rng.uniform(0.0, 0.06))
        process.kill()
        process.join()
        assert check_labels(file) in known
    assert {check_labels(path) for path in tmp_path.glob("*before-restore*.db")} <= known


def test_a_restoring_that_fails_changes_nothing(file, tmp_path, monkeypatch):
    backup = tmp_path / "backup.db"
    backup_labels(file, backup)
    edits(file, 1)
    before = check_labels(file)

    def full(connection: sqlite3.Connection, center: TriangleCenter = NEW_CENTER) -> None:
        if connection.execute("PRAGMA database_list").fetchone()[2]:  # a file, not in memory
            connection.execute("SELECT raise_it()")
        make(connection, center)

    monkeypatch.setattr("semviz_annotation.storage.database.make", full)
    with pytest.raises(SemvizError, match="Not restored"):
        restore_labels(file, backup)
    assert check_labels(file) == before
