"""P3P: every pose fits its three points, the true one is among them, and PoseLib knows no other."""

import numpy as np
import poselib
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.base.pose import so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.matched.p3p import solve_p3p
from semviz_core.localization.matched.p3p_ransac import Points, most_inliers

Problem = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def problem(seed: int, count: int = 3) -> Problem:
    """Rays and points (count, 3), true rotation and translation."""
    rng = np.random.default_rng(seed)
    seen = rng.uniform([-10.0, -4.0, 5.0], [10.0, 2.0, 40.0], (count, 3))
    R, t = so3_exp(rng.normal(size=3)), rng.normal(0.0, 5.0, 3)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True), (seen - t) @ R, R, t


def solved(ray: FloatArray, point_m: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    rotation, translation = np.zeros((4, 3, 3)), np.zeros((4, 3))
    found = solve_p3p(ray, point_m, rotation, translation)
    return list(zip(rotation[:found], translation[:found], strict=True))


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0))
def test_the_poses_are_those_that_fit(seed: int) -> None:
    ray, point_m, R, t = problem(seed)
    poses = solved(ray, point_m)
    for rotation, translation in poses:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        seen = point_m @ rotation.T + translation
        np.testing.assert_allclose(np.cross(seen, ray), 0.0, atol=1e-5)
        assert ((seen * ray).sum(axis=1) > 0.0).all()
    off = [np.abs(pose - R).max() + np.abs(other - t).max() for pose, other in poses]
    assert min(off) < 1e-4


def test_there_are_as_many_as_poselib_finds() -> None:
    problems = [problem(seed)[:2] for seed in range(500)]
    assert [len(solved(*case)) for case in problems] == [
        len(poselib.p3p(*case)) for case in problems
    ]


@pytest.mark.parametrize("wrong", ["on a line", "one point", "one ray"])
def test_degenerate_points_are_no_crash(wrong: str) -> None:
    ray, point_m, _, _ = problem(1)
    if wrong == "on a line":
        point_m[2] = 2.0 * point_m[1] - point_m[0]
    elif wrong == "one point":
        point_m[2] = point_m[1]
    else:
        ray[2] = ray[1]
    assert len(solved(ray, point_m)) <= 4


def test_ransac_finds_the_pose_of_the_true_points() -> None:
    for seed in range(5):
        ray, point_m, R, t = problem(seed, 24)
        point_m[10:] = point_m[np.random.default_rng(seed).permutation(np.arange(10, 24))]
        point_m[10:] += 1.0
        known = np.stack([np.ones(24, dtype=bool), np.zeros(24, dtype=bool)], axis=1)
        points = Points.of(np.arange(24), known, np.stack([ray] * 2), np.stack([point_m] * 2))
        rotation, translation, inliers, hypotheses = most_inliers(points, seed)
        np.testing.assert_allclose(rotation, R, atol=1e-6)
        np.testing.assert_allclose(translation, t, atol=1e-4)
        assert 10 <= inliers <= 12
        assert 500 < hypotheses <= 1000
