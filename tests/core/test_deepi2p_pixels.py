"""Street frames with clouds, and DeepI2P from pixels: its solvers, samples and network."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import pose_error, published_error
from semviz_core.research.evaluation.problems import make_problem
from semviz_core.research.evaluation.street_frames import (
    CLOUD_M,
    LEAST_SEEN,
    OPTIONS,
    PICTURE_CAMERA,
    MappedStreet,
    StreetProblem,
    cell_centers,
    cells,
    street_problem,
)
from semviz_core.research.point_matching.frustum import (
    BOUND_M,
    HEIGHT_BOUND_M,
    cell_matches,
)
from semviz_core.research.point_matching.pixel_methods import METHODS, TrueLabels
from semviz_core.research.point_matching.pixel_network import POINTS, CloudBatch, DeepI2PPixels
from semviz_core.research.point_matching.pixel_training import (
    CLOUDS,
    StreetFrame,
    collate,
    make_cloud_sample,
)
from semviz_core.simulation.drawing import PinholeView
from semviz_core.simulation.layout import with_other_cars
from semviz_core.simulation.lidar import REACH_M, depth_image, merged, scan, surfaces

torch.set_num_threads(1)
SEED = 6


@pytest.fixture(scope="module")
def problem() -> StreetProblem:
    return street_problem(SEED, "paper")


@pytest.fixture(scope="module")
def world() -> MappedStreet:
    return MappedStreet(SEED // 2)


@pytest.fixture(scope="module")
def frame(problem: StreetProblem) -> StreetFrame:
    pose = problem.T_camera_map.inverse()
    cloud = problem.cloud.copy()
    cloud[:, :3] -= pose.translation
    return StreetFrame(problem.picture, cloud.astype(np.float16), pose.rotation.T)


def test_a_scanner_sees_the_nearest_surface_and_nothing_behind_it(world: MappedStreet) -> None:
    layout, pose, rng = world.street.layout, world.pose(30), np.random.default_rng(0)
    solid = replace(layout, trees=())
    returns = scan(solid, pose, rng)
    view = PinholeView(world.street.rig.left, pose)
    pixel, depth = view.project(returns[:, :3]), view.depth(returns[:, :3])
    inside = (depth > 1.0) & view.camera.contains(pixel)
    u, v = np.round(pixel[inside]).astype(int).T
    seen = depth_image(surfaces(solid, pose.translation), view, rng).inverse_depth[v, u]
    assert inside.sum() > 2000
    assert (np.abs(seen * depth[inside] - 1.0) < 0.03).mean() > 0.95  # edges of pixels differ
    assert np.linalg.norm(returns[:, :3] - pose.translation, axis=1).max() < 1.5 * REACH_M


def test_normals_of_a_wall_are_across_it() -> None:
    x, z = np.mgrid[0:6:0.1, 0:3:0.1]
    wall = np.column_stack([x.ravel(), np.full(x.size, 4.0), z.ravel(), np.full(x.size, 0.5)])
    cloud = merged([wall, wall])
    assert len(cloud) == pytest.approx(20 * 10, abs=40)
    np.testing.assert_allclose(np.abs(cloud[:, 5]), 1.0, atol=1e-6)


def test_only_cars_differ_on_another_day(world: MappedStreet) -> None:
    layout = world.street.layout
    other = with_other_cars(layout, OPTIONS, 1)
    assert other.poles is layout.poles
    assert other.houses is layout.houses
    places = {tuple(car.middle_m.round(2)) for car in layout.cars}
    assert other.cars
    assert not places & {tuple(car.middle_m.round(2)) for car in other.cars}


def test_a_frame_shows_enough_and_its_pairs_are_true(problem: StreetProblem) -> None:
    assert len(problem.observed) >= LEAST_SEEN
    assert problem.picture.shape == (160, 640, 3)
    offset = np.linalg.norm(problem.cloud[:, :2] - problem.prior.position_m[:2], axis=1)
    assert offset.max() < CLOUD_M
    center = problem.T_camera_map.inverse().translation
    assert np.linalg.norm((problem.prior.position_m - center)[:2]) < 5.0
    i, j = problem.pairs.T
    assert len(i) >= 3
    place = problem.T_camera_map.apply(problem.submap.anchor_m[j])
    off = problem.camera.project(place) - problem.observed.anchor_px[i]
    known = problem.observed.anchor_known[i]
    assert np.median(np.linalg.norm(off[known], axis=1)) < 25.0


@pytest.mark.parametrize("name", ["true frustum", "true cells"])
def test_true_labels_give_the_pose(problem: StreetProblem, name: str) -> None:
    result = METHODS[name]().solve(problem)
    assert result.T_camera_map is not None, result.reason
    rte_m, rre_deg = pose_error(result.T_camera_map, problem.T_camera_map)
    assert rte_m < 1.5
    assert rre_deg < 4.0


def test_the_labels_alone_decide(problem: StreetProblem) -> None:
    """Labels of a camera that is turned about the fix give that camera's heading."""
    origin = Pose(np.eye(3), problem.prior.position_m)
    turn = Pose.from_rotvec([0.0, 0.0, 0.6], np.zeros(3))
    turned = problem.T_camera_map @ origin @ turn @ origin.inverse()
    result = TrueLabels("true cells", "cells").solve(replace(problem, T_camera_map=turned))
    assert result.T_camera_map is not None, result.reason
    assert pose_error(result.T_camera_map, turned)[1] < 4.0
    assert pose_error(result.T_camera_map, problem.T_camera_map)[1] > 20.0


def test_the_shipped_network_gives_a_level_pose_near_the_fix(problem: StreetProblem) -> None:
    result = METHODS["deepi2p-pixels"]().solve(problem)
    assert result.T_camera_map is not None, result.reason
    offset = result.T_camera_map.inverse().translation - problem.prior.position_m
    assert np.abs(offset).max() <= BOUND_M + 1e-9
    assert np.abs(offset[2]) <= HEIGHT_BOUND_M + 1e-9
    up = result.T_camera_map.rotation[:, 2]
    np.testing.assert_allclose(up, problem.prior.up_camera, atol=1e-9)
    assert set(result.time_ms) == {"label", "solve"}


def test_chance_knows_the_fix_and_gravity_alone(problem: StreetProblem) -> None:
    result = METHODS["fix alone"]().solve(problem)
    assert result.T_camera_map is not None
    center = result.T_camera_map.inverse().translation
    np.testing.assert_allclose(center, problem.prior.position_m, atol=1e-9)
    up = result.T_camera_map.rotation[:, 2]
    np.testing.assert_allclose(up, problem.prior.up_camera, atol=1e-9)


def test_frames_without_a_cloud_are_refused() -> None:
    with pytest.raises(SemvizError, match="street-paper"):
        METHODS["true cells"]().solve(make_problem(3))


def test_a_point_is_in_the_cell_around_it() -> None:
    pixel = np.array([[-0.4, -0.4], [31.4, 0.0], [31.6, 0.0], [639.4, 159.4]])
    found = cells(pixel, np.ones(4, bool))
    assert found.tolist() == [0, 0, 1, 99]
    assert np.abs(cell_centers(found) - pixel).max() < 16.0
    corner = np.array([[0.0, 0.0]])
    assert cells(np.array([[np.nan, np.nan]]), np.zeros(1, bool)).tolist() == [0]
    assert cell_centers(cells(corner, np.ones(1, bool))).tolist() == [[15.5, 15.5]]


def test_samples_stay_true_when_turned_shifted_and_mirrored(frame: StreetFrame) -> None:
    """The labels of each draw fix one camera within the error of its fix."""
    poses = []
    for seed in range(3):
        sample = make_cloud_sample(frame, np.random.default_rng(seed))
        assert sample.points.shape == (CLOUDS, POINTS, 7)
        for points, inside, cell in zip(sample.points, sample.inside, sample.cell, strict=True):
            pose = cell_matches(points[:, :3], inside, cell_centers(cell))
            assert isinstance(pose, Pose), pose
            poses.append(pose)
            pixel = PICTURE_CAMERA.project(pose.apply(points[inside, :3]))
            assert np.median(np.abs(pixel - cell_centers(cell[inside]))) < 14.0
    centers = np.array([pose.inverse().translation for pose in poses])
    assert np.linalg.norm(centers[:, :2], axis=1).max() < 7.0
    headings = [np.arctan2(pose.rotation[2, 1], pose.rotation[2, 0]) for pose in poses]
    assert np.ptp(headings) > np.pi


def test_clouds_of_a_picture_do_not_touch_each_other(frame: StreetFrame) -> None:
    torch.manual_seed(0)
    network = DeepI2PPixels().eval()
    batch = collate([make_cloud_sample(frame, np.random.default_rng(seed)) for seed in (0, 1)])
    with torch.no_grad():
        together = network(batch)
        second = slice(CLOUDS, 2 * CLOUDS)
        alone = network(
            CloudBatch(
                batch.picture[1:], batch.points[second], batch.node_a[second],
                batch.node_b[second], batch.inside[second], batch.cell[second],
            )
        )  # fmt: skip
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one[second], other, atol=1e-4, rtol=1e-4)


def test_published_measures_count_a_turn_twice() -> None:
    """A camera in its place, but turned: DeepI2P's translation is off, the centre is not."""
    true = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    turned = Pose.from_rotvec([0.0, 0.5, 0.0], np.zeros(3)) @ true
    origin = np.array([4.0, 0.0, 0.0])
    assert pose_error(turned, true)[0] < 1e-9
    translation_m, euler_deg = published_error(turned, true, origin)
    assert translation_m == pytest.approx(2.0 * np.sin(0.25) * np.hypot(5.0, 3.0))
    assert euler_deg == pytest.approx(np.rad2deg(0.5))
