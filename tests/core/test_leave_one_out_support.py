"""Which pairs an answer hangs on: found where they are planted."""

import numpy as np
from problem_frames import NOISY, frames

from semviz_core.base.frame import Prior
from semviz_core.base.localization import Refinement
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.association import pair_gain
from semviz_core.localization.least_squares import as_match, fit_pairs
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import PoseEstimate, refine_pose
from semviz_core.localization.residuals import new_rows
from semviz_core.localization.status import critical_pair
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem


def scene_of(problem: LocalizationProblem) -> PoseProblem:
    return PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)


def refined(
    problem: LocalizationProblem, pairs: IntArray, prior: Prior | None = None
) -> Refinement:
    found = refine_pose(scene_of(problem), prior or problem.prior, problem.T_camera_map, pairs)
    assert isinstance(found, PoseEstimate), found.reason
    return found.refinement


def gain_under_others(
    problem: LocalizationProblem, pairs: IntArray, row: int
) -> tuple[float, FloatArray]:
    """What the pair in ``row`` gains at the pose of the others, and that pose's covariance."""
    scene = scene_of(problem)
    others = fit_pairs(scene, problem.prior, problem.T_camera_map, np.delete(pairs, row, axis=0))
    pose, covariance = others.T_camera_map, np.linalg.inv(others.information)
    i, j = pairs[row]
    gain = pair_gain(scene, pose.rotation, pose.translation, i, j, covariance, new_rows())
    return gain, covariance


def test_support_is_what_the_pose_of_the_others_says() -> None:
    for problem in frames(10, NOISY, 6):
        fit = refined(problem, problem.pairs)
        assert fit.support is not None
        assert fit.open_m is not None
        for row in range(len(fit.pairs)):
            gain, covariance = gain_under_others(problem, problem.pairs, row)
            if np.isfinite(gain) and gain > 3.0:  # elsewhere a bottom may tip from seen to hidden
                np.testing.assert_allclose(fit.support[row], gain, atol=0.3)
            assert fit.open_m[row] >= np.sqrt(np.trace(covariance[:3, :3])) * 0.95


def test_many_pairs_need_none_of_them() -> None:
    for problem in frames(5, NOISY, 12):
        assert critical_pair(refined(problem, problem.pairs)) is None


def test_of_three_pairs_one_is_needed() -> None:
    """With three pairs each fixes what the other two leave open."""
    problem = frames(1, NOISY, 8)[0]
    few = refined(problem, problem.pairs[:3])
    many = refined(problem, problem.pairs)
    assert few.open_m is not None
    assert many.open_m is not None
    assert few.open_m.max() > 2.0 * many.open_m[:3].max()


def test_a_false_pair_is_not_supported() -> None:
    """Each pair in turn joined with the mapped element next to the right one."""
    unsupported = []
    for problem in frames(20, NOISY, 8):
        i, j = problem.pairs[0]
        same = np.flatnonzero(problem.submap.class_id == problem.submap.class_id[j])
        same = np.setdiff1d(same, problem.pairs[:, 1])
        if not len(same):
            continue
        away = np.linalg.norm(problem.submap.anchor_m[same] - problem.submap.anchor_m[j], axis=1)
        pairs = problem.pairs.copy()
        pairs[0, 1] = same[np.argmin(away)]
        fit = refined(problem, pairs)
        assert fit.support is not None
        unsupported.append(fit.support[0] < 0.0)
        assert as_match(scene_of(problem), pairs)[i] == pairs[0, 1]
    assert len(unsupported) > 10
    assert np.mean(unsupported) > 0.9
