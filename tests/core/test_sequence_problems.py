"""Drives made of problems."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import LocalizationProblem, make_problem
from semviz_core.research.evaluation.roads import simulated_road
from semviz_core.research.evaluation.sequences import Blackout, make_sequence


def standing(frames: int) -> list[LocalizationProblem]:
    """A car that creeps 1 m a frame; the same view, for what is seen does not matter here."""
    problem = make_problem(3)
    ahead = Pose.exp([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    poses = [problem.T_camera_map]
    for _ in range(frames - 1):
        poses.append(ahead @ poses[-1])
    return [replace(problem, T_camera_map=pose) for pose in poses]


def test_odometry_is_off_by_about_a_percent_and_says_so() -> None:
    drive = make_sequence(standing(60), seed=1)
    chi2 = []
    for before, now in zip(drive.frames[:-1], drive.frames[1:], strict=True):
        assert now.odometry is not None
        true = now.T_camera_map @ before.T_camera_map.inverse()
        error = (now.odometry.T_now_before @ true.inverse()).log()
        assert 0.0 < np.linalg.norm(error[:3]) < 0.06
        chi2.append(error @ np.linalg.solve(now.odometry.covariance, error))
    assert drive.frames[0].odometry is None
    assert np.mean(chi2) == pytest.approx(6.0, abs=1.5)


@pytest.mark.parametrize("with_odometry", [True, False])
def test_a_blackout_takes_what_is_seen_for_its_time(with_odometry: bool) -> None:
    drive = make_sequence(standing(30), 1, blackout=Blackout(1.0, 0.5, with_odometry))

    dark = [row for row, frame in enumerate(drive.frames) if not len(frame.observed)]
    assert dark == [10, 11, 12, 13, 14]
    assert all((drive.frames[row].odometry is not None) == with_odometry for row in dark)


def test_an_empty_drive_is_refused() -> None:
    with pytest.raises(SemvizError, match="at least one frame"):
        make_sequence([], seed=1)


def test_a_drive_does_not_jump() -> None:
    """It keeps its place beside the road's poses, a metre apart; single frames have each their
    own."""
    road = simulated_road(3)
    drive = [make_problem(3, None, road, index, driving=True) for index in range(200, 230)]
    single = [make_problem(3, None, road, index) for index in range(200, 230)]

    def turns_deg(problems: list[LocalizationProblem]) -> list[float]:
        poses = [problem.T_camera_map for problem in problems]
        return [pose_error(now, before)[1] for before, now in pairwise(poses)]

    def roads_deg() -> list[float]:
        poses = [pose.inverse() for pose in road.T_map_camera[200:230]]
        return [pose_error(now, before)[1] for before, now in pairwise(poses)]

    np.testing.assert_allclose(turns_deg(drive), roads_deg(), atol=1e-6)
    assert np.mean(turns_deg(single)) > 2.0 + np.mean(turns_deg(drive))


def test_the_map_of_a_drive_holds_each_element_once() -> None:
    problems = standing(4)
    first, last = problems[0].submap[:10], problems[0].submap[5:20]
    parts = [replace(problems[0], submap=first), replace(problems[1], submap=last)]

    elements = make_sequence(parts, seed=0).semantic_map.elements

    np.testing.assert_array_equal(np.sort(elements.id), np.unique(problems[0].submap.id[:20]))
