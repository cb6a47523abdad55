"""Pairs that are forced or forbidden, and a start in place of the search: what then must hold."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from problem_frames import EXACT, NOISY, frames

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.localizer import NO_CONSTRAINTS, Localizer
from semviz_core.localization.problem import PoseProblem
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import CAMERA, DETECTOR, LocalizationProblem


def localized(
    problem: LocalizationProblem, pairing: PairConstraints = NO_CONSTRAINTS, method: str = "search"
) -> Localization:
    return Localizer(method, detector=DETECTOR).localize(
        problem.observed, problem.submap, problem.camera, problem.prior, pairing=pairing
    )


def error_m(found: Localization, problem: LocalizationProblem) -> float:
    """Infinite without a pose."""
    if found.T_camera_map is None:
        return np.inf
    return pose_error(found.T_camera_map, problem.T_camera_map)[0]


def wrong_pairs(problem: LocalizationProblem) -> list[list[int]]:
    """Of one class, and not true; of each observed row one."""
    true = dict(problem.pairs.tolist())
    found = []
    for i, j in true.items():
        same = np.flatnonzero(problem.submap.class_id == problem.observed.class_id[i])
        others = same[same != j]
        if len(others):
            found.append([i, int(others[len(others) // 2])])
    return found


@given(seed=st.integers(0, 19))
def test_without_pairs_nothing_changes_to_the_last_bit(seed: int) -> None:
    problem = frames(20, NOISY)[seed]
    plain = PoseProblem.of(CAMERA, problem.observed, problem.submap, DETECTOR)
    supposed = PairConstraints().applied(plain)
    np.testing.assert_array_equal(plain.candidate, supposed.candidate)
    np.testing.assert_array_equal(plain.compatible, supposed.compatible)
    for name in plain.seen.dtype.names:
        np.testing.assert_array_equal(plain.seen[name], supposed.seen[name])
    free, other = localized(problem), localized(problem, PairConstraints())
    assert free.reason == other.reason
    if free.T_camera_map is not None and other.T_camera_map is not None:
        assert free.T_camera_map.as_matrix().tobytes() == other.T_camera_map.as_matrix().tobytes()


@pytest.mark.parametrize("number", range(12))
def test_forced_true_pairs_give_the_true_pose(number: int) -> None:
    problem = frames(12, EXACT)[number]
    found = localized(problem, PairConstraints(forced=problem.pairs))
    assert found.status == "ok", found.reason
    assert error_m(found, problem) < 0.01


def test_a_forced_pair_binds_its_two_elements_and_no_others() -> None:
    for problem in frames(10, NOISY, 8):
        i, j = problem.pairs[0].tolist()
        found = localized(problem, PairConstraints(forced=np.array([[i, j]])))
        assert found.match is not None
        assert found.refinement is not None
        probability = found.match.probability[:-1, :-1]
        assert probability[i, j] > 0.999
        assert np.delete(probability[i], j).max() == 0.0
        assert np.delete(probability[:, j], i).max() == 0.0
        assert [i, j] in found.refinement.pairs.tolist()
        assert len(found.refinement.pairs) >= len(problem.pairs) - 2  # they stay free to pair


def test_a_forced_wrong_pair_makes_it_worse_or_has_no_answer() -> None:
    """Never a pose that leaves it out, and never one that says so of nothing."""
    tried = 0
    for problem in frames(15, NOISY, 6):
        plain = error_m(localized(problem), problem)
        for pair in wrong_pairs(problem):
            found = localized(problem, PairConstraints(forced=np.array([pair])))
            tried += 1
            if found.T_camera_map is None:
                assert found.reason.endswith(".")
                continue
            assert found.refinement is not None
            fitting = found.refinement.pairs[found.refinement.inlier].tolist()
            assert pair in fitting
            assert error_m(found, problem) > plain
    assert tried > 60


def test_a_forbidden_pair_is_not_made() -> None:
    for problem in frames(10, NOISY, 8):
        pair = problem.pairs[:1]
        found = localized(problem, PairConstraints(forbidden=pair))
        assert found.match is not None
        assert found.match.probability[tuple(pair[0])] == 0.0
        assert found.refinement is not None
        assert pair[0].tolist() not in found.refinement.pairs.tolist()
        assert error_m(found, problem) < 1.0


def test_a_forced_pair_may_join_two_classes_of_signs() -> None:
    """A sign that was called by another name is found again."""
    for problem in frames(5, EXACT, 8):
        signs = np.flatnonzero(~problem.observed.is_line[problem.pairs[:, 0]])
        if not len(signs):
            continue
        i, j = problem.pairs[signs[0]].tolist()
        named = problem.observed.class_id.copy()
        named[i] = 1 + named[i] % 3
        miscalled = replace(problem, observed=replace(problem.observed, class_id=named))
        found = localized(miscalled, PairConstraints(forced=np.array([[i, j]])))
        assert found.refinement is not None
        assert [i, j] in found.refinement.pairs.tolist()


def test_forced_pairs_tell_the_direct_method_what_classes_do_not() -> None:
    problem = frames(1, EXACT, 8)[0]
    plain = localized(problem, method="direct")
    assert "Classes do not fix the matches" in plain.reason
    found = localized(problem, PairConstraints(forced=problem.pairs), "direct")
    assert found.status == "ok", found.reason
    assert error_m(found, problem) < 0.01


def test_from_the_true_pose_it_ends_where_the_search_does_if_that_is_right() -> None:
    compared = 0
    for problem in frames(10, NOISY, 8):
        searched = localized(problem)
        started = Localizer(detector=DETECTOR).localize(
            problem.observed, problem.submap, CAMERA, problem.prior, start=problem.T_camera_map
        )
        assert started.search is not None
        assert len(started.search.score) == 1
        if searched.status == started.status == "ok" and error_m(searched, problem) < 1.0:
            compared += 1
            assert abs(error_m(started, problem) - error_m(searched, problem)) < 0.05
    assert compared > 5


def test_from_a_pose_where_nothing_fits_there_is_no_answer() -> None:
    problem = frames(1, NOISY, 8)[0]
    away = problem.T_camera_map @ Pose(np.eye(3), np.array([200.0, 0.0, 0.0]))
    found = Localizer(detector=DETECTOR).localize(
        problem.observed, problem.submap, CAMERA, problem.prior, start=away
    )
    assert found.status == "cannot"
    assert found.T_camera_map is None
    assert "elements fit one pose" in found.reason


def test_pairs_that_cannot_be_meant_are_refused() -> None:
    problem = frames(1, NOISY, 8)[0]
    m, line = len(problem.observed), problem.submap.is_line
    pole = int(np.flatnonzero(problem.observed.is_line)[0])
    refused = [
        ("observed with", lambda: localized(problem, PairConstraints(np.array([[m, 0]])))),
        ("submap with", lambda: localized(problem, PairConstraints(np.array([[0, -1]])))),
        ("a pole and a sign", lambda: localized(
            problem, PairConstraints(np.array([[pole, int(np.flatnonzero(~line)[0])]])))),
        ("observed twice", lambda: PairConstraints(np.array([[0, 1], [0, 2]]))),
        ("both forced and forbidden",
         lambda: PairConstraints(np.array([[0, 1]]), np.array([[0, 1]]))),
    ]  # fmt: skip
    for words, make in refused:
        with pytest.raises(SemvizError, match=words):
            make()


def test_pairs_of_nothing_are_nothing() -> None:
    """An empty image and an empty map take an empty pairing."""
    empty = frames(1, NOISY, 8)[0]
    seen: Elements2D = empty.observed[[]]
    mapped: Elements3D = empty.submap[[]]
    PairConstraints().check(seen, mapped)
    found = Localizer().localize(seen, mapped, CAMERA, empty.prior, pairing=PairConstraints())
    assert found.status == "cannot"
