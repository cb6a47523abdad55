"""Refinement: honest covariance, one-to-one pairs, and robust to elements that moved."""

import numpy as np
import pytest

from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import Difficulty, Problem, make_problem
from semviz_core.pose import Pose
from semviz_core.solving.refine import Failure, Refined, refine
from semviz_core.solving.scene import Scene

CLEAN = Difficulty(moved=0.0, missing=0.0, false_detections=0.0, map_sigma_m=0.03)


def refined(problem: Problem, **options: object) -> Refined | Failure:
    scene = Scene.of(problem.camera, problem.observed, problem.submap)
    nudge = Pose.exp([0.15, -0.05, 0.1, 0.002, 0.004, -0.002])
    return refine(scene, problem.prior, nudge @ problem.T_camera_map, **options)


def test_covariance_is_sound() -> None:
    nees = []
    for seed in range(300, 420):
        problem = make_problem(seed, CLEAN)
        result = refined(problem, pairs=problem.pairs)
        if isinstance(result, Refined):
            error = (problem.T_camera_map @ result.T_camera_map.inverse()).log()
            nees.append(error @ np.linalg.solve(result.covariance, error))

    assert len(nees) > 100
    # mean of a chi2 of 6 degrees of freedom; the prior's height is simulated better than stated
    assert np.mean(nees) == pytest.approx(6.0, abs=1.2)


def test_pairs_are_found_one_to_one_and_true() -> None:
    right, all_of_them = 0, 0
    for seed in range(20):
        problem = make_problem(seed)
        result = refined(problem)
        assert isinstance(result, Refined)
        pairs = result.refinement.pairs
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
        right += len({*map(tuple, pairs.tolist())} & {*map(tuple, problem.pairs.tolist())})
        all_of_them += len(problem.pairs)
    assert right / all_of_them > 0.95


def test_cost_falls_and_the_pose_is_the_true_one() -> None:
    problem = make_problem(5)
    result = refined(problem)
    assert isinstance(result, Refined)
    assert (np.diff(result.refinement.cost_trace) <= 0.0).all()
    assert result.refinement.cost_trace[0] > result.refinement.cost_trace[-1]
    assert pose_error(result.T_camera_map, problem.T_camera_map)[0] < 0.3
    assert result.refinement.inlier.all()


def test_a_moved_element_does_not_pull_the_pose() -> None:
    problem = make_problem(7, CLEAN)
    before = refined(problem)
    anchor, end = problem.submap.anchor_m.copy(), problem.submap.end_m.copy()
    row = int(problem.pairs[0, 1])
    anchor[row, :2] += 1.5
    end[row, :2] += 1.5
    values = {**vars(problem.submap), "anchor_m": anchor, "end_m": end}
    moved = Problem(**{**vars(problem), "submap": type(problem.submap)(**values)})

    after = refined(moved)

    assert isinstance(before, Refined)
    assert isinstance(after, Refined)
    assert row not in after.refinement.pairs[:, 1]
    assert pose_error(after.T_camera_map, before.T_camera_map)[0] < 0.1


def test_too_few_pairs_fail_with_numbers() -> None:
    problem = make_problem(5)
    result = refined(problem, pairs=problem.pairs[:2])
    assert isinstance(result, Failure)
    assert result.reason == f"2 of {len(problem.observed)} elements fit one pose, 3 needed."
