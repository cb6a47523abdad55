"""Roads: what a drive passes, and real ones read from files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.research.evaluation.roads import (
    LEAST_OFFSET_M,
    T_CAM0_VELODYNE,
    BenchmarkRoad,
    kitti_road,
    simulated_road,
)

AHEAD = Pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def straight(poles_m: list[list[float]], length: int = 60, rise: float = 0.1) -> BenchmarkRoad:
    """A road along x, a pose each half metre, climbing by ``rise`` a metre."""
    poses = [
        Pose(AHEAD.rotation, np.array([0.5 * k, 0.0, 1.65 + rise * 0.5 * k])) for k in range(length)
    ]
    return BenchmarkRoad("straight", tuple(poses), np.array(poles_m))


@pytest.fixture(scope="module", params=range(3))
def road(request: pytest.FixtureRequest) -> BenchmarkRoad:
    return simulated_road(request.param)


def test_a_simulated_road_is_repeatable() -> None:
    first, same, other = simulated_road(3), simulated_road(3), simulated_road(4)
    np.testing.assert_array_equal(first.center_m, same.center_m)
    np.testing.assert_array_equal(first.poles_m, same.poles_m)
    assert len(first) != len(other) or not np.allclose(first.center_m, other.center_m)


def test_a_simulated_road_is_driven_smoothly_with_bends_and_slopes(road: BenchmarkRoad) -> None:
    step = np.diff(road.center_m, axis=0)
    length = np.linalg.norm(step[:, :2], axis=1)
    assert 1_500.0 < length.sum() < 3_500.0
    assert np.median(length) == pytest.approx(1.0, abs=0.05)
    assert 0.1 < length.min() < length.max() < 1.5  # less on the inside of corners
    slope = step[:, 2] / length
    assert 0.03 < np.abs(slope).max() < 0.12
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    assert np.ptp(heading) > np.pi  # there are corners
    assert np.abs(np.diff(heading)).max() < 0.3


def test_cameras_look_along_the_drive_and_do_not_roll(road: BenchmarkRoad) -> None:
    step = np.gradient(road.center_m, axis=0)
    rotation = np.array([pose.rotation for pose in road.T_map_camera])
    along = step / np.linalg.norm(step, axis=1, keepdims=True)
    np.testing.assert_allclose(rotation[:, :, 2], along, atol=1e-6)
    np.testing.assert_allclose(rotation[:, 2, 0], 0.0, atol=1e-9)  # x stays level
    assert (rotation[:, 2, 1] < -0.9).all()  # y looks down


def test_some_of_a_simulated_road_crosses_itself_at_another_height(road: BenchmarkRoad) -> None:
    center = road.center_m
    near = cKDTree(center[:, :2]).query_pairs(3.0, output_type="ndarray")
    height = np.abs(np.subtract(*center[near.T, 2]))
    assert height.max() > 4.0


def test_some_of_a_simulated_road_is_driven_twice(road: BenchmarkRoad) -> None:
    center = road.center_m
    near = cKDTree(center).query_pairs(4.0, output_type="ndarray")
    again = np.unique(near[np.abs(near[:, 0] - near[:, 1]) > 50])
    assert 0.1 < len(again) / len(road) < 0.6


def test_no_pole_stands_on_the_road(road: BenchmarkRoad) -> None:
    distance, _ = cKDTree(road.center_m[:, :2]).query(road.poles_m)
    assert distance.min() >= LEAST_OFFSET_M
    assert np.quantile(distance, 0.9) < 25.0


def test_poles_of_a_simulated_road_are_as_dense_as_kitti_s(road: BenchmarkRoad) -> None:
    away_m = np.linalg.norm(road.center_m[::20, None, :2] - road.poles_m, axis=2)
    seen = (away_m <= 50.0).sum(axis=1)
    assert 10 < np.median(seen) < 60
    assert np.quantile(seen, 0.9) > 1.5 * np.quantile(seen, 0.1)  # and as irregular


def test_ground_is_that_of_the_nearest_pose() -> None:
    road = straight([[10.0, 5.0], [20.0, -3.0]])
    np.testing.assert_allclose(road.ground_m, [1.0, 2.0])
    assert road.height(np.array([10.1, 4.0, -77.0])) == pytest.approx(2.65)


def test_poles_are_mapped_from_15_m_before() -> None:
    road = straight([[20.0, 5.0], [2.0, 5.0]])
    view = road.mapping_view
    np.testing.assert_allclose(np.linalg.norm(view, axis=1), 1.0)
    back = 5.0 / view[:, 1]  # metres along the view back to the drive, at y = 0
    assert back[0] == pytest.approx(15.0, abs=0.5)
    assert back[1] == pytest.approx(np.hypot(2.0, 5.0), abs=1e-9)  # the drive begins there


def test_the_road_near_a_place_has_a_pose_each_metre() -> None:
    road = straight([[10.0, 5.0]], length=200)
    near = road.near(np.array([50.0, 0.0, 0.0]), 10.0)
    assert len(near) == 21
    np.testing.assert_allclose(np.diff(near[:, 0]), 1.0)
    np.testing.assert_allclose(near[:, 2], 1.65 + 0.1 * near[:, 0])


def test_a_road_of_one_pose_is_refused() -> None:
    with pytest.raises(SemvizError, match="road short: 1 poses; give two or more"):
        BenchmarkRoad("short", (AHEAD,), np.zeros((0, 2)))


# --- files of KITTI ---


def write_poses(path: Path, count: int = 30) -> Path:
    """A drive straight ahead, half a metre a frame, in KITTI's axes."""
    matrix = np.tile(np.eye(3, 4), (count, 1, 1))
    matrix[:, 2, 3] = 0.5 * np.arange(count)
    np.savetxt(path, matrix.reshape(count, 12))
    return path


def write_poles(path: Path, poles: object, name: str = "poleparams") -> Path:
    np.savez(path, **{name: np.asarray(poles, dtype=np.float64)})
    return path


POLES = [[5.0, 4.0, 0.1], [6.0, 1.0, 0.1], [9.0, -3.0, 0.1]]


def test_a_kitti_drive_is_turned_to_z_up(tmp_path: Path) -> None:
    poses, poles = write_poses(tmp_path / "02.txt"), write_poles(tmp_path / "p.npz", POLES)
    road = kitti_road(poses, poles, "02")
    assert road.name == "02"
    assert len(road) == 30
    np.testing.assert_allclose(road.center_m[-1], [14.5, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(road.T_map_camera[0].rotation, AHEAD.rotation, atol=1e-9)
    behind = T_CAM0_VELODYNE.translation[2]
    np.testing.assert_allclose(  # the second pole stands on the road
        road.poles_m, [[5.0 + behind, 4.0], [9.0 + behind, -3.0]], atol=1e-9
    )


def test_a_calibration_places_the_velodyne(tmp_path: Path) -> None:
    poses, poles = write_poses(tmp_path / "02.txt"), write_poles(tmp_path / "p.npz", POLES)
    calibration = tmp_path / "calib.txt"
    calibration.write_text("P0: 1\nTr: 0 -1 0 0.5  0 0 -1 0  1 0 0 -0.2\n")
    road = kitti_road(poses, poles, "02", calibration)
    np.testing.assert_allclose(road.poles_m, [[4.8, 3.5], [8.8, -3.5]], atol=1e-9)


def test_what_is_wrong_with_files_is_named(tmp_path: Path) -> None:
    poses, poles = write_poses(tmp_path / "02.txt"), write_poles(tmp_path / "p.npz", POLES)
    torn, text = tmp_path / "torn.txt", poses.read_text().splitlines()
    torn.write_text("\n".join([text[0], text[1][:-30], *text[2:]]))
    bent = tmp_path / "bent.txt"
    bent.write_text("\n".join([text[0], " ".join(["3"] * 12)]))
    other = write_poles(tmp_path / "other.npz", POLES, "poles")
    flat = write_poles(tmp_path / "flat.npz", [1.0, 2.0])
    nan = write_poles(tmp_path / "nan.npz", [[np.nan, 1.0]])
    broken, no_laser = tmp_path / "broken.npz", tmp_path / "calib.txt"
    broken.write_bytes(poles.read_bytes()[:100])
    no_laser.write_text("P0: 1\n")
    mistakes = [
        ((tmp_path / "no.txt", poles, None), "no.txt: no such file"),
        ((torn, poles, None), "torn.txt, line 2: "),
        ((bent, poles, None), "bent.txt, line 2: "),
        ((poses, tmp_path / "no.npz", None), "no.npz: no such file; give the sequence's pole map"),
        ((poses, other, None), "other.npz: holds no 'poleparams'"),
        ((poses, flat, None), r"flat.npz: poleparams has shape \(2,\), expected \(n, 2\)"),
        ((poses, nan, None), "nan.npz: poleparams"),
        ((poses, broken, None), "broken.npz: not a readable npz file"),
        ((poses, poles, no_laser), "calib.txt: no line 'Tr:'"),
    ]
    for (drive, standing, calibration), words in mistakes:
        with pytest.raises(SemvizError, match=words) as error:
            kitti_road(drive, standing, "02", calibration)
        assert "\n" not in str(error.value)


@pytest.mark.realdata
def test_a_real_drive_and_its_surveyed_poles(kitti_root: Path, kitti_pole_map: Path) -> None:
    poses = kitti_root / "poses" / "02.txt"
    road = kitti_road(poses, kitti_pole_map, "02")
    by_calibration = kitti_road(
        poses, kitti_pole_map, "02", kitti_root / "sequences" / "02" / "calib.txt"
    )
    assert len(road) == 4_661
    assert len(road.poles_m) > 300
    distance, _ = cKDTree(road.center_m[:, :2]).query(road.poles_m)
    assert LEAST_OFFSET_M <= distance.min() < np.median(distance) < 15.0
    assert np.ptp(road.center_m[:, 2]) < 0.1 * np.ptp(road.center_m[:, :2])  # z is up
    together = cKDTree(by_calibration.poles_m).query(road.poles_m)[0]
    assert np.quantile(together, 0.9) < 0.5  # a thousandth of a radian, far away
