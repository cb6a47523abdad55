"""Label files of versions 1 and 2 are opened and upgraded, or left as they were."""

import sqlite3
from pathlib import Path

import pytest

from semviz_annotation.labels.edits import (
    AddObservation,
    DecideElements,
    DeleteElement,
    MoveObservation,
    ReviewFrame,
)
from semviz_annotation.labels.labels import new_id
from semviz_annotation.labels.rows import review_decision
from semviz_annotation.storage import database, tables
from semviz_annotation.storage.backup import backup_labels, check_labels, restore_labels
from semviz_annotation.storage.operations import CHANGES, Operation
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

VERSION_1 = """
CREATE TABLE operations (
    number INTEGER PRIMARY KEY,
    request_id TEXT NOT NULL UNIQUE,
    author TEXT NOT NULL,
    origin TEXT NOT NULL CHECK (origin IN ('human', 'machine')),
    time TEXT NOT NULL,
    kind TEXT NOT NULL,
    changes TEXT NOT NULL,
    undoes INTEGER REFERENCES operations,
    redoes INTEGER REFERENCES operations
);
CREATE TRIGGER operations_stay BEFORE UPDATE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TRIGGER operations_last BEFORE DELETE ON operations
    BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END;
CREATE TABLE elements (
    id TEXT PRIMARY KEY,
    number INTEGER NOT NULL UNIQUE,
    class_id INTEGER NOT NULL
);
CREATE TABLE observations (
    id TEXT PRIMARY KEY,
    element_id TEXT NOT NULL REFERENCES elements DEFERRABLE INITIALLY DEFERRED,
    frame_index INTEGER NOT NULL,
    side TEXT NOT NULL CHECK (side IN ('left', 'right')),
    anchor_u REAL NOT NULL,
    anchor_v REAL NOT NULL,
    end_u REAL,
    end_v REAL,
    anchor_known INTEGER NOT NULL,
    end_known INTEGER NOT NULL,
    UNIQUE (element_id, frame_index, side)
);
CREATE TABLE reviews (frame_index INTEGER PRIMARY KEY, state TEXT NOT NULL);
CREATE TABLE counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
INSERT INTO counters VALUES ('next element number', 1);
PRAGMA application_id = 1398164546;
PRAGMA user_version = 1;
PRAGMA journal_mode = WAL;
"""
TABLES = ("elements", "observations", "reviews", "counters")


def pole(frame: int = 0) -> AddObservation:
    return AddObservation(new_id(), new_id(), frame, "left", (1.0, 2.0), (3.0, 40.0), class_id=0)


@pytest.fixture
def known(tmp_path: Path) -> LabelStore:
    """What two people and a machine did: the same in this version."""
    store = LabelStore.open(tmp_path / "known.db", triangle_center="box")
    first, second = pole(0), pole(1)
    store.apply(first, "ann")
    store.apply(second, "bea")
    store.apply(MoveObservation(first.observation_id, (0.1 + 0.2, 1e-300)), "ann")
    store.undo("ann")
    store.redo("ann")
    store.undo("ann")
    store.apply(DeleteElement(second.element_id), "bea")
    store.apply(ReviewFrame(7, "reviewed, empty"), "detector", origin="machine")
    return store


@pytest.fixture
def old(known: LabelStore, path: Path) -> Path:
    """The file of version 1 with the same content."""
    connection = sqlite3.connect(path)
    connection.executescript(VERSION_1)
    for operation in known.operations():
        connection.execute(
            "INSERT INTO operations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", version_1(operation)
        )
    connection.execute("DELETE FROM counters")
    connection.execute("ATTACH ? AS known", (str(known.path),))
    for table in TABLES:
        connection.execute(f"INSERT INTO main.{table} SELECT * FROM known.{table}")
    connection.commit()
    connection.close()
    return path


def version_1(operation: Operation) -> tuple[object, ...]:
    changes = CHANGES.dump_json(operation.changes).decode()
    who = (operation.request_id, operation.author, operation.origin, operation.time)
    return (operation.number, *who, operation.kind, changes, operation.undoes, operation.redoes)


def test_nothing_is_lost_and_the_chain_begins_at_the_first_operation(old, known):
    with LabelStore.open(old) as store:
        assert store.operations() == known.operations()
        assert store.labels == known.labels
        assert store.labels.next_number == known.labels.next_number == 3
        assert (store.undoable("ann"), store.redoable("ann")) == (1, 3)
        assert store.last_writers(store.labels.observations) == known.last_writers(
            known.labels.observations
        )
        store.redo("ann")
    assert contents(old, "sqlite_master") == contents(known.path, "sqlite_master")
    with LabelStore.open(old) as store:
        assert store.last_operation == 9


def contents(path: Path, table: str) -> list[tuple[object, ...]]:
    with sqlite3.connect(path) as connection:
        columns = "type, name, sql" if table == "sqlite_master" else "*"
        return sorted(connection.execute(f"SELECT {columns} FROM {table}"), key=repr)


def dump(path: Path) -> list[str]:
    with sqlite3.connect(path) as connection:
        return [*connection.iterdump(), *map(str, connection.execute("PRAGMA user_version"))]


def test_a_failed_upgrade_leaves_the_file_as_it_was(old, monkeypatch):
    before = dump(old)

    for step in range(1, 8):

        def write(connection: sqlite3.Connection, operation: Operation, step: int = step) -> None:
            if operation.number == step:
                raise sqlite3.OperationalError("disk I/O error")

        monkeypatch.setattr(tables, "write_operation", write)
        with pytest.raises(SemvizError, match=r"Not opened: .*disk I/O error"):
            LabelStore.open(old)
        assert dump(old) == before
    monkeypatch.undo()
    LabelStore.open(old).close()


def test_an_operation_of_version_1_that_cannot_be_read_is_named(old):
    with sqlite3.connect(old) as connection:
        connection.execute("DROP TRIGGER operations_stay")
        connection.execute("UPDATE operations SET changes = '[{}]' WHERE number = 4")
        connection.execute(
            "CREATE TRIGGER operations_stay BEFORE UPDATE ON operations "
            "BEGIN SELECT RAISE(ABORT, 'the log is append-only'); END"
        )
    before = dump(old)
    with pytest.raises(SemvizError, match=r"labels.db: the label file is damaged \(0.before"):
        LabelStore.open(old)
    assert dump(old) == before


def test_an_old_file_is_checked_and_backed_up_as_it_is(old, known, tmp_path):
    before = dump(old)
    assert check_labels(old) == check_labels(known.path)
    backup_labels(old, tmp_path / "backup.db")
    assert dump(old) == before
    _, aside = restore_labels(old, tmp_path / "backup.db")
    assert aside is not None
    assert dump(aside) == before
    with LabelStore.open(old) as store:
        assert store.operations() == known.operations()


@pytest.fixture
def without_decisions(known: LabelStore, tmp_path: Path) -> Path:
    """The file of version 2 with the same content."""
    path = tmp_path / "version_2.db"
    backup_labels(known.path, path)
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE judgements")
        for table in ("notes", "declarations", "attribute_types", "attributes", "outlines"):
            connection.execute(f"DROP TABLE {table}")
        connection.execute("PRAGMA user_version = 2")
    return path


def test_a_file_of_version_2_gets_room_for_decisions_and_loses_nothing(without_decisions, known):
    assert check_labels(without_decisions) == check_labels(known.path)
    with LabelStore.open(without_decisions) as store:
        assert store.operations() == known.operations()
        assert store.labels == known.labels
        (element_id,) = store.labels.elements
        store.apply(DecideElements((review_decision(element_id, "keep"),)), "ann")
    assert contents(without_decisions, "sqlite_master") == contents(known.path, "sqlite_master")
    check_labels(without_decisions)
    with LabelStore.open(without_decisions) as store:
        assert [decision.verdict for decision in store.labels.decisions_of(element_id)] == ["keep"]


def test_an_upgrade_from_version_2_that_fails_leaves_the_file_as_it_was(
    without_decisions, monkeypatch
):
    before = dump(without_decisions)
    monkeypatch.setattr(database, "_SINCE_3", database._SINCE_3 + "CREATE TABLE elements (id);\n")
    with pytest.raises(SemvizError, match=r"Not opened: .*elements already exists"):
        LabelStore.open(without_decisions)
    assert dump(without_decisions) == before
    monkeypatch.undo()
    LabelStore.open(without_decisions).close()
