"""Learned correspondences: their geometry, the laws of P, and the poses that follow from it."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Match
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights, read_weights, shipped_weights
from semviz_core.common.errors import SemvizError
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.correspondences.candidate_pairs import (
    CandidatePairs,
    Compass,
    Sample,
    candidate_pairs,
    level_view,
    pair_distance_m,
)
from semviz_core.localization.correspondences.couples import FrameGeometry
from semviz_core.localization.correspondences.matcher import (
    SUREST_PER_SEEN,
    CoupleHypotheses,
    PairMatcher,
    consensus,
    couple_poses,
    load_pair_matcher,
)
from semviz_core.localization.correspondences.network import LEAST_ODDS, fit_poses
from semviz_core.localization.heading_votes import OF_COUPLES
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import search
from semviz_core.localization.upright import gravity, likely_ups, upright_view
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    CAMERA,
    DETECTOR,
    Difficulty,
    LocalizationProblem,
    make_problem,
)

PRECISE = Difficulty(
    sigma_px=0.01, hidden_bottoms=0.0, false_detections=0.0, missing=0.0, duplicated=0.0, moved=0.0,
    map_view_sigma_m=0.0, map_sigma_m=0.0, map_turn_rad=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def matcher() -> PairMatcher:
    return load_pair_matcher(None, DEFAULT_CLASSES)


def problems(
    number: int, level: Difficulty | None = None, pairs: int = 3
) -> list[LocalizationProblem]:
    made = (make_problem(seed, level) for seed in range(100))
    return [one for one in made if one.is_valid and len(one.pairs) >= pairs][:number]


def asked(problem: LocalizationProblem) -> tuple:
    return problem.observed, problem.submap, problem.camera, problem.prior


def geometry(problem: LocalizationProblem) -> tuple[Sample, CandidatePairs]:
    sample = Sample.of(*asked(problem))
    return sample, candidate_pairs(sample, sample.seen_class[:, None] == sample.mapped_class)


def are_true(problem: LocalizationProblem, seen: np.ndarray, mapped: np.ndarray) -> np.ndarray:
    true = np.zeros((len(problem.observed), len(problem.submap)), dtype=bool)
    true[tuple(problem.pairs.T)] = True
    return true[seen, mapped]


def true_pose(problem: LocalizationProblem) -> tuple[complex, complex]:
    """Return camera, about the fix, and turn on the ground."""
    center = problem.T_camera_map.inverse().translation - problem.prior.position_m
    turn = complex(*problem.T_camera_map.rotation[2, :2])
    return complex(center[0], center[1]), turn / abs(turn)


# --- geometry ---


def test_gravity_is_that_of_the_search() -> None:
    for problem in problems(5):
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
        up, _ = gravity(scene, PriorRecord.of(problem.prior))
        along = problem.camera.bearing(problem.observed.anchor_px) @ up
        slope = along / np.sqrt(1.0 - along**2)
        assert np.allclose(level_view(Sample.of(*asked(problem))).slope[:, 0], slope, atol=2e-3)


@pytest.mark.parametrize("level", [PRECISE, replace(PRECISE, gps_distance_m=(25.0, 30.0))])
def test_true_pairs_are_candidates_at_about_their_distance(level: Difficulty) -> None:
    of, off = 0, []
    for problem in problems(15, level):
        _, pairs = geometry(problem)
        camera, turn = true_pose(problem)
        rows = np.flatnonzero(are_true(problem, pairs.seen, pairs.mapped))
        told = np.array([pair_distance_m(pairs, row, turn) for row in rows])
        off.append((told - np.abs(pairs.place_m[rows] - camera)) / pairs.sigma_m[rows])
        of += len(problem.pairs)
    sigmas = np.abs(np.concatenate(off))
    assert len(sigmas) > 0.8 * of  # bridges put some of the roads at another height
    assert np.median(sigmas) < 1.0


def test_poses_near_the_truth_are_fitted_to_it() -> None:
    rng = np.random.default_rng(0)
    before, after = [], []
    for problem in problems(25, PRECISE):
        true, turn = true_pose(problem)
        camera_m = np.array([true + complex(*rng.normal(0.0, 0.5, 2))])
        before.append(abs(camera_m[0] - true))
        fit_poses(geometry(problem)[1], camera_m, np.array([turn]))
        after.append(abs(camera_m[0] - true))
    assert np.median(after) < 0.5 * np.median(before)


def test_couples_of_true_pairs_know_the_camera() -> None:
    off = []
    for problem in problems(15, PRECISE):
        sample, pairs = geometry(problem)
        couples = FrameGeometry.of(pairs, Compass.of(sample)).couples
        true = are_true(problem, pairs.seen, pairs.mapped)
        both = true[couples.first] & true[couples.second]
        off.append(np.abs(couples.camera_m[both] - true_pose(problem)[0]))
    assert np.median(np.concatenate(off)) < 1.5


# --- P ---


def symmetric_scene() -> tuple[Elements2D, Elements3D, Pose]:
    """A camera amid elements that are symmetric about it; those ahead are observed."""
    place = np.array([[12.0, 4.0], [18.0, -5.0], [25.0, 2.0], [15.0, -9.0]])
    place = np.concatenate([place, -place])
    height = np.tile([3.0, 2.6, 5.0, 2.4], 2)
    class_id = np.tile([POLE, RECTANGULAR, POLE, RECTANGULAR], 2)
    top = np.column_stack([place, height])
    bottom = np.where((class_id == POLE)[:, None], np.column_stack([place, 0.0 * height]), np.nan)
    submap = Elements3D.from_ends(np.arange(8), top, bottom, class_id)
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    T_camera_map = Pose(rotation, rotation @ [0.0, 0.0, -1.65])
    tops, bottoms = (CAMERA.project(T_camera_map.apply(point[:4])) for point in (top, bottom))
    return Elements2D.from_ends(tops, bottoms, class_id[:4]), submap, T_camera_map


def test_a_compass_tells_the_two_halves_of_a_symmetric_scene_apart(matcher: PairMatcher) -> None:
    observed, submap, _ = symmetric_scene()
    prior = Prior(np.array([0.0, 0.0, 1.65]), up_camera=np.array([0.0, -1.0, 0.0]))
    ahead, behind = np.arange(4), np.arange(4, 8)

    def matched(prior: Prior) -> np.ndarray:
        return matcher.match(observed, submap, CAMERA, prior).probability

    unknown = matched(prior)
    assert np.allclose(unknown[ahead, ahead], unknown[ahead, behind], atol=0.02)
    told = matched(replace(prior, heading_rad=0.0))
    assert (told[ahead, ahead] > told[ahead, behind] + 0.1).all()
    wrong = matched(replace(prior, heading_rad=np.pi))
    assert (wrong[ahead, ahead] < wrong[ahead, behind] - 0.1).all()


def test_rows_and_columns_sum_to_one_and_pairs_are_prioritized(matcher: PairMatcher) -> None:
    problem = problems(1)[0]
    found, again = matcher.match(*asked(problem)), matcher.match(*asked(problem))
    for field in fields(Match):
        values = (getattr(one, field.name) for one in (found, again))
        assert np.array_equal(*values)
    P, order = found.probability, found.order
    assert np.allclose(P[:-1].sum(axis=1), 1.0, atol=1e-5)
    assert np.allclose(P[:, :-1].sum(axis=0), 1.0, atol=1e-5)
    same = problem.observed.class_id[:, None] == problem.submap.class_id
    assert np.array_equal(np.isfinite(found.cost), same)
    assert same[tuple(order.T)].all()
    assert len(order) <= SUREST_PER_SEEN * len(problem.observed)
    assert (np.diff(P[tuple(order.T)]) <= 0.0).all()


def test_the_order_of_elements_does_not_matter(matcher: PairMatcher) -> None:
    """But for a couple's pose, which is measured from its first pair: centimetres."""
    rng = np.random.default_rng(1)
    for problem in problems(5, pairs=6):
        P = matcher.match(*asked(problem)).probability
        seen, mapped = (rng.permutation(len(side)) for side in (problem.observed, problem.submap))
        other = replace(problem, observed=problem.observed[seen], submap=problem.submap[mapped])
        turned = matcher.match(*asked(other)).probability
        rows, columns = np.append(seen, len(seen)), np.append(mapped, len(mapped))
        assert np.abs(P[np.ix_(rows, columns)] - turned).mean() < 3e-3
        assert np.abs(P - turned).mean() > 1e-2  # planted: orders that do not agree
        poses = [answered(one).T_camera_map for one in (problem, other)]
        if poses[0] is not None and poses[1] is not None:
            assert pose_error(*poses)[0] < 1e-3


def test_nothing_that_may_be_a_pair_is_an_answer_too(matcher: PairMatcher) -> None:
    observed, submap, _ = symmetric_scene()
    far = Prior(np.array([500.0, 0.0, 1.65]))
    found = matcher.match(observed, submap, CAMERA, far)
    assert found.cost.min() == -LEAST_ODDS
    of_two_classes = matcher.match(observed[:1], submap[[1]], CAMERA, far)
    assert np.isinf(of_two_classes.cost).all()
    assert len(of_two_classes.order) == 0


def test_the_shipped_weights_match(matcher: PairMatcher) -> None:
    first, near, of = 0, 0, 0
    for problem in problems(15):
        found = matcher.match(*asked(problem))
        likely = found.probability[problem.pairs[:, 0], :-1].argmax(axis=1)
        first += int((likely == problem.pairs[:, 1]).sum())
        of += len(problem.pairs)
        center = problem.T_camera_map.inverse().translation
        pose = poses_of_couples(problem, found)
        near += bool((np.linalg.norm(pose[:, :2] - center[:2], axis=1) < 2.5).any())
    assert first > 0.8 * of
    assert near >= 13


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    weights = read_weights(shipped_weights("matcher"))
    NetworkWeights("paper", weights.options, weights.tensors).save(tmp_path / "a.safetensors")
    with pytest.raises(SemvizError, match="weights of paper; give those of matcher"):
        load_pair_matcher(tmp_path / "a.safetensors", DEFAULT_CLASSES)
    fewer = dict(list(weights.tensors.items())[1:])
    NetworkWeights("matcher", weights.options, fewer).save(tmp_path / "b.safetensors")
    with pytest.raises(SemvizError, match="another version of matcher"):
        load_pair_matcher(tmp_path / "b.safetensors", DEFAULT_CLASSES)


# --- poses ---


def with_pairs(found: Match, pairs: np.ndarray) -> Match:
    """Return P that holds only ``pairs`` (k, 2), each for certain."""
    P = np.zeros_like(found.probability)
    P[:-1, -1] = P[-1, :-1] = 1.0
    i, j = pairs.T
    P[i, -1], P[-1, j] = 0.0, 0.0
    P[i, j] = 1.0
    return Match(found.cost, P, pairs)


def first_pose(problem: LocalizationProblem, found: Match) -> Pose | None:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    modes = search(scene, problem.prior, OF_COUPLES, CoupleHypotheses(found))
    return Pose(modes.rotation[0], modes.translation[0]) if len(modes.score) else None


def poses_of_couples(problem: LocalizationProblem, found: Match) -> np.ndarray:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    record = PriorRecord.of(problem.prior)
    ups, sigma = likely_ups(scene, record)
    view = upright_view(scene, ups[0], sigma)
    return couple_poses(scene, view, record, found.order, found.probability)[0]


@pytest.mark.parametrize("level", [PRECISE, replace(PRECISE, gps_distance_m=(25.0, 30.0))])
def test_a_couple_of_true_pairs_proposes_the_true_pose(
    matcher: PairMatcher, level: Difficulty
) -> None:
    off = []
    for problem in problems(12, level):
        found = matcher.match(*asked(problem))
        center = problem.T_camera_map.inverse().translation
        poses = poses_of_couples(problem, with_pairs(found, problem.pairs))
        off.append(np.linalg.norm(poses[:, :2] - center[:2], axis=1).min(initial=np.inf))
        heading = np.hypot(poses[:, 3], poses[:, 4])
        assert np.allclose(heading, 1.0)
        # planted: pairs that are turned round among the mapped elements
        turned = np.column_stack([problem.pairs[:, 0], np.roll(problem.pairs[:, 1], 1)])
        poses = poses_of_couples(problem, with_pairs(found, turned))
        assert len(poses) < len(turned) ** 2
    assert np.median(off) < 1.5
    assert np.mean(np.array(off) < 2.5) > 0.8


def test_a_compass_limits_the_poses_of_couples(matcher: PairMatcher) -> None:
    problem = problems(1, pairs=6)[0]
    turn = true_pose(problem)[1]
    told = replace(problem.prior, heading_rad=float(np.angle(turn)), heading_sigma_rad=0.05)
    found = matcher.match(*asked(problem))
    free, bound = (
        poses_of_couples(replace(problem, prior=prior), found) for prior in (problem.prior, told)
    )
    assert 0 < len(bound) < len(free)
    assert (bound[:, 3] * turn.real + bound[:, 4] * turn.imag > np.cos(0.2)).all()


def test_true_pairs_alone_give_the_true_pose_and_false_ones_do_not(matcher: PairMatcher) -> None:
    near = misled = 0
    chosen = problems(12, PRECISE, pairs=6)
    for problem in chosen:
        found = matcher.match(*asked(problem))
        pose = first_pose(problem, with_pairs(found, problem.pairs))
        near += pose is not None and pose_error(pose, problem.T_camera_map)[0] < 0.3
        # planted: only pairs that are false
        false = found.order[~are_true(problem, *found.order.T)][:2]
        planted = first_pose(problem, with_pairs(found, false))
        misled += planted is None or pose_error(planted, problem.T_camera_map)[0] > 1.0
    assert near >= 11
    assert misled > 0.5 * len(chosen)


def test_consensus_prefers_the_true_pose(matcher: PairMatcher) -> None:
    problem = problems(1, PRECISE, pairs=6)[0]
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    record = PriorRecord.of(problem.prior)
    ups, sigma = likely_ups(scene, record)
    view = upright_view(scene, ups[0], sigma)
    center, turn = problem.T_camera_map.inverse().translation, true_pose(problem)[1]
    true = np.array([*center, turn.real, turn.imag, 0.0])
    shifted = true + np.array([3.0, -3.0, 0.0, 0.0, 0.0, 0.0])
    P = with_pairs(matcher.match(*asked(problem)), problem.pairs).probability
    nats = consensus(scene, view, np.array([true, shifted]), P)
    assert nats[0] > nats[1] + 5.0
    nothing = np.zeros_like(P)
    nothing[:-1, -1] = 1.0
    alike = consensus(scene, view, np.array([true, shifted]), nothing)
    assert alike[0] == pytest.approx(alike[1])


# --- the method ---


def answered(problem: LocalizationProblem, **options: object) -> Localization:
    localizer = Localizer("correspondences", detector=DETECTOR)
    return localizer.localize(*asked(problem), **options)  # type: ignore[arg-type]


def test_it_localizes_and_says_how_well() -> None:
    near = 0
    chosen = problems(12, pairs=6)
    for problem in chosen:
        found, again = answered(problem), answered(problem)
        assert (found.status, found.reason) == (again.status, again.reason)
        assert found.match is not None
        assert list(found.time_ms) == ["match", "search", "verify", "refine"]
        if found.T_camera_map is None or again.T_camera_map is None:
            continue
        assert np.array_equal(found.T_camera_map.rotation, again.T_camera_map.rotation)
        assert found.covariance is not None
        assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
        near += pose_error(found.T_camera_map, problem.T_camera_map)[0] < 1.0
    assert near >= 10


@pytest.mark.parametrize("seen", [0, 1, 3])
def test_too_few_elements_are_refused(seen: int) -> None:
    problem = problems(1)[0]
    found = answered(replace(problem, observed=problem.observed[:seen]))
    assert (found.status, found.T_camera_map) == ("cannot", None)
    assert f"{seen} element" in found.reason


@pytest.mark.parametrize("mapped", [0, 1])
def test_a_map_of_nothing_or_of_one_element_is_refused(mapped: int) -> None:
    problem = problems(1)[0]
    found = answered(replace(problem, submap=problem.submap[:mapped]))
    assert (found.status, found.T_camera_map) == ("cannot", None)
    assert found.reason


def test_a_fix_that_is_far_off_is_refused_but_its_matches_are_shown() -> None:
    problem = problems(1)[0]
    elsewhere = replace(
        problem.prior, position_m=problem.prior.position_m + np.array([900.0, 0, 0])
    )
    found = answered(replace(problem, prior=elsewhere))
    assert (found.status, found.T_camera_map) == ("cannot", None)
    assert "No two elements fit one pose" in found.reason
    assert found.match is not None


def test_forced_and_forbidden_pairs_are_kept() -> None:
    problem = problems(1, pairs=6)[0]
    pair, other = problem.pairs[:1], problem.pairs[1:2]
    found = answered(problem, pairing=PairConstraints(forced=pair, forbidden=other))
    assert found.match is not None
    assert found.match.probability[tuple(pair[0])] == pytest.approx(1.0)
    assert found.match.probability[tuple(other[0])] == 0.0
    assert found.refinement is not None
    kept = {tuple(row) for row in found.refinement.pairs.tolist()}
    assert tuple(pair[0]) in kept
    assert tuple(other[0]) not in kept
