"""What people choose for wrong poses: stored beside the drive, used by everything after it."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from command_line import Call, call
from streets import street
from turned_drive import COUNT, SEED, TURNED, drive, labels, measured_town, wrong_poses

from semviz.workspace.chosen_frames import posed_frames, select_frames
from semviz.workspace.poses.pose_choices import PoseOperation, read_choices
from semviz.workspace.poses.pose_review import PoseReview, check_poses, choose_poses, pose_change
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.mapping.build import build_map
from semviz_core.base.frame import Frame
from semviz_core.common.errors import SemvizError

__all__ = ["drive", "labels", "measured_town", "wrong_poses"]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    return partial(call, capsys)


@pytest.fixture
def town(measured_town: Path, tmp_path: Path) -> Path:
    """A copy."""
    return Path(shutil.copytree(measured_town, tmp_path / "town"))


def worst_deg(frames: tuple[Frame, ...]) -> float:
    errors = []
    for frame, truth in zip(frames, street(SEED, COUNT).frames, strict=True):
        if frame.T_map_camera is not None:
            assert truth.T_map_camera is not None
            errors.append((truth.T_map_camera.inverse() @ frame.T_map_camera).log()[3:])
    return float(np.rad2deg(np.linalg.norm(errors, axis=1).max()))


def test_refined_poses_are_used_by_everything_and_undone(run: Call, town: Path) -> None:
    settings = (town / "semviz.toml").read_bytes()
    assert run("map", "build", town)[0] == 0
    status, output, _ = run("map", "check", town, "--json")
    checked = json.loads(output)
    (fault,) = checked["poses"]["faults"]
    assert "stereo and " in fault["text"]
    assert fault["labels"]["agreeing"] >= 0.8 * fault["labels"]["elements"]
    blamed = {row["frame_index"] for row in checked["leave_out"] if not row["pose_is_wrong"]}
    assert not blamed & set(TURNED)

    status, output, errors = run("poses", "choose", town, "refine", "--author", "mara")
    assert (status, errors) == (0, "")
    assert output == "frames 5-7: refined\n"
    assert worst_deg(Workspace.open(town).source.frames) < 0.05
    assert worst_deg(Workspace.open(town).given_source.frames) > 0.6
    assert (town / "semviz.toml").read_bytes() == settings
    status, output, _ = run("poses", "check", town, "--gate")
    assert status == 0, output
    assert "frames 5-7: refined (mara, " in output
    status, _, errors = run("map", "check", town)
    assert "built with other poses (frames 5-7 now refined): rebuild it" in errors
    status, output, _ = run("map", "build", town, "--json")
    built = json.loads(output)
    assert built["poses"]["used"]["refined"] == [[5, 7]]
    assert built["poses"]["faults"][0]["choice"]["author"] == "mara"
    workspace = Workspace.open(town)
    assert workspace.read_map("main").settings["poses"]["refined"] == [[5, 7]]
    assert pose_change(workspace.read_map("main"), workspace) == ""
    assert "other poses" not in run("map", "check", town)[2]

    trajectory = town / "trajectory.tum"
    assert run("trajectory", town, trajectory)[0] == 0
    assert run("poses", "choose", town, "undo")[1] == "undo: frames 5-7: refined\n"
    assert worst_deg(Workspace.open(town).source.frames) > 0.6
    assert run("poses", "choose", town, "redo")[0] == 0
    assert worst_deg(Workspace.open(town).source.frames) < 0.05


def test_frames_left_out_keep_their_labels_which_do_not_count(run: Call, town: Path) -> None:
    assert run("poses", "choose", town, "leave-out")[1] == "frames 5-7: left out\n"
    workspace = Workspace.open(town)
    frames = {frame.index: frame for frame in workspace.source.frames}
    assert [index for index, frame in frames.items() if frame.left_out] == list(TURNED)
    assert frames[5].T_map_camera is None
    built, report = build_map(workspace.read_labels(), workspace.source)
    used = {id_ for source in built.provenance for id_ in source.observation_ids}
    rows = workspace.read_labels().observations
    assert not {rows[id_].frame_index for id_ in used} & set(TURNED)
    assert report.observations < len(rows)
    assert run("map", "build", town)[0] == 0
    assert run("map", "check", town)[0] == 0
    localized = posed_frames(select_frames(workspace.source, None))
    assert len(localized) == COUNT - len(TURNED)


def test_kept_poses_are_not_asked_about_again(run: Call, town: Path) -> None:
    assert run("poses", "choose", town, "keep")[1] == "frames 5-7: kept as they are\n"
    assert run("poses", "choose", town, "refine")[1].startswith("no fault is open")
    _, output, _ = run("map", "build", town)
    assert "kept as they are by" in output
    assert "choose what to do" not in output
    assert run("poses", "choose", town, "ask")[1] == "frames 5-7: to be asked again\n"
    assert run("poses", "choose", town, "refine")[1] == "frames 5-7: refined\n"


def test_labels_that_fit_the_given_poses_refuse_the_refined_ones(
    run: Call, town: Path, labels: Labels
) -> None:
    """The images say that frames 5 to 7 are turned; all labels there are made to say that not."""
    workspace = Workspace.open(town)
    check = check_poses(workspace, workspace.given_source.frames, lambda what, done, of: None)
    contrary = labels.with_rows(
        replace(row, anchor_px=turned(row.anchor_px), end_px=row.end_px and turned(row.end_px))
        if isinstance(row, Observation) and row.frame_index in TURNED
        else row
        for row in labels.rows()
    )
    review = PoseReview.of(workspace, check, contrary)
    with pytest.raises(SemvizError, match="Refining makes the labels kept back worse"):
        choose_poses(review, "refine", (5, 7, "frames"), "tester")
    assert not workspace.pose_choices_path.exists()


def turned(pixel: tuple[float, float]) -> tuple[float, float]:
    """Where a camera turned to the right by 0.7 deg sees a pixel, nearly."""
    focal = street(SEED, COUNT).rig.left.K[0, 0]
    return pixel[0] - float(np.deg2rad(0.7) * focal), pixel[1]


def test_refusals_change_nothing(run: Call, town: Path, tmp_path: Path) -> None:
    path = town / "pose_choices.json"
    for words, why in (
        (("choose", town, "undo"), "there is no choice of poses to undo"),
        (("choose", town, "refine", "--frames", "40:50"), "has no frames from 40 to 49"),
        (("choose", town, "refine", "--frames", "4:8:2"), "a stretch has no steps"),
        (("choose", town, "redo", "--frames", "4:8"), "--frames is not for redo"),
    ):
        status, output, errors = run("poses", *words)
        assert (status, output) == (2, "")
        assert why in errors
        assert not path.exists()
    run("new", tmp_path / "street", "--simulate", 3, "--frames", "0:4")
    status, _, errors = run("poses", "choose", tmp_path / "street", "keep", "--frames", "0:2")
    assert (status, "poses of a simulated street are true" in errors) == (2, True)


def test_a_damaged_file_or_other_poses_are_refused(run: Call, drive: Path, town: Path) -> None:
    run("poses", "choose", town, "refine")
    path = town / "pose_choices.json"
    content = path.read_bytes()
    for place in range(0, len(content), 97):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(SemvizError, match="pose_choices"):
            read_choices(path)
    path.write_bytes(content)
    settings = town / "semviz.toml"
    text = settings.read_text()
    dropped = ("poses = ", "# Checksum")  # as the comment says that people do
    lines = [line for line in text.splitlines() if not line.startswith(dropped)]
    settings.write_text("\n".join(lines))
    status, _, errors = run("poses", "check", town)
    assert (status, "were refined from other poses" in errors) == (2, True)


def test_choices_made_at_the_same_time_are_all_kept(run: Call, town: Path) -> None:
    workspace = Workspace.open(town)
    check = check_poses(workspace, workspace.given_source.frames, lambda what, done, of: None)
    review = PoseReview.of(workspace, check, workspace.read_labels())

    def choose(frame: int) -> None:
        for request in ("a", "a", "b"):  # the page may send a request twice
            name = f"{request} {frame}"
            choose_poses(review, "leave out", (frame, frame, "frames"), name, name)

    threads = [Thread(target=choose, args=(frame,)) for frame in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    made = read_choices(workspace.pose_choices_path).present
    assert sorted(one.author for one in made) == sorted(f"{r} {f}" for r in "ab" for f in range(6))


def test_later_choices_take_the_place_of_earlier_ones() -> None:
    choices = read_choices(Path("none"))
    for choice, first, last in (("leave out", 0, 9), ("keep", 3, 4), ("leave out", 4, 4)):
        choices = choices.with_operation(
            PoseOperation(choice=choice, first=first, last=last, author="a", time="t")
        )
    frames = choices.applied(street(SEED, COUNT).frames)
    assert [frame.index for frame in frames if frame.left_out] == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert choices.moved(-1).with_operation(choices.operations[0]).standing == 3
