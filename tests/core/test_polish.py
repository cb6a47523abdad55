"""Hypotheses are moved to where what is seen agrees, and what is not seen counts against them."""

import numpy as np
import pytest
from frames import frames

from semviz_core.arrays import FloatArray
from semviz_core.evaluation.problems import DETECTOR, HARD_SETS, Problem
from semviz_core.solving.effort import WIDE
from semviz_core.solving.hypotheses import upright_hypotheses
from semviz_core.solving.polish import polish
from semviz_core.solving.rating import POLISHED, VOTED, rate
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.upright import UprightView, likely_ups, upright_view


def seen_upright(problem: Problem) -> tuple[Scene, Known, UprightView]:
    scene = Scene.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    known = Known.of(problem.prior)
    ups, sigma_rad = likely_ups(scene, known)
    return scene, known, upright_view(scene, ups[0], sigma_rad)


def true_pose(problem: Problem, moved: FloatArray) -> FloatArray:
    """(h, 5) the upright true pose, moved by (h, 3) x, y and heading."""
    inverse = problem.T_camera_map.inverse()
    ahead = inverse.rotation[:, 2]
    heading = np.arctan2(ahead[1], ahead[0]) + moved[:, 2]
    x, y, z = inverse.translation[:, None] + np.column_stack([moved[:, :2], 0.0 * heading]).T
    return np.column_stack([x, y, z, np.cos(heading), np.sin(heading)])


def off_m(pose: FloatArray, problem: Problem) -> FloatArray:
    return np.hypot(*(pose[:, :2] - problem.T_camera_map.inverse().translation[:2]).T)


def test_polishing_brings_hypotheses_to_the_truth() -> None:
    rng = np.random.default_rng(0)
    before, after, turned = [], [], []
    for problem in frames(40):
        scene, _, view = seen_upright(problem)
        way, turn = rng.uniform(-np.pi, np.pi, 20), rng.normal(0.0, np.deg2rad(1.5), 20)
        moved = np.column_stack([1.2 * np.cos(way), 1.2 * np.sin(way), turn])
        start = true_pose(problem, moved)
        found = polish(scene, view, start, WIDE.step_m)
        np.testing.assert_array_equal(found[:, 2], start[:, 2])
        np.testing.assert_allclose(np.hypot(found[:, 3], found[:, 4]), 1.0)
        before.append(off_m(start, problem))
        after.append(off_m(found, problem))
        true = true_pose(problem, np.zeros((1, 3)))[0]
        turned.append(np.abs(found[:, 3] * true[4] - found[:, 4] * true[3]))
    assert np.median(before) == pytest.approx(1.2)
    assert np.median(after) < 0.4
    assert np.median(turned) < np.deg2rad(0.6)


def test_what_is_in_view_and_not_seen_counts_against_a_pose() -> None:
    for problem in frames(5):
        scene, known, view = seen_upright(problem)
        poses = upright_hypotheses(scene, view, known, WIDE).pose
        with_misses, without = (
            rate(scene, view, known, poses, VOTED, one) for one in (True, False)
        )
        assert (with_misses <= without).all()
        assert (with_misses < without).any()
        nowhere = true_pose(problem, np.array([[1e4, 0.0, 0.0]]))
        one, other = (rate(scene, view, known, nowhere, VOTED, which) for which in (True, False))
        assert one == other  # nothing is mapped there


def test_polished_hypotheses_are_rated_in_a_better_order() -> None:
    """The best rated one is the true one more often."""
    right = []
    for problem in frames(40, HARD_SETS["GPS 30 m"]):
        scene, known, view = seen_upright(problem)
        voted = upright_hypotheses(scene, view, known, WIDE).pose
        polished = polish(scene, view, voted, WIDE.step_m)
        first = voted[rate(scene, view, known, voted, VOTED, False).argmax()]
        second = polished[rate(scene, view, known, polished, POLISHED, True).argmax()]
        right.append(off_m(np.stack([first, second]), problem) < 2.0)
    usual, better = np.sum(right, axis=0)
    assert better >= usual + 4
