"""Position priors that are off alike: what they have in common is told from chance."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted_runs import plant_in_run

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.prior_offsets import prior_offsets, without_offset
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.diagnosis.run import diagnose_run
from semviz_core.research.evaluation.problems import CAMERA, DETECTOR
from semviz_core.research.evaluation.roads import simulated_road

NO_ELEMENTS = Elements3D.from_ends([], np.zeros((0, 3)), np.zeros((0, 3)), [])
LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Of T_camera_map, for a camera that looks along x."""
SIGMA_M = 0.5


def drive(count: int, seed: int = 0) -> list[FrameReference]:
    """Frames around two corners at a changing speed, with independent errors of the priors."""
    rng, at = np.random.default_rng(seed), np.linspace(0.0, 1.0, count)
    speed_m, turn_rad = 1.0 + 0.6 * np.sin(9.0 * at), 1.6 * np.sin(5.0 * at)
    ahead = np.column_stack([np.cos(turn_rad), np.sin(turn_rad), np.zeros(count)])
    centers_m = np.cumsum(speed_m[:, None] * ahead, axis=0)
    priors_m = centers_m + [SIGMA_M, SIGMA_M, 0.0] * rng.standard_normal((count, 3))
    return [frame(*values) for values in zip(centers_m, turn_rad, priors_m, strict=True)]


def frame(center_m: FloatArray, turn_rad: float, prior_m: FloatArray) -> FrameReference:
    turned = Pose.from_rotvec([0.0, 0.0, turn_rad], np.zeros(3)).rotation
    rotation = LEVEL @ turned.T
    empty = np.zeros((0, 2))
    found = Localization(
        "search", CAMERA, Prior(prior_m, SIGMA_M), Elements2D.from_ends(empty, empty, []),
        NO_ELEMENTS, "ok", "because", Pose(rotation, -rotation @ center_m), 1e-4 * np.eye(6),
    )  # fmt: skip
    return FrameReference.of(found, SemanticMap(NO_ELEMENTS, MapFrame("drive")), None, None)


def moved(case: FrameReference, by_m: FloatArray) -> FrameReference:
    prior = case.prior
    prior = replace(prior, position_m=prior.position_m + np.append(by_m, 0.0))
    return replace(case, localization=replace(case.localization, prior=prior))


def centers(cases: list[FrameReference]) -> FloatArray:
    return np.array([case.reference.inverse().translation[:2] for case in cases if case.reference])


def toward(cases: list[FrameReference]) -> FloatArray:
    return np.array([case.reference.rotation[2, :2] for case in cases if case.reference])


@pytest.mark.parametrize("seed", range(3))
def test_priors_that_are_right_have_nothing_in_common(seed: int) -> None:
    assert prior_offsets(drive(100, seed)) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_shifted_map_is_told_and_taken_from_the_priors(seed: int) -> None:
    cases = [moved(case, np.array([1.0, -0.4])) for case in drive(100, seed)]
    (best,) = prior_offsets(cases)
    assert best.pattern.kind == "misaligned map"
    assert best.value == pytest.approx([1.0, -0.4], abs=0.2)
    corrected = without_offset(cases, best)
    assert prior_offsets(corrected) == ()
    off_m = np.array([case.prior.position_m[:2] for case in corrected]) - centers(cases)
    assert np.abs(off_m.mean(axis=0)).max() < 0.2


@pytest.mark.parametrize("seed", range(3))
def test_an_antenna_beside_the_camera_is_told(seed: int) -> None:
    cases = drive(100, seed)
    ahead = toward(cases)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    cases = [moved(*pair) for pair in zip(cases, -0.3 * ahead + 0.9 * left, strict=True)]
    (best,) = prior_offsets(cases)
    assert best.pattern.kind == "wrong extrinsic"
    assert best.value == pytest.approx([-0.3, 0.9], abs=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_late_images_are_told(seed: int) -> None:
    cases = drive(100, seed)
    step_m = np.gradient(centers(cases), axis=0)
    late = [moved(*pair) for pair in zip(cases, -1.5 * step_m, strict=True)]
    best, *rivals = prior_offsets(late)
    assert best.pattern.kind == "time offset"
    assert best.value == pytest.approx([1.5], abs=0.2)
    assert [rival.pattern.kind for rival in rivals] in ([], ["wrong extrinsic"])


@pytest.mark.parametrize("seed", range(3))
def test_a_fix_that_errs_slowly_is_no_fault(seed: int) -> None:
    """Within what it states, as satellites have it: then frames do not count one by one."""
    rng, off_m = np.random.default_rng(seed), np.zeros((100, 2))
    off_m[0] = SIGMA_M * rng.standard_normal(2)
    for k in range(1, 100):
        off_m[k] = 0.98 * off_m[k - 1] + 0.2 * SIGMA_M * rng.standard_normal(2)
    cases = drive(100, seed)
    own_m = np.array([case.prior.position_m[:2] for case in cases]) - centers(cases)
    assert prior_offsets([moved(*pair) for pair in zip(cases, off_m - own_m, strict=True)]) == ()


def test_a_fix_that_jumps_in_some_frames_is_none_either() -> None:
    cases = drive(100)
    jumped = [moved(case, np.array([8.0, 3.0])) for case in cases[:20]]
    assert prior_offsets([*jumped, *cases[20:]]) == ()


def test_a_run_without_ground_truth_names_it() -> None:
    cases = [moved(case, np.array([1.0, -0.4])) for case in drive(60)]
    frames = [(case.localization, None) for case in cases]
    cause, *others = diagnose_run(frames, cases[0].semantic_map).causes
    assert (cause.kind, others) == ("misaligned map", [])
    assert "the map is shifted by that, or the priors are in another datum" in cause.sentence
    assert cause.frames == tuple(range(60))


def test_priors_too_late_to_find_the_frames_are_told_by_frames_solved_far_around_them() -> None:
    run = plant_in_run("time offset", 300, simulated_road(4), 40, fix_sigma_m=0.5)
    assert run is not None
    results = [localization for localization, _ in run.frames]
    assert sum(result.status == "ok" for result in results) < 8
    cause = diagnose_run([(result, None) for result in results], run.semantic_map, DETECTOR).causes[
        0
    ]
    assert cause.kind == "time offset"
    assert "1.0" in cause.sentence or "0.9" in cause.sentence
    assert len(cause.frames) > 15


def test_few_frames_say_nothing() -> None:
    assert prior_offsets([moved(case, np.array([9.0, 0.0])) for case in drive(5)]) == ()
