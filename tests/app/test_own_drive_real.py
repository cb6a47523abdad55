"""Files of real drives, which are not part of the project: SEMVIZ_DRIVES names their folder."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from pyarrow import feather

from semviz.workspace.workspace import Workspace
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles

REPOSITORY = Path(__file__).parents[2]
pytestmark = pytest.mark.realdata


def test_five_imports_of_a_real_drive_agree_with_colmap(drives: Path) -> None:
    """With strong distortion, and pixels counted from the corner or from the first centre."""
    done = subprocess.run(
        [sys.executable, REPOSITORY / "bench" / "own_drive.py", drives / "utbm_stereo"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == [
        "camera_info, TUM", "COLMAP text", "COLMAP binary", "nerfstudio", "MCAP"
    ]  # fmt: skip
    assert all(float(row[1]) <= 0.45 for row in rows)
    assert all(float(row[2]) < 0.1 for row in rows)


@pytest.mark.parametrize(
    ("planted", "warning"),
    [
        ("", ""),
        ("no distortion", "as in a barrel: the calibration's distortion is too weak"),
        ("rectified before", "as in a cushion"),
    ],
)
def test_lines_of_a_real_drive_tell_a_wrong_distortion(
    drives: Path, tmp_path: Path, planted: str, warning: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """UTBM's lens bends lines by tens of pixels; its own calibration leaves nothing."""
    root = drives / "utbm_stereo"
    own = tmp_path / "bb2_left.yaml"
    shutil.copy(root / own.name, own)
    lens = read_calibration(own).cameras[0]
    coefficients = re.search(r"distortion_coefficients:.*?data: (\[.*?\])", own.read_text(), re.S)
    assert coefficients is not None
    weaker = lens.distortion * (0.0 if planted == "no distortion" else 1.0)
    own.write_text(own.read_text().replace(coefficients[1], str([*weaker.tolist(), 0.0][:5])))
    images = root / "bb2_left"
    if planted == "rectified before":
        images = tmp_path / "images"
        images.mkdir()
        for path in (root / "bb2_left").iterdir():
            image = cv2.imread(str(path))
            straight = cv2.undistort(image, lens.K, lens.distortion)  # type: ignore[arg-type]
            cv2.imwrite(str(images / path.name), straight)
    code, out, err = call(
        capsys, "new", tmp_path / "town", "--images", images, "--calibration", own
    )  # fmt: skip
    assert code == 0
    assert "distortion removed" in out
    assert warning in err
    assert "red and blue are swapped" in err
    assert bool(warning) == ("straight edges bend by" in err)


def test_a_real_stereo_pair_of_euroc_is_rectified(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = (drives / "euroc_micro" / "mav0" / name for name in ("cam0", "cam1"))
    code, out, err = call(
        capsys, "new", tmp_path / "euroc", "--images", left / "data", "--right", right / "data",
        "--calibration", left / "sensor.yaml", "--right-calibration", right / "sensor.yaml",
        "--strict",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "2 cameras 0.110 m apart" in out
    assert "names of the images, in ns" in out


def test_phone_photos_without_calibration_are_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = drives / "lund_exif_gps" / "images"
    code, _, err = call(capsys, "new", tmp_path / "lund", "--images", images)
    assert code == 2
    assert "no calibration. A guess would be wrong; give --calibration FILE" in err
    poses = drives / "lund_exif_gps" / "gps.csv"
    code, _, err = call(capsys, "new", tmp_path / "lund", "--images", images, "--poses", poses)
    assert (code, err.count("\n")) == (2, 1)


def test_a_real_frame_of_nuscenes(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six cameras, up to 43 ms apart; the street ahead is above the horizon of none."""
    from nuscenes_tables import write_tables

    source = drives / "nuscenes_frame"
    root = tmp_path / "nuscenes"
    write_tables(source / "mmdet3d_info.pkl", root / "v1.0-mini", source)
    (root / "samples").symlink_to(source / "samples")
    times = []
    for camera in sorted(path.name for path in (source / "samples").iterdir()):
        town = tmp_path / camera
        code, out, err = call(capsys, "new", town, "--images", root, "--cameras", camera)
        assert code == 0, err
        assert "1600x900" in out
        assert "1 frames, 1 with a pose, 0.0 m, 1 camera" in out
        (frame,) = Workspace.open(town).source.frames
        times.append(frame.time_s)
        assert frame.T_map_camera is not None
        assert frame.T_map_camera.rotation[2, 1] < -0.99  # y is down
    assert 0.04 < np.ptp(times) < 0.046
    pair = ("new", tmp_path / "pair", "--images", root, "--cameras", "CAM_FRONT,CAM_BACK")
    code, _, err = call(capsys, *pair)
    assert code == 2
    assert "no stereo pair; choose one camera" in err
    assert call(capsys, *pair, "--rig")[0] == 0


def test_a_real_frame_of_nuscenes_as_a_rig_of_six(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A point of the world lands where nuScenes puts it, in all cameras that see it."""
    from nuscenes_tables import read_frame, write_tables

    source = drives / "nuscenes_frame"
    root = tmp_path / "nuscenes"
    write_tables(source / "mmdet3d_info.pkl", root / "v1.0-mini", source)
    (root / "samples").symlink_to(source / "samples")
    names = sorted(path.name for path in (source / "samples").iterdir())
    town = tmp_path / "town"
    code, out, err = call(capsys, "new", town, "--images", root, "--cameras", ",".join(names))
    assert code == 0, err
    assert "one pinhole camera for all 6" in out
    assert "CAM_BACK: sees 89 x 58 deg, of which 63 x 38 are left" in err
    dataset = Workspace.open(town).source
    assert isinstance(dataset, ImageFolder)
    assert np.ptp([frame.time_s for frame in dataset.frames]) > 0.04
    told = read_frame(source / "mmdet3d_info.pkl")
    ego2global = np.array(told["ego2global"])
    rng = np.random.default_rng(0)
    points = rng.uniform([-40.0, -40.0, -1.0], [40.0, 40.0, 6.0], (4000, 3))
    world = points @ ego2global[:3, :3].T + ego2global[:3, 3]
    for frame in dataset.frames:
        camera = told["images"][dataset.camera_of[frame.index]]
        T_camera_ego = np.linalg.inv(np.array(camera["cam2ego"]))
        in_camera = points @ T_camera_ego[:3, :3].T + T_camera_ego[:3, 3]
        pixels = in_camera @ np.array(camera["cam2img"])[:3, :3].T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert frame.T_map_camera is not None
        rectified = dataset.rig.left.project(frame.T_map_camera.inverse().apply(world))
        shown = np.flatnonzero(dataset.rig.left.contains(rectified))
        assert len(shown) > 100
        found = dataset.to_original(rectified[shown], frame.index, "left")
        assert np.linalg.norm(found - pixels[shown], axis=1).max() < 0.1


def test_real_pairs_of_kitti_360_in_the_layout_of_nerfstudio(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both cameras in one folder; six of the ten listed images are missing."""
    root = drives / "kitti360_nerf"
    code, out, err = call(
        capsys, "new", tmp_path / "town", "--images", root / "*_00.png", "--right",
        root / "*_01.png", "--poses", root / "transforms.json", "--metric", "--strict",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "2 pairs, by name" in out
    assert "2 cameras 0.595 m apart" in out
    rows = re.search(r"off their row, median +(\d\.\d\d) px", out)
    assert rows is not None
    assert float(rows[1]) < 0.5
    assert re.search(r"\d+ matches, that agree +\d\d%", out)


def test_a_real_log_of_argoverse_2(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its tables with grey images: radial terms alone, poses in city coordinates."""
    log = tmp_path / "log"
    shutil.copytree(drives / "argoverse2", log)
    stamps = feather.read_table(log / "city_SE3_egovehicle.feather")["timestamp_ns"].to_pylist()
    folder = log / "sensors" / "cameras" / "ring_front_center"
    folder.mkdir(parents=True)
    for stamp in stamps[100:2000:500]:
        cv2.imwrite(str(folder / f"{stamp}.jpg"), np.full((2048, 1550, 3), 90, np.uint8))
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", log)
    assert code == 0, err
    assert "brown-conrady (-0.241, -0.212, 0, 0, 0.326)" in out
    assert re.search(r"up is z \(cameras tilted [0-3] deg\)", out)
    assert "4 of 4 images have a pose (by time)" in out
    assert "moves" not in err  # it looks where it goes


def test_real_tables_of_boreas(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "boreas"
    for name in ("camera", "calib", "applanix"):
        (root / name).mkdir(parents=True)
    shutil.copy(drives / "boreas" / "P_camera.txt", root / "calib")
    shutil.copy(drives / "boreas" / "camera_poses.csv", root / "applanix")
    lines = (root / "applanix" / "camera_poses.csv").read_text().splitlines()[1:]
    image = np.full((2048, 2448, 3), 90, np.uint8)
    for line in lines[::30]:
        cv2.imwrite(str(root / "camera" / f"{line.split(',')[0]}.png"), image)
    code, out, err = call(capsys, "new", tmp_path / "town", "--images", root)
    assert code == 0, err
    assert "up is z" in out
    assert "origin moved to 623000 4849000 0 m" in out
    frames = Workspace.open(tmp_path / "town").source.frames
    assert all(frame.T_map_camera is not None for frame in frames)


def test_real_poses_of_comma2k19(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """ECEF keeps its millimetres; the camera looks where it drives, and up is up."""
    images = tmp_path / "cam"
    images.mkdir()
    shutil.copy(drives / "comma2k19" / "preview.png", images / "0.png")
    for index in range(1, 1200):
        (images / f"{index}.png").hardlink_to(images / "0.png")
    own = tmp_path / "cam.toml"
    own.write_text(
        '[left]\nsize_px = [1164, 874]\nmodel = "pinhole"\nfocal_px = [910, 910]\n'
        "center_px = [582, 437]\n"
    )
    code, out, err = call(
        capsys, "new", tmp_path / "town", "--images", images, "--calibration", own,
        "--poses", drives / "comma2k19" / "global_pose", "--rate", "20", "--frames", "0:1200:20",
    )  # fmt: skip
    assert code == 0, err
    assert "up is the earth's" in out
    assert "camera moves" not in err
    t = [frame.T_map_camera for frame in Workspace.open(tmp_path / "town").source.frames]
    heights = np.array([pose.translation[2] for pose in t if pose is not None])
    assert len(heights) == 60
    assert np.ptp(heights) < 40.0


@pytest.mark.parametrize("layout", ["nuscenes_tables_lyft", "nuscenes_tables_t4"])
def test_real_tables_in_the_schema_of_nuscenes(drives: Path, tmp_path: Path, layout: str) -> None:
    """Of others: every camera that has images can be read."""
    tables = tmp_path / layout / "annotation"
    shutil.copytree(drives / layout, tables)
    rows = json.loads((tables / "sample_data.json").read_text())
    images = [row for row in rows if row["fileformat"].startswith("jp")]
    for row in images:
        path = tmp_path / layout / row["filename"]
        path.parent.mkdir(parents=True, exist_ok=True)
        size = (row["height"], row["width"], 3)
        cv2.imwrite(str(path), np.zeros(size, np.uint8))
    mounted = json.loads((tables / "calibrated_sensor.json").read_text())
    sensors = json.loads((tables / "sensor.json").read_text())
    channels = {row["token"]: row["channel"] for row in sensors}
    used = {row["calibrated_sensor_token"] for row in images}
    found = {channels[row["sensor_token"]] for row in mounted if row["token"] in used}
    assert found
    for camera in found:
        drive = read_drive(DriveFiles(images=tmp_path / layout, cameras=(camera,)))
        assert all(frame.T_map_camera is not None for frame in drive.frames)


def test_real_ini_files_of_ros(drives: Path) -> None:
    """Eight terms are the rational model."""
    folder = drives / "ros_camera_info"
    wide, rational = (
        read_calibration(folder / name).cameras[0] for name in ("calib5.ini", "calib8_rational.ini")
    )
    assert (wide.width, wide.height, wide.K[0, 0]) == (640, 480, 369.344588)
    np.testing.assert_array_equal(wide.distortion[:2], rational.distortion[:2])
    assert (len(wide.distortion), len(rational.distortion)) == (5, 8)
