"""Hypotheses are moved to where what is seen agrees, and what is not seen counts against them."""

from dataclasses import replace

import numpy as np
import pytest
from problem_frames import EXACT, frames

from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.heading_votes import WIDE, vote_headings
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.rating import (
    REFINED_SIGMAS,
    VOTED_SIGMAS,
    rate_poses,
    refine_candidates,
)
from semviz_core.localization.search import camera_pose
from semviz_core.localization.upright import UprightView, likely_ups, tilted_slope, upright_view
from semviz_core.research.evaluation.problems import DETECTOR, HARD_SETS, LocalizationProblem


def seen_upright(problem: LocalizationProblem) -> tuple[PoseProblem, PriorRecord, UprightView]:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    known = PriorRecord.of(problem.prior)
    ups, sigma_rad = likely_ups(scene, known)
    return scene, known, upright_view(scene, ups[0], sigma_rad)


def true_pose(problem: LocalizationProblem, moved: FloatArray) -> FloatArray:
    """(h, 6) the upright true pose, moved by (h, 3) x, y and heading."""
    inverse = problem.T_camera_map.inverse()
    ahead = inverse.rotation[:, 2]
    heading = np.arctan2(ahead[1], ahead[0]) + moved[:, 2]
    x, y, z = inverse.translation[:, None] + np.column_stack([moved[:, :2], 0.0 * heading]).T
    return np.column_stack([x, y, z, np.cos(heading), np.sin(heading), np.zeros(len(moved))])


def off_m(pose: FloatArray, problem: LocalizationProblem) -> FloatArray:
    return np.hypot(*(pose[:, :2] - problem.T_camera_map.inverse().translation[:2]).T)


def test_polishing_brings_hypotheses_to_the_truth() -> None:
    rng = np.random.default_rng(0)
    before, after, turned = [], [], []
    for problem in frames(40):
        scene, _, view = seen_upright(problem)
        way, turn = rng.uniform(-np.pi, np.pi, 20), rng.normal(0.0, np.deg2rad(1.5), 20)
        moved = np.column_stack([1.2 * np.cos(way), 1.2 * np.sin(way), turn])
        start = true_pose(problem, moved)
        found = refine_candidates(scene, view, start, WIDE.step_m)
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
        true = true_pose(problem, np.zeros((1, 3)))
        alone = rate_poses(scene, view, known, true, VOTED_SIGMAS)
        place, ahead = true[0, :3], np.array([true[0, 3], true[0, 4], 0.0])
        for away_m, counts in ((20.0, True), (-20.0, False)):
            sign = Elements3D.from_ends([10**6], [place + away_m * ahead], [[np.nan] * 3], [9])
            more = replace(problem, submap=joined(problem.submap, sign))
            rating = rate_poses(seen_upright(more)[0], view, known, true, VOTED_SIGMAS)
            assert (rating < alone - 0.3) if counts else (rating == alone)


def test_polishing_finds_by_how_much_gravity_is_off() -> None:
    off_deg = []
    for problem in frames(20, EXACT):
        prior = replace(problem.prior, up_camera=tilted(problem, np.deg2rad(1.2)))
        scene, _, view = seen_upright(replace(problem, prior=prior))
        polished = refine_candidates(
            scene, view, true_pose(problem, np.zeros((1, 3))), WIDE.step_m
        )[0]
        up = camera_pose(view, polished)[0][:, 2]
        assumed, true = view.R_level_camera[2], problem.T_camera_map.rotation[:, 2]
        off_deg.append([np.rad2deg(np.arccos(min(value @ true, 1.0))) for value in (assumed, up)])
    assumed_deg, found_deg = np.median(off_deg, axis=0)
    assert assumed_deg > 0.5
    assert found_deg < 0.2 * assumed_deg


def tilted(problem: LocalizationProblem, by_rad: float) -> FloatArray:
    """(3,) up in camera coordinates, wrong by a turn about the camera's x axis."""
    turn = Pose.from_rotvec(np.array([by_rad, 0.0, 0.0]), np.zeros(3))
    return turn.apply(problem.T_camera_map.rotation[:, 2][None])[0]


def test_a_tilt_of_the_pose_is_one_of_what_is_seen() -> None:
    tilt_rad = float(np.deg2rad(1.0))
    for problem in frames(5):
        scene, _, view = seen_upright(problem)
        pose = true_pose(problem, np.zeros((1, 3)))[0]
        pose[5] = tilt_rad
        exact = upright_view(scene, camera_pose(view, pose)[0][:, 2].copy(), view.up_sigma_rad)
        for elements, other in zip(view.seen, exact.seen, strict=True):
            assert tilted_slope(elements, 0, tilt_rad) == pytest.approx(other["slope"][0], abs=3e-3)


def test_polished_hypotheses_are_rated_in_a_better_order() -> None:
    """The best rated one is the true one more often."""
    right = []
    for problem in frames(40, HARD_SETS["GPS 30 m"]):
        scene, known, view = seen_upright(problem)
        voted = vote_headings(scene, view, known, WIDE).pose
        polished = refine_candidates(scene, view, voted, WIDE.step_m)
        first = voted[rate_poses(scene, view, known, voted, VOTED_SIGMAS).argmax()]
        second = polished[rate_poses(scene, view, known, polished, REFINED_SIGMAS).argmax()]
        right.append(off_m(np.stack([first, second]), problem) < 2.0)
    usual, better = np.sum(right, axis=0)
    assert better >= usual + 4
