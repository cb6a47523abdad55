"""``semviz poses``: a fault planted into poses is found in rendered images, and refined away; the
motions of the images are measured once; nothing of the workspace changes."""

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_line import Call, call
from streets import street
from support.planted_pose_faults import moved
from support.street_labels import careful, label_street
from turned_drive import COUNT, SEED, TURNED, drive, wrong_poses

from semviz.workspace.poses.pose_labels import label_evidence
from semviz.workspace.poses.pose_review import check_poses, motions_path
from semviz.workspace.workspace import Workspace
from semviz_core.base.pose import Pose
from semviz_core.datasets.trajectory import load_trajectory, save_trajectory

__all__ = ["drive", "wrong_poses"]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of one command."""
    return partial(call, capsys)


def test_healthy_poses_pass_the_gate_and_motions_are_measured_once(
    run: Call, drive: Path, tmp_path: Path
) -> None:
    folder, plot = tmp_path / "town", tmp_path / "town.png"
    run("new", folder, "--kitti", drive)
    status, output, errors = run("poses", "check", folder, "--gate", "--plot", plot)
    assert (status, errors) == (0, "")
    assert "no fault found" in output
    assert plot.read_bytes().startswith(b"\x89PNG")
    file = motions_path(Workspace.open(folder))
    before = file.stat().st_mtime_ns
    status, output, _ = run("poses", "check", folder, "--json")
    found = json.loads(output)
    assert found["faults"] == []
    assert len(found["pairs"]) == COUNT - 1
    assert file.stat().st_mtime_ns == before
    image = drive / "sequences" / "02" / "image_2" / "000003.png"
    os.utime(image)  # another image, for all that is known
    run("poses", "check", folder)
    assert file.stat().st_mtime_ns != before


def test_turned_poses_are_named_refined_and_used(
    run: Call, drive: Path, wrong_poses: Path, tmp_path: Path
) -> None:
    folder, refined = tmp_path / "town", tmp_path / "refined.tum"
    status, _, errors = run(
        "new", folder, "--kitti", drive, "--poses", wrong_poses, "--check-poses"
    )
    assert status == 0
    assert "frames 5-7: poses turned by up to 0.7 deg" in errors
    settings = (folder / "semviz.toml").read_bytes()
    status, output, _ = run("poses", "check", folder, "--gate", "--json")
    assert status == 1
    (fault,) = json.loads(output)["faults"]
    assert (fault["kind"], fault["first"], fault["last"]) == ("turned", 5, 7)
    assert fault["turn_deg"] == pytest.approx(0.7, abs=0.05)
    status, output, _ = run("poses", "refine", folder, "--out", refined, "--json")
    assert status == 0
    moves = {move["frame"]: move for move in json.loads(output)["moves"]}
    assert [frame for frame, move in moves.items() if move["from_images_alone"]] == [5, 6, 7]
    assert (folder / "semviz.toml").read_bytes() == settings
    truth = street(SEED, COUNT).frames
    for frame, pose in zip(truth, load_trajectory(refined).T_map_camera, strict=True):
        assert frame.T_map_camera is not None
        error = (frame.T_map_camera.inverse() @ pose).log()
        assert np.rad2deg(np.linalg.norm(error[3:])) < 0.05
        assert np.linalg.norm(error[:3]) < 0.03
    again = tmp_path / "again"
    run("new", again, "--kitti", drive, "--poses", refined)
    status, output, _ = run("poses", "check", again, "--gate")
    assert status == 0, output


def test_new_suspects_flat_and_frozen_poses_without_reading_images(
    run: Call, drive: Path, tmp_path: Path
) -> None:
    frames = street(SEED, COUNT).frames
    still = frames[4].T_map_camera
    assert still is not None
    flat = moved(
        frames, lambda row, pose: Pose(pose.rotation, pose.translation * np.array([1.0, 1.0, 0.0]))
    )
    frozen = moved(frames, lambda row, pose: still if row in TURNED else pose)
    for name, wrong, words in (
        ("flat", flat, "all heights are the same"),
        ("frozen", frozen, "frames 4-7 have exactly one pose"),
    ):
        path = tmp_path / f"{name}.tum"
        save_trajectory(wrong, path, "tum")
        status, _, errors = run("new", tmp_path / name, "--kitti", drive, "--poses", path)
        assert (status, words in errors, "semviz poses check" in errors) == (0, True, True)


def test_refusals(run: Call, drive: Path, tmp_path: Path) -> None:
    folder = tmp_path / "town"
    run("new", folder, "--kitti", drive)
    own = drive / "poses" / "02.txt"
    before = own.read_bytes()
    for words in (
        ("poses", "refine", folder, "--out", own, "--force"),
        ("poses", "refine", folder, "--out", folder / "semviz.toml", "--force"),
        ("poses", "check", folder, "--plot", tmp_path / "plot.jpg"),
        ("poses", "check", folder, "--frames", "0:2"),
        ("map", "build", folder, "--pose-sigma-deg", "0.1"),
    ):
        status, output, errors = run(*words)
        assert (status, output) == (2, ""), words
        assert errors.startswith("semviz: ")
        assert errors.count("\n") == 1
    assert own.read_bytes() == before


def test_elements_that_jump_together_agree(
    run: Call, drive: Path, wrong_poses: Path, tmp_path: Path
) -> None:
    """Those of the turned frames agree; those of healthy frames have nothing to agree to."""
    folder, source = tmp_path / "town", street(SEED, COUNT)
    run("new", folder, "--kitti", drive, "--poses", wrong_poses)
    workspace = Workspace.open(folder)
    check = check_poses(workspace, workspace.source.frames, lambda what, done, of: None)
    (fault,) = check.faults
    labels = label_street(careful(source, 0.3, seed=1), range(COUNT), memory=COUNT).labels
    evidence = label_evidence(labels, workspace.source, check, fault)
    assert evidence is not None
    assert evidence.elements >= 5
    assert evidence.agreeing >= 0.8 * evidence.elements
    assert evidence.before_px > 4.0
    assert evidence.after_px < 1.0
    elsewhere = replace(fault, first=9, last=10)
    healthy = label_evidence(labels, workspace.source, check, elsewhere)
    assert healthy is not None
    assert healthy.before_px < 1.0
    assert healthy.agreeing <= 0.3 * healthy.elements
    whole = replace(fault, first=0, last=COUNT - 1)  # each set of poses places the elements
    everywhere = label_evidence(labels, workspace.source, check, whole)
    assert everywhere is not None
    assert everywhere.after_px < everywhere.before_px
    of_rig = replace(whole, kind="baseline")
    assert label_evidence(labels, workspace.source, check, of_rig) is None
