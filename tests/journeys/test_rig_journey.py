"""A rig of four cameras with lenses and clocks of their own: from files to a map and poses."""

import csv
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from command_line import call
from journeys.driver import POLE, LabelDriver
from labelled_rig import SIGMA_PX, label, true_pose
from streets import street

from semviz.annotator import messages
from semviz.annotator.panes import SecondImage
from semviz.annotator.session import LabelSession
from semviz.cli import main
from semviz.runs.reader import load_run
from semviz.web.protocol import RefusedError
from semviz.workspace.localization.rebuild import rebuild_run
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import new_id
from semviz_annotation.labels.proposal import ProcessedImages, Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles, poses_at_times
from semviz_core.datasets.rig_cameras import frames_by_camera
from semviz_core.simulation.street import Street
from semviz_core.simulation.street_rig import (
    CALIBRATION,
    POSES,
    four_cameras,
    record_rig,
    visible_at,
)

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 6
CAMERAS = four_cameras()
NAMES = ",".join(CAMERAS)


@pytest.fixture(scope="module")
def source() -> Street:
    return street(3, FRAMES + 2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, source: Street) -> Path:
    folder = tmp_path_factory.mktemp("rig")
    record_rig(folder, source, CAMERAS, range(FRAMES))
    return folder


def words(recording: Path, town: Path, **changed: object) -> list[object]:
    options = {
        "images": recording,
        "cameras": NAMES,
        "calibration": recording / CALIBRATION,
        "poses": recording / POSES,
    } | changed
    pairs = [(f"--{name}", value) for name, value in options.items() if value is not None]
    return ["new", town, *(word for pair in pairs for word in pair)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, recording: Path) -> Path:
    path = tmp_path_factory.mktemp("workspaces") / "town"
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words(recording, path)), "--strict"])
    assert not ended.value.code
    return path


@pytest.fixture
def town(tmp_path: Path, made: Path) -> Workspace:
    """A copy beside it: images are named relative to the workspace."""
    path = made.parent / tmp_path.name
    shutil.copytree(made, path)
    return Workspace.open(path)


def test_every_camera_has_its_frames_poses_at_their_own_times_and_one_pinhole(
    town: Workspace, source: Street
) -> None:
    dataset = town.source
    assert isinstance(dataset, ImageFolder)
    frames = frames_by_camera(dataset)
    assert {name: [frame.index for frame in its] for name, its in frames.items()} == {
        name: list(range(10 * number, 10 * number + FRAMES)) for number, name in enumerate(CAMERAS)
    }
    late = [its[0].time_s - frames["front"][0].time_s for its in frames.values()]
    np.testing.assert_allclose(late, [0.0, 0.013, 0.027, 0.041], atol=1e-5)
    point = np.array([[0.3, -0.2, 8.0]])
    for name, its in frames.items():
        lens = CAMERAS[name].lens
        assert dataset.image(its[0].index, "left").shape[1::-1] == (
            dataset.rig.left.width,
            dataset.rig.left.height,
        )
        for frame in its:
            truth = true_pose(source, frame, CAMERAS[name])
            assert frame.T_map_camera is not None
            np.testing.assert_allclose(frame.T_map_camera.as_matrix(), truth.as_matrix(), atol=1e-4)
            pixels = dataset.to_original(dataset.rig.left.project(point), frame.index, "left")
            np.testing.assert_allclose(pixels, lens.project(point), atol=1e-6)


def test_a_rig_is_mapped_and_every_camera_localized_in_one_map(
    town: Workspace, source: Street, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    label(town, source, CAMERAS, SIGMA_PX)
    assert call(capsys, "map", "build", town.path)[0] == 0
    truth, built = source.truth_map.elements, town.read_map("main").elements
    sigma = np.sqrt(np.trace(built.covariance_m2[:, :3, :3], axis1=1, axis2=2))
    apart = np.linalg.norm(built.anchor_m[:, None] - truth.anchor_m[None], axis=2).min(axis=1)
    assert (apart < 4.0 * sigma + 0.05)[built.anchor_known].all()
    for camera in ("front", "back"):
        run = town.path / "runs" / f"{camera}.rrd"
        code, _, err = call(
            capsys, "localize", town.path, "--camera", camera, "--out", run, "--images", "reference"
        )
        assert code == 0, err
        numbers = json.loads(call(capsys, "evaluate", run, "--json")[1])
        assert numbers["status"]["ok"] == FRAMES
        assert numbers["rte_m"]["q3"] < 0.1
        assert load_run(run).info.camera == camera
    code, _, err = call(capsys, "localize", town.path, "--camera", "roof")
    assert (code, err.count("\n")) == (2, 1)
    assert "no camera roof; the drive has front, left, right, back" in err
    assert call(capsys, "labels", "export", town.path, tmp_path / "l.csv")[0] == 0
    row = next(row for row in csv.DictReader((tmp_path / "l.csv").open()) if row["frame"] == "31")
    assert row["image"].startswith("back/17")


def test_a_frame_is_localized_by_all_cameras(
    town: Workspace, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their images are 13 to 41 ms apart."""
    label(town, source, CAMERAS, SIGMA_PX)
    assert call(capsys, "map", "build", town.path)[0] == 0
    numbers = {}
    for name, words in {"alone": (), "rig": ("--rig",)}.items():
        run = town.path / "runs" / f"{name}.rrd"
        options = ("--camera", "left", "--out", run, "--images", "none", *words)
        code, _, err = call(capsys, "localize", town.path, *options)
        assert code == 0, err
        numbers[name] = json.loads(call(capsys, "evaluate", run, "--json")[1])
    assert numbers["rig"]["status"]["ok"] == FRAMES
    assert numbers["rig"]["rte_m"]["q2"] < numbers["alone"]["rte_m"]["q2"]
    stored = load_run(town.path / "runs" / "rig.rrd")
    assert stored.info.camera == "left"
    assert stored.info.options["rig"]
    for record in stored.frames:
        found = record.localization
        assert found.reason.startswith("4 cameras: ")
        assert f" of {len(found.observed)} elements" not in found.reason  # of all cameras
    with pytest.raises(SemvizError, match="one pose from several cameras"):
        rebuild_run(stored, town.path / "runs" / "again.rrd", town)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--rig", "--track"), "--rig is for single frames and --method search"),
        (("--rig", "--method", "direct"), "--rig is for single frames and --method search"),
        (("--rig", "--observations", "simulated"), "--rig is for labels and detections"),
    ],
)
def test_a_rig_that_cannot_be_localized_is_refused(
    town: Workspace, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str
) -> None:
    code, _, err = call(capsys, "localize", town.path, *options)
    assert (code, err.count("\n")) == (2, 1)
    assert said in err


def test_detections_of_all_cameras_make_a_map_in_which_each_is_localized(
    town: Workspace, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a label; every element is detected 0.5 px off."""
    rng, camera = np.random.default_rng(0), town.source.rig.left
    rows: list[Proposal] = []
    for name, its in frames_by_camera(town.source).items():
        for frame in its:
            seen, _ = visible_at(source, camera, true_pose(source, frame, CAMERAS[name]))
            off = rng.normal(0.0, SIGMA_PX, (2, len(seen), 2))
            found = replace(
                seen,
                anchor_px=seen.anchor_px + off[0],
                end_px=seen.end_px + off[1],
                score=np.full(len(seen), 0.9),
            )
            rows += as_proposals(frame.index, "left", found, camera, "simulated", "centroid")
    images = frozenset((frame.index, "left") for frame in town.source.frames)
    processed = ProcessedImages("simulated", images=images)
    save_proposals(Proposals.of(rows, processed), town.proposals_path)
    assert call(capsys, "map", "build", town.path, "--from", "detections")[0] == 0
    run = town.path / "runs" / "back.rrd"
    words = ("--map", "from-detections", "--observations", "detected", "--camera", "back")
    code, _, err = call(capsys, "localize", town.path, *words, "--out", run, "--images", "none")
    assert code == 0, err
    numbers = json.loads(call(capsys, "evaluate", run, "--json")[1])
    assert numbers["status"]["ok"] == FRAMES
    assert numbers["rte_m"]["q3"] < 0.15


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cameras": "front,roof,back"}, "no folder roof of a camera"),
        ({"cameras": "front,back,back"}, "each named once"),
        ({"cameras": "front,left"}, "--cameras has no meaning"),
        ({"calibration": None}, "no calibration"),
    ],
)
def test_what_is_no_rig_is_refused(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, object],
    message: str,
) -> None:
    code, _, err = call(capsys, *words(recording, tmp_path / "town", **changed))
    assert (code, err.count("\n")) == (2, 1)
    assert message in err
    assert not (tmp_path / "town").exists()


def test_a_camera_whose_place_nobody_says_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (recording / CALIBRATION).read_text().splitlines()
    places = [row for row, line in enumerate(lines) if line.startswith("T_body")]
    own = tmp_path / "rig.toml"
    own.write_text("\n".join(line for row, line in enumerate(lines) if row != places[1]))
    code, _, err = call(capsys, *words(recording, tmp_path / "town", calibration=own))
    assert code == 2
    assert "does not say where camera left is" in err


def test_the_second_image_is_the_one_wished_for_and_marks_name_it(town: Workspace) -> None:
    """Also if another page wishes for another one in between."""
    session = LabelSession(town, "ann")
    try:
        usual = session.frame(5).panes["right"]
        assert (usual.camera, usual.frame) == ("front", 1)  # 4 m back
        beside = session.frame(15).panes["right"]
        assert (beside.camera, beside.frame) == ("left", 14)  # 1 m, as it looks aside
        wished = session.frame(5, SecondImage(camera="right"))
        assert (wished.panes["right"].camera, wished.panes["right"].frame) == ("right", 25)
        assert wished.at_that_time == {"left": 15, "right": 25, "back": 35}
        assert session.frame(5, SecondImage(step=-2)).panes["right"].frame == 3
        assert session.frame(5, SecondImage(step=40)).panes["right"].frame == 1  # the usual one
        mark = messages.DrawEdit(
            kind="draw", observation_id=new_id(), element_id=new_id(), frame_index=5,
            side="right", second=25, anchor_px=(200.0, 80.0), class_id=3,
        )  # fmt: skip
        session.frame(5)  # another page's
        session.apply(new_id(), mark)
        (row,) = session.labels.observations.values()
        assert (row.frame_index, row.side) == (25, "left")
        with pytest.raises(RefusedError, match="cannot be shown"):
            session.apply(new_id(), mark.model_copy(update={"second": 5}))
    finally:
        session.close()


@pytest.fixture
def served(town: Workspace) -> Iterator[Served]:
    with annotating(town) as served:
        yield served


@pytest.mark.browser
def test_a_pole_is_labelled_in_two_cameras_in_the_browser(
    served: Served, town: Workspace, source: Street, page: "Page"
) -> None:
    """The front image beside the one of the right camera that was taken 27 ms later."""
    frames = {frame.index: frame for frame in town.source.frames}
    model = town.source.rig.left
    both = {}
    for index in range(FRAMES):
        ahead, aside = (
            visible_at(source, model, true_pose(source, frames[number], CAMERAS[name]))
            for number, name in ((index, "front"), (20 + index, "right"))
        )
        for row, element in enumerate(ahead[1].tolist()):
            if element in aside[1].tolist() and ahead[0].is_line[row]:
                other = aside[1].tolist().index(element)
                both[index] = [
                    (seen.anchor_px[at], seen.end_px[at])
                    for seen, at in ((ahead[0], row), (aside[0], other))
                ]
    index, (here, there) = next(iter(both.items()))
    driver = LabelDriver(page)
    mark = "&" if "?" in served.url else "?"
    driver.open(f"{served.url}{mark}frame={index}&second=right")
    page.wait_for_selector(f'#right-image h2:has-text("right {20 + index}")')
    page.wait_for_function("() => semviz.images.bitmap('right')")
    assert page.inner_text("#left-image h2") == f"front {index}"
    assert driver.draw_pair(POLE, here, there) == "P-01"
    rows = {(row.frame_index, row.side) for row in served.observations}
    assert rows == {(index, "left"), (20 + index, "left")}
    position = served.annotator.session.position(served.observations[0].element_id)
    assert position is not None
    truth = source.truth_map.elements.anchor_m
    assert np.linalg.norm(truth - position.anchor_m, axis=1).min() < 0.3
    page.keyboard.press("Shift+C")
    page.wait_for_selector('#left-image h2:has-text("left")')


def kalibr_chain(recording: Path) -> Path:
    """The cameras as Kalibr writes them: each with the IMU's pose in it, a metre ahead of it."""
    path = recording / "camchain.yaml"
    T_imu_body = Pose(np.eye(3), np.array([0.0, 0.3, -1.0]))
    lines = []
    for number, mount in enumerate(CAMERAS.values()):
        lens = mount.lens
        T_cam_imu = (T_imu_body @ mount.T_body_camera).inverse().as_matrix().tolist()
        model = {"brown-conrady": "radtan", "fisheye": "equidistant"}[lens.model]
        lines.append(
            f"cam{number}:\n"
            "  camera_model: pinhole\n"
            f"  intrinsics: {lens.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}\n"
            f"  distortion_model: {model}\n"
            f"  distortion_coeffs: {lens.distortion.tolist()}\n"
            f"  resolution: {[lens.width, lens.height]}\n"
            f"  T_cam_imu: {T_cam_imu}\n"
        )
    path.write_text("".join(lines))
    return path


def colmap_model(recording: Path, town: Workspace, source: Street) -> Path:
    """A model of the rig's images; COLMAP counts pixels from the corner."""
    path = recording / "sparse"
    path.mkdir()
    cameras, images = [], []
    dataset = town.source
    assert isinstance(dataset, ImageFolder)
    for number, (name, mount) in enumerate(CAMERAS.items(), 1):
        K, lens = mount.lens.K, mount.lens
        model = {"brown-conrady": "OPENCV", "fisheye": "OPENCV_FISHEYE"}[lens.model]
        terms = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *lens.distortion]
        cameras.append(f"{number} {model} {lens.width} {lens.height} {' '.join(map(str, terms))}")
        for frame in frames_by_camera(dataset)[name]:
            pose = true_pose(source, frame, mount).inverse()
            x, y, z, w = pose.as_quaternion()
            words = [len(images) + 1, w, x, y, z, *pose.translation, number]
            file = dataset.original_path(frame.index, "left").name
            images.append(f"{' '.join(map(str, words))} {name}/{file}\n")
    (path / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (path / "images.txt").write_text("\n".join(images) + "\n")
    (path / "points3D.txt").write_text("")
    return path


@pytest.mark.parametrize("source_of_cameras", ["Kalibr", "COLMAP"])
def test_a_rig_of_kalibr_or_colmap_is_the_same(
    recording: Path, town: Workspace, source: Street, source_of_cameras: str
) -> None:
    if source_of_cameras == "Kalibr":
        files = DriveFiles(
            recording,
            rig=tuple(CAMERAS),
            calibration=kalibr_chain(recording),
            poses=recording / POSES,
        )
    else:
        model = colmap_model(recording, town, source)
        files = DriveFiles(recording, rig=tuple(CAMERAS), poses=model, metric=True)
    drive = read_drive(files)
    known = {frame.index: frame for frame in town.source.frames}
    assert {frame.index for frame in drive.frames} == set(known)
    assert drive.axes is not None
    assert drive.axes.up == "z"
    for frame in drive.frames:
        pose = known[frame.index].T_map_camera
        assert frame.T_map_camera is not None
        assert pose is not None
        np.testing.assert_allclose(frame.T_map_camera.as_matrix(), pose.as_matrix(), atol=2e-4)


def test_poses_refined_by_another_camera_are_those_of_the_first(
    town: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "refined.tum"
    assert call(capsys, "poses", "refine", town.path, "--camera", "back", "--out", out)[0] == 0
    rows = np.loadtxt(out)
    first = frames_by_camera(town.source)["front"]
    times = [frame.time_s for frame in frames_by_camera(town.source)["back"]]
    poses = [frame.T_map_camera for frame in first if frame.T_map_camera is not None]
    there = poses_at_times(poses, np.array([one.time_s for one in first]), np.array(times), 1.0)
    for row, pose in zip(rows, there, strict=True):
        if pose is not None:  # the last image is later than the front camera's last
            np.testing.assert_allclose(row[1:4], pose.translation, atol=0.05)
