"""The search's parts: gravity from poles, hypotheses near the truth, pairs, score, modes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semviz_core.evaluation.problems import Difficulty, Problem, make_problem
from semviz_core.frame import Prior
from semviz_core.solving.association import associate, log_likelihood, one_to_one
from semviz_core.solving.hypotheses import upright_hypotheses
from semviz_core.solving.residuals import SURE
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.search import apart, camera_pose, search
from semviz_core.solving.upright import gravity, level_rotation, upright_views

EXACT = Difficulty(
    sigma_px=1e-3, map_sigma_m=0.0, moved=0.0, missing=0.0, false_detections=0.0, hidden_bottoms=0.0
)
GAINS = arrays(np.float64, (5, 7), elements=st.one_of(st.just(-np.inf), st.floats(-5.0, 20.0)))


def scene_of(problem: Problem) -> Scene:
    return Scene.of(problem.camera, problem.observed, problem.submap)


def exact_prior(problem: Problem, **changes: object) -> Prior:
    true_up = problem.T_camera_map.rotation[:, 2]
    center = problem.T_camera_map.inverse().translation
    height = np.array([*problem.prior.position_m[:2], center[2]])
    return replace(problem.prior, position_m=height, up_camera=true_up, **changes)


@given(gain=GAINS)
def test_pairs_are_one_to_one_and_worth_their_gain(gain: np.ndarray) -> None:
    match = one_to_one(gain)
    rows = np.flatnonzero(match >= 0)
    assert len(np.unique(match[rows])) == len(rows)
    assert (gain[rows, match[rows]] > 0.0).all()
    free = np.setdiff1d(np.arange(gain.shape[1]), match)
    assert (gain[match < 0][:, free] <= 0.0).all()  # none left out that would have gained


def test_gravity_from_poles_alone() -> None:
    errors = []
    for seed in range(20):
        problem = make_problem(seed, Difficulty(with_gravity=False))
        up, covariance = gravity(scene_of(problem), problem.prior)
        sigma = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
        error = np.arccos(np.clip(up @ problem.T_camera_map.rotation[:, 2], -1.0, 1.0))
        errors.append(error / sigma)
        assert np.linalg.norm(up) == pytest.approx(1.0)
    assert np.median(errors) < 2.0


def test_level_rotation_takes_up_to_z_and_the_optical_axis_ahead() -> None:
    up = np.array([0.02, -0.99, 0.1])
    up /= np.linalg.norm(up)
    R = level_rotation(up)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-12)
    ahead = R[:, 2]
    assert ahead[0] > 0.9
    assert ahead[1] == pytest.approx(0.0, abs=1e-12)


def test_where_gravity_is_doubtful_several_attitudes_are_tried() -> None:
    problem = make_problem(2, Difficulty(with_gravity=False))
    signs = problem.observed[~problem.observed.is_line]
    scene = Scene.of(problem.camera, signs, problem.submap)
    assert len(upright_views(scene, problem.prior)) == 9
    assert len(upright_views(scene_of(make_problem(2)), make_problem(2).prior)) == 1


@pytest.mark.parametrize("seed", range(6))
def test_without_noise_some_hypothesis_is_the_true_pose(seed: int) -> None:
    problem = make_problem(seed, EXACT)
    prior = exact_prior(problem, up_sigma_rad=1e-4, road_m=None)
    scene = scene_of(problem)
    view = upright_views(scene, prior)[0]
    hypotheses = upright_hypotheses(scene, view, Known.of(prior))
    used, tried = hypotheses.number
    assert tried >= used > 0
    poses = [camera_pose(view, one) for one in hypotheses.pose[:used]]
    rotation, translation = (np.array(one) for one in zip(*poses, strict=True))
    true = problem.T_camera_map
    away, angle = apart(true.rotation, true.translation, rotation, translation)
    assert ((away < 0.3) & (angle < np.deg2rad(1.0))).any()


def test_hypotheses_stay_within_the_gates() -> None:
    problem = make_problem(0)
    ahead = problem.T_camera_map.rotation[2]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    prior = replace(problem.prior, heading_rad=heading)
    scene = scene_of(problem)
    found = upright_hypotheses(scene, upright_views(scene, prior)[0], Known.of(prior))
    poses = found.pose[: found.number[0]]
    away = np.linalg.norm(poses[:, :2] - prior.position_m[:2], axis=1)
    assert away.max() <= 3.0 * prior.horizontal_sigma_m + 3.5
    turned = np.angle((poses[:, 3] + 1j * poses[:, 4]) * np.exp(-1j * heading))
    assert np.rad2deg(np.abs(turned).max()) <= 3.0 * 5.0 + 8.0


def test_the_true_pose_scores_above_its_neighbours() -> None:
    problem = make_problem(1)
    scene, known, true = scene_of(problem), Known.of(problem.prior), problem.T_camera_map
    score = []
    for shift in ([0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 0.0, 8.0]):
        pose = true.rotation, true.translation + np.array(shift)
        match, gain = associate(scene, *pose, SURE)
        score.append(log_likelihood(scene, known, *pose, match, gain))
    assert score[0] > max(score[1:]) + 10.0


def test_modes_are_distinct_and_best_first() -> None:
    problem = make_problem(3)
    modes = search(scene_of(problem), problem.prior)
    assert len(modes.score) > 1
    assert (np.diff(modes.score) <= 0.0).all()
    for row in range(len(modes.score) - 1):
        away, angle = apart(
            modes.rotation[row],
            modes.translation[row],
            modes.rotation[row + 1 :],
            modes.translation[row + 1 :],
        )
        assert ((away > 1.0) | (angle > np.deg2rad(2.0))).all()
