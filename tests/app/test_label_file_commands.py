"""semviz labels check, backup, restore: what they print, and their exit status."""

import json
import sqlite3
from pathlib import Path

import pytest
from command_line import call
from random_edits import pole

from semviz.workspace.workspace import Workspace
from semviz_core.common.errors import SemvizError


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = Workspace.create_street(tmp_path / "street", seed=1, frames=range(3))
    with made.open_labels() as store:
        store.apply(pole(0), "ann")
        store.apply(pole(1), "bea")
    return made


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    return call(capsys, "labels", *arguments)


def test_check_says_what_is_there_and_where_it_breaks(workspace, capsys):
    status, out, _ = run(capsys, "check", workspace.path)
    assert status == 0
    assert "sound; 2 operations, 2 elements, 2 observations; hash " in out
    status, out, _ = run(capsys, "check", workspace.path, "--json")
    said = json.loads(out)
    assert (status, said["operations"], len(said["hash"])) == (0, 2, 64)
    with sqlite3.connect(workspace.labels_path) as connection:
        connection.execute("UPDATE observations SET anchor_u = 8 WHERE frame_index = 1")
    for flags in ([], ["--json"]):
        status, out, err = run(capsys, "check", workspace.path, *flags)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert "labels.db: the label file is damaged (operation 2: " in err


def test_what_a_backup_holds_comes_back(workspace, tmp_path, capsys):
    file = tmp_path / "backup.db"
    assert run(capsys, "backup", workspace.path, file) == (
        0,
        f"{file}: 2 operations, checked\n",
        "",
    )
    with workspace.open_labels() as store:
        before = store.labels
        store.undo("ann")
        status, out, _ = run(capsys, "restore", workspace.path, file)
        kept = workspace.path / "labels-before-restore-3.db"
        assert (status, out.strip()) == (
            0,
            f"{workspace.labels_path}: 2 operations; the replaced file is kept as {kept}",
        )
        assert store.labels == before
    assert kept.is_file()
    status, _, err = run(capsys, "backup", workspace.path, workspace.path / "semviz.toml")
    assert status == 2
    assert "choose another name" in err
    status, _, err = run(capsys, "restore", workspace.path, workspace.path / "semviz.toml")
    assert (status, err) == (2, f"semviz: {workspace.path / 'semviz.toml'}: not a label file\n")


def test_a_log_of_another_sequence_is_refused_before_anything_is_written(
    workspace, tmp_path, capsys
):
    assert run(capsys, "export", workspace.path, tmp_path / "log.jsonl")[0] == 0
    other = Workspace.create_street(tmp_path / "other", seed=1, frames=range(1))
    assert run(capsys, "import", other.path, tmp_path / "log.jsonl") == (
        2,
        "",
        f"semviz: {tmp_path / 'log.jsonl'}: labels of another sequence: 1 of its labelled frames "
        "are not in this one, the first is 1; nothing imported\n",
    )
    with other.open_labels() as store:
        assert store.last_operation == 0


def test_an_unknown_ending_is_refused_with_the_known_ones(workspace, tmp_path, capsys):
    file = tmp_path / "labels.txt"
    assert run(capsys, "export", workspace.path, file) == (
        2,
        "",
        f"semviz: {file}: no format has this ending; take .xml, .json, .csv, .jsonl, or say which "
        "with --format\n",
    )
    assert not file.exists()
    assert run(capsys, "export", workspace.path, file, "--format", "log")[0] == 0


def test_classes_in_a_folder_that_cannot_be_written_are_said_in_plain_words(workspace, monkeypatch):
    """Tests may run as a user whom no mode stops, so SQLite's own error stands for the folder."""
    refused = sqlite3.OperationalError("unable to open database file")
    refused.sqlite_errorcode = sqlite3.SQLITE_CANTOPEN

    def connect(*_: object, **__: object) -> None:
        raise refused

    monkeypatch.setattr(sqlite3, "connect", connect)
    with pytest.raises(SemvizError, match=r"labels\.db or its folder cannot be written; make it"):
        _ = workspace.classes
