"""Refinement: honest covariance, one-to-one pairs, and robust to elements that moved."""

from dataclasses import replace

import numpy as np
import pytest
from problem_frames import NOISY, flagged, frames, signs_on_one_ray

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Belief
from semviz_core.base.pose import Pose
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import NEEDED_PAIRS, Failure, PoseEstimate, refine_pose
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem

NUDGE = Pose.exp([0.15, -0.05, 0.1, 0.002, 0.004, -0.002])
FRAMES = 200
MEAN_WITHIN = 3.29 * np.sqrt(12.0 / FRAMES)
"""Of a mean of chi-squares of 6 degrees of freedom, whose variance is 12: passed by 999 of 1000
sets of frames."""
MEDIAN, MEDIAN_WITHIN = 5.348, 3.29 * 0.5 / (0.1234 * np.sqrt(FRAMES))
"""The same of their median, where their density is 0.1234."""
OUTSIDE = 22.46
"""So large is one of a thousand."""


def refined(
    problem: LocalizationProblem, detector: DetectorModel = DETECTOR, **options: object
) -> PoseEstimate | Failure:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, detector)
    return refine_pose(scene, problem.prior, NUDGE @ problem.T_camera_map, **options)


def nees(problem: LocalizationProblem, result: PoseEstimate | Failure) -> float:
    """Squared error over its covariance; inf without a pose."""
    if isinstance(result, Failure):
        return np.inf
    error = (problem.T_camera_map @ result.T_camera_map.inverse()).log()
    return float(error @ np.linalg.solve(result.covariance, error))


def with_sigma(problem: LocalizationProblem, factor: float) -> LocalizationProblem:
    """The same detections, said to be so many times as uncertain as they are."""
    seen = problem.observed
    return replace(problem, observed=replace(seen, sigma_px=factor * seen.sigma_px))


@pytest.mark.parametrize("noise", ["low", "paper"])
def test_the_covariance_is_that_of_the_errors(noise: str) -> None:
    """Of true pairs, hidden bottoms not flagged."""
    problems = frames(FRAMES, replace(NOISY, noise=noise))
    found = [nees(problem, refined(problem, pairs=problem.pairs)) for problem in problems]
    assert np.mean(found) == pytest.approx(6.0, abs=MEAN_WITHIN)
    assert np.median(found) == pytest.approx(MEDIAN, abs=MEDIAN_WITHIN)


def test_a_covariance_of_wrong_sigmas_is_caught_by_the_test_above() -> None:
    problems = frames(FRAMES, NOISY)
    never_hidden = DETECTOR._replace(hidden_bottoms=0.0)
    faults = [
        [refined(with_sigma(problem, 0.5), pairs=problem.pairs) for problem in problems],
        [refined(with_sigma(problem, 2.0), pairs=problem.pairs) for problem in problems],
        [refined(problem, never_hidden, pairs=problem.pairs) for problem in problems],
    ]
    for results in faults:
        found = [nees(problem, result) for problem, result in zip(problems, results, strict=True)]
        assert abs(np.mean(found) - 6.0) > MEAN_WITHIN


def test_the_covariance_holds_with_the_pairs_it_chooses() -> None:
    """In maps with all their faults; a wrong pair now and then may not spoil the rest."""
    problems = frames(FRAMES)
    found = np.array([nees(problem, refined(problem)) for problem in problems])
    assert np.median(found) == pytest.approx(MEDIAN, abs=MEDIAN_WITHIN)
    assert np.mean(found > OUTSIDE) <= 0.03


def test_pairs_are_found_one_to_one_and_true() -> None:
    right, chosen, true = 0, 0, 0
    for problem in frames(60):
        result = refined(problem)
        assert isinstance(result, PoseEstimate)
        pairs = result.refinement.pairs
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
        right += len({*map(tuple, pairs.tolist())} & {*map(tuple, problem.pairs.tolist())})
        chosen, true = chosen + len(pairs), true + len(problem.pairs)
    assert right / true > 0.97
    assert right / chosen > 0.97


def test_cost_falls_and_the_pose_is_the_true_one() -> None:
    for problem in frames(10, NOISY, 8):
        result = refined(problem)
        assert isinstance(result, PoseEstimate)
        trace = result.refinement.cost_trace
        assert (np.diff(trace) <= 0.0).all()
        assert trace[0] > trace[-1]
        assert pose_error(result.T_camera_map, problem.T_camera_map)[0] < 0.5
        assert result.refinement.inlier.mean() > 0.8


def test_steps_say_how_far_each_moved_the_camera() -> None:
    """Summed up they reach as far as the answer is from the start, or further; refused ones do
    not count."""
    for problem in frames(10, NOISY, 8):
        result = refined(problem)
        assert isinstance(result, PoseEstimate)
        trace, steps = result.refinement.cost_trace, result.refinement.steps
        assert steps is not None
        assert steps.shape == (len(trace) - 1, 2)
        assert (np.diff(trace)[steps[:, 0] == 0.0] == 0.0).all()
        assert (steps[np.diff(trace) < 0.0, 0] > 0.0).all()
        moved_m, _ = pose_error(result.T_camera_map, NUDGE @ problem.T_camera_map)
        assert steps[:, 0].sum() > 0.9 * moved_m


def test_the_start_does_not_matter() -> None:
    """Any pose within the doubt that is allowed for leads to the same optimum."""
    for problem in frames(10, NOISY, 8):
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
        here = refine_pose(scene, problem.prior, problem.T_camera_map)
        there = refined(problem)
        assert isinstance(here, PoseEstimate)
        assert isinstance(there, PoseEstimate)
        np.testing.assert_array_equal(here.refinement.pairs, there.refinement.pairs)
        off = (here.T_camera_map @ there.T_camera_map.inverse()).log()
        assert off @ np.linalg.solve(here.covariance, off) < 1e-4


def test_a_moved_element_does_not_pull_the_pose() -> None:
    for problem in frames(10, NOISY, 8):
        before = refined(problem)
        anchor, end = problem.submap.anchor_m.copy(), problem.submap.end_m.copy()
        row = int(problem.pairs[0, 1])
        across = 8.0 * problem.T_camera_map.rotation[0, :2]  # of the view, where noise is least
        anchor[row, :2] += across
        end[row, :2] += across
        submap = replace(problem.submap, anchor_m=anchor, end_m=end)

        after = refined(replace(problem, submap=submap))

        assert isinstance(before, PoseEstimate)
        assert isinstance(after, PoseEstimate)
        assert [*problem.pairs[0]] not in after.refinement.pairs.tolist()
        # as far as one element of eight moves it, whether it is there or not
        off = (before.T_camera_map @ after.T_camera_map.inverse()).log()
        assert off @ np.linalg.solve(after.covariance, off) < OUTSIDE


def test_a_belief_counts_like_other_knowledge() -> None:
    """A sure belief is kept to, an unsure one changes nothing."""
    problem = frames(1, NOISY, 8)[0]
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    given = scene, problem.prior, problem.T_camera_map, problem.pairs
    alone = fit_pairs(*given).T_camera_map
    place = Pose.exp([0.05, 0.0, 0.05, 0.0, 0.002, 0.0]) @ problem.T_camera_map
    for sigma, other in ((1e-5, place), (1e3, alone)):
        result = fit_pairs(*given, belief=Belief(place, sigma**2 * np.eye(6)))
        np.testing.assert_allclose(result.T_camera_map.as_matrix(), other.as_matrix(), atol=1e-3)


def test_too_few_pairs_fail_with_numbers() -> None:
    problem = frames(1)[0]
    result = refined(problem, pairs=problem.pairs[: NEEDED_PAIRS - 1])
    assert isinstance(result, Failure)
    seen = len(problem.observed)
    assert result.reason.startswith(f"{NEEDED_PAIRS - 1} of {seen} elements")


def test_a_pose_with_all_elements_behind_it_and_no_heading_is_a_failure() -> None:
    """Its information is singular: only the prior is left, which says nothing of the heading."""
    problem = frames(1)[0]
    seen = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    ahead = problem.submap.anchor_m @ level.T
    behind = Pose(level, np.array([0.0, 0.0, -500.0 - ahead[:, 2].max()]))
    center, up = behind.inverse().translation, np.array([0.0, -1.0, 0.0])
    prior = replace(problem.prior, position_m=center, up_camera=up, heading_rad=None)
    result = refine_pose(seen, prior, behind, problem.pairs)
    assert isinstance(result, Failure)
    assert "do not fix" in result.reason


def test_what_the_pairs_do_not_fix_is_named() -> None:
    problem = signs_on_one_ray(frames(1)[0], 60.0, 0.25)
    sure = replace(problem.prior, horizontal_sigma_m=0.1)
    for prior, word in (
        (replace(sure, horizontal_sigma_m=5.0), "position"),
        (replace(sure, up_sigma_rad=0.2), "rotation"),
    ):
        result = refined(replace(problem, prior=prior))
        assert isinstance(result, Failure)
        assert word in result.reason
    assert isinstance(refined(replace(problem, prior=sure)), PoseEstimate)
    on_one_ray = refined(signs_on_one_ray(frames(1)[0]))
    assert isinstance(on_one_ray, Failure)
    assert "one straight line" in on_one_ray.reason


def test_flagged_bottoms_and_weighed_ones_give_the_same_pose() -> None:
    """What the mixture takes for hidden is what labels flag."""
    apart = []
    for problem in frames(40, NOISY):
        known = refined(flagged(problem), DetectorModel(), pairs=problem.pairs)
        weighed = refined(problem, pairs=problem.pairs)
        assert isinstance(known, PoseEstimate)
        assert isinstance(weighed, PoseEstimate)
        off = (known.T_camera_map @ weighed.T_camera_map.inverse()).log()
        apart.append(off @ np.linalg.solve(weighed.covariance, off))
    assert np.median(apart) < 1e-3  # of 5.3 between the pose and the truth
