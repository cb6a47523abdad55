"""Simulated priors are off by what they say, and only tell what was asked."""

import numpy as np
import pytest

from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior

POSE = Pose.from_rotvec([-1.2, 1.1, -0.9], [40.0, -7.0, 2.0])
DRAWS = 800


def draws(options: PriorOptions) -> list[Prior]:
    return [simulate_prior(POSE, options, (seed, 3)) for seed in range(DRAWS)]


def test_the_fix_is_off_by_a_uniform_distance_in_any_direction() -> None:
    offset = np.array([draw.position_m for draw in draws(PriorOptions())]) - POSE.translation
    distance = np.linalg.norm(offset[:, :2], axis=1)
    assert distance.min() >= 5.0
    assert distance.max() <= 10.0
    assert np.allclose(np.quantile(distance, [0.25, 0.5, 0.75]), [6.25, 7.5, 8.75], atol=0.3)
    assert np.abs(offset[:, :2].mean(axis=0)).max() < 0.6
    assert offset[:, 2].std() == pytest.approx(0.3, rel=0.1)
    sigma = simulate_prior(POSE, PriorOptions(), 0).horizontal_sigma_m
    assert np.sqrt((offset[:, :2] ** 2).mean()) == pytest.approx(sigma, rel=0.05)


def test_gravity_is_off_by_its_sigma_about_each_axis() -> None:
    up = np.array([draw.up_camera for draw in draws(PriorOptions(imu_sigma_rad=0.01))])
    tilt = (up @ POSE.rotation.T)[:, :2]
    assert np.allclose(tilt.std(axis=0), 0.01, rtol=0.1)
    assert np.abs(tilt.mean(axis=0)).max() < 0.002


def test_heading_is_told_only_when_asked() -> None:
    assert simulate_prior(POSE, PriorOptions(), 0).heading_rad is None
    told = draws(PriorOptions(heading_sigma_rad=0.2))
    true = np.arctan2(POSE.rotation[1, 2], POSE.rotation[0, 2])
    error = np.array([float(prior.heading_rad or 0.0) - true for prior in told])
    error = (error + np.pi) % (2.0 * np.pi) - np.pi
    assert error.std() == pytest.approx(0.2, rel=0.1)
    assert told[0].heading_sigma_rad == 0.2


def test_leaving_a_sensor_out_changes_nothing_else() -> None:
    full = simulate_prior(POSE, PriorOptions(heading_sigma_rad=0.1), 5)
    bare = simulate_prior(POSE, PriorOptions(imu_sigma_rad=None), 5)
    assert bare.up_camera is None
    assert np.array_equal(full.position_m, bare.position_m)
    assert np.array_equal(simulate_prior(POSE, PriorOptions(), 5).up_camera, full.up_camera)


def test_a_perfect_fix_is_possible_and_an_impossible_range_is_refused() -> None:
    perfect = simulate_prior(POSE, PriorOptions(distance_m=(0.0, 0.0)), 1)
    assert np.allclose(perfect.position_m[:2], POSE.translation[:2])
    with pytest.raises(SemvizError, match="not a range"):
        PriorOptions(distance_m=(10.0, 5.0))
