"""Samples to train on, made from numbers."""

import json
import pickle
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.research.evaluation.problems import Difficulty
from semviz_core.research.training import simulated_samples
from semviz_core.research.training.simulated_samples import (
    FRAMES_A_WORLD,
    HELD_OUT,
    LEARNED_DISTRIBUTION,
    PAPER_20M_DISTRIBUTION,
    PAPER_DISTRIBUTION,
    ROADS_AT_A_TIME,
    KittiFiles,
    SimulatedSamples,
    transform_sample,
)

SOME = range(3, 3 + 12 * FRAMES_A_WORLD * ROADS_AT_A_TIME, FRAMES_A_WORLD * ROADS_AT_A_TIME)
"""Numbers of as many worlds, all on one road."""

LOCAL = {"point_m", "bottom_m", "road", "prior", "origin_m", "truth"}
"""What is in local coordinates."""


def parts(sample: Sample) -> list[np.ndarray]:
    assert sample.truth is not None
    truth = sample.truth
    own = [getattr(sample, field.name) for field in fields(sample) if field.name != "truth"]
    return [*own, truth.rotation, truth.translation, truth.pairs]


def same(sample: Sample, other: Sample) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(parts(sample), parts(other), strict=True))


def in_camera(sample: Sample) -> tuple[FloatArray, FloatArray]:
    """(n, 3) peaks and bottoms in the camera's coordinates."""
    assert sample.truth is not None
    R, t = sample.truth.rotation, sample.truth.translation
    return sample.point_m @ R.T + t, sample.bottom_m @ R.T + t


@pytest.mark.parametrize(
    "given_drills", [PAPER_DISTRIBUTION, LEARNED_DISTRIBUTION, PAPER_20M_DISTRIBUTION]
)
def test_samples_are_valid_and_hold_no_nan(given_drills: SimulatedSamples) -> None:
    for number in SOME:
        sample = given_drills.sample(number)
        assert sample.truth is not None
        assert len(sample.ray) >= 4
        assert sample.truth.pairs.any()
        assert all(np.isfinite(part).all() for part in parts(sample))


def test_true_pairs_lie_where_they_are_seen() -> None:
    """Within the detector's noise; a pair that is wrong is degrees off."""
    for number in SOME:
        sample = PAPER_DISTRIBUTION.sample(number)
        assert sample.truth is not None
        seen, mapped = np.nonzero(sample.truth.pairs & sample.seen_known[:, :1])
        ray = in_camera(sample)[0][mapped]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        off_rad = np.linalg.norm(ray - sample.ray[seen], axis=1)
        assert (off_rad < 0.06).all()
        assert (sample.seen_class[seen] == sample.mapped_class[mapped]).all()


def test_a_limited_number_of_frames_is_turned_anew() -> None:
    few = replace(PAPER_20M_DISTRIBUTION, frames=3)
    first, again, other = few.sample(1), few.sample(4), few.sample(2)
    assert np.array_equal(first.ray, again.ray)
    assert np.allclose(in_camera(first)[0], in_camera(again)[0])
    assert not np.allclose(first.point_m, again.point_m, atol=0.1)
    assert first.ray.shape != other.ray.shape or not np.allclose(first.ray, other.ray)
    assert not np.array_equal(few.held_out(1).ray, few.held_out(4).ray)
    assert same(first, PAPER_20M_DISTRIBUTION.sample(1))


def test_the_same_number_is_the_same_sample_in_every_process() -> None:
    there = pickle.loads(pickle.dumps(LEARNED_DISTRIBUTION))
    simulated_samples._road.cache_clear()
    for number in (5, HELD_OUT + 5):
        assert same(LEARNED_DISTRIBUTION.sample(number), there.sample(number))
    assert same(LEARNED_DISTRIBUTION.held_out(5), LEARNED_DISTRIBUTION.sample(HELD_OUT + 5))
    assert not same(LEARNED_DISTRIBUTION.sample(5), LEARNED_DISTRIBUTION.sample(6))


@given(st.integers(0, HELD_OUT - 1), st.integers(0, 10**8), st.booleans())
def test_held_out_and_training_share_no_road_and_no_seed(
    number: int, held_out: int, on_kitti: bool
) -> None:
    kitti = KittiFiles(Path("poses"), Path("poles")) if on_kitti else None
    given_drills = replace(PAPER_DISTRIBUTION, kitti=kitti)
    (road, seed), (other_road, other_seed) = map(given_drills.place, (number, HELD_OUT + held_out))
    assert road != other_road
    assert seed != other_seed
    assert {road, other_road}.isdisjoint({"09", "10", *map(str, range(1000))})
    assert min(seed, other_seed) > 1_000_000


@given(
    st.sampled_from(SOME),
    st.floats(-np.pi, np.pi),
    st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)),
)
def test_other_coordinates_change_nothing_for_the_camera(
    number: int, turn_rad: float, shift_m: tuple[float, float]
) -> None:
    before = compass_sample(number)
    after = transform_sample(before, turn_rad, shift_m)
    for elements, other in zip(in_camera(before), in_camera(after), strict=True):
        np.testing.assert_allclose(elements, other, atol=1e-9)
    for name in {field.name for field in fields(before)} - LOCAL:
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    np.testing.assert_array_equal(before.prior[:5], after.prior[:5])
    np.testing.assert_allclose(heading_error(before), heading_error(after), atol=1e-9)
    np.testing.assert_allclose(above_road(before), above_road(after), atol=1e-9)


@given(st.sampled_from(SOME), st.floats(-np.pi, np.pi), st.floats(-5.0, 5.0))
def test_the_origin_moves_with_the_shift(number: int, turn_rad: float, along_m: float) -> None:
    """A place in the map has the new local coordinates that the turn and the shift give it."""
    before = compass_sample(number)
    after = transform_sample(before, turn_rad, (along_m, 0.0))
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    place = before.point_m[0] + before.origin_m
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ (place - after.origin_m)
    np.testing.assert_allclose(turned, after.point_m[0], atol=1e-9)


def test_samples_are_turned_anywhere_and_shifted_as_far_as_the_paper_says() -> None:
    shifts, turns = [], []
    for number in SOME:
        problem, sample = PAPER_DISTRIBUTION.problem(number), PAPER_DISTRIBUTION.sample(number)
        assert sample.truth is not None
        shifts.append(np.linalg.norm(sample.origin_m - problem.prior.position_m))
        turn = sample.truth.rotation.T @ problem.T_camera_map.rotation
        turns.append(np.arctan2(turn[1, 0], turn[0, 0]))
    assert 3.0 < max(shifts) <= 5.0
    assert np.ptp(turns) > np.pi


def test_learned_samples_begin_at_the_fix() -> None:
    for number in SOME:
        origin = LEARNED_DISTRIBUTION.sample(number).origin_m
        np.testing.assert_array_equal(origin, LEARNED_DISTRIBUTION.problem(number).prior.position_m)


def test_levels_come_as_often_as_their_weights_say() -> None:
    far = Difficulty(gps_distance_m=(40.0, 40.0))
    mixed = SimulatedSamples(((3.0, Difficulty()), (1.0, far)))
    numbers = [first + k for first in SOME for k in range(FRAMES_A_WORLD)]
    sigma = [mixed.problem(number).prior.horizontal_sigma_m for number in numbers]
    assert np.mean(np.array(sigma) > 20.0) == pytest.approx(0.25, abs=0.08)


def test_samples_on_kittis_roads(tmp_path: Path) -> None:
    kitti = write_roads(tmp_path, poles=80)
    given_drills = replace(PAPER_DISTRIBUTION, kitti=kitti)
    assert given_drills.place(0)[0] in simulated_samples.TRAINING_SEQUENCES
    assert len(given_drills.sample(0).ray) >= 4
    assert given_drills.place(HELD_OUT)[0] == "08"
    with pytest.raises(SemvizError, match="no such file"):
        replace(PAPER_DISTRIBUTION, kitti=KittiFiles(tmp_path / "none", tmp_path)).sample(0)


def test_a_road_without_poles_is_said_to_be_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated_samples, "_MOST_TRIES", 5)
    bare = replace(PAPER_DISTRIBUTION, kitti=write_roads(tmp_path, poles=1))
    with pytest.raises(SemvizError, match="no frame shows four elements"):
        bare.sample(0)


def test_samples_describe_themselves_in_json() -> None:
    told = json.loads(json.dumps(LEARNED_DISTRIBUTION.describe()))
    assert told["roads"] == "simulated"
    assert {"weight": 12.0, "noise": "paper"} in told["levels"]
    assert told != PAPER_DISTRIBUTION.describe()
    assert sum("gps_distance_m" in level for level in told["levels"]) == 16


def compass_sample(number: int) -> Sample:
    """With a heading that is known, before anything is turned."""
    compass = SimulatedSamples(((1.0, Difficulty(heading_sigma_rad=0.1)),))
    problem = compass.problem(number)
    sample = Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)
    return sample.with_truth(problem.T_camera_map, problem.pairs)


def heading_error(sample: Sample) -> float:
    """Sine of the angle between the prior's heading and the true one."""
    assert sample.truth is not None
    ahead = sample.truth.rotation[2, :2]
    return float(np.cross(np.append(ahead, 0.0), np.append(sample.prior[5:7], 0.0))[2])


def above_road(sample: Sample) -> FloatArray:
    """(n,) height of the mapped peaks above the road's plane."""
    height, *slope = sample.road
    return np.asarray(sample.point_m[:, 2] - height - sample.point_m[:, :2] @ slope)


def write_roads(folder: Path, poles: int) -> KittiFiles:
    """Straight drives of 120 m as KITTI's files, with poles on both sides."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(0.0, 150.0, poles), rng.uniform(3.0, 9.0, poles)])
    places[::2, 1] *= -1.0
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {ahead}" for ahead in range(120)]
    for sequence in (*simulated_samples.TRAINING_SEQUENCES, *simulated_samples.HELD_OUT_SEQUENCES):
        (folder / f"{sequence}.txt").write_text("\n".join(rows) + "\n")
        np.savez(folder / f"kitti_{sequence}.npz", poleparams=places)
    return KittiFiles(folder, folder)
