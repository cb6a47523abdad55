"""Runs of learned correspondences: made, read, asked again and diagnosed like any other."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call

from semviz.runs.diagnosis import detector_of, frame_diagnosis, truth_of
from semviz.runs.metrics import errors_of
from semviz.runs.reader import load_run
from semviz.what_if.request_changes import UseMethod
from semviz.what_if.solve import solve_with_changes
from semviz_core.base.localization import Match
from semviz_core.diagnosis.frame import check_association
from semviz_core.diagnosis.reference import FrameReference


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("correspondences")


@pytest.fixture
def path(folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = folder / "street" / "runs" / "correspondences.rrd"
    if not path.exists():
        street = folder / "street"
        assert call(capsys, "new", street, "--simulate", 7, "--frames", "0:30")[0] == 0
        status, out, errors = call(
            capsys, "localize", street, "--map", "truth", "--frames", "10:30",
            "--method", "correspondences",
        )  # fmt: skip
        assert status == 0, errors
        assert "correspondences.rrd: " in out
    return path


def test_a_run_stores_poses_status_and_what_was_learned(path: Path) -> None:
    run = load_run(path)
    assert run.info.method == "correspondences"
    errors = [errors_of(record) for record in run.frames]
    near = [error is not None and error.distance_m < 1.0 for error in errors]
    assert sum(near) >= 0.7 * len(run.frames)
    record = run.frames[0]
    was, now = record.localization, solve_with_changes(run, record).localization
    assert was.match is not None
    assert now.match is not None
    assert np.array_equal(was.match.probability, now.match.probability)
    assert (was.status, was.reason) == (now.status, now.reason)


def test_another_run_can_ask_for_it(
    path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = "localize", folder / "street", "--map", "truth", "--frames", "10:12"
    assert call(capsys, *asked)[0] == 0
    run = load_run(folder / "street" / "runs" / "search.rrd")
    changed = solve_with_changes(run, run.frames[0], [UseMethod("correspondences")])
    same = load_run(path).frames[0].localization.match
    assert same is not None
    assert changed.localization.match is not None
    assert np.array_equal(changed.localization.match.probability, same.probability)


def test_the_diagnosis_knows_the_rank_of_true_pairs(path: Path) -> None:
    run = load_run(path)
    assert {frame_diagnosis(run, record).kind for record in run.frames}  # all have one
    record = run.frames[0]
    result, truth = record.localization, truth_of(run, record)
    assert result.match is not None
    case = FrameReference.of(result, run.semantic_map, truth, detector_of(run))
    assert check_association(case) is None
    # planted: the pairs that P prefers are in the opposite order
    worst = Match(result.match.cost, result.match.probability, result.match.order[::-1])
    planted = FrameReference.of(
        replace(result, match=worst), run.semantic_map, truth, detector_of(run)
    )
    fault = check_association(planted)
    assert fault is not None
    assert fault.kind == "wrong matches"
    assert "median rank of the true pairs" in fault.sentence


def test_the_benchmark_has_a_row_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, errors = call(
        capsys, "benchmark", "--methods", "correspondences,true matches", "--frames", 12,
        "--noise", "low", "--no-plots", "--json", "--out", tmp_path,
    )  # fmt: skip
    assert status == 0, errors
    rows = {row["method"]: row for row in json.loads(out)["rows"] if row["stratum"] == "all"}
    assert set(rows) == {"correspondences", "true matches"}
    row = rows["correspondences"]
    assert list(row["stages_ms"]) == ["match", "search", "verify", "refine"]
    assert 0.5 < row["share_below_1m"] <= 1.0
    assert row["coverage"] + row["ambiguous"] + row["cannot"] == pytest.approx(1.0)


def test_it_needs_no_torch() -> None:
    code = (
        "import sys; from semviz import Localizer; Localizer('correspondences');"
        "from semviz_core.localization.correspondences import network;"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
