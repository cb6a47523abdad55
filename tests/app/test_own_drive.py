"""An own drive from its files to a pose: images through lenses, labels, map, localization."""

import csv
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from recorded_streets import LENSES, PINHOLE, Recording, record
from streets import street

from semviz.cli import main
from semviz.workspace.outputs import check_outputs
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import new_id
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side
from semviz_core.base.pose import so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.simulation.street import Street

FRAMES = 9
KEYPOINTS = {
    "pole": ["peak", "bottom"],
    "triangular sign": ["middle"],
    "rectangular sign": ["middle"],
    "rounded sign": ["middle"],
}
SIGMA_PX = 0.5
SIDES: tuple[Side, Side] = ("left", "right")
TURNED = so3_exp(np.deg2rad([0.8, -1.2, 0.6]))
"""The right camera's axes, in those of the street's."""
Semviz = Callable[..., str]


@pytest.fixture(scope="module")
def source() -> Street:
    return street(3, FRAMES)


@pytest.fixture(scope="module", params=["pinhole", "brown", "fisheye"])
def recording(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, source: Street
) -> Recording:
    folder = tmp_path_factory.mktemp(request.param)
    turned = None if request.param == "pinhole" else TURNED
    return record(folder, source, LENSES[request.param], range(FRAMES), turned)


@pytest.fixture
def semviz(capsys: pytest.CaptureFixture[str]) -> Semviz:
    def run(*arguments: object) -> str:
        code, out, err = call(capsys, *arguments)
        assert code == 0, err
        return out

    return run


def label(workspace: Workspace, street: Street) -> None:
    """Label what the street shows, in rectified pixels, with a careful person's errors."""
    rng = np.random.default_rng(0)
    names: dict[int, str] = {}
    with workspace.open_labels() as store:
        for index in range(FRAMES):
            for side in SIDES:
                seen, ids = street.labels(index, side)
                anchors, ends = in_rectified(workspace, street, index, side, seen)
                noise = rng.normal(0.0, SIGMA_PX, (2, len(ids), 2))
                for row, number in enumerate(ids.tolist()):
                    anchor, end = (anchors + noise[0])[row], (ends + noise[1])[row]
                    if not inside(workspace, anchor, end if seen.is_line[row] else anchor):
                        continue
                    is_new = number not in names
                    element_id = names.setdefault(number, new_id())
                    added = AddObservation(
                        observation_id=new_id(),
                        element_id=element_id,
                        frame_index=index,
                        side=side,
                        anchor_px=tuple(anchor.tolist()),
                        end_px=tuple(end.tolist()) if seen.is_line[row] else None,
                        anchor_known=bool(seen.anchor_known[row]),
                        end_known=bool(seen.end_known[row]),
                        class_id=int(seen.class_id[row]) if is_new else None,
                    )
                    store.apply(added, "ann")


def in_rectified(
    workspace: Workspace, street: Street, index: int, side: Side, seen: Elements2D
) -> tuple[FloatArray, FloatArray]:
    """The street's pixels of one of its cameras, in the workspace's image of that camera."""
    rig = workspace.source.rig
    camera = rig.left if side == "left" or rig.right is None else rig.right
    here = workspace.source.frames[index].T_map_camera
    first = workspace.source.frames[0].T_map_camera
    truth = street.frames[index].T_map_camera
    assert here is not None
    assert first is not None
    assert truth is not None
    # Rays of the street's camera, turned to the rectified one: both have the same world axes.
    R = here.rotation.T @ truth.rotation
    result = []
    for pixels in (seen.anchor_px, np.where(np.isnan(seen.end_px), 0.0, seen.end_px)):
        rays = np.column_stack([street.rig.left.normalize(pixels), np.ones(len(pixels))])
        result.append(camera.project(rays @ R.T))
    return result[0], result[1]


def inside(workspace: Workspace, *pixels: FloatArray) -> bool:
    camera = workspace.source.rig.left
    return bool(
        all(
            np.isfinite(px).all()
            and (px >= 0.0).all()
            and (px <= [camera.width - 1.0, camera.height - 1.0]).all()
            for px in pixels
        )
    )


@pytest.fixture(scope="module")
def town(
    tmp_path_factory: pytest.TempPathFactory, recording: Recording, source: Street
) -> Workspace:
    """The recording as a workspace, labelled. Tests add a map and a run."""
    path = tmp_path_factory.mktemp("workspaces") / "town"
    words = (
        "new", path, "--images", recording.left, "--right", recording.right,
        "--calibration", recording.kalibr, "--poses", recording.poses, "--strict",
    )  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert not ended.value.code
    workspace = Workspace.open(path)
    label(workspace, source)
    return workspace


def test_a_drive_is_mapped_and_localized_as_well_as_by_a_pinhole(
    town: Workspace, source: Street, semviz: Semviz
) -> None:
    semviz("map", "build", town.path)
    built = town.read_map("main").elements
    truth = source.truth_map.elements
    nearest = np.linalg.norm(built.anchor_m[:, None] - truth.anchor_m[None], axis=2).min(axis=1)
    assert len(built) > 8
    sigma = np.sqrt(np.trace(built.covariance_m2[:, :3, :3], axis1=1, axis2=2))
    assert (nearest < 4.0 * sigma + 0.05)[built.anchor_known].all()
    assert np.median(nearest) < 0.6
    accuracy = json.loads(semviz("map", "check", town.path, "--json"))
    assert accuracy["classes"]["pole"]["lateral_rmse_px"] < 2.0 * SIGMA_PX
    run = town.path / "runs" / "first.rrd"
    semviz("localize", town.path, "--out", run, "--images", "reference")
    numbers = json.loads(semviz("evaluate", run, "--json"))
    assert numbers["status"]["ok"] >= FRAMES - 2
    assert numbers["rte_m"]["q3"] < 0.3
    assert numbers["rre_deg"]["q3"] < 0.3


def test_labels_are_exported_in_recorded_pixels_too(
    town: Workspace, recording: Recording, tmp_path: Path, semviz: Semviz
) -> None:
    """They are where the street's points fall through the lens that recorded it."""
    assert "(csv)" in semviz("labels", "export", town.path, tmp_path / "labels.csv")
    rows = list(csv.DictReader((tmp_path / "labels.csv").open()))
    assert len(rows) == len(town.read_labels().observations) > 8
    rectified = town.source
    assert isinstance(rectified, ImageFolder)
    for row in rows:
        side: Side = "left" if row["side"] == "left" else "right"
        assert (recording.left.parent / row["side"] / row["image"]).is_file()
        camera = rectified.rectified.of(side).camera
        turn = rectified.rectified.of(side).R_original_rectified
        for end in ("anchor", "end") if row["end_u_px"] else ("anchor",):
            here = np.array([[float(row[f"{end}_u_px"]), float(row[f"{end}_v_px"])]])
            there = [float(row[f"{end}_u_original_px"]), float(row[f"{end}_v_original_px"])]
            ray = np.append(camera.normalize(here)[0], 1.0) @ turn.T
            lens = rectified.rectified.of(side).original
            theirs = through(lens, ray)
            np.testing.assert_allclose(there, theirs, atol=1e-6)


def test_labels_drawn_in_recorded_images_are_rectified(
    town: Workspace, recording: Recording, tmp_path: Path, semviz: Semviz
) -> None:
    """Another tool's file names the recorded images, here at twice their size."""
    semviz("labels", "export", town.path, tmp_path / "labels.csv")
    rows = list(csv.DictReader((tmp_path / "labels.csv").open()))
    source = town.source
    assert isinstance(source, ImageFolder)
    lens = source.rectified.of("left").original
    names = sorted({(row["side"], row["image"]) for row in rows})
    document = {
        "images": [
            {"id": number, "file_name": f"{side}/{name}", "width": 2 * lens.width,
             "height": 2 * lens.height}
            for number, (side, name) in enumerate(names)
        ],
        "categories": [
            {"id": number, "name": name, "keypoints": points}
            for number, (name, points) in enumerate(KEYPOINTS.items())
        ],
        "annotations": [
            {"id": number, "image_id": names.index((row["side"], row["image"])),
             "category_id": list(KEYPOINTS).index(row["class"]),
             "keypoints": doubled(row)}
            for number, row in enumerate(rows)
        ],
    }  # fmt: skip
    (tmp_path / "theirs.json").write_text(json.dumps(document))
    kept = shutil.ignore_patterns("labels.db*", "maps", "runs")
    other = Workspace.open(shutil.copytree(town.path, tmp_path / "other", ignore=kept))
    words = ("labels", "import", other.path, tmp_path / "theirs.json", "--pixels", "recorded")
    report = json.loads(semviz(*words, "--json"))
    assert report["observations"] == len(rows)
    assert report["assumed"]["labels of images of another size: scaled to that of the workspace"]
    semviz("labels", "export", town.path, tmp_path / "ours", "--format", "labelme")
    report = json.loads(semviz("labels", "import", town.path, tmp_path / "ours", "--json"))
    both = "images named like recorded and rectified ones: rectified (--pixels)"
    assert report["already"] == len(rows)
    assert report["assumed"].get(both, len(rows)) == len(rows)  # a pinhole's are the same

    def drawn(workspace: Workspace) -> list[list[float]]:
        marks = workspace.read_labels().observations.values()
        return sorted([*row.anchor_px, *(row.end_px or row.anchor_px)] for row in marks)

    np.testing.assert_allclose(drawn(other), drawn(town), atol=1e-5)


def doubled(row: dict[str, str]) -> list[float]:
    """Keypoints of a line of the table, in the recorded image at twice its size."""
    ends = ("anchor", "end")[: len(KEYPOINTS[row["class"]])]
    cells = [row[f"{end}_{axis}_original_px"] for end in ends for axis in "uv"]
    pixels = np.array(cells, dtype=np.float64).reshape(-1, 2)
    return [value for u, v in (2.0 * pixels + 0.5).tolist() for value in (u, v, 2)]


def through(lens: OriginalCamera, ray: FloatArray) -> FloatArray:
    """OpenCV's pixel of a ray."""
    if lens.model == "pinhole":
        return np.asarray((lens.K @ (ray / ray[2]))[:2])
    project = cv2.fisheye.projectPoints if lens.model == "fisheye" else cv2.projectPoints
    pixels, _ = project(ray[None, None], np.zeros(3), np.zeros(3), lens.K, lens.distortion)
    return np.asarray(pixels).reshape(2)


def test_rectified_images_are_made_once_and_again_if_the_recording_is_newer(
    town: Workspace, recording: Recording
) -> None:
    first = town.source.image(3, "right")
    path = town.path / "rectified" / "right" / "000003.png"
    if town.source.rig.left.width == PINHOLE.width:
        assert not (town.path / "rectified").exists()
        return
    made = path.stat().st_mtime_ns
    np.testing.assert_array_equal(Workspace.open(town.path).source.image(3, "right"), first)
    assert path.stat().st_mtime_ns == made
    os.utime(path, ns=(0, 0))
    town.source.image(3, "right")
    assert path.stat().st_mtime_ns > 0


def test_body_poses_and_their_extrinsic_give_the_same_drive(
    town: Workspace, recording: Recording
) -> None:
    body = read_drive(
        DriveFiles(
            recording.left,
            right=recording.right,
            calibration=recording.kalibr,
            poses=recording.body_poses,
            extrinsic="calibration",
        )
    )
    for frame, wanted in zip(body.frames, town.source.frames, strict=True):
        assert frame.T_map_camera is not None
        assert wanted.T_map_camera is not None
        np.testing.assert_allclose(
            frame.T_map_camera.as_matrix(), wanted.T_map_camera.as_matrix(), atol=1e-6
        )


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A folder with six grey images, calibrated as the street's camera, without poses."""
    (tmp_path / "cam").mkdir()
    for index in range(6):
        image = np.full((PINHOLE.height, PINHOLE.width, 3), 90, np.uint8)
        assert cv2.imwrite(str(tmp_path / "cam" / f"image_{index}.jpg"), image)
    (tmp_path / "cam.toml").write_text(
        '[left]\nsize_px = [1241, 376]\nmodel = "pinhole"\n'
        "focal_px = [718.856, 718.856]\ncenter_px = [607.1928, 185.2157]\n"
    )
    return tmp_path


def kitti_poses(folder: Path, source: Street, count: int) -> Path:
    from semviz_core.datasets.trajectory import T_MAP_WORLD

    path = folder / "poses.txt"
    lines = []
    for frame in source.frames[:count]:
        assert frame.T_map_camera is not None
        numbers = (T_MAP_WORLD.inverse() @ frame.T_map_camera).as_matrix()[:3].ravel().tolist()
        lines.append(" ".join(map(repr, numbers)))
    path.write_text("\n".join(lines))
    return path


def test_a_drive_without_poses_can_be_labelled_and_says_what_it_lacks(
    small: Path, semviz: Semviz, capsys: pytest.CaptureFixture[str], source: Street
) -> None:
    town = small / "town"
    out = semviz("new", town, "--images", small / "cam", "--calibration", small / "cam.toml")
    assert "none: images can be labelled, but no map built" in out
    assert "6 frames, 0 with a pose, 0.0 m, 1 camera, 0 warnings" in out
    assert not (town / "left-out.csv").exists()
    workspace = Workspace.open(town)
    with workspace.open_labels() as store:
        added = AddObservation(
            observation_id=new_id(), element_id=new_id(), frame_index=2, side="left",
            anchor_px=(100.0, 50.0), end_px=(100.0, 200.0), anchor_known=True, end_known=True,
            class_id=0,
        )  # fmt: skip
        store.apply(added, "ann")
    code, _, err = call(capsys, "map", "build", town)
    assert code == 2
    assert err.count("\n") == 1


def test_strict_makes_nothing_where_images_lack_poses(
    small: Path, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    times = small / "times.txt"
    times.write_text("\n".join(str(10.0 + 0.1 * index) for index in range(6)))
    poses = small / "tum.txt"
    poses.write_text(
        "".join(f"{10.0 + 0.1 * i} {i} 0 {0.1 * i} 0.5 -0.5 0.5 -0.5\n" for i in range(5))
    )
    arguments = (
        "new", small / "town", "--images", small / "cam", "--calibration", small / "cam.toml",
        "--poses", poses, "--times", times, "--up", "z",
    )  # fmt: skip
    code, _, err = call(capsys, *arguments, "--strict")
    assert code == 2
    assert err.splitlines()[-1] == "semviz: --strict: 1 warning; nothing was made"
    assert not (small / "town").exists()
    code, out, err = call(capsys, *arguments)
    assert code == 0
    assert err == (
        "warning: 1 of 6 images have no pose: they can be labelled, and are left out of maps\n"
    )
    assert "6 frames, 5 with a pose" in out
    assert "left-out.csv which images, and why" in out
    _, row = (small / "town" / "left-out.csv").read_text().splitlines()
    assert row.startswith('image_5.jpg,left,10.5,"no pose, taken 0.100 s after the last pose: ')


def test_images_that_are_left_out_are_listed_as_text_for_spreadsheets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side, last in (("left", "=1+2, x.png"), ("right", "c.png")):
        (tmp_path / side).mkdir()
        for name in ("a.png", "b.png", last):
            assert cv2.imwrite(str(tmp_path / side / name), np.zeros((48, 64, 3), np.uint8))
    camera = 'size_px = [64, 48]\nmodel = "pinhole"\nfocal_px = [60, 60]\ncenter_px = [32, 24]\n'
    (tmp_path / "cam.toml").write_text(
        "T_right_left = [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0]]\n"
        f"[left]\n{camera}[right]\n{camera}"
    )
    code, out, err = call(
        capsys, "new", tmp_path / "town", "--images", tmp_path / "left",
        "--right", tmp_path / "right", "--calibration", tmp_path / "cam.toml",
    )  # fmt: skip
    assert code == 0, err
    assert "warning: 2 images without one on the other side: left out" in err
    path = tmp_path / "town" / "left-out.csv"
    assert f"  left out     {path} which images, and why\n" in out
    reason = "no match by name in the other camera"
    assert path.read_text().splitlines() == [
        "file,side,time_s,reason",
        f'"\'=1+2, x.png",left,,{reason}',
        f"c.png,right,,{reason}",
    ]
    with pytest.raises(SemvizError, match="left-out"):
        check_outputs(path, lambda head: True, force=True)


def test_poses_of_another_drive_are_refused_by_their_count(
    small: Path, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(
        capsys, "new", small / "town", "--images", small / "cam",
        "--calibration", small / "cam.toml", "--poses", kitti_poses(small, source, 5),
    )  # fmt: skip
    assert (code, out) == (2, "")
    assert "5 poses for 6 images, and nothing says which belong together" in err
    assert not (small / "town").exists()


def test_motions_are_measured_again_once_a_recorded_image_is_replaced(
    small: Path, semviz: Semviz, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    town = small / "town"
    semviz(
        "new", town, "--images", small / "cam",
        "--calibration", small / "cam.toml", "--poses", kitti_poses(small, source, 6),
    )  # fmt: skip
    measured = []
    for _ in range(3):
        call(capsys, "poses", "check", town)
        measured.append((town / "image_motions.safetensors").stat().st_mtime_ns)
        if len(measured) == 2:
            os.utime(small / "cam" / "image_2.jpg")  # another image, for all that is known
    assert measured[0] == measured[1] != measured[2]


def test_a_backward_camera_is_warned_about_and_accepted(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = small / "times.txt"
    times.write_text("\n".join(str(10.0 + 0.5 * index) for index in range(6)))
    poses = small / "tum.txt"
    poses.write_text(  # the camera looks along -x and moves along x
        "".join(f"{10.0 + 0.5 * i} {2 * i} 0 0 0.5 0.5 -0.5 -0.5\n" for i in range(6))
    )
    code, _, err = call(
        capsys, "new", small / "town", "--images", small / "cam",
        "--calibration", small / "cam.toml", "--poses", poses, "--times", times,
    )  # fmt: skip
    assert code == 0, err
    assert "the camera moves backwards in 100% of its steps" in err


def test_a_damaged_drive_file_is_named(small: Path, semviz: Semviz) -> None:
    town = small / "town"
    semviz("new", town, "--images", small / "cam", "--calibration", small / "cam.toml")
    path = town / "drive.json"
    text = path.read_text()
    for wrong in (text.replace("image_0.jpg", "../image_0.jpg"), text[:-20], "[]"):
        path.write_text(wrong)
        with pytest.raises(SemvizError, match=r"drive\.json: damaged \(.*run 'semviz new' again"):
            _ = Workspace.open(town).source


def test_options_of_own_images_are_refused_for_other_sources(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = call(capsys, "new", tmp_path / "t", "--simulate", 1, "--calibration", "a.yaml")
    assert (code, err) == (2, "semviz: --calibration needs --images FOLDER\n")
