"""Runs of other localizers: recorded frame by frame in Python, and from files by a command."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from small_runs import small_run
from support.planted_runs import plant_in_run

from semviz import MatchedPose, RunRecorder, load_run
from semviz.runs.comparison import compare_runs
from semviz.runs.diagnosis import (
    DetectionErrors,
    diagnosis_card,
    frame_diagnosis,
    run_diagnosis,
)
from semviz.runs.run import FrameRecord, Run
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.trajectory import save_trajectory
from semviz_core.research.evaluation.roads import simulated_road

REPOSITORY = Path(__file__).parents[2]


def true_matches(record: FrameRecord) -> np.ndarray:
    rows = np.flatnonzero(record.element_id >= 0)
    return np.column_stack([rows, record.element_id[rows]])


def as_foreign(record: FrameRecord, **changes: object) -> MatchedPose:
    """The frame as another localizer, which found the true pose, would return it."""
    truth = record.frame.T_map_camera
    assert truth is not None
    known = MatchedPose(record.localization.observed, truth.inverse(), true_matches(record))
    return replace(known, **changes)  # type: ignore[arg-type]


def recorded(path: Path, run: Run, **changes: object) -> Run:
    with RunRecorder(path, run.semantic_map, run.info.rig, "theirs") as recorder:
        for record in run.frames:
            recorder.add(
                record.frame.index,
                as_foreign(record, **changes),
                truth=record.frame.T_map_camera,
                element_id=record.element_id,
            )
    return load_run(path)


def test_a_recorded_run_is_measured_compared_and_diagnosed(tmp_path: Path) -> None:
    run = small_run()
    theirs = recorded(tmp_path / "theirs.rrd", run)
    assert theirs.complete
    assert theirs.info.method == "theirs"
    for record, ours in zip(theirs.frames, run.frames, strict=True):
        result = record.localization
        assert result.prior is None
        assert result.match is not None
        assert np.allclose(result.match.probability[:-1].sum(axis=1), 1.0)
        assert np.array_equal(result.observed.anchor_px, ours.localization.observed.anchor_px)
        assert frame_diagnosis(theirs, record).fault.kind == "healthy"
    assert compare_runs(run, theirs).as_dict()


def test_wrong_matches_of_a_localizer_are_named(tmp_path: Path) -> None:
    run = small_run()
    record = next(frame for frame in run.frames if len(true_matches(frame)) >= 6)
    matches = true_matches(record)
    classes = dict(zip(*record.localization.submap.id[None], record.localization.submap.class_id,
                       strict=True))  # fmt: skip
    poles = np.flatnonzero([classes.get(int(id_)) == 0 for id_ in matches[:, 1]])
    matches[poles, 1] = np.roll(matches[poles, 1], 1)  # planted
    with RunRecorder(tmp_path / "wrong.rrd", run.semantic_map, run.info.rig, "theirs") as recorder:
        off = record.frame.T_map_camera
        assert off is not None
        moved = replace(off, translation=off.translation + np.array([4.0, 2.0, 0.0])).inverse()
        recorder.add(
            record.frame.index,
            as_foreign(record, matches=matches, T_camera_map=moved),
            truth=off,
            element_id=record.element_id,
        )
    wrong = load_run(tmp_path / "wrong.rrd")
    assert frame_diagnosis(wrong, wrong.frames[0]).fault.kind == "wrong matches"


def test_poles_whose_bottoms_are_hidden_fit_their_elements(tmp_path: Path) -> None:
    """A car hides half of the bottoms, and the detector takes what it sees for the bottom."""
    planted = plant_in_run("healthy", 2001, simulated_road(2001), 12)
    assert planted is not None
    camera = planted.frames[0][0].camera
    with RunRecorder(tmp_path / "theirs.rrd", planted.semantic_map, camera, "theirs") as recorder:
        for index, (result, truth) in enumerate(planted.frames):
            pose, ids = truth.T_camera_map, truth.element_id
            assert ids is not None
            rows = np.flatnonzero(ids >= 0)
            matched = MatchedPose(result.observed, pose, np.column_stack([rows, ids[rows]]))
            recorder.add(index, matched, truth=pose.inverse(), element_id=ids)
    run = load_run(tmp_path / "theirs.rrd")
    fits = [frame.localization.refinement for frame in run.frames]
    inlier = np.concatenate([fit.inlier for fit in fits if fit is not None])
    assert inlier.mean() > 0.95
    assert run_diagnosis(run).elements == ()
    card = diagnosis_card(run, run.frames[0], DetectionErrors((), ()))
    assert "Outliers, true pose" not in dict(card.rows)


def test_an_exception_leaves_a_partial_run(tmp_path: Path) -> None:
    run, path = small_run(), tmp_path / "theirs.rrd"

    def interrupted() -> None:
        with RunRecorder(path, run.semantic_map, run.info.rig, "theirs") as recorder:
            recorder.add(0, as_foreign(run.frames[0]))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        interrupted()
    assert not path.exists()
    partial = load_run(tmp_path / "theirs.partial.rrd")
    assert (len(partial.frames), partial.complete) == (1, False)


def test_mistakes_are_one_clear_line(tmp_path: Path) -> None:
    run = small_run()
    record = run.frames[0]
    with pytest.raises(SemvizError, match=r"ends in \.rrd"):
        RunRecorder("theirs", run.semantic_map, run.info.rig, "theirs")
    closed = RunRecorder(tmp_path / "a.rrd", run.semantic_map, run.info.rig, "theirs")
    with pytest.raises(SemvizError, match="with RunRecorder"):
        closed.add(0, as_foreign(record))
    with closed as recorder:
        recorder.add(3, as_foreign(record))
        for found, message in (
            (as_foreign(record, matches=[(0, 99999)]), "element 99999, which is not in the map"),
            (as_foreign(record, status="cannot"), "does not go with a pose"),
        ):
            with pytest.raises(SemvizError, match=message):
                recorder.add(4, found)
        with pytest.raises(SemvizError, match="after frame 3"):
            recorder.add(3, as_foreign(record))
        with pytest.raises(SemvizError, match="images=True"):
            recorder.add(4, as_foreign(record), image=b"")
    with pytest.raises(SemvizError, match="row 77 of"):
        as_foreign(record, matches=[(77, 0)])


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("theirs") / "street"
    return Workspace.create_street(folder, 7, range(4))


def written(workspace: Workspace, kind: str) -> tuple[Path, Path]:
    """True poses as estimates, and true matches, as files."""
    poses, matches = workspace.path / "poses.tum", workspace.path / f"matches.{kind}"
    frames = workspace.source.frames
    save_trajectory([frame for frame in frames if frame.index != 2], poses, "tum")
    rows = []
    for frame in frames:
        observed, ids = workspace.street.labels(frame.index, "left")
        for row, id_ in enumerate(ids.tolist()):
            (u, v), (end_u, end_v) = observed.anchor_px[row].tolist(), observed.end_px[row].tolist()
            ends = ("", "") if np.isnan(end_u) else (end_u, end_v)
            rows.append((frame.index, u, v, *ends, id_))
    names = ("frame", "u_px", "v_px", "end_u_px", "end_v_px", "element")
    if kind == "json":
        matches.write_text(json.dumps([dict(zip(names, row, strict=True)) for row in rows]))
    else:
        matches.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]))
    return poses, matches


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_the_command_records_files(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    poses, matches = written(workspace, kind)
    out = workspace.path / "runs" / f"{kind}.rrd"
    status, output, errors = call(
        capsys, "record", workspace.path, "--map", TRUTH, "--poses", poses, "--matches", matches,
        "--out", out, "--method", "theirs", "--priors", poses,
    )  # fmt: skip
    assert status == 0, errors
    assert "3 ok, 1 cannot" in output
    run = load_run(out)
    assert [record.localization.status for record in run.frames] == ["ok", "ok", "cannot", "ok"]
    first = run.frames[0]
    assert first.image is not None
    assert first.localization.prior is not None
    fit = first.localization.refinement
    assert fit is not None
    assert len(fit.pairs) == len(first.localization.observed) > 3
    assert np.nanmax(np.abs(fit.residual_px[fit.inlier])) < 3.0
    assert np.mean(fit.inlier) > 0.7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,u_px\n0,1\n", "no column v_px"),
        ("frame,u_px,v_px,element\n0,1,2,99999\n", "row 1: the map has no element 99999"),
        ("frame,u_px,v_px,element\n0,x,2,1\n", "row 1: u_px 'x' is not a finite number"),
        ("frame,u_px,v_px,class\n0,1,2,lamp\n", "row 1: unknown class lamp; known are 0 or pole"),
        ("frame,u_px,v_px,class\n99,1,2,pole\n", "frame 99, which the workspace does not have"),
        ("frame,u_px,v_px,class\n1.5,1,2,pole\n", "row 1: frame is 1.5; give a whole number"),
        ("frame,u_px,v_px,class,sigma_px\n1,1,2,pole,0\n", "sigma_px is 0; give a number above"),
        ("frame,u_px,v_px,class,end_u_px\n1,1,2,pole,3\n", "an end needs both end_u_px and end_v"),
        (f"frame,u_px,v_px\n1,{'1' * 200_000},2\n", "not a CSV table (field larger than"),
        (f'[{{"frame": 1{"0" * 400}}}]', "frame '1000"),
    ],
)
def test_broken_matches_are_one_line(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    poses, _ = written(workspace, "csv")
    matches = workspace.path / ("broken.json" if text.startswith("[") else "broken.csv")
    matches.write_text(text)
    status, _, errors = call(
        capsys, "record", workspace.path, "--map", TRUTH, "--poses", poses, "--matches", matches,
        "--out", workspace.path / "broken.rrd",
    )  # fmt: skip
    assert status == 2
    assert message in errors
    assert errors.count("\n") == 1


@pytest.mark.realdata
def test_a_model_of_colmap_becomes_a_run(drives: Path, tmp_path: Path) -> None:
    model, out = drives / "utbm_stereo" / "sparse_text", tmp_path / "hloc.rrd"
    script = REPOSITORY / "docs" / "examples" / "colmap_to_run.py"
    subprocess.run([sys.executable, script, model, out], check=True, timeout=120)
    run = load_run(out)
    assert len(run.frames) == 5
    for record in run.frames:
        fit = record.localization.refinement
        assert fit is not None
        assert fit.inlier.mean() > 0.95  # COLMAP's own points under its own poses
        assert np.median(np.abs(fit.residual_px)) < 0.5
