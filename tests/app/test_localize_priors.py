"""``semviz localize --priors FILE --odometry FILE``: measured priors and odometry in a run."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import call

from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.what_if.change import FrameRequest
from semviz.what_if.solve import solve_with_changes
from semviz.workspace.localization.localize import NO_PRIOR
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.trajectory import save_trajectory
from semviz_core.metrics.pose_errors import pose_error

FRAMES = 10
LACKING = 4
"""A frame without a fix."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("priors") / "street"
    return Workspace.create_street(folder, 7, range(FRAMES))


@pytest.fixture(scope="module")
def priors(workspace: Workspace) -> Path:
    rows = ["frame,x_m,y_m,z_m,heading_deg,horizontal_sigma_m"]
    for frame in workspace.source.frames:
        assert frame.T_map_camera is not None
        x, y, z = frame.T_map_camera.translation
        heading_deg = np.rad2deg(heading_rad(frame.T_map_camera))
        fix = f"{x + 2.0},{y - 1.0},{z}" if frame.index != LACKING else ",,"
        rows.append(f"{frame.index},{fix},{heading_deg},3")
    path = workspace.path.parent / "priors.csv"
    path.write_text("\n".join(rows))
    return path


def odometry(workspace: Workspace, backwards: bool = False) -> Path:
    """Visual odometry in a world of its own; ``backwards``: of a camera that drives the other
    way."""
    elsewhere = Pose.exp([7.0, 8.0, 9.0, 0.0, 0.0, 0.3])
    poses = [elsewhere @ frame.T_map_camera for frame in workspace.source.frames]
    if backwards:
        poses = poses[::-1]
    frames = [
        Frame(frame.index, frame.time_s, pose)
        for frame, pose in zip(workspace.source.frames, poses, strict=True)
    ]
    path = workspace.path.parent / f"odometry-{backwards}.tum"
    save_trajectory(frames, path, "tum")
    return path


def localized(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], *options: object
) -> tuple[Run, str]:
    path = workspace.path / "runs" / "measured.rrd"
    where = ("--out", path, "--map", TRUTH, "--images", "none")
    status, _, errors = call(capsys, "localize", workspace.path, *where, *options)
    assert status == 0, errors
    return load_run(path), errors


def errors_m(run: Run) -> list[float]:
    return [
        pose_error(record.localization.T_camera_map, truth)[0]
        for record, truth in zip(run.frames, run.truths, strict=True)
        if record.localization.T_camera_map is not None and truth is not None
    ]


def test_frames_are_localized_by_measured_fixes(
    workspace: Workspace, priors: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, said = localized(workspace, capsys, "--priors", priors)
    assert f"{FRAMES - 1} of {FRAMES} frames have a prior, {FRAMES - 1} with heading, 0" in said
    assert run.info.options["priors"] == str(priors)
    for record in run.frames:
        prior, truth = record.localization.prior, record.frame.T_map_camera
        assert truth is not None
        if record.frame.index == LACKING:
            assert prior is None
            continue
        assert prior is not None
        off_m = prior.position_m - truth.translation
        assert np.allclose(off_m, [2.0, -1.0, 0.0], atol=1e-9)
        assert (prior.horizontal_sigma_m, prior.up_camera) == (3.0, None)
    assert np.median(errors_m(run)) < 0.1


def test_a_frame_without_fix_is_recorded_as_such(
    workspace: Workspace, priors: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, _ = localized(workspace, capsys, "--priors", priors)
    record = run.frames[LACKING]
    assert record.localization.status == "cannot"
    assert record.localization.reason == NO_PRIOR
    said = frame_diagnosis(run, record)
    assert said.fault.kind == "not in the submap"
    assert "no prior" in said.fault.sentence
    tried = solve_with_changes(run, record).localization  # with a fix where it truly was
    assert tried.status == "ok"
    assert sum(tried.time_ms.values()) < 2000.0  # without compiling
    lost = replace(record, frame=replace(record.frame, T_map_camera=None))
    with pytest.raises(SemvizError, match="has no prior, true pose or estimate"):
        FrameRequest.of(run, lost)
    with pytest.raises(SemvizError, match="has no prior"):
        _ = record.localization.given_prior


def test_the_tracker_follows_the_odometry_of_the_file(
    workspace: Workspace, priors: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, said = localized(
        workspace, capsys, "--priors", priors, "--track", "--odometry", odometry(workspace)
    )
    assert f"{FRAMES - 1} of {FRAMES - 1} motions are known" in said
    assert run.frames[LACKING].localization.status == "ok"  # without a fix
    assert max(errors_m(run)) < 0.2
    for (before, now), record in zip(
        pairwise(workspace.source.frames), run.frames[1:], strict=True
    ):
        assert record.odometry is not None
        step = now.T_map_camera.inverse() @ before.T_map_camera
        assert np.allclose(record.odometry.T_now_before.as_matrix(), step.as_matrix(), atol=1e-9)

    wrong, _ = localized(
        workspace, capsys, "--priors", priors, "--track", "--odometry", odometry(workspace, True)
    )
    right = [frame.localization.status for frame in run.frames].count("ok")
    assert sum(error < 0.2 for error in errors_m(wrong)) < right - 3


def test_priors_without_odometry_simulate_none(
    workspace: Workspace, priors: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, _ = localized(workspace, capsys, "--priors", priors, "--track", "--frames", "0:4")
    assert [record.odometry for record in run.frames] == [None] * 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--priors", "none.csv"), "--priors none.csv: no such file"),
        (("--odometry", "{priors}"), "--odometry is for tracking and rigs; add --track or --rig"),
        (("--priors", "{priors}", "--fix-sigma", "0"), "write numbers above 0"),
        (("--priors", "{far}"), "km from the map: other coordinates"),
        (("--priors", "{late}"), "another clock or unit"),
    ],
)
def test_wrong_files_are_one_line(
    workspace: Workspace,
    priors: Path,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    options: tuple[str, ...],
    message: str,
) -> None:
    far, late = tmp_path / "far.csv", tmp_path / "late.csv"
    far.write_text("frame,x_m,y_m,z_m\n0,458000,5428000,115\n")
    late.write_text("time_s,x_m,y_m,z_m\n1700000000,0,0,1.6\n")
    files = {"priors": priors, "far": far, "late": late}
    given = [option.format(**files) for option in options]
    status, _, errors = call(capsys, "localize", workspace.path, "--map", TRUTH, *given)
    assert status == 2
    assert message in errors
    assert errors.count("\n") == 1
