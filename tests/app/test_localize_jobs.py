"""``semviz localize --jobs``: several processes give the same run."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadly_frames import Frames

from semviz.cli import main
from semviz.runs.reader import load_run
from semviz.runs.run import KNOWN_DIAGNOSES, FrameRecord
from semviz.workspace.localization.frame_processes import localized_in_processes
from semviz.workspace.workspace import TRUTH, Workspace

FRAMES = 20


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace.create_street(tmp_path_factory.mktemp("streets") / "street", 5, range(FRAMES))


def localized(workspace: Workspace, out: Path, *options: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["localize", str(workspace.path), "--map", TRUTH, "--out", str(out), *options])
    return int(ended.value.code or 0)


def content(record: FrameRecord) -> list[object]:
    found = record.localization
    pose = None if found.T_camera_map is None else found.T_camera_map.translation.tobytes()
    covariance = None if found.covariance is None else found.covariance.tobytes()
    scores = None if found.search is None else found.search.score.tobytes()
    return [
        record.frame.index, found.status, found.reason, pose, covariance, scores,
        found.observed.anchor_px.tobytes(), found.submap.id.tobytes(),
        record.image, KNOWN_DIAGNOSES[record].sentence,
    ]  # fmt: skip


def test_two_processes_give_the_run_of_one(workspace: Workspace, tmp_path: Path) -> None:
    runs = []
    for jobs in ("1", "2"):
        assert localized(workspace, tmp_path / f"{jobs}.rrd", "--jobs", jobs) == 0
        runs.append(load_run(tmp_path / f"{jobs}.rrd"))
    one, two = ([content(record) for record in run.frames] for run in runs)
    assert len(one) == FRAMES
    assert one == two
    assert runs[0].info.options == runs[1].info.options
    assert np.sum([record.localization.status == "ok" for record in runs[0].frames]) > 5


@pytest.mark.parametrize(
    ("options", "said"),
    [(("--jobs", "0"), "--jobs 0: give 1 or more"), (("--jobs", "2", "--track"), "--jobs is for")],
)
def test_what_cannot_be_shared_is_refused(
    workspace: Workspace,
    tmp_path: Path,
    options: tuple[str, ...],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert localized(workspace, tmp_path / "none.rrd", *options) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "none.rrd").exists()


def test_a_killed_process_costs_no_frame(capfd: pytest.CaptureFixture[str]) -> None:
    told: Any = list(localized_in_processes(Frames(deadly=40), 100, 2))
    assert [record.row for record in told] == list(range(100))
    assert {record.process for record in told[48:]} == {os.getpid()}
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert "a process of localize died (out of memory?) at frame" in said


def test_ctrl_c_is_for_the_first_process_alone() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        told: Any = list(localized_in_processes(Frames(), 20, 2))
        assert {record.interrupt for record in told} == {signal.SIG_IGN}
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
