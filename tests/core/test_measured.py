"""Priors and odometry from files: formats, latency, rate, gaps, and what is not known."""

from pathlib import Path

import numpy as np
import pytest

from semviz_core.base.frame import Frame, OdometryNoise, Prior
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.measured_poses import Surroundings
from semviz_core.datasets.measured_priors import (
    MeasuredOdometry,
    MeasuredPriors,
    PriorSigmas,
    read_odometry,
    read_priors,
)
from semviz_core.datasets.own_drive.poses.conventions import geodetic, map_on_earth
from semviz_core.datasets.trajectory import T_MAP_WORLD, save_trajectory

NO_ROAD = np.zeros((0, 3))
ORIGIN = (49.0, 8.4, 115.0)


def frame(index: int, T_map_camera: Pose | None = None) -> Frame:
    return Frame(index, 0.1 * index, T_map_camera)


def camera(x_m: float, yaw_rad: float = 0.0, z_m: float = 1.6) -> Pose:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = Pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), [x_m, 0.0, z_m])
    return turned @ T_MAP_WORLD


def priors_of(tmp_path: Path, text: str, around: Surroundings | None = None) -> MeasuredPriors:
    path = tmp_path / "priors.csv"
    path.write_text(text)
    return read_priors(path, around or Surroundings(), PriorSigmas(), NO_ROAD)


def odometry_of(tmp_path: Path, text: str) -> MeasuredOdometry:
    path = tmp_path / "odometry.csv"
    path.write_text(text)
    return read_odometry(path, Surroundings(), OdometryNoise(), 0.25)


def known(prior: Prior | None) -> Prior:
    assert prior is not None
    return prior


def test_a_table_says_what_it_measured_and_no_more(tmp_path: Path) -> None:
    priors = priors_of(
        tmp_path,
        "time_s,x_m,y_m,z_m,heading_deg,horizontal_sigma_m,satellites\n"
        "0.0,1,2,3,90,0.5,9\n0.1,,,,,,0\n0.2,2,2,3,,,8\n",
    )
    assert priors.ignored == ("satellites",)
    first, last = known(priors.prior_of(frame(0))), known(priors.prior_of(frame(2)))
    assert first.position_m.tolist() == [1.0, 2.0, 3.0]
    assert (first.heading_rad, first.horizontal_sigma_m) == pytest.approx((np.pi / 2, 0.5))
    assert first.up_camera is None
    assert last.heading_rad is None
    assert last.horizontal_sigma_m == PriorSigmas().horizontal_m


def test_a_fix_serves_frames_once_it_arrived_until_it_is_too_old(tmp_path: Path) -> None:
    priors = priors_of(tmp_path, "time_s,latency_s,x_m,y_m,z_m\n0,0.2,0,0,0\n1,0.2,10,0,0\n")
    assert priors.prior_of(frame(1)) is None  # measured, and not there yet
    assert known(priors.prior_of(frame(5))).position_m[0] == 0.0
    assert known(priors.prior_of(frame(10))).position_m[0] == 0.0  # the second is on its way
    assert known(priors.prior_of(frame(12))).position_m[0] == 10.0
    assert priors.prior_of(frame(30)) is None
    wide = known(priors.prior_of(frame(5))).horizontal_sigma_m  # at 10 m/s, for half a second
    assert wide == pytest.approx(np.hypot(5.5, 5.0))


def test_odometry_carries_an_old_prior_to_the_frame(tmp_path: Path) -> None:
    poses = [camera(0.7 * k, 0.03 * k) for k in range(11)]
    path = tmp_path / "poses.tum"
    save_trajectory([frame(k, pose) for k, pose in enumerate(poses)], path, "tum")
    odometry = read_odometry(path, Surroundings(), OdometryNoise(), 0.25)
    first = tmp_path / "first.tum"
    first.write_text(path.read_text().splitlines()[0])
    priors = read_priors(first, Surroundings(), PriorSigmas(), NO_ROAD)
    prior = known(priors.prior_of(frame(10), odometry.between))
    assert np.allclose(prior.position_m, poses[10].translation)
    assert prior.heading_rad == pytest.approx(heading_rad(poses[10]))
    assert prior.up_camera is not None
    assert np.allclose(prior.up_camera, poses[10].rotation[2])
    assert prior.horizontal_sigma_m > PriorSigmas().horizontal_m


def test_gnss_is_placed_by_the_anchor_of_the_map(tmp_path: Path) -> None:
    text = "name,utc_ns,lat_deg,lon_deg,alt_m,true_heading_deg\na.jpg,0,49.0001,8.4,115,0\n"
    with pytest.raises(SemvizError, match="--anchor"):
        priors_of(tmp_path, text)
    for x_heading_deg, expected in ((90.0, (0.0, 11.12, 0.0)), (0.0, (11.12, 0.0, 0.0))):
        around = Surroundings(T_map_ecef=map_on_earth(ORIGIN, x_heading_deg))
        prior = known(priors_of(tmp_path, text, around).prior_of(frame(0)))
        assert np.allclose(prior.position_m, expected, atol=0.01)
        assert prior.heading_rad == pytest.approx(np.deg2rad(x_heading_deg), abs=1e-4)
        assert prior.up_camera is None  # no pitch, no roll


def test_a_fix_without_height_is_on_the_road_of_the_map(tmp_path: Path) -> None:
    path = tmp_path / "priors.csv"
    path.write_text("frame,x_m,y_m\n0,4,0\n")
    with pytest.raises(SemvizError, match="heights"):
        read_priors(path, Surroundings(), PriorSigmas(), NO_ROAD)
    road_m = np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 7.0]])
    priors = read_priors(path, Surroundings(), PriorSigmas(), road_m)
    assert known(priors.prior_of(frame(0))).position_m.tolist() == [4.0, 0.0, 7.0]
    assert priors.prior_of(frame(1)) is None


def test_odometry_of_any_world_and_scale_of_noise(tmp_path: Path) -> None:
    rows = ["time_s,x_m,y_m,z_m,qx,qy,qz,qw,translation_sigma_m,rotation_sigma_deg"]
    elsewhere = Pose.exp([5.0, 6.0, 7.0, 0.4, 0.5, 0.6])
    poses = [camera(0.5 * k) for k in range(6)]
    for k, pose in enumerate(poses):
        moved = elsewhere @ pose
        numbers = [0.1 * k, *moved.translation, *moved.as_quaternion(), 0.03, 0.2]
        rows.append(",".join(map(str, numbers)))
    odometry = odometry_of(tmp_path, "\n".join(rows))
    step = odometry.of_step(frame(1), frame(3))
    assert step is not None
    assert np.allclose((poses[3].inverse() @ poses[1]).as_matrix(), step.T_now_before.as_matrix())
    assert np.sqrt(step.covariance[0, 0]) == pytest.approx(0.03 * np.sqrt(2.0))
    assert odometry.of_step(frame(4), frame(7)) is None  # behind the last line


def test_speeds_and_yaw_rates_of_wheels(tmp_path: Path) -> None:
    rate, speed = np.deg2rad(20.0), 10.0
    lines = [f"{0.02 * k},{speed},20" for k in range(51)]
    odometry = odometry_of(tmp_path, "\n".join(["time_s,speed_mps,yaw_rate_degps", *lines]))
    step = odometry.of_step(frame(0), frame(10))
    assert step is not None
    T = T_MAP_WORLD @ step.T_now_before.inverse() @ T_MAP_WORLD.inverse()  # T_before_now, body
    radius = speed / rate
    assert np.allclose(T.translation, [radius * np.sin(rate), radius * (1 - np.cos(rate)), 0.0],
                       atol=1e-3)  # fmt: skip
    gap = odometry_of(tmp_path, "time_s,speed,yaw_rate\n0,1,0\n0.1,1,0\n0.9,1,0\n1.0,1,0")
    assert gap.of_step(frame(0), frame(10)) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,x_m,y_m,z_m\n0,1,2\n", "line 2: 3 cells, expected 4"),
        ("time_s,x_m,y_m,z_m\n0,1,two,3\n", "line 2: y_m 'two' is not a finite number"),
        ("time_s,x_m,y_m,z_m\n,1,2,3\n", "line 2: time_s is empty"),
        ("x_m,y_m,z_m\n1,2,3\n", "no column time_s, frame or name"),
        ("time_s,heading_deg\n0,2\n", "no columns x_m and y_m"),
        ("time_s,x_m,y_m,z_m\n0,,,\n", "no line has a position"),
        ("time_s,x_m,y_m,z_m,up_x,up_y,up_z\n0,1,2,3,0,-3,0\n", "have length 3.00"),
        ("time_s,x_m,y_m,z_m,horizontal_sigma_m\n0,1,2,3,0\n", "horizontal_sigma_m is 0"),
        ("hello\n", "not a finite number|holds no poses"),
        (f"time_s,x_m,y_m,z_m\n{'1' * 200_000},1,2,3\n", "not a CSV table"),
        ("", "is empty"),
    ],
)
def test_broken_files_are_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        priors_of(tmp_path, text)


def test_a_place_on_earth_and_back() -> None:
    place = map_on_earth(ORIGIN, 90.0).inverse().translation
    assert geodetic(place) == pytest.approx(ORIGIN)
