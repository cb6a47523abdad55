"""Poses that something beside the search proposes."""

from dataclasses import replace

import numpy as np

from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import Modes, search
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem, make_problem
from semviz_core.research.pair_matcher.inference import with_proposed


def easy_problem() -> LocalizationProblem:
    made = (make_problem(seed) for seed in range(50))
    return next(sample for sample in made if sample.is_valid and len(sample.pairs) >= 6)


def upright(pose: Pose) -> np.ndarray:
    center, ahead = pose.inverse().translation, pose.rotation[2]
    return np.append(center, ahead[:2] / np.hypot(*ahead[:2]))


def without_best(modes: Modes) -> Modes:
    parts = ("rotation", "translation", "score", "match", "gain")
    return replace(modes, **{name: getattr(modes, name)[1:] for name in parts})


def best_error_m(modes: Modes, problem: LocalizationProblem) -> float:
    best = Pose(nearest_rotation(modes.rotation[0]), modes.translation[0])
    return pose_error(best, problem.T_camera_map)[0]


def test_what_the_search_missed_is_found_where_it_is_proposed() -> None:
    problem = easy_problem()
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    modes = search(scene, problem.prior)
    missed = without_best(modes)
    near = upright(problem.T_camera_map) + np.array([0.8, -0.5, 0.0, 0.0, 0.0])
    elsewhere = near + np.array([15.0, 0.0, 0.0, 0.0, 0.0])
    found = with_proposed(missed, scene, problem.prior, np.array([elsewhere, near]))
    assert best_error_m(found, problem) < 0.5
    assert np.isclose(found.score[0], modes.score[0], atol=1e-3)
    assert (np.diff(found.score) <= 0.0).all()
    assert len(found.match) == len(found.gain) == len(found.rotation) == len(found.score)


def test_what_is_known_already_is_not_told_twice() -> None:
    problem = easy_problem()
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    modes = search(scene, problem.prior)
    found = with_proposed(modes, scene, problem.prior, upright(problem.T_camera_map)[None])
    assert len(found.score) == len(modes.score)
    assert np.allclose(found.score, modes.score, atol=1e-3)
    assert with_proposed(modes, scene, problem.prior, np.empty((0, 5))) is modes
