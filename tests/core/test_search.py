"""The search's parts: gravity from poles, hypotheses near the truth, pairs, score, modes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from problem_frames import EXACT, frames

from semviz_core.base.elements import Elements3D, joined
from semviz_core.localization.association import (
    associate,
    gated_pairs,
    log_likelihood,
    one_to_one,
    pair_gain,
)
from semviz_core.localization.heading_votes import (
    BINS,
    BLOCK,
    DEFAULT_EFFORT,
    GATE_SIGMAS,
    GATE_WIDER_M,
    WIDE,
    _blocks,
    vote_headings,
)
from semviz_core.localization.problem import FEW, SIGHT_M, PoseProblem, PriorRecord, rows_within
from semviz_core.localization.residuals import EXACT_POSE, new_rows
from semviz_core.localization.search import (
    APART_M,
    APART_RAD,
    BASIN_M,
    BASIN_RAD,
    camera_pose,
    pose_distances,
    search,
)
from semviz_core.localization.upright import (
    UprightView,
    assumed_upright,
    gravity,
    level_rotation,
    likely_ups,
    upright_view,
)
from semviz_core.research.evaluation.problems import DETECTOR, Difficulty, LocalizationProblem

GAINS = arrays(np.float64, (5, 7), elements=st.one_of(st.just(-np.inf), st.floats(-5.0, 20.0)))
MAP = np.random.default_rng(0).uniform(-500.0, 500.0, (3 * FEW, 2))


def scene_of(problem: LocalizationProblem) -> PoseProblem:
    return PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)


def known_of(problem: LocalizationProblem) -> PriorRecord:
    return PriorRecord.of(assumed_upright(problem.prior))


def best_view(scene: PoseProblem, known: PriorRecord) -> UprightView:
    ups, sigma_rad = likely_ups(scene, known)
    return upright_view(scene, ups[0], sigma_rad)


@pytest.mark.parametrize("gate", [3.0, 16.0, 31.5, 76.0])
def test_the_searched_blocks_are_those_with_a_position_within_the_gate(gate: float) -> None:
    step_m = DEFAULT_EFFORT.step_m
    blocks = _blocks(known_of(frames(1)[0]), gate, step_m)
    most = int(gate / step_m) + 2 * BLOCK
    column, row = np.mgrid[-most : most + 1, -most : most + 1]
    inside = step_m * np.hypot(column, row) <= gate
    middle = len(blocks) // 2
    of = [np.round(axis[inside] / BLOCK).astype(int) + middle for axis in (column, row)]
    needed = np.zeros_like(blocks)
    needed[tuple(of)] = True
    np.testing.assert_array_equal(blocks, needed)


@pytest.mark.parametrize("spread", [0.0, 1.0, 4.0])
def test_the_gate_by_angle_drops_no_pair_that_fits(spread: float) -> None:
    """Poses beside the true one, with a covariance as wide: poles with and without a peak."""
    rng = np.random.default_rng(3)
    covariance = np.diag(spread * np.r_[[0.3**2] * 3, [np.deg2rad(0.7) ** 2] * 3])
    fitting = 0
    for problem in frames(6):
        hidden = rng.random(len(problem.observed)) < 0.3
        known = problem.observed.anchor_known & ~(hidden & problem.observed.is_line)
        scene = scene_of(replace(problem, observed=replace(problem.observed, anchor_known=known)))
        R, t = problem.T_camera_map.writable()
        t += np.sqrt(spread) * rng.normal(0.0, 0.3, 3)
        all_pairs = np.argwhere(scene.compatible)
        gain = [pair_gain(scene, R, t, i, j, covariance, new_rows()) for i, j in all_pairs]
        fits = np.array(gain) > 0.0
        seen, mapped, _ = gated_pairs(scene, R, t, covariance)
        assert set(map(tuple, all_pairs[fits])) <= set(zip(seen, mapped, strict=True))
        fitting += fits.sum()
    assert fitting > 30


@given(gain=GAINS)
def test_pairs_are_one_to_one_and_worth_their_gain(gain: np.ndarray) -> None:
    seen, mapped = np.nonzero(gain > -np.inf)
    match, own = one_to_one(seen, mapped, gain[seen, mapped], gain.shape)
    rows = np.flatnonzero(match >= 0)
    np.testing.assert_array_equal(own[rows], gain[rows, match[rows]])
    assert (own[match < 0] == 0.0).all()
    assert len(np.unique(match[rows])) == len(rows)
    assert (gain[rows, match[rows]] > 0.0).all()
    free = np.setdiff1d(np.arange(gain.shape[1]), match)
    assert (gain[match < 0][:, free] <= 0.0).all()  # none left out that would have gained


@pytest.mark.parametrize(("with_gravity", "false"), [(False, 0.0), (True, 0.0), (True, 1.0)])
def test_gravity_is_as_sure_as_it_says(with_gravity: bool, false: float) -> None:
    chi2 = []
    for problem in frames(200, Difficulty(with_gravity=with_gravity, clutter_share=false)):
        known = known_of(problem)
        up, covariance = gravity(scene_of(problem), known)
        assert np.linalg.norm(up) == pytest.approx(1.0)
        off = known.value["across_up"] @ (up - problem.T_camera_map.rotation[:, 2])
        chi2.append(off @ np.linalg.solve(covariance, off))
    # chi-squares of two degrees of freedom, whose variance is four; poles lean by 0.7 deg here,
    # where 1 deg is allowed for, so where they alone tell, the squares are down to half as large
    within = 3.3 * np.sqrt(4.0 / len(chi2))
    assert (2.0 if with_gravity else 1.0) - within < np.mean(chi2) < 2.0 + within


def test_level_rotation_takes_up_to_z_and_the_optical_axis_ahead() -> None:
    up = np.array([0.02, -0.99, 0.1])
    up /= np.linalg.norm(up)
    R = level_rotation(up)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-12)
    ahead = R[:, 2]
    assert ahead[0] > 0.9
    assert ahead[1] == pytest.approx(0.0, abs=1e-12)


def test_where_gravity_is_doubtful_several_attitudes_are_tried() -> None:
    problem = frames(1, Difficulty(with_gravity=False))[0]
    signs = problem.observed[~problem.observed.is_line]
    scene = PoseProblem.of(problem.camera, signs, problem.submap)
    assert len(likely_ups(scene, known_of(problem))[0]) == 9
    sure = frames(1)[0]
    assert len(likely_ups(scene_of(sure), known_of(sure))[0]) == 1


@pytest.mark.parametrize("number", range(6))
def test_without_noise_some_hypothesis_is_the_true_pose(number: int) -> None:
    """Near enough to be fitted to it."""
    problem = frames(6, EXACT)[number]
    prior = replace(problem.prior, up_camera=problem.T_camera_map.rotation[:, 2])
    scene = scene_of(problem)
    view = best_view(scene, PriorRecord.of(prior))
    hypotheses = vote_headings(scene, view, PriorRecord.of(prior), DEFAULT_EFFORT)
    assert hypotheses.evaluated >= len(hypotheses.pose) > 0
    poses = [camera_pose(view, pose) for pose in hypotheses.pose]
    rotation, translation = (np.array(parts) for parts in zip(*poses, strict=True))
    true = problem.T_camera_map
    away, angle = pose_distances(true.rotation, true.translation, rotation, translation)
    assert ((away < BASIN_M) & (angle < BASIN_RAD)).any()


@pytest.mark.parametrize("number", range(6))
def test_without_noise_the_best_mode_is_the_true_pose(number: int) -> None:
    problem = frames(6, EXACT)[number]
    modes = search(scene_of(problem), problem.prior)
    true = problem.T_camera_map
    away, angle = pose_distances(
        true.rotation, true.translation, modes.rotation[:1], modes.translation[:1]
    )
    assert away[0] < 1e-3
    assert angle[0] < 1e-5


@pytest.mark.parametrize("count", [FEW, 3 * FEW])
@given(x=st.floats(-700.0, 700.0), y=st.floats(-700.0, 700.0), reach_m=st.floats(0.0, 600.0))
def test_what_is_near_is_found_in_maps_of_any_size(
    count: int, x: float, y: float, reach_m: float
) -> None:
    problem = frames(1)[0]
    peak = np.column_stack([MAP[:count], np.full(count, 3.0)])
    signs = Elements3D.from_ends(np.arange(count), peak, np.full((count, 3), np.nan), [9] * count)
    scene = PoseProblem.of(problem.camera, problem.observed, signs)
    away_m = np.hypot(*(MAP[:count] - [x, y]).T)
    near = np.flatnonzero(away_m <= reach_m)
    np.testing.assert_array_equal(np.sort(rows_within(scene, x, y, reach_m)), near)


def test_what_is_out_of_sight_changes_nothing() -> None:
    """Neither what is found nor how surely, in whatever order the map then is."""
    for problem in frames(4):
        place = problem.prior.position_m + np.column_stack(
            [np.linspace(-2000.0, 2000.0, 3 * FEW), np.full((3 * FEW, 2), SIGHT_M + 50.0)]
        )
        none = np.full((3 * FEW, 3), np.nan)
        far = Elements3D.from_ends(10**6 + np.arange(3 * FEW), place, none, [1] * (3 * FEW))
        more = replace(problem, submap=joined(problem.submap, far))
        alone, among = (search(scene_of(each), problem.prior) for each in (problem, more))
        np.testing.assert_allclose(among.score, alone.score, atol=1e-6)
        np.testing.assert_allclose(among.translation, alone.translation, atol=1e-6)


def test_the_true_pose_is_among_the_votes_where_every_heading_has_some() -> None:
    """Twice as many false detections as true ones agree with something under every heading."""
    level = Difficulty(sigma_px=3.0, clutter_share=2.0)
    found = 0
    for problem in frames(30, level):
        scene, known = scene_of(problem), known_of(problem)
        view = best_view(scene, known)
        voted = vote_headings(scene, view, known, DEFAULT_EFFORT)
        poses = [camera_pose(view, pose) for pose in voted.pose]
        rotation, translation = (np.array(parts) for parts in zip(*poses, strict=True))
        true = problem.T_camera_map
        away, angle = pose_distances(true.rotation, true.translation, rotation, translation)
        found += bool(((away < BASIN_M + 1.0) & (angle < BASIN_RAD)).any())
    assert found >= 28


@pytest.mark.parametrize("stated", [1.0, 3.0])
def test_a_stated_sigma_that_is_too_small_is_noticed(stated: float) -> None:
    level = Difficulty(sigma_px=3.0, stated_sigma_px=stated)
    scales = [search(scene_of(problem), problem.prior).sigma_scale for problem in frames(30, level)]
    if stated < 3.0:
        assert np.median(scales) in (2.2, 3.3)
    else:
        assert np.mean(np.array(scales) == 1.0) > 0.9


def test_hypotheses_stay_within_the_gates() -> None:
    problem = frames(1)[0]
    ahead = problem.T_camera_map.rotation[2]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    prior = replace(problem.prior, heading_rad=heading)
    scene = scene_of(problem)
    known = PriorRecord.of(prior)
    found = vote_headings(scene, best_view(scene, known), known, DEFAULT_EFFORT)
    assert len(found.pose) > 0
    away = np.linalg.norm(found.pose[:, :2] - prior.position_m[:2], axis=1)
    assert away.max() <= GATE_SIGMAS * prior.horizontal_sigma_m + GATE_WIDER_M
    turned = np.angle((found.pose[:, 3] + 1j * found.pose[:, 4]) * np.exp(-1j * heading))
    bin_rad = 2.0 * np.pi / BINS
    assert np.abs(turned).max() <= GATE_SIGMAS * prior.heading_sigma_rad + bin_rad


@pytest.mark.parametrize("number", range(4))
def test_the_true_pose_scores_above_its_neighbours(number: int) -> None:
    problem = frames(4)[number]
    scene, known, true = scene_of(problem), PriorRecord.of(problem.prior), problem.T_camera_map
    score = []
    for shift in ([0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 0.0, 8.0]):
        pose = true.rotation, true.translation + np.array(shift)
        match, gain = associate(scene, *pose, EXACT_POSE)
        score.append(log_likelihood(scene, known, *pose, match, gain))
    assert score[0] > max(score[1:]) + 10.0


def test_modes_are_distinct_and_best_first() -> None:
    several = 0
    for problem in frames(6):
        modes = search(scene_of(problem), problem.prior)
        several += len(modes.score) > 1
        assert modes.evaluated >= modes.passed > 0
        assert (np.diff(modes.score) <= 0.0).all()
        for row in range(len(modes.score) - 1):
            away, angle = pose_distances(
                modes.rotation[row],
                modes.translation[row],
                modes.rotation[row + 1 :],
                modes.translation[row + 1 :],
            )
            assert ((away > APART_M) | (angle > APART_RAD)).all()
    assert several


def test_the_default_effort_is_the_recorded_one() -> None:
    assert tuple(DEFAULT_EFFORT) == (3.0, 100, 16, 6, 3, 30.0)
    for problem in frames(3):
        effort, other = (
            search(scene_of(problem), problem.prior),
            search(scene_of(problem), problem.prior, DEFAULT_EFFORT),
        )
        np.testing.assert_array_equal(effort.score, other.score)
        np.testing.assert_array_equal(effort.translation, other.translation)


@pytest.mark.parametrize("with_gravity", [False, True])
def test_effort_is_kept_to_and_finds_more(with_gravity: bool) -> None:
    level = Difficulty(sigma_px=3.0, clutter_share=1.0, with_gravity=with_gravity)
    little = DEFAULT_EFFORT._replace(polished=4, started=2, finished=1)
    best, count = [], []
    for problem in frames(8, level):
        scene, prior = scene_of(problem), assumed_upright(problem.prior)
        few, usual, wide = (
            search(scene, prior, effort) for effort in (little, DEFAULT_EFFORT, WIDE)
        )
        views = len(likely_ups(scene, PriorRecord.of(prior))[0])
        assert few.passed <= 4 * views
        best.append([proposal.score[0] for proposal in (few, usual, wide)])
        count.append([len(proposal.score) for proposal in (few, usual, wide)])
    assert (np.max(count, axis=0) <= [1, DEFAULT_EFFORT.finished, WIDE.finished]).all()
    assert (np.diff(np.mean(count, axis=0)) > 0.0).all()
    few_best, usual_best, wide_best = np.mean(best, axis=0)
    assert few_best < min(usual_best, wide_best) + (1e-3 if with_gravity else 0.0)


def test_the_order_of_elements_does_not_matter() -> None:
    """What is given in another order gives the same modes, with their pairs renumbered."""
    for problem in frames(4):
        rng = np.random.default_rng(0)
        seen, mapped = (
            rng.permutation(len(elements)) for elements in (problem.observed, problem.submap)
        )
        shuffled = replace(problem, observed=problem.observed[seen], submap=problem.submap[mapped])
        proposal, other = (search(scene_of(each), problem.prior) for each in (problem, shuffled))
        np.testing.assert_allclose(other.translation[0], proposal.translation[0], atol=1e-5)
        assert other.score[0] == pytest.approx(proposal.score[0], abs=1e-4)
        paired = np.flatnonzero(other.match[0] >= 0)
        again = np.full(len(seen), -1)
        again[seen[paired]] = mapped[other.match[0][paired]]
        np.testing.assert_array_equal(again, proposal.match[0])
