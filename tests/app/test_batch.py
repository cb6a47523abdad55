"""A batch counts what is done once, whatever dies and whoever does it too."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from slow_drives import slow_command

from semviz.batch.batch import BatchCommand, DriveBatch, DriveOutcome, Plan
from semviz.batch.evaluation import BatchEvaluation
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive
from semviz.commands.batch import run_command
from semviz.workspace.workspace import Workspace
from semviz_core.common.errors import SemvizError


@pytest.fixture
def collection(tmp_path: Path) -> Collection:
    return Collection.create(tmp_path / "city")


def run_of(drive: str) -> bytes:
    return f"{drive}.rrd".encode() * 1000


def test_goes_on_with_the_same_plan_and_refuses_another(collection: Collection) -> None:
    plan = Plan("localize", ("--method", "search"), map_version=3)
    assert DriveBatch.begin(collection, "june", plan) == DriveBatch.begin(collection, "june", plan)
    with pytest.raises(SemvizError, match="options --method search, not none"):
        DriveBatch.begin(collection, "june", replace(plan, options=()))


def test_names_the_batches_that_there_are(collection: Collection) -> None:
    DriveBatch.begin(collection, "june", Plan("detect"))
    with pytest.raises(SemvizError, match="no batch july; choose from june"):
        DriveBatch.open(collection, "july")


def test_options_hold_the_name_of_the_drive() -> None:
    plan = Plan("localize", ("--priors", "{workspace}/{drive}.csv"))
    assert plan.options_for(Drive("may", "/data/may")) == ["--priors", "/data/may/may.csv"]


def test_work_stores_a_run_then_that_it_is_done(collection: Collection) -> None:
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    work = Work(collection.where, "june", slow_command)
    outcome = work(Drive("may", "/data/may"))
    assert not outcome.failure
    assert not outcome.was_done
    assert batch.store.read(batch.output("runs", "may")) == run_of("may")
    again = work(Drive("may", "/data/may"))
    assert again.was_done
    assert again.printed == outcome.printed


def interrupted_command(command: BatchCommand, arguments: list[str]) -> int:
    """Work that is killed after its output, before anybody knows that it is done."""
    slow_command(command, arguments)
    raise KeyboardInterrupt


def test_what_was_killed_between_output_and_done_is_done_again(collection: Collection) -> None:
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    with pytest.raises(KeyboardInterrupt):
        Work(collection.where, "june", interrupted_command)(Drive("may", "/data/may"))
    assert batch.outcome("may") is None
    batch.store.write_new(batch.output("runs", "may"), b"of labels of that time")
    assert not Work(collection.where, "june", slow_command)(Drive("may", "")).failure
    assert batch.store.read(batch.output("runs", "may")) == run_of("may")


def test_of_two_that_do_a_drive_at_once_the_first_counts(collection: Collection) -> None:
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    first = DriveOutcome("may", printed={"process": 1})

    def overtaken(command: BatchCommand, arguments: list[str]) -> int:
        batch.finish(first, {})
        return slow_command(command, arguments)

    outcome = Work(collection.where, "june", overtaken)(Drive("may", "/data/may"))
    assert outcome == replace(first, was_done=True)
    assert batch.outcome("may") == outcome


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (SemvizError("/data/may: no such workspace"), "/data/may: no such workspace (on "),
        (OSError(28, "No space left on device", "/tmp/may.rrd"), "/tmp/may.rrd: No space left"),
        (MemoryError(), "out of memory (on "),
        (ZeroDivisionError("division by zero"), "unexpected ZeroDivisionError: division by zero"),
    ],
)
def test_a_failure_is_told_and_stores_nothing(
    collection: Collection, error: Exception, reason: str
) -> None:
    def failing(command: BatchCommand, arguments: list[str]) -> int:
        raise error

    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    outcome = Work(collection.where, "june", failing)(Drive("may", "/data/may"))
    assert outcome.failure.startswith(reason)
    assert collection.store.keys("batches/") == [batch.key("plan.json")]


def test_another_version_of_semviz_does_nothing(collection: Collection) -> None:
    DriveBatch.begin(collection, "june", Plan("localize", semviz="0.0.1"))
    outcome = Work(collection.where, "june", slow_command)(Drive("may", "/data/may"))
    assert "the batch was begun with 0.0.1" in outcome.failure


def test_a_damaged_plan_is_named(collection: Collection) -> None:
    collection.store.write_new("batches/june/plan.json", b"{")
    with pytest.raises(SemvizError, match=r"batches/june/plan.json: no plan of a batch"):
        DriveBatch.open(collection, "june")


def test_a_damaged_result_is_named(collection: Collection) -> None:
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    batch.store.write_new(batch.key("done", "may.json"), b'{"printed": {}}')
    with pytest.raises(SemvizError, match=r"done/may.json: damaged; delete it"):
        batch.done_before()


def test_without_a_table_nothing_is_evaluated(collection: Collection) -> None:
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    with pytest.raises(SemvizError, match="no run could be evaluated"):
        BatchEvaluation.of(batch)


ON_A_FULL_DISK = """
import resource, sys
from semviz.batch.work import Work
from semviz.collection.collection import Collection
from semviz.commands.batch import run_command
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000,) * 2)
(drive,) = Collection.open(sys.argv[1]).drives()
print(Work(sys.argv[1], "june", run_command)(drive).failure)
"""


def test_a_full_disk_loses_nothing(tmp_path: Path) -> None:
    Workspace.create_street(tmp_path / "may", seed=5, frames=range(6))
    collection = Collection.create(tmp_path / "city", [tmp_path / "may"])
    batch = DriveBatch.begin(
        collection, "june", Plan("localize", ("--observations", "simulated", "--map", "truth"))
    )
    command = [sys.executable, "-c", ON_A_FULL_DISK, collection.where]
    failure = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "is the disk full?" in failure or "File too large" in failure
    assert batch.drives_with("runs") == [one.drive for one in batch.done_before()] == []
    (drive,) = collection.drives()
    assert not Work(collection.where, "june", run_command)(drive).failure
    assert batch.drives_with("runs") == ["may"]
