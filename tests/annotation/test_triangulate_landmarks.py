"""Placing all landmarks at once: exact without noise, honest about noise, deaf to outliers."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sequences import Drive, drive, pixels

from semviz_annotation.mapping.placement.landmarks import uprighted
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import refine_positions, residuals
from semviz_annotation.mapping.placement.triangulation import (
    Landmarks,
    PlaceOptions,
    triangulate_landmarks,
    triangulate_linearly,
)
from semviz_core.common.errors import SemvizError

seeds = st.integers(0, 999)
COUNTS = st.integers(2, 7)


def changed(observations: ObservationArray, rows: object, **arrays: object) -> ObservationArray:
    """With other values in some rows."""
    new = {name: getattr(observations, name).copy() for name in arrays}
    for name, values in arrays.items():
        new[name][rows] = values
    return replace(observations, **new)


def places(placed: Landmarks) -> np.ndarray:
    return np.concatenate([placed.anchor_m, placed.end_m], axis=1)


def nees(placed: Landmarks, truth: Drive, landmarks: np.ndarray) -> float:
    """Mean squared error over the stated covariance, over its dimension: 1 where it is honest."""
    size = 6 if truth.is_line[landmarks].any() else 3
    error = (places(placed) - np.concatenate([truth.anchor_m, truth.end_m], axis=1))[
        landmarks, :size
    ]
    covariance = placed.covariance_m2[landmarks, :size, :size]
    return float(np.einsum("ni,nij,nj->", error, np.linalg.inv(covariance), error) / error.size)


@settings(deadline=None, max_examples=30)
@given(seeds, COUNTS, st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([np.inf, 3.0]))
def test_exact_observations_give_exact_places(seed, frames, hidden, outlier_sigmas):
    world = drive(frames, seed=seed, hidden=hidden)
    placed = triangulate_landmarks(
        world.views, world.observations, PlaceOptions(outlier_sigmas=outlier_sigmas)
    )
    assert placed.ok.all()
    assert np.allclose(placed.anchor_m, world.anchor_m, atol=1e-7)
    known = placed.end_known
    assert np.array_equal(known, world.observations.of(world.observations.end_known))
    assert np.allclose(placed.end_m[known], world.end_m[known], atol=1e-7)
    off = np.cross(placed.end_m - world.anchor_m, world.end_m - world.anchor_m)[world.is_line]
    assert np.abs(off).max() < 1e-6  # an end that nobody saw is on the line, all the same
    assert placed.chi2.max() < 1e-12
    assert (placed.rows >= placed.parameters).all()


def test_an_end_nobody_saw_is_the_furthest_that_anybody_saw():
    world = drive(5, seed=3, hidden=1.0)
    placed = triangulate_landmarks(world.views, world.observations)
    length = np.linalg.norm(world.end_m - world.anchor_m, axis=1)
    shown = np.linalg.norm(placed.end_m - world.anchor_m, axis=1)
    for landmark in np.flatnonzero(world.is_line):
        rows = world.observations.landmark == landmark
        reach = max(
            along(world, row) for row in np.flatnonzero(rows)
        )  # of the observations' ends, as a share
        assert shown[landmark] == pytest.approx(reach * length[landmark], abs=1e-6)


def along(world: Drive, row: int) -> float:
    """How far down its pole an observation's end is, as a share; by bisection."""
    landmark, view = world.observations.landmark[row], world.observations.view[row : row + 1]
    low, high = 0.0, 1.0
    top = world.observations.anchor_px[row]
    goal = np.linalg.norm(world.observations.end_px[row] - top)
    for _ in range(50):
        share = (low + high) / 2.0
        point = world.anchor_m[landmark] + share * (
            world.end_m[landmark] - world.anchor_m[landmark]
        )
        reached = np.linalg.norm(pixels(world.true_views, view, point[None])[0] - top)
        low, high = (share, high) if reached < goal else (low, share)
    return low


def test_no_pole_ends_beyond_the_horizon():
    """Nobody sees the bottom, so it may be anywhere along the line; but not everywhere."""
    world = drive(5, landmarks=1, seed=3, hidden=1.0)
    for stretch, fits in ((10.0, True), (1e5, False)):
        end_m = world.anchor_m + stretch * (world.end_m - world.anchor_m)
        start = np.concatenate([world.anchor_m, end_m], axis=1)
        _, cost = refine_positions(
            world.views, world.observations, start, np.ones(1, dtype=bool), PlaceOptions()
        )
        assert np.isfinite(cost[0]) == fits


@settings(deadline=None, max_examples=20)
@given(seeds, st.integers(0, 7), st.floats(0.2, 0.9))
def test_a_hidden_bottom_tells_of_the_line_and_not_of_its_end(seed, row, share):
    """Against the same places without that observation: more is known of all but where it ends."""
    world = drive(4, landmarks=1, seed=seed)
    observations = world.observations
    cut = observations.anchor_px[row] + share * (
        observations.end_px[row] - observations.anchor_px[row]
    )
    hidden = changed(observations, row, end_px=cut, end_known=False)
    others = triangulate_landmarks(
        world.views, observations.where(np.arange(len(observations)) != row)
    )
    placed = triangulate_landmarks(world.views, hidden)
    assert np.allclose(places(placed), places(others), atol=1e-7)
    gained = np.linalg.inv(placed.covariance_m2[0]) - np.linalg.inv(others.covariance_m2[0])
    largest = np.abs(gained).max()
    assert np.linalg.eigvalsh(gained).min() > -1e-6 * largest
    along = np.concatenate([np.zeros(3), (world.end_m - world.anchor_m)[0]])
    assert np.abs(gained @ along / np.linalg.norm(along)).max() < 1e-6 * largest


def test_a_stray_observation_does_not_make_a_pole_longer():
    """Nobody sees the bottom; one click beside the pole ends far below all others."""
    world = drive(5, landmarks=1, seed=3, hidden=1.0)
    observations = world.observations
    aside = observations.anchor_px[4] + [60.0, 0.0]
    stray = changed(
        observations,
        4,
        anchor_px=aside,
        end_px=aside + 6.0 * (observations.end_px - observations.anchor_px)[4],
    )
    others = triangulate_landmarks(
        world.views, observations.where(np.arange(len(observations)) != 4)
    )
    assert np.allclose(triangulate_landmarks(world.views, stray).end_m, others.end_m, atol=0.02)


@settings(deadline=None, max_examples=20)
@given(seeds, st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.floats(-5e3, 5e3))
def test_a_rigid_motion_of_the_world_moves_the_places(seed, turn, shift):
    world = drive(4, seed=seed, sigma_px=1.0, hidden=0.5)
    Q, d = Rotation.from_rotvec(turn).as_matrix(), np.array([shift, -shift, 10.0])
    R = world.views.R @ Q.T
    moved = replace(world.views, R=R, t=world.views.t - R @ d)
    before, after = (
        triangulate_landmarks(world.views, world.observations),
        triangulate_landmarks(moved, world.observations),
    )
    ok = before.ok
    assert np.array_equal(ok, after.ok)
    size = np.sqrt(np.trace(before.covariance_m2[ok], axis1=1, axis2=2))[:, None]
    both = np.nan_to_num(places(before)), np.nan_to_num(places(after))
    expected = np.concatenate([both[0][:, :3] @ Q.T + d, both[0][:, 3:] @ Q.T + d], axis=1)
    line = world.is_line & ok
    assert (np.abs(both[1] - expected)[line] < 1e-3 * size[line[ok]]).all()
    assert (np.abs(both[1] - expected)[ok, :3] < 1e-3 * size).all()
    J = np.kron(np.eye(2), Q)
    assert np.allclose(after.covariance_m2, J @ before.covariance_m2 @ J.T, rtol=1e-3, atol=1e-6)


@settings(deadline=None, max_examples=10)
@given(seeds, st.randoms(use_true_random=False))
def test_neither_order_nor_company_matters(seed, random):
    world = drive(4, seed=seed, sigma_px=1.0, hidden=0.3)
    together = triangulate_landmarks(world.views, world.observations)
    order = list(range(len(world.observations)))
    random.shuffle(order)
    shuffled = np.array(order)
    anew = world.observations.taken(shuffled, world.observations.landmark[shuffled], 6)
    placed = triangulate_landmarks(world.views, anew.regrouped(anew.landmark, 6))
    assert list(placed.failure) == list(together.failure)
    assert np.allclose(places(placed), places(together), atol=1e-6, equal_nan=True)
    for landmark in range(6):
        alone = triangulate_landmarks(
            world.views, world.observations.only(np.arange(6) == landmark)
        )
        for field in fields(Landmarks):
            if field.name not in ("chi2_of", "failure"):
                mine, all_of_them = (
                    getattr(alone, field.name)[0],
                    getattr(together, field.name)[landmark],
                )
                assert np.allclose(mine, all_of_them, rtol=1e-6, atol=1e-9, equal_nan=True)


@settings(deadline=None, max_examples=20)
@given(seeds)
def test_derivatives_are_those_of_the_errors(seed):
    world = drive(3, seed=seed, sigma_px=2.0, hidden=0.3)
    anchor, end = world.anchor_m, np.nan_to_num(world.end_m)
    at = residuals(world.views, world.observations, anchor, end)
    assert at.ahead.all()
    for axis in range(6):
        moved = []
        for step in (1e-5, -1e-5):
            X = np.concatenate([anchor, end], axis=1)
            X[:, axis] += step
            moved.append(residuals(world.views, world.observations, X[:, :3], X[:, 3:]).error_px)
        slope = (moved[0] - moved[1]) / 2e-5
        assert np.allclose(at.J[at.counts][:, axis], slope[at.counts], atol=1e-4)
    shifted = replace(world.views, K=world.views.K + 1e-5 * np.array([[0, 0, 1], [0] * 3, [0] * 3]))
    right = residuals(shifted, world.observations, anchor, end).error_px
    assert np.allclose(at.by_u[at.counts], ((right - at.error_px) / 1e-5)[at.counts], atol=1e-4)


@pytest.mark.parametrize("outlier_sigmas", [3.0, np.inf])
def test_covariances_are_honest(outlier_sigmas):
    options = PlaceOptions(sigma_px=0.7, outlier_sigmas=outlier_sigmas)
    world = drive(12, landmarks=1200, seed=1, sigma_px=0.7, step_m=1.5, hidden=0.5)
    placed = triangulate_landmarks(world.views, world.observations, options)
    usual = placed.ok & (placed.angle_rad > np.deg2rad(1.0))
    fit = placed.chi2[usual].sum() / (placed.rows - placed.parameters)[usual].sum()
    assert fit == pytest.approx(1.0, abs=0.05)
    for landmarks in (usual & ~world.is_line, usual & world.is_line & placed.end_known):
        assert landmarks.sum() > 300
        assert 0.9 < nees(placed, world, landmarks) < 1.15


def test_rays_weigh_by_their_depth():
    """A click from far away says less in metres than one from near by."""
    world = drive(25, landmarks=200, seed=2, sigma_px=1.0)
    assert (
        0.9
        < nees(triangulate_linearly(world.views, world.observations), world, ~world.is_line)
        < 1.15
    )


def test_least_squares_beat_rays_and_planes():
    world = drive(12, landmarks=400, seed=2, sigma_px=1.0, hidden=0.5)
    poles = world.is_line
    errors = [
        np.linalg.norm(place_by(world.views, world.observations).anchor_m - world.anchor_m, axis=1)
        for place_by in (triangulate_linearly, triangulate_landmarks)
    ]
    linear, best = (float(np.sqrt(np.nanmean(np.square(error[poles])))) for error in errors)
    assert best < 0.9 * linear


@settings(deadline=None, max_examples=30)
@given(seeds, st.integers(0, 5), st.integers(0, 7), st.floats(0.0, 6.28), st.floats(12.0, 200.0))
def test_a_planted_outlier_is_found_and_does_no_harm(seed, landmark, number, angle, far_px):
    world = drive(6, seed=seed, sigma_px=0.5)
    row = np.flatnonzero(world.observations.landmark == landmark)[number]
    shift = far_px * np.array([np.cos(angle), np.sin(angle)])
    if world.is_line[landmark]:  # along itself a line has nothing to be told from its shift
        shift = np.array([np.copysign(far_px, shift[0]), 0.0])
    planted = changed(
        world.observations,
        row,
        anchor_px=world.observations.anchor_px[row] + shift,
        end_px=world.observations.end_px[row] + shift,
    )
    options = PlaceOptions(sigma_px=0.5)
    placed, clean = (
        triangulate_landmarks(world.views, planted, options),
        triangulate_landmarks(world.views, world.observations, options),
    )
    mine = planted.landmark == landmark
    assert placed.ok[landmark]
    assert np.nanargmax(np.where(mine, placed.chi2_of, 0.0)) == row
    size = 6 if world.is_line[landmark] else 3
    difference = (places(placed) - places(clean))[landmark, :size]
    covariance = placed.covariance_m2[landmark, :size, :size]
    assert difference @ np.linalg.solve(covariance, difference) < 9.0


def test_the_place_is_where_most_observations_agree():
    """Three of ten are of another sign 3 m further on: the mean of the two is no place."""
    world = drive(5, landmarks=2, seed=4, sigma_px=0.3)
    observations = world.observations.only(np.array([False, True]))
    other = pixels(world.true_views, observations.view, world.anchor_m[[1]] + [3.0, -1.0, 0.0])
    rows = [0, 1, 4]
    mixed = changed(observations, rows, anchor_px=other[rows])
    linear = triangulate_linearly(world.views, mixed)
    placed = triangulate_landmarks(world.views, mixed, PlaceOptions(sigma_px=0.3))
    sigma_m = np.sqrt(np.trace(placed.covariance_m2[0]))
    assert np.linalg.norm(linear.anchor_m[0] - world.anchor_m[1]) > 5.0 * sigma_m
    assert np.linalg.norm(placed.anchor_m[0] - world.anchor_m[1]) < 2.5 * sigma_m
    assert set(np.argsort(placed.chi2_of)[-3:]) == set(rows)


def test_one_swapped_observation_does_not_keep_a_pole_from_its_place():
    world = drive(5, landmarks=1, seed=4)
    observations = world.observations
    swapped = changed(
        observations, 3, anchor_px=observations.end_px[3], end_px=observations.anchor_px[3]
    )
    assert "swapped" in triangulate_linearly(world.views, swapped).failure[0]
    placed = triangulate_landmarks(world.views, swapped)
    assert np.allclose(placed.anchor_m, world.anchor_m, atol=0.05)
    assert np.argmax(placed.chi2_of) == 3


def reason(views: ViewArray, observations: ObservationArray, **options: float) -> str:
    placed = triangulate_landmarks(views, observations, PlaceOptions(**options))
    assert not placed.ok[0]
    assert np.isnan(placed.anchor_m[0]).all()
    assert (placed.covariance_m2[0] == 0.0).all()
    assert np.isnan(placed.chi2_of).all()
    return str(placed.failure[0])


def test_failures_have_reasons():
    world = drive(5, landmarks=2, seed=4)
    pole, sign = (world.observations.only(np.arange(2) == landmark) for landmark in range(2))
    first = np.arange(len(sign)) < 1
    pair = np.arange(len(sign)) < 2
    assert reason(world.views, sign.where(first)) == "labelled in one image only"
    narrow = reason(world.views, sign, min_angle_rad=1.5)
    assert "the rays are nearly parallel" in narrow
    assert "the planes are nearly parallel" in reason(world.views, pole, min_angle_rad=1.5)
    exchanged = sign.where(pair).taken(np.array([1, 0]), np.zeros(2, dtype=np.int64), 1)
    crossed = replace(sign.where(pair), anchor_px=exchanged.anchor_px)
    assert "behind the camera" in reason(world.views, crossed)
    second = pole.where(pair)
    swapped = changed(second, 1, anchor_px=second.end_px[1], end_px=second.anchor_px[1])
    assert "swapped" in reason(world.views, swapped)
    apart = changed(sign.where(pair), 1, anchor_px=sign.anchor_px[1] + [0.0, 40.0])
    assert "the views disagree by" in reason(world.views, apart)


def test_what_cannot_be_is_an_error():
    world = drive(3, landmarks=2)
    both = world.observations.regrouped(np.zeros(len(world.observations), dtype=np.int64), 1)
    with pytest.raises(SemvizError, match="a pole in some views and a sign in others"):
        triangulate_landmarks(world.views, both)
    with pytest.raises(SemvizError, match="sigma_px must be positive"):
        PlaceOptions(sigma_px=0.0)


def test_nothing_and_the_unseen_are_no_trouble():
    world = drive(3, landmarks=4)
    assert (
        len(
            triangulate_landmarks(
                world.views, world.observations.only(np.zeros(4, dtype=bool))
            ).failure
        )
        == 0
    )
    some = world.observations.where(world.observations.landmark != 2)
    placed = triangulate_landmarks(world.views, some)
    assert list(placed.failure) == ["", "", "labelled in one image only", ""]


def test_progress_counts_landmarks():
    world = drive(12, landmarks=3000, seed=1)
    told: list[tuple[int, int]] = []
    triangulate_landmarks(
        world.views, world.observations, on_progress=lambda done, of: told.append((done, of))
    )
    assert len(told) > 1
    assert told[-1] == (3000, 3000)
    assert sorted(told) == told


def test_each_observation_counts_by_its_own_sigma():
    """Half of the observations are four times as noisy, and say so."""
    ratio = 4.0
    found, plain = [], []
    for seed in range(6):
        world = drive(8, landmarks=40, seed=seed)
        rng = np.random.default_rng(seed)
        k = len(world.observations)
        vague = rng.random(k) < 0.5
        sigma = np.where(vague, ratio, 1.0)[:, None]
        observations = replace(
            world.observations,
            anchor_px=world.observations.anchor_px + sigma * rng.normal(0.0, 1.0, (k, 2)),
            end_px=world.observations.end_px + sigma * rng.normal(0.0, 1.0, (k, 2)),
            sigma_ratio=np.repeat(sigma, 2, axis=1),
        )
        options = PlaceOptions(outlier_sigmas=np.inf)
        placed = triangulate_landmarks(world.views, observations, options)
        signs = ~world.is_line & placed.ok
        found.append(nees(placed, world, signs))
        alike = replace(observations, sigma_ratio=np.ones((k, 2)))
        equal = triangulate_landmarks(world.views, alike, options)
        both = signs & equal.ok
        plain.append(
            np.linalg.norm(equal.anchor_m[both] - world.anchor_m[both])
            / np.linalg.norm(placed.anchor_m[both] - world.anchor_m[both])
        )
    assert np.mean(found) == pytest.approx(1.0, abs=0.3)
    assert np.mean(plain) > 1.2


def test_equal_ratios_are_another_sigma():
    world = drive(6, landmarks=10, sigma_px=1.0, hidden=0.3)
    k = len(world.observations)
    doubled = replace(world.observations, sigma_ratio=np.full((k, 2), 2.0))
    one = triangulate_landmarks(world.views, doubled, PlaceOptions(sigma_px=1.0))
    two = triangulate_landmarks(world.views, world.observations, PlaceOptions(sigma_px=2.0))
    for column in fields(Landmarks):
        first, second = getattr(one, column.name), getattr(two, column.name)
        assert (first == second).all() or np.allclose(first, second, equal_nan=True), column.name


def test_a_pole_that_may_lean_anywhere_stands_upright():
    world = drive(2, landmarks=6, sigma_px=2.0, step_m=0.3, seed=4)
    placed = triangulate_landmarks(world.views, world.observations)
    poles = world.is_line & placed.ok
    upright = uprighted(placed, poles, np.deg2rad(3.0))

    def lean_deg(landmarks: Landmarks) -> np.ndarray:
        off = (landmarks.anchor_m - landmarks.end_m)[poles]
        return np.rad2deg(np.arctan2(np.linalg.norm(off[:, :2], axis=1), off[:, 2]))

    assert lean_deg(placed).max() > 10.0
    assert lean_deg(upright).max() < 5.0
    error = [np.linalg.norm(p.end_m[poles] - world.end_m[poles]) for p in (placed, upright)]
    assert error[1] < error[0]
    assert (np.linalg.eigvalsh(upright.covariance_m2[poles]) > 0.0).all()
    assert np.array_equal(upright.anchor_m[~poles], placed.anchor_m[~poles], equal_nan=True)
