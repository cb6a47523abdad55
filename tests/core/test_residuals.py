"""Residuals: exact derivatives, stated noise, and what is not known does not count."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.evaluation.problems import CAMERA, Difficulty, Problem, make_problem
from semviz_core.frame import Prior
from semviz_core.pose import Pose
from semviz_core.solving.least_squares import perturbed
from semviz_core.solving.residuals import Scene, pair_residuals, prior_rows, residual_rows

SEEDS = st.integers(0, 10_000)
EXACT = Difficulty(sigma_px=1e-6, map_sigma_m=0.0, moved=0.0, missing=0.0, false_detections=0.0)


def near_pose(problem: Problem, seed: int) -> tuple[np.ndarray, np.ndarray]:
    step = np.random.default_rng(seed).normal(0.0, [[0.2] * 3 + [0.02] * 3])
    pose = problem.T_camera_map
    return perturbed(pose.rotation[None], pose.translation[None], step)


def central(function, start: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(..., 6) numerical derivative by the left perturbation."""
    steps = 1e-6 * np.eye(6)[:, None, :]
    return np.stack(
        [
            (function(*perturbed(*start, s)) - function(*perturbed(*start, -s))) / 2e-6
            for s in steps
        ],
        axis=-1,
    )


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_pair_jacobians_are_those_of_finite_differences(seed: int) -> None:
    problem = make_problem(seed)
    scene = Scene.of(problem.camera, problem.observed, problem.submap)
    seen, mapped = problem.pairs[None, :, 0], problem.pairs[None, :, 1]
    start = near_pose(problem, seed)

    analytic = residual_rows(scene, *start, seen, mapped).jacobian()
    numeric = central(lambda R, t: residual_rows(scene, R, t, seen, mapped).residual, start)

    np.testing.assert_allclose(analytic, numeric, rtol=1e-4, atol=2e-3)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, heading=st.floats(-3.1, 3.1))
def test_prior_jacobians_are_those_of_finite_differences(seed: int, heading: float) -> None:
    problem = make_problem(seed)
    prior = replace(problem.prior, heading_rad=heading)
    start = near_pose(problem, seed)
    residual, analytic = prior_rows(prior, *start)
    wraps = np.abs(residual[0, -1]) * prior.heading_sigma_rad > np.pi - 1e-3

    numeric = central(lambda R, t: prior_rows(prior, R, t)[0], start)

    assert residual.shape == (1, 6)
    rows = slice(None, -1) if wraps else slice(None)
    np.testing.assert_allclose(analytic[:, rows], numeric[:, rows], rtol=1e-5, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_without_noise_true_pairs_have_no_residual(seed: int) -> None:
    problem = make_problem(seed, EXACT)

    found = pair_residuals(
        problem.T_camera_map, problem.camera, problem.observed, problem.submap, problem.pairs
    )

    assert np.nanmax(np.abs(found.residual_px), initial=0.0) < 1e-3
    assert found.residual_px.shape == (len(problem.pairs), 2)


def test_chi2_of_true_pairs_is_as_large_as_their_rows() -> None:
    chi2, rows, inlier = [], [], []
    for seed in range(60):
        problem = make_problem(seed, Difficulty(moved=0.0))
        found = pair_residuals(
            problem.T_camera_map, problem.camera, problem.observed, problem.submap, problem.pairs
        )
        chi2.append(found.chi2)
        rows.append(found.rows)
        inlier.append(found.inlier)

    assert np.concatenate(chi2).sum() / np.concatenate(rows).sum() == pytest.approx(1.0, abs=0.1)
    assert np.concatenate(inlier).mean() > 0.99


def pole(end_known: bool = True, end_px: float = 200.0) -> tuple[Elements2D, Elements3D]:
    """A pole 10 m ahead, its peak 3 m above the camera, its bottom 1.65 m below."""
    peak_v = CAMERA.K[1, 2] - 71.8856
    observed = Elements2D.from_ends([[650.0, peak_v]], [[650.0, end_px]], [0])
    observed = replace(observed, end_known=np.array([end_known]))
    x = (650.0 - CAMERA.K[0, 2]) / 718.856 * 10.0
    return observed, Elements3D.from_ends([1], [[x, -1.0, 10.0]], [[x, 1.65, 10.0]], [0])


PAIR = np.array([[0, 0]])


def test_a_hidden_bottom_says_nothing_along_the_pole() -> None:
    seen, mapped = pole(end_known=True)
    known = pair_residuals(Pose.identity(), CAMERA, seen, mapped, PAIR)
    seen, mapped = pole(end_known=False)
    hidden = pair_residuals(Pose.identity(), CAMERA, seen, mapped, PAIR)

    assert not known.inlier[0]
    assert known.rows[0] == 4
    assert hidden.inlier[0]
    assert hidden.rows[0] == 3
    assert hidden.chi2[0] == pytest.approx(0.0, abs=1e-6)


def test_a_pole_without_known_ends_is_still_a_line() -> None:
    seen, mapped = pole(end_known=False)
    shifted = seen.anchor_px + np.array([5.0, 0.0])
    seen = replace(seen, anchor_known=np.array([False]), anchor_px=shifted)
    seen = replace(seen, end_px=seen.end_px + np.array([5.0, 0.0]))

    found = pair_residuals(Pose.identity(), CAMERA, seen, mapped, PAIR)

    assert found.residual_px[0, 0] == pytest.approx(5.0, abs=1e-6)  # right of the projection
    assert np.isnan(found.residual_px[0, 1])
    assert found.rows[0] == 2


def test_uncertain_map_elements_weigh_less() -> None:
    seen, mapped = pole()
    vague = replace(mapped, covariance_m2=100.0 * mapped.covariance_m2)

    sharp_chi2 = pair_residuals(Pose.identity(), CAMERA, seen, mapped, PAIR).chi2[0]
    assert pair_residuals(Pose.identity(), CAMERA, seen, vague, PAIR).chi2[0] < 0.1 * sharp_chi2


def test_what_is_behind_the_camera_is_no_inlier() -> None:
    seen, mapped = pole()
    backwards = Pose.from_rotvec([0.0, np.pi, 0.0], np.zeros(3))

    found = pair_residuals(backwards, CAMERA, seen, mapped, PAIR)

    assert np.isinf(found.chi2[0])
    assert not found.inlier[0]
    assert np.isnan(found.residual_px).all()


def test_distorted_pixels_are_undistorted_first() -> None:
    bent = Camera(CAMERA.width, CAMERA.height, CAMERA.K, np.array([-0.3, 0.1, 0.0, 0.0]))
    points = np.array([[1.0, -0.5, 6.0], [-3.0, 0.2, 9.0]])
    observed = Elements2D.from_ends(bent.project(points), np.full((2, 2), np.nan), [1, 2])
    mapped = Elements3D.from_ends([1, 2], points, np.full((2, 3), np.nan), [1, 2])

    found = pair_residuals(Pose.identity(), bent, observed, mapped, np.array([[0, 0], [1, 1]]))

    assert np.abs(found.residual_px).max() < 1e-2


def test_no_pairs_give_empty_arrays() -> None:
    seen, mapped = pole()
    none = np.zeros((0, 2), dtype=np.int64)
    assert pair_residuals(Pose.identity(), CAMERA, seen, mapped, none).chi2.shape == (0,)


def test_prior_without_gravity_and_heading_has_three_rows() -> None:
    eye = np.eye(3)[None]
    residual, _ = prior_rows(Prior(np.array([5.5, 0.0, 0.3])), eye, np.zeros((1, 3)))
    np.testing.assert_allclose(residual, [[-1.0, 0.0, -1.0]])
