"""Poses from matches: exact minimal solvers, most matches wrong, and plain reasons for none."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from semviz_core.base.classes import POLE, ROUNDED
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.localization.association import associate
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.localization.matched import METHODS, Estimate, Failure, localize_matches
from semviz_core.localization.matched.chance import Consensus, needed_inliers
from semviz_core.localization.matched.matches import Matches
from semviz_core.localization.matched.minimal_solvers import Constraints, sample_poses
from semviz_core.localization.matched.ransac import (
    SAMPLE_SIGMA_PX,
    blurred,
    find_consensus,
    improve_consensus,
)
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.methods import make_matched_problem
from semviz_core.research.evaluation.problems import CAMERA, DETECTOR, LocalizationProblem

UP_MAP = np.array([0.0, 0.0, 1.0])


def street(seed: int, classes: list[int]) -> tuple[Elements2D, Elements3D, Pose]:
    """Elements of ``classes`` 8 to 40 m ahead of a camera, exactly as it sees them."""
    rng = np.random.default_rng(seed)
    axes = Pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    tilt = Pose.from_rotvec(rng.normal(0.0, 0.03, 3), rng.normal(0.0, 0.3, 3))
    heading = Pose.from_rotvec([0.0, 0.0, rng.uniform(-3.0, 3.0)], rng.normal(0.0, 20.0, 3))
    T_camera_map = tilt @ axes @ heading
    n = len(classes)
    ahead, height = rng.uniform(8.0, 40.0, n), rng.uniform(0.5, 5.0, n)
    peak = np.column_stack([ahead, rng.uniform(-0.7, 0.7, n) * ahead, height])
    foot = peak - np.column_stack([rng.normal(0.0, 0.05, (n, 2)), height + 1.65])
    ends = [heading.inverse().apply(point) for point in (peak, foot)]
    pole = np.array(classes)[:, None] == POLE
    submap = Elements3D.from_ends(
        np.arange(n), ends[0], np.where(pole, ends[1], np.nan), classes, 0.03
    )
    seen = [CAMERA.project(T_camera_map.apply(end)) for end in ends]
    observed = Elements2D.from_ends(seen[0], np.where(pole, seen[1], np.nan), classes)
    return observed, submap, T_camera_map


def cut(observed: Elements2D, rows: list[int]) -> Elements2D:
    """The same, but of the poles at ``rows`` neither end is known."""
    known = np.ones(len(observed), dtype=bool)
    known[rows] = False
    values = {**vars(observed), "anchor_known": observed.anchor_known & known}
    return Elements2D(**{**values, "end_known": observed.end_known & known})


def with_outliers(seed: int) -> tuple[LocalizationProblem, IntArray, FloatArray, BoolArray]:
    """A problem with four wrong matches of the right class for each true one."""
    matched = make_matched_problem(seed)
    return matched.problem, matched.pairs, matched.score, matched.true


def solved(
    problem: LocalizationProblem, pairs: IntArray, score: FloatArray, **given: Any
) -> Estimate | Failure:
    """What ``localize_matches`` makes of a problem, told how its detector works."""
    return localize_matches(
        problem.observed, problem.submap, problem.camera, pairs, score,
        **{"detector": DETECTOR, **given},
    )  # fmt: skip


def own_pairs(count: int) -> IntArray:
    return np.column_stack([np.arange(count), np.arange(count)])


@pytest.mark.parametrize(
    ("classes", "lines", "upright"),
    [
        pytest.param([POLE, POLE], [], False, id="two poles"),
        pytest.param([POLE, ROUNDED], [], True, id="two points and gravity"),
        pytest.param([POLE, ROUNDED, POLE], [], False, id="three points"),
        pytest.param([ROUNDED, POLE, ROUNDED], [1], False, id="two points and a line"),
        pytest.param([POLE, POLE, ROUNDED], [0, 1], False, id="a point and two lines"),
    ],
)
def test_minimal_samples_give_the_exact_pose(
    classes: list[int], lines: list[int], upright: bool
) -> None:
    errors = []
    for seed in range(100):
        observed, submap, truth = street(seed, classes)
        pairs = own_pairs(len(classes))
        matches = Matches.checked(
            cut(observed, lines), submap, CAMERA, pairs, np.ones(len(classes))
        )
        up = truth.rotation @ UP_MAP if upright else None
        found = sample_poses(Constraints.of(matches), pairs[:, 0][None], up)
        off = [np.abs(R - truth.rotation).max() + np.abs(t - truth.translation).max()
               for R, t in zip(*found, strict=True)]  # fmt: skip
        errors.append(min(off, default=np.inf))
    assert np.mean(np.array(errors) < 1e-6) >= 0.98  # a few samples are nearly degenerate
    assert np.max(errors) < 1e-2


def test_a_degenerate_sample_gives_nothing_that_is_not_finite() -> None:
    observed, submap, _ = street(1, [POLE, POLE, POLE])
    blind = cut(observed, [0, 1, 2])
    of = Constraints.of(Matches.checked(blind, submap, CAMERA, own_pairs(3), np.ones(3)))
    rotation, _ = sample_poses(of, np.array([[0, 1, 2]]), None)
    assert len(rotation) == 0
    of = Constraints.of(Matches.checked(observed, submap, CAMERA, own_pairs(3), np.ones(3)))
    rotation, translation = sample_poses(of, np.array([[0, 0]]), None)
    assert np.isfinite(rotation).all()
    assert np.isfinite(translation).all()


@pytest.mark.parametrize("method", METHODS)
def test_true_matches_give_the_true_pose(method: str) -> None:
    observed, submap, truth = street(3, [POLE, POLE, POLE, ROUNDED, ROUNDED, POLE])
    found = localize_matches(observed, submap, CAMERA, own_pairs(6), np.ones(6), method=method)
    assert isinstance(found, Estimate)
    assert pose_error(found.T_camera_map, truth) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert found.inlier.all()
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


def test_four_of_five_matches_wrong() -> None:
    good, inlying, wrong = 0, 0, 0
    for seed in range(12):
        problem, pairs, score, true = with_outliers(seed)
        found = solved(problem, pairs, score)
        assert isinstance(found, Estimate)
        good += pose_error(found.T_camera_map, problem.T_camera_map)[0] < 1.0
        inlying += int((found.inlier & true).sum())
        wrong += int((found.inlier & ~true).sum())
        chosen = pairs[found.inlier]
        assert len(np.unique(chosen[:, 0])) == len(np.unique(chosen[:, 1])) == len(chosen)
    assert good == 12
    assert wrong < 0.05 * inlying


def test_hidden_bottoms_mislead_only_who_is_not_told() -> None:
    answered = np.zeros(2, dtype=int)
    for seed in range(12):
        problem, pairs, score, _ = with_outliers(seed)
        for which, detector in enumerate([DETECTOR, None]):
            found = solved(problem, pairs, score, detector=detector)
            if isinstance(found, Estimate):
                off = pose_error(found.T_camera_map, problem.T_camera_map)[0]
                answered[which] += off < 1.0
    assert answered[0] == 12
    assert answered[1] < 10


def matches_and_truth(seed: int) -> tuple[Matches, BoolArray, Pose]:
    problem, pairs, score, true = with_outliers(seed)
    given = problem.observed, problem.submap, CAMERA, pairs, score, DETECTOR
    return Matches.checked(*given), true, problem.T_camera_map


def gain_near(problem: PoseProblem, start: Pose, sigma_px: float) -> float:
    """The gain of the consensus near a pose whose pairs are taken with blurred detections."""
    pose = start.rotation, start.translation
    mapped, _ = associate(blurred(problem, sigma_px), *pose, np.zeros((6, 6)))
    return find_consensus(problem, PriorRecord.of(None), *pose, mapped).gain


def test_a_rough_pose_settles_where_the_truth_does_by_seeing_less_sharply_first() -> None:
    rng = np.random.default_rng(2)
    settled, settled_sharply = 0, 0
    for seed in range(8):
        matches, _, truth = matches_and_truth(seed)
        problem = matches.problem()
        start = Pose.exp(rng.normal(0.0, [0.15] * 3 + [0.008] * 3)) @ truth
        goal = gain_near(problem, truth, SAMPLE_SIGMA_PX) - 0.1
        settled += gain_near(problem, start, SAMPLE_SIGMA_PX) > goal
        settled_sharply += gain_near(problem, start, 0.0) > goal
    assert settled >= 7
    assert settled_sharply < settled


def test_polishing_frees_a_pose_from_a_wrong_match() -> None:
    free, freed, settled = PriorRecord.of(None), 0, 0
    for seed in range(20):
        matches, true, truth = matches_and_truth(seed)
        problem, pairs = matches.problem(), matches.pairs
        right = np.flatnonzero(true)[:3]
        apart = ~np.isin(pairs, pairs[right]).any(axis=1) & ~true
        held = pairs[[*right, np.flatnonzero(apart)[0]]]
        pose = fit_pairs(problem, None, truth, held).T_camera_map
        mapped = np.full(len(matches.observed), -1)
        mapped[held[:, 0]] = held[:, 1]
        goal = gain_near(problem, truth, SAMPLE_SIGMA_PX) - 0.1
        settled += gain_near(problem, pose, SAMPLE_SIGMA_PX) > goal
        found = Consensus(pose.rotation, pose.translation, mapped, 0.0)
        freed += improve_consensus(problem, free, found).gain > goal
    assert freed >= 18
    assert freed > settled


def test_a_prior_that_the_matches_contradict_is_left_out() -> None:
    left_out = 0
    for seed in range(6):
        problem, pairs, score, _ = with_outliers(seed)
        high = problem.prior.position_m + np.array([0.0, 0.0, 1.0])
        prior = replace(problem.prior, position_m=high, road_m=None)
        alone, found = (solved(problem, pairs, score, prior=pose) for pose in (None, prior))
        assert isinstance(alone, Estimate)
        assert isinstance(found, Estimate)
        off = found.T_camera_map @ alone.T_camera_map.inverse()
        left_out += np.abs(off.log()).max() < 1e-3
    assert left_out >= 5  # a pose that matches hardly fix may give way to the prior


def test_the_paper_s_ransac_answers_rightly_or_not_at_all() -> None:
    errors = []
    for seed in range(24):
        problem, pairs, score, _ = with_outliers(seed)
        found = solved(problem, pairs, score, method="p3p")
        if isinstance(found, Estimate):
            errors.append(pose_error(found.T_camera_map, problem.T_camera_map)[0])
    assert len(errors) >= 8
    assert np.mean(np.array(errors) < 1.0) > 0.8


def test_gravity_and_position_spare_hypotheses() -> None:
    tried = np.zeros(2)
    for seed in range(6):
        problem, pairs, score, _ = with_outliers(seed)
        for which, prior in enumerate([None, problem.prior]):
            found = solved(problem, pairs, score, prior=prior)
            assert isinstance(found, Estimate)
            assert pose_error(found.T_camera_map, problem.T_camera_map)[0] < 1.0
            tried[which] += found.hypotheses
    assert tried[1] < 0.5 * tried[0]


@pytest.mark.parametrize("method", METHODS)
def test_moving_the_map_moves_the_pose(method: str) -> None:
    problem, pairs, score, _ = with_outliers(4)
    T_other_map = Pose.from_rotvec([0.4, -0.2, 2.0], [300.0, -40.0, 7.0])
    moved = problem.submap.transformed(T_other_map)
    here, there = (
        solved(replace(problem, submap=submap), pairs, score, method=method)
        for submap in (problem.submap, moved)
    )
    if isinstance(here, Failure):
        assert isinstance(there, Failure)
        return
    assert isinstance(there, Estimate)
    off = there.T_camera_map @ T_other_map @ here.T_camera_map.inverse()
    assert np.abs(off.log()).max() < 1e-3


@pytest.mark.parametrize("method", METHODS)
def test_one_seed_gives_one_answer(method: str) -> None:
    observed, submap, _ = street(8, [POLE, POLE, POLE, ROUNDED, ROUNDED, POLE])
    first, second = (
        localize_matches(observed, submap, CAMERA, own_pairs(6), np.ones(6), method=method, seed=5)
        for _ in range(2)
    )
    assert isinstance(first, Estimate)
    assert isinstance(second, Estimate)
    # PoseLib's line solvers draw random numbers that no seed reaches; only rounding may differ
    off = first.T_camera_map.as_matrix() - second.T_camera_map.as_matrix()
    assert np.abs(off).max() < 1e-9
    assert np.array_equal(first.inlier, second.inlier)


@pytest.mark.parametrize("method", METHODS)
def test_matches_that_are_all_wrong_give_a_reason(method: str) -> None:
    answered = 0
    for seed in range(6):
        problem, pairs, score, true = with_outliers(seed)
        found = solved(problem, pairs[~true], score[~true], method=method)
        answered += isinstance(found, Estimate)
        if isinstance(found, Failure):
            assert "matches" in found.reason
    assert answered == 0


def few_true(seed: int, true_matches: int) -> tuple[LocalizationProblem, IntArray, FloatArray]:
    """A problem with so few true matches, and four wrong ones for each."""
    problem, pairs, score, true = with_outliers(seed)
    kept = np.concatenate(
        [np.flatnonzero(true)[:true_matches], np.flatnonzero(~true)[: 4 * true_matches]]
    )
    return problem, pairs[kept], score[kept]


def test_four_true_matches_of_twenty_suffice_where_they_agree_closely() -> None:
    right, wrong, enough = 0, 0, needed_inliers(20)
    for seed in range(20):
        problem, pairs, score = few_true(seed, 4)
        found = solved(problem, pairs, score, prior=problem.prior)
        if isinstance(found, Estimate):
            off_m = pose_error(found.T_camera_map, problem.T_camera_map)[0]
            right += off_m < 1.0
            wrong += off_m >= 2.0
    assert enough == 5
    assert right >= 15
    assert wrong == 0


def test_a_prior_does_not_make_chance_a_pose() -> None:
    answered = 0
    for seed in range(25):
        problem, pairs, score, true = with_outliers(seed)
        found = solved(problem, pairs[~true], score[~true], prior=problem.prior)
        answered += isinstance(found, Estimate)
    assert answered <= 1


def test_more_matches_need_more_agreement() -> None:
    needed = [needed_inliers(count) for count in range(3, 200)]
    assert needed[0] == 3
    assert needed == sorted(needed)
    assert needed_inliers(50) == 5


def test_no_answer_from_too_little() -> None:
    observed, submap, _ = street(2, [POLE, POLE, POLE, POLE])

    def reason(seen: Elements2D, mapped: Elements3D, pairs: IntArray) -> str:
        found = localize_matches(seen, mapped, CAMERA, pairs, np.ones(len(pairs)))
        assert isinstance(found, Failure)
        return found.reason

    assert reason(observed, submap, own_pairs(0)) == "No matches are given."
    assert "2 seen and 2 mapped elements; 3" in reason(observed, submap, own_pairs(2))
    upright = {**vars(submap), "end_m": submap.anchor_m - [0.0, 0.0, 4.0]}
    blind = cut(observed, [0, 1, 2, 3])
    assert "parallel lines" in reason(blind, Elements3D(**upright), own_pairs(4))


def test_no_answer_from_one_post() -> None:
    heights = np.array([5.0, 2.5, 2.0, 1.5])
    anchor = np.column_stack([np.full(4, 10.0), np.zeros(4), heights])
    end = np.where(np.arange(4)[:, None] == 0, [10.0, 0.0, 0.0], np.nan)
    classes = [POLE, ROUNDED, ROUNDED, ROUNDED]
    submap = Elements3D.from_ends(np.arange(4), anchor, end, classes)
    pixels = np.column_stack([np.full(4, 600.0), 300.0 - 40.0 * heights])
    bottom = np.where(np.arange(4)[:, None] == 0, [600.0, 300.0], np.nan)
    observed = Elements2D.from_ends(pixels, bottom, classes)
    found = localize_matches(observed, submap, CAMERA, own_pairs(4), np.ones(4))
    assert isinstance(found, Failure)
    assert "one straight line, such as one post" in found.reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"score": [np.nan, 1.0, 1.0]}, "score holds NaN"),
        ({"score": [1.0, 1.0]}, "score has shape"),
        ({"score": [2.0, 1.0, 1.0]}, r"outside \[0, 1\]"),
        ({"pairs": [[0, 0], [1, 1], [2, 9]]}, "submap with 3 elements lacks"),
        ({"pairs": [[0, 0], [1, 1], [-1, 2]]}, "observed with 3 elements lacks"),
        ({"pairs": [[0, 0], [1, 1], [1, 1]]}, "same pair twice"),
        ({"pairs": [[0, 0], [1, 1], [0, 2]]}, r"pair \(0, 2\) joins elements of different"),
        ({"pairs": [[0.0, 0.5], [1.0, 1.0], [2.0, 2.0]]}, "whole numbers"),
        ({"method": "magic"}, "unknown method 'magic'"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_impossible_input_is_refused(change: dict[str, object], message: str) -> None:
    observed, submap, _ = street(2, [POLE, POLE, ROUNDED])
    given = {"pairs": own_pairs(3), "score": np.ones(3), **change}
    with pytest.raises(SemvizError, match=message):
        localize_matches(observed, submap, CAMERA, **given)
