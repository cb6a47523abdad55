"""A batch on a Ray cluster of several machines, which are processes of this one."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from command_line import call
from slow_drives import deadly_command, slow_command

from semviz.batch.batch import DriveBatch, DriveOutcome, Plan
from semviz.batch.cluster import Cluster
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive
from semviz.workspace.workspace import Workspace

TESTS = str(Path(__file__).parents[1])
FIGURES = ("frames", "status", "rte_m", "rre_deg", "share_below_1m", "diagnoses")


@contextmanager
def cluster(others: int) -> Iterator[Any]:
    """A cluster of a head and so many other machines, of one core each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster as Machines

    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [TESTS, before]))  # of its workers
    head = {"num_cpus": 1, "include_dashboard": False}
    machines = Machines(initialize_head=True, head_node_args=head)
    for _ in range(others):
        machines.add_node(num_cpus=1)
    yield machines
    machines.shutdown()
    os.environ.pop("PYTHONPATH")
    if before is not None:
        os.environ["PYTHONPATH"] = before


@pytest.fixture(scope="module")
def machines() -> Iterator[Any]:
    with cluster(1) as machines:
        yield machines


NAMES = [f"d{number:02}" for number in range(60)]
"""Of the drives of ``batch_driver``."""


def drives(count: int) -> list[Drive]:
    return [Drive(f"d{number:02}", "/nowhere") for number in range(count)]


def workers() -> list[psutil.Process]:
    """The processes that work on drives."""
    found = psutil.process_iter(["cmdline"])
    return [one for one in found if (one.info["cmdline"] or [""])[0].startswith("ray::_call")]


def kill_some(count: int, stop: threading.Event) -> None:
    """Kill so many workers, one after the other."""
    choice = random.Random(0)
    while count and not stop.wait(0.3):
        if found := workers():
            choice.choice(found).send_signal(signal.SIGKILL)
            count -= 1


def test_what_dies_is_done_again_and_once(machines: Any, tmp_path: Path) -> None:
    collection = Collection.create(tmp_path / "city")
    batch = DriveBatch.begin(collection, "june", Plan("localize"))
    stop, lines = threading.Event(), list[str]()
    killer = threading.Thread(target=kill_some, args=(5, stop))
    killer.start()
    outcomes = list[DriveOutcome]()
    lost = machines.add_node(num_cpus=1)
    work = Work(collection.where, "june", slow_command)
    for outcome in Cluster(machines.address, tries=9).run(work, drives(40), lines.append):
        outcomes.append(outcome)
        if len(outcomes) == 5:
            machines.remove_node(lost, allow_graceful=False)
    stop.set()
    killer.join()
    names = [drive.name for drive in drives(40)]
    assert sorted(outcome.drive for outcome in outcomes) == names
    assert not any(outcome.failure for outcome in outcomes)
    assert batch.drives_with("runs") == [one.drive for one in batch.done_before()] == names
    assert lines
    assert all("begun again" in line for line in lines)


def test_a_drive_that_always_kills_its_worker_fails_alone(machines: Any, tmp_path: Path) -> None:
    collection = Collection.create(tmp_path / "city")
    DriveBatch.begin(collection, "june", Plan("localize"))
    work = Work(collection.where, "june", deadly_command)
    lines = list[str]()
    outcomes = Cluster(machines.address, tries=2).run(work, drives(3), lines.append)
    failures = {outcome.drive: outcome.failure for outcome in outcomes if outcome.failure}
    assert failures == {"d01": "its worker died (out of memory?), 2 times"}
    assert lines == ["d01: its worker died (out of memory?); begun again"]


def driver(machines: Any, where: Path) -> subprocess.Popen[str]:
    """A process that runs the same batch."""
    arguments = [sys.executable, f"{TESTS}/batch_driver.py", machines.address, str(where)]
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)


def test_two_drivers_of_one_batch_one_of_them_killed(machines: Any, tmp_path: Path) -> None:
    collection = Collection.create(tmp_path / "city")
    both = driver(machines, tmp_path / "city"), driver(machines, tmp_path / "city")
    assert both[0].stdout is not None
    assert both[0].stdout.readline().endswith(" done\n")
    both[0].kill()
    lines = both[1].communicate(timeout=200)[0].splitlines()
    assert both[1].returncode == 0
    assert lines
    assert all(line.endswith(" done") for line in lines)
    batch = DriveBatch.open(collection, "june")
    assert batch.drives_with("runs") == [one.drive for one in batch.done_before()] == NAMES
    assert driver(machines, tmp_path / "city").communicate(timeout=200)[0] == ""
    for name in NAMES:
        assert collection.store.read(batch.output("runs", name)) == f"{name}.rrd".encode() * 1000


def test_the_head_dies_and_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_gcs_rpc_server_reconnect_timeout_s", "5")  # not a minute
    collection = Collection.create(tmp_path / "city")
    with cluster(0) as machines:
        first = driver(machines, tmp_path / "city")
        assert first.stdout is not None
        done = {first.stdout.readline().split()[0]}
        machines.head_node.kill_gcs_server()
        done |= {line.split()[0] for line in first.communicate(timeout=200)[0].splitlines()}
        assert first.returncode != 0
    batch = DriveBatch.open(collection, "june")
    assert done <= {one.drive for one in batch.done_before()} < set(NAMES)
    with cluster(0) as machines:
        second = driver(machines, tmp_path / "city")
        again = {line.split()[0] for line in second.communicate(timeout=200)[0].splitlines()}
    assert second.returncode == 0
    assert not done & again
    assert batch.drives_with("runs") == [one.drive for one in batch.done_before()] == NAMES


def test_a_collection_is_localized_and_evaluated(
    machines: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [tmp_path / name for name in ("april", "may", "june")]
    for seed, folder in enumerate(folders):
        Workspace.create_street(folder, seed=seed, frames=range(6))
    Collection.create(tmp_path / "city", folders)
    settings = folders[1] / "semviz.toml"
    whole = settings.read_bytes()
    settings.write_bytes(whole[:20])

    options = ("--observations", "simulated", "--map", "truth", "--images", "none")
    command = "batch", "localize", tmp_path / "city", "--ray", machines.address, "--json"
    status, output, errors = call(capsys, *command, "--", *options)
    said = json.loads(output)
    assert (status, said["done"]) == (1, 2)
    assert list(said["failed"]) == ["may"]
    assert errors.startswith("may failed: ")
    assert "semviz.toml" in errors

    settings.write_bytes(whole)
    status, output, _ = call(capsys, *command, "--", *options)
    said = json.loads(output)
    assert (status, said["done"], said["done_before"]) == (0, 3, 2)
    assert sum(said["status"].values()) == 18

    evaluate = "batch", "evaluate", tmp_path / "city", "--ray", machines.address, "--json"
    frames = tmp_path / "frames.parquet"
    status, output, _ = call(capsys, *evaluate, "--frames", frames)
    evaluated = json.loads(output)
    assert (status, evaluated["frames"]) == (0, 18)
    assert frames.read_bytes().startswith(b"PAR1")
    for folder, drive in zip(sorted(folders), evaluated["drives"], strict=True):
        assert call(capsys, "localize", folder, *options)[0] == 0
        alone = json.loads(call(capsys, "evaluate", folder / "runs" / "search.rrd", "--json")[1])
        assert drive["drive"] == folder.name
        for figure in FIGURES:
            assert drive[figure] == pytest.approx(alone[figure], rel=1e-9), figure
