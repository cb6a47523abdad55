"""Localizability: laws of what a map lets a camera know, and planted weaknesses to be found."""

from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
import pytest

from semviz_core.base.classes import POLE, RECTANGULAR
from semviz_core.base.detector_model import NOISE, DetectorModel
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localizability.expected_error import (
    LOST_M,
    PositionInformation,
    expected_error,
    suggest_elements,
)
from semviz_core.localizability.predict import Localizability, predict, simulate_localization
from semviz_core.localizability.route import (
    UP,
    Conditions,
    candidates_beside,
    detect,
    poses_along,
    thinned,
    visible_elements,
)
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.methods import bound_covariance
from semviz_core.research.evaluation.problems import CAMERA, LocalizationProblem

DETECTOR = DetectorModel(0.5, 0.8, 0.4, 20.0, 40.0, 41.0)
CONDITIONS = Conditions(DETECTOR, NOISE["low"], crop_radius_m=50.0, trials=1)
SURE = replace(
    CONDITIONS, detector=DETECTOR._replace(recall_near=0.999999, recall_far=0.999999),
    hidden_bottoms=0.0,
)  # fmt: skip
"""Everything in view is found, for all that is drawn."""
TRACK_M: FloatArray = np.column_stack([np.arange(0.0, 120.0, 3.0), np.zeros(40), np.full(40, 1.65)])
BARE_M = (40.0, 90.0)
"""No element stands along this stretch of the street."""


def elements_at(places_m: FloatArray, height_m: float | FloatArray = 4.0) -> Elements3D:
    """Poles at places (n, 2), every third with a sign instead."""
    n = len(places_m)
    foot = np.column_stack([places_m, np.zeros(n)])
    anchor = foot + np.column_stack([np.zeros((n, 2)), np.broadcast_to(height_m, n)])
    sign = np.arange(n) % 3 == 2
    end = np.where(sign[:, None], np.nan, foot)
    class_id = np.where(sign, RECTANGULAR, POLE)
    return Elements3D.from_ends(np.arange(n), anchor, end, class_id)


def mapped(elements: Elements3D) -> SemanticMap:
    return SemanticMap(elements, MapFrame("made-up"), trajectory_m=TRACK_M)


@pytest.fixture(scope="module")
def street() -> SemanticMap:
    """Elements on both sides at random places, with a bare stretch."""
    rng = np.random.default_rng(3)
    x = rng.uniform(5.0, 170.0, 60)
    places = np.column_stack([x, rng.choice([-1.0, 1.0], 60) * rng.uniform(4.0, 9.0, 60)])
    places = places[(x < BARE_M[0]) | (x > BARE_M[1])]
    return mapped(elements_at(places, rng.uniform(2.5, 6.0, len(places))))


@pytest.fixture(scope="module")
def predicted(street: SemanticMap) -> Localizability:
    return predict(street, CAMERA, poses_along(TRACK_M), CONDITIONS)


def position_informations(
    semantic_map: SemanticMap, conditions: Conditions = CONDITIONS
) -> list[PositionInformation]:
    poses = poses_along(TRACK_M)[::4]
    return [
        expected_error(semantic_map, CAMERA, pose, conditions, k) for k, pose in enumerate(poses)
    ]


def test_where_all_is_found_the_bound_is_that_of_the_benchmark(street: SemanticMap) -> None:
    """The same Cramer-Rao bound as ``evaluation.bound``, worked out another way."""
    for pose in poses_along(TRACK_M)[:7:2]:
        error = expected_error(street, CAMERA, pose, SURE, 0)
        assert error.count.min() >= 4
        visible = visible_elements(street.elements, CAMERA, pose.inverse(), SURE)
        exact = PriorOptions((1e-9, 1e-9), vertical_sigma_m=0.3)
        prior = replace(
            simulate_prior(pose, exact, 0), position_m=pose.translation,
            up_camera=pose.rotation[2], road_m=street.road_near(pose.translation, 60.0),
            horizontal_sigma_m=SURE.prior.horizontal_sigma_m,
        )  # fmt: skip
        pairs = np.column_stack([np.arange(len(visible.row)), visible.row])
        problem = LocalizationProblem(
            visible.seen,
            street.elements,
            CAMERA,
            prior,
            pose.inverse(),
            pairs,
            visible.seen.end_known,
        )
        bound = bound_covariance(problem)
        assert bound is not None
        sigma_m = np.sqrt(np.trace(bound[:3, :3]))
        np.testing.assert_allclose(error.sigmas()[:, 0], sigma_m, rtol=1e-6)


def test_more_elements_are_never_worse(street: SemanticMap) -> None:
    rng = np.random.default_rng(0)
    more = elements_at(np.column_stack([rng.uniform(0.0, 150.0, 10), rng.uniform(-8.0, 8.0, 10)]))
    both = joined(street.elements, replace(more, id=1000 + more.id))
    better = 0
    for before, after in zip(
        position_informations(street), position_informations(mapped(both)), strict=True
    ):
        assert (after.sigmas() <= before.sigmas() * (1.0 + 1e-9)).all()
        better += after.expected_m < before.expected_m
    assert better > 3


def test_a_better_detector_and_a_better_map_are_better(street: SemanticMap) -> None:
    def mean(semantic_map: SemanticMap, conditions: Conditions) -> float:
        return float(
            np.mean(
                [
                    information.expected_m
                    for information in position_informations(semantic_map, conditions)
                ]
            )
        )

    ordinary = mean(street, CONDITIONS)
    assert mean(street, SURE) < 0.95 * ordinary
    assert mean(street, replace(CONDITIONS, noise=NOISE["paper"])) > 1.05 * ordinary
    vague = replace(street.elements, covariance_m2=100.0 * street.elements.covariance_m2)
    assert mean(mapped(vague), CONDITIONS) > 1.05 * ordinary


def test_the_bare_stretch_is_the_worst(predicted: Localizability) -> None:
    worst = predicted.stretches()[0]
    assert BARE_M[0] - 30.0 < worst.first_m < BARE_M[1]
    assert worst.lost > 0.9
    assert worst.expected_m > 0.9 * LOST_M
    assert np.isinf(predicted.sigma_m[worst.first : worst.last + 1]).any()
    assert predicted.stretches()[-1].expected_m < 0.5


def test_stretches_are_the_whole_route_once(predicted: Localizability) -> None:
    rows = [
        row for stretch in predicted.stretches() for row in range(stretch.first, stretch.last + 1)
    ]
    assert sorted(rows) == list(range(len(TRACK_M)))


def test_a_suggested_element_helps_where_it_is_said(
    street: SemanticMap, predicted: Localizability
) -> None:
    """Put up, and predicted anew with other draws: as good as was said, within chance."""
    first = predicted.suggested[0]
    assert BARE_M[0] - 5.0 < first.element.anchor_m[0, 0] < BARE_M[1] + 30.0
    new = predicted.suggested
    grown = reduce(joined, (effect.element for effect in new), street.elements)
    again = predict(mapped(grown), CAMERA, predicted.T_map_camera, replace(CONDITIONS, seed=9))
    said = sum(effect.total_m2 for effect in new)
    got = float(((again.expected_m - predicted.expected_m) * np.gradient(predicted.along_m)).sum())
    assert said < -5.0
    assert got == pytest.approx(said, rel=0.25)


def test_no_place_is_suggested_twice(street: SemanticMap, predicted: Localizability) -> None:
    best = replace(predicted.suggested[0].element, id=[10_000])
    found = position_informations(street)
    along_m = np.arange(len(found)) * 12.0
    assert len(suggest_elements(found, along_m, best, CAMERA, CONDITIONS, 3)) == 1


def test_the_critical_element_is_the_one_that_hurts_most(
    street: SemanticMap, predicted: Localizability
) -> None:
    named = predicted.critical[0]
    assert named.total_m2 > 0.0
    assert named.after_m > named.before_m

    def mean_without(element_id: int) -> float:
        kept = street.elements[street.elements.id != element_id]
        seeds = (replace(CONDITIONS, seed=seed, outcomes=256) for seed in range(2))
        return float(
            np.mean(
                [
                    information.expected_m
                    for c in seeds
                    for information in position_informations(mapped(kept), c)
                ]
            )
        )

    others = street.elements.id[::9].tolist()
    costs = [mean_without(other) for other in others if other != named.element.id[0]]
    assert mean_without(int(named.element.id[0])) > np.median(costs)


def test_the_same_seed_gives_the_same_and_another_nearly(street: SemanticMap) -> None:
    poses = poses_along(TRACK_M)[:6]
    first, same = (predict(street, CAMERA, poses, CONDITIONS) for _ in range(2))
    other = predict(street, CAMERA, poses, replace(CONDITIONS, seed=5))
    for name in ("sigma_m", "sigma_deg", "expected_m", "lost", "ambiguous"):
        np.testing.assert_array_equal(getattr(first, name), getattr(same, name))
    assert (first.expected_m != other.expected_m).any()
    np.testing.assert_allclose(first.expected_m, other.expected_m, atol=0.2)


def test_turning_and_moving_the_map_changes_nothing(street: SemanticMap) -> None:
    T = Pose.from_rotvec([0.0, 0.0, 2.1], [300.0, -80.0, 12.0])
    there = SemanticMap(street.elements.transformed(T), street.frame, trajectory_m=T.apply(TRACK_M))
    for k, pose in enumerate(poses_along(TRACK_M)[::6]):
        here = expected_error(street, CAMERA, pose, CONDITIONS, k)
        moved = expected_error(there, CAMERA, T @ pose, CONDITIONS, k)
        np.testing.assert_allclose(here.sigmas(), moved.sigmas(), rtol=1e-6)


def test_a_row_of_equal_poles_is_ambiguous() -> None:
    """The same number of poles, once equal and equally spaced, once at random."""
    x = np.repeat(np.arange(-40.0, 160.0, 8.0), 2)
    side = np.tile([-5.0, 5.0], len(x) // 2)
    poles = elements_at(np.column_stack([x, side]))
    foot = np.column_stack([x, side, np.zeros(len(x))])
    row = Elements3D.from_ends(poles.id, foot + 4.0 * UP, foot, np.full(len(x), POLE))
    rng = np.random.default_rng(1)
    foot = foot + np.column_stack([rng.uniform(-4.0, 4.0, (len(x), 2)), np.zeros(len(x))])
    anchor = foot + np.column_stack([np.zeros((len(x), 2)), rng.uniform(2.0, 7.0, len(x))])
    mixed = Elements3D.from_ends(poles.id, anchor, foot, np.full(len(x), POLE))
    conditions, pose = replace(CONDITIONS, trials=12), poses_along(TRACK_M)[10]
    alike = simulate_localization(mapped(row), CAMERA, pose, conditions, 0)
    told_apart = simulate_localization(mapped(mixed), CAMERA, pose, conditions, 0)
    assert sum(alike) == pytest.approx(1.0)
    assert alike.ambiguous > 0.7
    assert told_apart.ambiguous < 0.4


def test_a_sure_answer_far_off_counts_as_ambiguous(
    street: SemanticMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose, conditions = poses_along(TRACK_M)[2], replace(CONDITIONS, trials=8)
    localize = Localizer.localize

    def elsewhere(self: Localizer, *request: Any) -> Localization:
        found = localize(self, *request)
        if found.T_camera_map is None:
            return found
        off = Pose(np.eye(3), np.array([0.0, 0.0, 1.5 * LOST_M]))
        return replace(found, T_camera_map=off @ found.T_camera_map)

    true = simulate_localization(street, CAMERA, pose, conditions, 0)
    monkeypatch.setattr(Localizer, "localize", elsewhere)
    wrong = simulate_localization(street, CAMERA, pose, conditions, 0)
    assert true.ok > 0.2
    assert wrong == (0.0, pytest.approx(true.ambiguous + true.ok), true.cannot)


def test_made_up_frames_have_the_noise_that_they_state(street: SemanticMap) -> None:
    pose, rng = poses_along(TRACK_M)[0], np.random.default_rng(0)
    silent = replace(SURE, detector=SURE.detector._replace(false_detections=1e-9))
    true = visible_elements(street.elements, CAMERA, pose.inverse(), silent).seen
    off = []
    for _ in range(400):
        seen = detect(street.elements, CAMERA, pose.inverse(), silent, rng)
        if len(seen) == len(true):
            off.append((seen.anchor_px - true.anchor_px) / true.sigma_px[:, 1:])
    points = np.concatenate(off)[:, 1]  # v: along poles that stand upright, and of signs
    assert len(points) > 1000
    assert np.std(points) == pytest.approx(1.0, abs=0.05)


def test_candidates_stand_where_there_is_room(street: SemanticMap) -> None:
    poses = poses_along(TRACK_M)
    found = candidates_beside(poses, street.elements, street.classes)
    assert set(found.class_id.tolist()) == {POLE, 1}
    assert not set(found.id.tolist()) & set(street.elements.id.tolist())
    away = found.anchor_m[:, None, :2] - street.elements.anchor_m[None, :, :2]
    assert np.linalg.norm(away, axis=2).min() >= 3.0
    assert np.abs(found.anchor_m[:, 1]).min() > 4.0


def test_a_drive_with_a_gap_is_two_drives() -> None:
    first = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    second = np.column_stack([np.full(5, 300.0), np.arange(5.0), np.zeros(5)])
    poses = poses_along(np.concatenate([first, second]))
    np.testing.assert_allclose([pose.rotation[:2, 2] for pose in poses[:5]], [[1.0, 0.0]] * 5)
    np.testing.assert_allclose(
        [pose.rotation[:2, 2] for pose in poses[5:]], [[0.0, 1.0]] * 5, atol=1e-12
    )
    assert thinned(first, 2.0) == [0, 2, 4]


def test_nothing_to_predict_is_said(street: SemanticMap) -> None:
    nothing = mapped(street.elements[[]])
    with pytest.raises(SemvizError, match="the map is empty"):
        predict(nothing, CAMERA, poses_along(TRACK_M), CONDITIONS)
    with pytest.raises(SemvizError, match="no poses"):
        predict(street, CAMERA, (), CONDITIONS)
    with pytest.raises(SemvizError, match="crop radius"):
        replace(CONDITIONS, crop_radius_m=-1.0)
