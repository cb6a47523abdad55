"""Frames that are not ok get the pose that odometry carries to them, and runs name more by it."""

from dataclasses import replace
from functools import lru_cache
from itertools import count

import numpy as np
import pytest
from support.planted_runs import PlantedRun, plant_in_run

from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.diagnosis.carried_poses import with_carried_poses
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.joint_fit import NEEDED_FRAMES, JointFit, joint_fits
from semviz_core.diagnosis.reference import FrameReference, is_near, pose_distance
from semviz_core.diagnosis.run import diagnose_run
from semviz_core.research.evaluation.problems import DETECTOR, default_road
from semviz_core.research.evaluation.roads import simulated_road

OK = (0, 1)
"""Frames of a drive that keep their own poses; the others lose them."""


@lru_cache
def drive(fault: FaultKind) -> PlantedRun:
    found = (plant_in_run(fault, seed, default_road()) for seed in count())
    return next(filter(None, found))


def few_ok(run: PlantedRun) -> list[Localization]:
    """The frames of which only ``OK`` are ok, at their true poses."""
    sure = np.diag(np.repeat([0.05, 0.002], 3) ** 2)
    return [
        replace(result, status="ok", T_camera_map=truth.T_camera_map, covariance=sure)
        if row in OK
        else replace(result, status="cannot", T_camera_map=None, covariance=None)
        for row, (result, truth) in enumerate(run.frames)
    ]


def cases(run: PlantedRun, results: list[Localization]) -> list[FrameReference]:
    return [FrameReference.of(result, run.semantic_map, None, DETECTOR) for result in results]


def test_odometry_carries_poses_to_frames_without_one() -> None:
    run = drive("healthy")
    carried = with_carried_poses(cases(run, few_ok(run)), run.odometry)
    for case, (_, truth) in zip(carried, run.frames, strict=True):
        assert case.localization.status == "ok"
        assert case.reference is not None
        away_m, angle = pose_distance(case.reference, truth.T_camera_map)
        assert away_m < 0.5
        assert angle < 0.02


def test_a_pose_that_no_other_frame_agrees_with_is_not_carried() -> None:
    """Without priors, two frames that disagree tell nothing of the others."""
    run = drive("healthy")
    results = [replace(result, prior=None) for result in few_ok(run)]
    first = results[0].T_camera_map
    assert first is not None
    off = Pose(np.eye(3), np.array([0.0, 0.0, 4.0]))
    results[0] = replace(results[0], T_camera_map=off @ first)
    carried = with_carried_poses(cases(run, results), run.odometry)
    assert [case.localization.status for case in carried[2:]] == ["cannot"] * (len(carried) - 2)


def test_a_stretch_without_any_pose_is_tracked_with_its_priors() -> None:
    run = drive("healthy")
    lost = [replace(result, status="cannot", T_camera_map=None) for result in few_ok(run)]
    carried = with_carried_poses(cases(run, lost), run.odometry)
    assert [case.localization.status for case in carried] == ["ok"] * len(carried)
    for case, (_, truth) in zip(carried, run.frames, strict=True):
        assert case.reference is not None
        assert is_near(case.reference, truth.T_camera_map)


def test_a_moved_element_is_named_though_few_frames_have_a_pose() -> None:
    run = drive("moved in the map")
    frames = [(result, None) for result in few_ok(run)]
    without = diagnose_run(frames, run.semantic_map, DETECTOR)
    found = diagnose_run(frames, run.semantic_map, DETECTOR, odometry=run.odometry)
    assert without.elements == ()
    assert [fault.kind for fault in found.elements] == ["moved in the map"]
    assert set(found.elements[0].elements) == set(run.elements)
    assert found.frames == len(frames)


def fits(fault: FaultKind) -> list[JointFit]:
    run = drive(fault)
    return joint_fits(with_carried_poses(cases(run, few_ok(run)), run.odometry), run.odometry)


@pytest.mark.parametrize("fault", ["wrong odometry", "wrong detection sigma"])
def test_the_planted_cause_is_the_likeliest(fault: FaultKind) -> None:
    best = fits(fault)[0]
    assert best.cause.kind == fault
    assert best.is_fault


@pytest.mark.parametrize("fault", ["healthy", "moved in the map", "missing in the map"])
def test_nothing_and_single_elements_are_no_common_cause(fault: FaultKind) -> None:
    found = fits(fault)
    assert found
    assert not any(fit.is_fault for fit in found)


def test_runs_with_two_sure_frames_name_their_odometry() -> None:
    run = drive("wrong odometry")
    frames = [(result, None) for result in few_ok(run)]
    found = diagnose_run(frames, run.semantic_map, DETECTOR, odometry=run.odometry)
    assert found.causes[0].kind == "wrong odometry"
    assert found.causes[0].sentence.startswith("The odometry is wrong: it ")


@pytest.mark.parametrize(
    ("fault", "seed"), [("wrong detection sigma", 2023), ("wrong heading prior", 2022)]
)
def test_a_wrong_assumption_does_not_keep_poses_from_being_carried(
    fault: FaultKind, seed: int
) -> None:
    """As stated, a track of these frames finds no pose: it starts again without the assumption."""
    run = plant_in_run(fault, seed, simulated_road(2000 + seed % 8))
    assert run is not None
    results = [result for result, _ in run.frames]
    assert sum(result.status == "ok" for result in results) < NEEDED_FRAMES
    frames = [(result, None) for result in results]
    found = diagnose_run(frames, run.semantic_map, DETECTOR, odometry=run.odometry)
    assert [cause.kind for cause in found.causes] == [fault]
