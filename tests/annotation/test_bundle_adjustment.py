"""Refining landmarks and poses together: nothing where all is exact, better where poses are not."""

import numpy as np
import pytest
from sequences import Drive, drive

from semviz_annotation.mapping.placement import bundle_adjustment as module
from semviz_annotation.mapping.placement.bundle_adjustment import (
    BundleResult,
    Normal,
    RefineOptions,
    Unknowns,
    VisibilityGraph,
    bundle_adjust,
    with_pose_errors,
)
from semviz_annotation.mapping.placement.observations import ViewArray
from semviz_annotation.mapping.placement.triangulation import (
    Landmarks,
    PlaceOptions,
    triangulate_landmarks,
)
from semviz_core.common.errors import SemvizError
from semviz_core.pose_checks.pose_covariance import PoseCovariance

POSES = (0.03, float(np.deg2rad(0.05)))
OPTIONS = RefineOptions(PlaceOptions(), pose_sigma_m=0.03, pose_sigma_deg=0.05)


def refined(world: Drive, options: RefineOptions = OPTIONS) -> tuple[Landmarks, BundleResult]:
    placed = triangulate_landmarks(world.views, world.observations, options.place)
    return placed, bundle_adjust(world.views, world.observations, placed, options)


def far_off(placed: Landmarks, world: Drive, landmarks: np.ndarray) -> float:
    """Root mean square distance of anchors from the truth."""
    return float(np.sqrt(np.square(placed.anchor_m - world.anchor_m)[landmarks].sum(axis=1).mean()))


def centers_off(views: ViewArray, world: Drive) -> float:
    away = views.center_m - world.true_views.center_m
    return float(np.sqrt(np.square(away).sum(axis=1).mean()))


def turned_off(views: ViewArray, world: Drive) -> float:
    return float(np.linalg.norm(views.R - world.true_views.R, axis=(1, 2)).mean())


@pytest.mark.parametrize("seed", range(3))
def test_where_all_is_exact_nothing_moves(seed):
    world = drive(6, landmarks=10, seed=seed, hidden=0.4)
    placed, result = refined(world)
    assert result.converged
    assert np.abs(result.moved).max() < 1e-9
    assert abs(result.offset_px) < 1e-9
    assert np.allclose(result.placed.anchor_m, placed.anchor_m, atol=1e-8)
    assert np.allclose(result.placed.end_m, placed.end_m, atol=1e-8, equal_nan=True)


def test_poses_and_landmarks_come_nearer_to_the_truth():
    world = drive(40, landmarks=60, seed=1, sigma_px=0.5, hidden=0.3, pose_sigma=POSES)
    placed, result = refined(world, RefineOptions(PlaceOptions(0.5), 0.03, 0.05))
    assert result.converged
    assert list(result.costs) == sorted(result.costs, reverse=True)
    assert centers_off(result.views, world) < 0.6 * centers_off(world.views, world)
    assert turned_off(result.views, world) < 0.7 * turned_off(world.views, world)
    ok = placed.ok
    assert far_off(result.placed, world, ok) < 0.7 * far_off(placed, world, ok)
    baseline = result.views.center_m[1::2] - result.views.center_m[::2]
    assert np.allclose(np.linalg.norm(baseline, axis=1), 0.54, atol=1e-12)  # they move as one
    size = np.linalg.norm(result.moved[:, :3], axis=1)
    distance = np.linalg.norm((result.views.center_m - world.views.center_m)[::2], axis=1)
    assert np.allclose(size, distance, atol=1e-12)


def test_an_offset_of_the_right_images_is_found():
    world = drive(20, landmarks=40, seed=2, sigma_px=0.3, offset_px=1.5)
    placed, result = refined(world, RefineOptions(PlaceOptions(0.3), 0.002, 0.003))
    assert result.offset_px == pytest.approx(1.5, abs=0.05)
    assert far_off(result.placed, world, placed.ok) < 0.7 * far_off(placed, world, placed.ok)
    right = result.views.K[result.views.is_right, 0, 2] - world.views.K[0, 0, 2]
    assert np.allclose(right, result.offset_px)
    assert np.array_equal(result.views.K[~result.views.is_right], world.views.K[::2])


def test_covariances_know_that_poses_are_uncertain():
    ratios = {True: [], False: []}
    blind = []
    for seed in range(4):
        world = drive(25, landmarks=80, seed=seed, sigma_px=1.0, pose_sigma=POSES)
        placed, result = refined(world)
        for is_line, size in ((True, 6), (False, 3)):
            landmarks = placed.ok & (world.is_line == is_line)
            truth = np.concatenate([world.anchor_m, world.end_m], axis=1)[landmarks, :size]
            for answer, into in ((placed, blind), (result.placed, ratios[is_line])):
                error = np.concatenate([answer.anchor_m, answer.end_m], axis=1)[landmarks, :size]
                error -= truth
                covariance = answer.covariance_m2[landmarks, :size, :size]
                weighed = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
                into.append((error * weighed).sum() / error.size)
    assert np.mean(blind) > 3.0
    assert 0.8 < np.mean(ratios[True]) < 1.3
    assert 0.8 < np.mean(ratios[False]) < 1.3


def test_covariances_include_the_errors_of_poses_that_stay():
    """Without them a map claims to be several times better than it is."""
    blind, told = [], []
    for seed in range(4):
        world = drive(25, landmarks=80, seed=seed, sigma_px=1.0, pose_sigma=POSES)
        placed = triangulate_landmarks(world.views, world.observations)
        frames = np.unique(world.views.frame_index)
        n, none = len(frames), np.zeros((len(frames), 6, 6))
        poses = PoseCovariance(
            frames, np.zeros(n, bool), np.repeat(POSES, 3) ** 2, none[:, 0], none, none[1:]
        )
        with_poses = with_pose_errors(
            world.views, world.observations, placed, PlaceOptions(), poses
        )
        assert np.array_equal(with_poses.anchor_m, placed.anchor_m, equal_nan=True)
        for answer, into in ((placed, blind), (with_poses, told)):
            landmarks = placed.ok & ~world.is_line
            error = (answer.anchor_m - world.anchor_m)[landmarks]
            covariance = answer.covariance_m2[landmarks, :3, :3]
            weighed = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
            into.append((error * weighed).sum() / error.size)
    assert np.mean(blind) > 3.0
    assert 0.8 < np.mean(told) < 1.3


def test_the_same_comes_out_each_time_and_the_input_stays():
    world = drive(8, landmarks=12, seed=5, sigma_px=1.0, pose_sigma=POSES)
    before = world.views.t.copy(), world.views.K.copy()
    first, second = refined(world)[1], refined(world)[1]
    assert np.array_equal(first.moved, second.moved)
    assert np.array_equal(first.placed.covariance_m2, second.placed.covariance_m2)
    assert np.array_equal(world.views.t, before[0])
    assert np.array_equal(world.views.K, before[1])


def test_frames_without_observations_stay_and_landmarks_without_a_place_stay_out():
    world = drive(12, landmarks=4, seed=6, sigma_px=1.0, pose_sigma=POSES)
    landmark, frame = world.observations.landmark, world.views.frame_index[world.observations.view]
    kept = world.observations.where(
        (frame != 3) & ((landmark != 1) | (np.cumsum(landmark == 1) <= 1))
    )
    placed = triangulate_landmarks(world.views, kept)
    result = bundle_adjust(world.views, kept, placed, OPTIONS)
    assert placed.failure[1] == result.placed.failure[1] == "labelled in one image only"
    assert (result.moved[3] == 0.0).all()
    assert np.abs(result.moved[2]).max() > 0.0


def test_one_camera_will_do():
    world = drive(20, landmarks=30, seed=7, sigma_px=0.5, pose_sigma=POSES)
    left = world.observations.where(~world.views.is_right[world.observations.view])
    placed = triangulate_landmarks(world.views, left, PlaceOptions(min_angle_rad=0.02))
    result = bundle_adjust(world.views, left, placed, OPTIONS)
    assert result.converged
    assert result.offset_px == 0.0
    assert centers_off(result.views, world) < centers_off(world.views, world)


def test_it_can_be_watched_and_interrupted():
    world = drive(5, landmarks=6, sigma_px=1.0, pose_sigma=POSES)
    placed = triangulate_landmarks(world.views, world.observations)
    told: list[int] = []
    bundle_adjust(
        world.views, world.observations, placed, OPTIONS, lambda done, of: told.append(done)
    )
    assert told == list(range(len(told)))

    def stop(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bundle_adjust(world.views, world.observations, placed, OPTIONS, stop)


def test_there_must_be_something_to_refine():
    world = drive(3, landmarks=2)
    nothing = world.observations.where(np.zeros(len(world.observations), dtype=bool))
    with pytest.raises(SemvizError, match="nothing to refine"):
        bundle_adjust(world.views, nothing, triangulate_landmarks(world.views, nothing))


@pytest.mark.parametrize("name", ["pose_sigma_m", "pose_sigma_deg", "offset_sigma_px"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_sigmas_are_positive_numbers(name, value):
    with pytest.raises(SemvizError, match=f"{name} must be positive"):
        RefineOptions(**{name: value})


# -- the equations behind it


def dense(normal: Normal, damping: float = 0.0) -> np.ndarray:
    """All unknowns' matrix: landmarks, frames, the shared one."""
    n, f = len(normal.landmarks), len(normal.frames)
    H = np.zeros((6 * (n + f) + 1,) * 2)
    more = 1.0 + damping * np.eye(6)
    for number, block in enumerate([*normal.landmarks * more, *normal.frames * more]):
        rows = slice(6 * number, 6 * number + 6)
        H[rows, rows] = block
    H[: 6 * n, 6 * n : -1] = normal.visibility.matrix(normal.between).toarray()
    H[:-1, -1] = np.concatenate([normal.landmarks_shared.ravel(), normal.frames_shared.ravel()])
    H[-1, -1] = normal.shared * (1.0 + damping)
    return np.triu(H) + np.triu(H, 1).T


def flat(values: Unknowns) -> np.ndarray:
    return np.concatenate([values.landmarks.ravel(), values.frames.ravel(), [values.shared]])


@pytest.fixture
def problem() -> "tuple[module.Problem, Unknowns]":
    """Landmarks in no order along the road, so that some come into sight late."""
    world = drive(12, landmarks=7, seed=8, sigma_px=1.0, hidden=0.4, pose_sigma=POSES, reach_m=28.0)
    mixed = np.array([4, 1, 6, 2, 0, 5, 3])
    observations = world.observations.regrouped(mixed[world.observations.landmark], 7)
    placed = triangulate_landmarks(world.views, observations)
    assert placed.ok.all()
    made = module.BundleProblem(world.views, observations, OPTIONS)
    at = made.start(placed)
    rng = np.random.default_rng(0)
    return made, Unknowns(at.landmarks, rng.normal(0.0, 0.01, at.frames.shape), 0.2)


def test_steps_are_those_of_all_unknowns_at_once(problem):
    made, at = problem
    normal = made.at(at).normal
    for damping in (0.0, 0.1):
        expected = -np.linalg.solve(dense(normal, damping), flat(normal.gradient))
        assert np.allclose(flat(normal.step(damping)), expected, rtol=1e-6, atol=1e-9)


def test_covariances_are_those_of_landmarks_and_frames_at_once(problem):
    made, at = problem
    normal = made.at(at).normal
    whole = np.linalg.inv(dense(normal)[:-1, :-1])
    for landmark, covariance in enumerate(normal.landmark_covariance()):
        rows = slice(6 * landmark, 6 * landmark + 6)
        assert np.allclose(covariance, whole[rows, rows], rtol=1e-6, atol=1e-12)


def test_the_gradient_is_that_of_the_cost(problem):
    made, at = problem
    gradient = made.at(at).normal.gradient
    for place_of, which, size in (("landmarks", (2, 1), 1e-6), ("frames", (3, 4), 1e-7)):
        for row, column in (which, (0, 0)):
            costs = []
            for step in (size, -size):
                move = Unknowns(np.zeros_like(at.landmarks), np.zeros_like(at.frames), 0.0)
                getattr(move, place_of)[row, column] = step
                costs.append(made.at(module._after(at, move)).cost)
            slope = (costs[0] - costs[1]) / (2.0 * size)
            assert slope / 2.0 == pytest.approx(getattr(gradient, place_of)[row, column], rel=2e-2)
    ahead, behind = (
        made.at(Unknowns(at.landmarks, at.frames, at.shared + step)).cost for step in (1e-5, -1e-5)
    )
    assert (ahead - behind) / 4e-5 == pytest.approx(gradient.shared, rel=1e-3)


def test_bonds_sum_what_belongs_together():
    world = drive(4, landmarks=3, seed=1)
    frame = world.views.frame_index[world.observations.view]
    bonds = VisibilityGraph.of(world.observations, frame, 4)
    values = np.arange(len(world.observations), dtype=float)
    for pair, total in enumerate(bonds.per_pair(values)):
        mine = (world.observations.landmark == bonds.landmark[pair]) & (frame == bonds.frame[pair])
        assert total == values[mine].sum()
    assert [values[frame == index].sum() for index in range(4)] == list(bonds.per_frame(values))
