"""A batch sees what changed in a drive since it was done, and does it again."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import call
from labelled_street import label_street
from slow_drives import slow_command

from semviz.batch.batch import BatchCommand, DriveBatch, DriveOutcome, Plan
from semviz.batch.cluster import Cluster
from semviz.batch.inputs import inputs_of
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive
from semviz.workspace.poses.pose_choices import FILE as POSE_CHOICES
from semviz.workspace.workspace import Workspace

FRAMES = range(6)


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    made = []
    for name in ("june", "may"):
        workspace = Workspace.create_street(tmp_path / name, seed=5, frames=FRAMES)
        label_street(workspace, workspace.street, FRAMES[:4])
        made.append(workspace.path)
    return made


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The work is done in this process."""
    monkeypatch.setattr(Cluster, "run", lambda self, work, drives, tell: map(work, drives))
    monkeypatch.setattr("semviz.commands.batch.require_extra", lambda *given: None)


def label_more(folder: Path) -> None:
    workspace = Workspace.open(folder)
    label_street(workspace, workspace.street, FRAMES[4:])


@pytest.mark.usefixtures("at_once")
def test_a_drive_whose_labels_changed_is_mapped_and_published_again(
    tmp_path: Path, folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    collection = Collection.create(tmp_path / "city", folders)
    assert call(capsys, "batch", "map", collection.where)[0] == 0
    batch = DriveBatch.open(collection, "map")
    before = [collection.store.read(batch.output("maps", name)) for name in ("june", "may")]
    label_more(folders[0])
    status, output, errors = call(capsys, "batch", "map", collection.where)
    assert status == 0
    assert errors.startswith("june: labels changed since; done again")
    assert "may" not in errors
    assert "2 of 2 drives done (1 of them before)" in output
    assert "version 2 of the map" in output
    after = [collection.store.read(batch.output("maps", name)) for name in ("june", "may")]
    assert [one == other for one, other in zip(before, after, strict=True)] == [False, True]
    assert "version 2 of the map" in call(capsys, "batch", "map", collection.where)[1]


@pytest.mark.usefixtures("at_once")
def test_a_run_is_told_that_is_of_earlier_labels(
    tmp_path: Path, folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    collection = Collection.create(tmp_path / "city", folders[:1])
    options = "--", "--observations", "simulated", "--map", "truth", "--images", "none"
    assert call(capsys, "batch", "localize", collection.where, *options)[0] == 0
    label_more(folders[0])
    status, output, errors = call(capsys, "batch", "evaluate", collection.where, "--json")
    assert status == 0
    assert json.loads(output)["frames"] == len(FRAMES)
    assert errors == (
        "june: labels changed since it was localized; 'semviz batch localize' does it again\n"
    )
    assert call(capsys, "batch", "localize", collection.where, *options)[0] == 0
    assert DriveBatch.open(collection, "localize").drives_with("frames") == []
    assert call(capsys, "batch", "evaluate", collection.where, "--json")[2] == ""


def replace_poses(folder: Path) -> None:
    (folder / POSE_CHOICES).write_text("{}")


def replace_map(folder: Path) -> None:
    (folder / "maps" / "truth.parquet").write_bytes(b"another")


def build_another_map(folder: Path) -> None:
    (folder / "maps" / "other.parquet").write_bytes(b"another")


def replace_fixes(folder: Path) -> None:
    (folder / "fixes.csv").write_text("another")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (label_more, "labels"),
        (replace_poses, POSE_CHOICES),
        (replace_map, "map truth"),
        (replace_fixes, "/fixes.csv"),
        (build_another_map, None),
    ],
)
def test_what_localize_reads_counts(
    folders: list[Path], change: Callable[[Path], None], name: str | None
) -> None:
    plan = Plan("localize", ("--map=truth", "--priors", "{workspace}/fixes.csv"))
    drive = Drive("june", str(folders[0]))
    before = inputs_of(plan, drive)
    change(folders[0])
    now = inputs_of(plan, drive)
    changed = [one for one in {*before, *now} if before.get(one) != now.get(one)]
    assert len(changed) == (name is not None)
    assert all(one.endswith(str(name)) for one in changed)


def test_nothing_is_stored_of_a_drive_that_changes_meanwhile(
    tmp_path: Path, folders: list[Path]
) -> None:
    collection = Collection.create(tmp_path / "city", folders)
    batch = DriveBatch.begin(collection, "june", Plan("localize"))

    def edited_meanwhile(command: BatchCommand, arguments: list[str]) -> int:
        label_more(folders[0])
        return slow_command(command, arguments)

    outcome = Work(collection.where, "june", edited_meanwhile)(collection.drives()[0])
    assert outcome.failure.startswith("labels changed meanwhile; run the command again")
    assert batch.drives_with("runs") == batch.done_before() == []


@pytest.mark.usefixtures("at_once")
def test_a_drive_that_is_out_of_reach_stays_done(
    tmp_path: Path, folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    collection = Collection.create(tmp_path / "city", folders)
    batch = DriveBatch.begin(collection, "localize", Plan("localize"))
    for drive in collection.drives():
        batch.finish(DriveOutcome(drive.name, inputs=inputs_of(batch.plan, drive)), {})
    folders[0].rename(tmp_path / "away")
    status, output, errors = call(capsys, "batch", "localize", collection.where)
    assert status == 0
    assert "2 of 2 drives done (2 of them before)" in output
    assert errors == (
        "workspaces of 1 drives that are done cannot be read here; whether they have changed is "
        "not known\n"
    )
