"""Residuals: exact derivatives, stated noise, and what is not known does not count."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problem_frames import EXACT, flagged

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Belief, Prior
from semviz_core.base.pose import Pose
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import rotate_left
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows, road_height
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.residuals import (
    EXACT_POSE,
    fill_rows,
    new_rows,
    pair_residuals,
    problem_residuals,
    whiten,
)
from semviz_core.research.evaluation.problems import CAMERA, LocalizationProblem, make_problem

SEEDS = st.integers(0, 10_000)


def near_pose(problem: LocalizationProblem, seed: int) -> tuple[np.ndarray, np.ndarray]:
    step = np.random.default_rng(seed).normal(0.0, [0.2] * 3 + [0.02] * 3)
    pose = problem.T_camera_map
    return rotate_left(pose.rotation, pose.translation, step)


def central(function, start: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(rows, 6) numerical derivative by the left perturbation."""
    steps = 1e-6 * np.eye(6)
    return np.stack(
        [
            (function(*rotate_left(*start, s)) - function(*rotate_left(*start, -s))) / 2e-6
            for s in steps
        ],
        axis=-1,
    )


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_pair_jacobians_are_those_of_finite_differences(seed: int) -> None:
    problem = make_problem(seed)
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
    start = near_pose(problem, seed)

    for i, j in problem.pairs:

        def residual(R: np.ndarray, t: np.ndarray, i: int = i, j: int = j) -> np.ndarray:
            rows = new_rows()
            return rows.residual[: fill_rows(scene, R, t, i, j, rows)].copy()

        rows = new_rows()
        count = fill_rows(scene, *start, i, j, rows)
        numeric = central(residual, start)
        np.testing.assert_allclose(rows.jacobian[:count], numeric, rtol=1e-4, atol=2e-3)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_whitening_is_by_the_covariance_of_the_rows(seed: int) -> None:
    problem = make_problem(seed)
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
    start = near_pose(problem, seed)
    for i, j in problem.pairs:
        rows = new_rows()
        count = fill_rows(scene, *start, i, j, rows)
        raw, by_map = rows.residual[:count].copy(), rows.by_map[:count].copy()
        across, along = problem.observed.sigma_px[i] ** 2
        noise = np.array([across, across if scene.seen["is_line"][i] else along, along, along])
        covariance = by_map @ scene.mapped["covariance_m2"][j] @ by_map.T + np.diag(noise[:count])
        whiten(scene, i, j, count, EXACT_POSE, rows)
        chi2 = (rows.residual[:count] ** 2).sum()
        assert chi2 == pytest.approx(raw @ np.linalg.solve(covariance, raw), rel=1e-9)


def known_residual(known: PriorRecord, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    return residual[: prior_rows(known, R, t, residual, jacobian)]


def known_jacobian(known: PriorRecord, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    return jacobian[: prior_rows(known, R, t, residual, jacobian)]


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, heading=st.floats(-3.1, 3.1), rise=st.floats(-0.1, 0.1))
def test_prior_jacobians_are_those_of_finite_differences(
    seed: int, heading: float, rise: float
) -> None:
    problem = make_problem(seed)
    along = np.linspace(-30.0, 30.0, 40)
    road = problem.prior.position_m + np.stack([along, 0.1 * along, rise * along], axis=1)
    known = PriorRecord.of(replace(problem.prior, heading_rad=heading, road_m=road))
    start = near_pose(problem, seed)
    residual = known_residual(known, *start)
    wraps = np.abs(residual[-1]) * problem.prior.heading_sigma_rad > np.pi - 1e-3

    numeric = central(lambda R, t: known_residual(known, R, t), start)

    assert residual.shape == (6,)
    rows = slice(None, -1) if wraps else slice(None)
    found = known_jacobian(known, *start)
    np.testing.assert_allclose(found[rows], numeric[rows], rtol=1e-4, atol=1e-3)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_a_belief_counts_the_distance_from_its_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 0.3, (6, 6))
    belief = Belief(Pose.exp(rng.normal(0.0, 1.0, 6)), root @ root.T + 0.01 * np.eye(6))
    off = rng.normal(0.0, 0.02, 6)
    pose = Pose.exp(off) @ belief.T_camera_map
    residual = known_residual(PriorRecord.of(None, belief), pose.rotation, pose.translation)
    chi2 = off @ np.linalg.solve(belief.covariance, off)
    assert residual @ residual == pytest.approx(chi2, rel=0.1, abs=1e-6)


def test_where_roads_cross_the_height_is_that_of_the_nearer_one() -> None:
    along = np.linspace(-20.0, 20.0, 41)
    low = np.stack([along, 0.0 * along, 0.0 * along], axis=1)
    high = np.stack([0.0 * along, along, 6.0 + 0.0 * along], axis=1)
    road = np.concatenate([low, high])
    road = road[np.argsort(road[:, 0])]
    assert road_height(road, 0.3, 0.2, 0.4)[0] == pytest.approx(0.0, abs=1e-9)
    assert road_height(road, 0.3, 0.2, 5.5)[0] == pytest.approx(6.0, abs=1e-9)


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
    for seed in range(200):
        problem = flagged(make_problem(seed))
        found = pair_residuals(
            problem.T_camera_map, problem.camera, problem.observed, problem.submap, problem.pairs
        )
        chi2.append(found.chi2)
        rows.append(found.rows)
        inlier.append(found.inlier)

    count = np.concatenate(rows).sum()
    within = 3.3 * np.sqrt(2.0 / count)
    assert np.concatenate(chi2).sum() / count == pytest.approx(1.0, abs=within)
    assert np.concatenate(inlier).mean() > 0.995


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
    known = PriorRecord.of(Prior(np.array([5.5, 0.0, 0.3])))
    np.testing.assert_allclose(known_residual(known, np.eye(3), np.zeros(3)), [-1.0, 0.0, -1.0])


def test_a_bottom_that_may_be_hidden_counts_only_where_it_fits() -> None:
    doubtful = DetectorModel(hidden_bottoms=0.5)
    above, mapped = pole(end_px=200.0)
    below, _ = pole(end_px=CAMERA.K[1, 2] + 118.6 + 60.0)  # hidden elements end above, not below
    for seen, rows, fits in ((above, 3, True), (below, 4, False)):
        scene = PoseProblem.of(CAMERA, seen, mapped, doubtful)
        found = problem_residuals(scene, Pose.identity(), PAIR)
        assert found.rows[0] == rows
        assert found.inlier[0] == fits


@compiled
def jacobian_after_other_arrays() -> float:
    rows, others = new_rows(), 0
    for size in range(1, 200):
        others += len(np.ones(size))
    return np.abs(rows.jacobian).max() if others else 1.0


def test_rows_keep_their_memory() -> None:
    """A record of a new array would be freed at once, and the next array would take its place."""
    assert jacobian_after_other_arrays() == 0.0
    assert jacobian_after_other_arrays.py_func() == 0.0


CHECKED = """
import numpy as np
from semviz_core.localization.matched import localize_matches
from semviz_core.research.evaluation.problems import make_problem

for seed in range(3):
    frame = make_problem(seed)
    localize_matches(
        frame.observed, frame.submap, frame.camera, frame.pairs, np.ones(len(frame.pairs)),
        prior=frame.prior, method="minimal",
    )
print("whole")
"""


def test_solvers_write_only_to_their_own_memory() -> None:
    """With glibc's checked malloc a process ends when it frees memory that was overwritten."""
    if not any(Path("/lib").glob("*-linux-gnu/libc_malloc_debug.so.0")):
        pytest.skip("this C library has no checked malloc")
    checked = {
        "LD_PRELOAD": "libc_malloc_debug.so.0",
        "GLIBC_TUNABLES": "glibc.malloc.check=3",
        "MALLOC_PERTURB_": "17",
    }
    ended = subprocess.run(
        [sys.executable, "-c", CHECKED], env=os.environ | checked, capture_output=True, text=True
    )
    assert ended.stdout == "whole\n", ended.stderr
