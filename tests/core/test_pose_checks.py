"""Poses against images: motions are measured with honest sigmas, planted faults are named, healthy
drives are not accused, and refined poses are near the truth."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.planted_pose_faults import (
    POSE_FAULTS,
    moved,
    noisy,
    with_baseline,
    with_right_image_moved,
)
from support.point_tracks import (
    driven,
    mono_rig,
    stereo_rig,
    tracks_between,
    tracks_of_drive,
    without_pose,
)

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.pose_checks import pose_covariance as pose_covariance_module
from semviz_core.pose_checks.comparison import DrivePoses, PoseComparison, RigErrors
from semviz_core.pose_checks.faults import PoseCheck, check_drive, pose_covariance, refined_frames
from semviz_core.pose_checks.image_motions import (
    ImageMotions,
    load_motions,
    motions_of,
    save_motions,
)
from semviz_core.pose_checks.motion import MOTION, measure_motion
from semviz_core.pose_checks.pose_covariance import PoseCovariance
from semviz_core.pose_checks.tracks import PointTracks
from semviz_core.pose_checks.variance_components import variance_components
from semviz_core.pose_checks.whole_drive import corrected_time
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

COUNT = 36
MOST_DEG = 0.05
"""Refined rotations are nearer to the truth, with stereo."""


@cache
def healthy_drive(seed: int) -> tuple[tuple[Frame, ...], list[PointTracks], ImageMotions]:
    rng = np.random.default_rng(seed)
    frames = driven(COUNT, rng)
    tracks = tracks_of_drive(frames, stereo_rig(), rng)
    return frames, tracks, motions_of(tracks, frames, stereo_rig())


@cache
def one_camera_drive(
    seed: int, driven_m: tuple[float, ...] | None = None
) -> tuple[tuple[Frame, ...], ImageMotions]:
    rng, rig = np.random.default_rng(seed), mono_rig()
    path = None if driven_m is None else np.array(driven_m)
    frames = driven(COUNT if path is None else len(path), rng, path)
    moving = 0.1 if path is None else 0.0
    return frames, motions_of(tracks_of_drive(frames, rig, rng, moving=moving), frames, rig)


def worst_m(truth: Sequence[Frame], frames: Sequence[Frame]) -> float:
    first, second = DrivePoses.of(truth), DrivePoses.of(frames)
    return float(np.linalg.norm(first.center_m - second.center_m, axis=1).max())


def worst_deg(truth: Sequence[Frame], frames: Sequence[Frame]) -> float:
    angles = []
    for first, second in zip(truth, frames, strict=True):
        assert first.T_map_camera is not None
        assert second.T_map_camera is not None
        angles.append((first.T_map_camera.inverse() @ second.T_map_camera).log()[3:])
    return float(np.rad2deg(np.linalg.norm(angles, axis=1).max()))


def kinds(check: PoseCheck) -> list[str]:
    return [fault.kind for fault in check.faults]


vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@settings(max_examples=15)
@given(turn=vectors, seed=st.integers(0, 1000), ahead_m=st.floats(0.3, 2.0))
def test_a_motion_is_measured_within_its_sigma(turn: np.ndarray, seed: int, ahead_m: float) -> None:
    """Also where every fourth point is on another vehicle."""
    T_now_before = Pose(so3_exp(0.03 * turn), np.array([0.05, -0.02, -ahead_m]))
    rng, rig = np.random.default_rng(seed), stereo_rig()
    tracks = tracks_between(Pose.identity(), T_now_before.inverse(), rig, rng, moving=0.25)
    motion = measure_motion(tracks, rig)
    assert motion.is_measured
    error = (motion.T_now_before @ T_now_before.inverse()).log()
    chi2 = error @ motion.information[MOTION, MOTION] @ error
    assert chi2 < 30.0
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.06


def test_one_camera_measures_rotation_and_direction_but_no_length() -> None:
    T_now_before = Pose(so3_exp(np.array([0.005, 0.02, -0.01])), np.array([0.1, 0.0, -1.2]))
    rng = np.random.default_rng(3)
    tracks = tracks_between(
        Pose.identity(), T_now_before.inverse(), mono_rig(), rng, count=300, moving=0.1
    )
    motion = measure_motion(tracks, mono_rig())
    true_m = float(np.linalg.norm(T_now_before.translation))
    scaled = motion.with_length(true_m)
    error = (scaled.T_now_before @ T_now_before.inverse()).log()
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.1
    assert np.linalg.norm(error[:3]) < 0.05
    length = T_now_before.translation / true_m
    assert length @ scaled.information[:3, :3] @ length < 1.0  # sigma above 1 m


def test_images_without_common_points_measure_nothing() -> None:
    assert not measure_motion(PointTracks.none(), stereo_rig()).is_measured
    rng = np.random.default_rng(0)
    noise = [rng.uniform([0, 0], [1241, 376], (80, 2)) for _ in range(4)]
    assert not measure_motion(PointTracks(*noise), stereo_rig()).is_measured


@pytest.mark.parametrize("name", POSE_FAULTS)
@pytest.mark.parametrize("sigmas", [(0.0, 0.0), (0.01, 0.02)], ids=["exact", "noisy"])
def test_a_planted_fault_is_named_and_repaired(name: str, sigmas: tuple[float, float]) -> None:
    plant, wanted = POSE_FAULTS[name]
    frames, _, motions = healthy_drive(1)
    rng = np.random.default_rng(5)
    planted = plant(noisy(frames, *sigmas, rng), rng)
    check = check_drive(planted.frames, motions, stereo_rig())
    assert len(check.faults) == 1, [fault.text for fault in check.faults]
    (fault,) = check.faults
    assert fault.kind in wanted
    if planted.first is not None and planted.last is not None:
        assert fault.first - planted.first in range(-1, 3 if "drift" in name else 2)
        assert abs(fault.last - planted.last) <= (5 if "first" in name else 1)
    assert worst_deg(frames, refined_frames(check)) < MOST_DEG


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_wrong_baseline_is_named_with_the_right_one(sign: float) -> None:
    frames, tracks, _ = healthy_drive(1)
    rig = with_baseline(stereo_rig(), 1.0 + 0.01 * sign)
    check = check_drive(frames, motions_of(tracks, frames, rig), rig)
    assert kinds(check) == ["baseline"]
    assert check.faults[0].value == pytest.approx(0.54, abs=0.001)


@pytest.mark.parametrize("offset", [(0.45, 0.0), (-0.45, 0.0), (0.0, 0.45)])
def test_a_right_image_beside_its_calibration_is_measured(offset: tuple[float, float]) -> None:
    frames, tracks, _ = healthy_drive(1)
    shifted = [with_right_image_moved(track, np.array(offset)) for track in tracks]
    check = check_drive(frames, motions_of(shifted, frames, stereo_rig()), stereo_rig())
    assert kinds(check) == ["right image"]
    assert check.comparison.rig.values[1:] == pytest.approx(offset, abs=0.08)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sigmas", [(0.0, 0.0), (0.01, 0.02), (0.03, 0.05)])
def test_healthy_drives_are_not_accused(seed: int, sigmas: tuple[float, float]) -> None:
    frames, _, motions = healthy_drive(seed)
    check = check_drive(noisy(frames, *sigmas, np.random.default_rng(seed)), motions, stereo_rig())
    assert not check.faults, [fault.text for fault in check.faults]
    assert worst_deg(frames, refined_frames(check)) < max(MOST_DEG, 2.0 * sigmas[1])


def test_a_turned_start_in_noisy_poses_is_not_late_and_late_poses_are() -> None:
    """On a road that is nearly straight, noise can suit another time."""
    frames, rig = Street(2006, StreetOptions(40)).frames, stereo_rig()
    motions = motions_of(tracks_of_drive(frames, rig, np.random.default_rng(0)), frames, rig)
    late, turned = "one frame late", "first 12 frames turned, 0.7 deg"
    for seed, fault in ((16, turned), (30, turned), (82, turned), (1, late), (2, late), (3, late)):
        rng = np.random.default_rng(seed)
        planted = POSE_FAULTS[fault][0](noisy(frames, 0.01, 0.02, rng), rng)
        correction = corrected_time(DrivePoses.of(planted.frames), motions)
        assert (correction is not None) == (fault == late)


@pytest.mark.parametrize("first", [0, 14])
def test_errors_of_refined_poses_are_correlated_and_grow_away_from_the_given_ones(
    first: int,
) -> None:
    frames, _, motions = healthy_drive(3)
    wrong = range(first, first + 10)
    turn = Pose(so3_exp(np.array([0.0, 0.02, 0.0])), np.zeros(3))
    planted = moved(frames, lambda row, pose: pose @ turn if row in wrong else pose)
    poses = pose_covariance(check_drive(planted, motions, stereo_rig()), wrong)
    sigma = np.array([np.sqrt(np.diag(poses.at(np.array([k])))) for k in range(len(frames))])
    others = np.delete(sigma, list(wrong), axis=0)
    assert np.ptp(others, axis=0).max() < 1e-9
    farthest = first if first == 0 else first + 4
    assert (sigma[farthest] > sigma[first + 9]).all()
    both = poses.at(np.array([first + 4, first + 5]))
    assert both[0, 6] > 0.5 * both[0, 0]


@pytest.mark.parametrize("assumed", [0.5, 1.0, 3.0])
def test_errors_of_refined_poses_are_those_of_all_given_poses_around_them(assumed: float) -> None:
    """Many drives with errors as stated, whatever sigma of given poses the refinement assumed."""
    rng, n, variance, wrong = np.random.default_rng(5), 12, np.full(6, 0.04), np.arange(4, 8)
    weight = np.tile(1.0 / (assumed**2 * variance), (n, 1))
    weight[wrong] = 0.0
    steps = np.eye(6 * (n - 1), 6 * n) - np.eye(6 * (n - 1), 6 * n, 6)
    H = np.diag(weight.ravel()) + steps.T @ steps / 0.01
    blocks = H.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)
    row = np.arange(n)
    poses = PoseCovariance(
        row, np.isin(row, wrong), variance, weight, blocks[row, row], blocks[row[:-1], row[1:]]
    )
    alone = rng.normal(0.0, 0.2, (20_000, 6 * n))
    motion = rng.normal(0.0, 0.1, (20_000, 6 * (n - 1)))
    refined = np.linalg.solve(H, (weight.ravel() * alone + motion @ steps / 0.01).T).T
    used = np.where(np.repeat(poses.refined, 6), refined, alone)
    assert np.allclose(poses.at(row), used.T @ used / len(used), atol=0.002)


def test_a_drive_that_is_refined_as_a_whole_is_held_by_its_corrected_poses() -> None:
    frames, _, motions = healthy_drive(3)
    late = POSE_FAULTS["one frame late"][0](frames, np.random.default_rng(0)).frames
    poses = pose_covariance(check_drive(late, motions, stereo_rig()), range(COUNT))
    assert np.diag(poses.at(np.arange(COUNT))).max() < 0.05**2


def test_a_refined_pose_is_stated_alike_with_given_poses_from_farther_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    n, held = 300, np.ones((300, 6))
    held[100:200] = 0.0
    step = np.full((n - 1, 6, 6), 50.0 * np.eye(6))
    diagonal = held[:, :, None] * np.eye(6)
    diagonal[1:] += step
    diagonal[:-1] += step
    poses = PoseCovariance(np.arange(n), held[:, 0] == 0.0, np.full(6, 0.5), held, diagonal, -step)
    rows = np.array([90, 120, 199, 205])
    near = poses.at(rows)
    assert 0.01 < near[0, 6] / near[6, 6] < 1.0
    monkeypatch.setattr(pose_covariance_module, "REACH_FRAMES", n)
    assert np.allclose(near, poses.at(rows), rtol=0.01, atol=1e-3)


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("pose_mm", [0.5, 10.0])
def test_errors_of_poses_and_of_motions_are_told_apart(pose_mm: float, share: float) -> None:
    """A motion's error is its stated one by the root of ``share``; more is never believed."""
    rng, n = np.random.default_rng(7), 200
    stated = np.repeat([0.005, 1e-4], 3)
    pose = np.repeat([1e-3 * pose_mm, 2e-5 * pose_mm], 3)
    innovation = np.sqrt(share) * rng.normal(0.0, stated, (n, 6))
    innovation -= np.diff(rng.normal(0.0, pose, (n + 1, 6)), axis=0)
    information, zeros = np.tile(np.diag(stated**-2.0), (n, 1, 1)), np.zeros(n)
    comparison = PoseComparison(
        innovation,
        zeros,
        zeros == 0.0,
        np.sqrt(2.0) * pose,
        RigErrors.none(),
        information,
        np.zeros((n, 3, 3)),
    )
    found = variance_components(comparison, np.arange(n) % 50 > 0)
    assert 0.5 < found.motion_share / min(share, 1.0) < 2.0
    if share <= 1.0 and pose_mm > 1.0:
        assert found.pose_sigma == pytest.approx(pose, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["yaw drift, 0.1 deg a frame", "first 12 frames turned, 0.7 deg"])
def test_a_drift_of_half_a_short_drive_is_not_believed(name: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 20])
    frames = driven(20, rng)
    motions = motions_of(tracks_of_drive(frames, stereo_rig(), rng), frames, stereo_rig())
    plant, wanted = POSE_FAULTS[name]
    planted = plant(noisy(frames, 0.01, 0.02, rng), rng)
    check = check_drive(planted.frames, motions, stereo_rig())
    assert set(kinds(check)) == set(wanted)
    assert worst_deg(frames, refined_frames(check)) < MOST_DEG


def test_a_jump_that_stays_moves_the_shorter_side_as_a_whole() -> None:
    frames, _, motions = healthy_drive(2)
    jumped = moved(
        frames,
        lambda row, pose: (
            Pose(pose.rotation, pose.translation + np.array([0.0, 0.5, 0.0])) if row >= 28 else pose
        ),
    )
    check = check_drive(jumped, motions, stereo_rig())
    assert kinds(check) == ["shifted"]
    assert (check.faults[0].first, check.faults[0].last) == (28, COUNT - 1)
    refined = refined_frames(check)[-1].T_map_camera
    true = frames[-1].T_map_camera
    assert refined is not None
    assert true is not None
    assert np.linalg.norm(refined.translation - true.translation) < 0.1


def test_a_vehicle_at_rest_is_not_frozen() -> None:
    rng, rig = np.random.default_rng(4), stereo_rig()
    frames = driven(20, rng)
    still = tuple(
        Frame(row, 0.1 * row, frames[min(row, 12)].T_map_camera) for row in range(len(frames))
    )
    motions = motions_of(tracks_of_drive(still, rig, rng), still, rig)
    assert not check_drive(still, motions, rig).faults


def test_one_camera_finds_turned_and_frozen_poses() -> None:
    rng, rig = np.random.default_rng(6), mono_rig()
    frames = driven(COUNT, rng)
    motions = motions_of(tracks_of_drive(frames, rig, rng), frames, rig)
    assert not check_drive(frames, motions, rig).faults
    for name in ("jump, 0.7 deg", "frozen for five frames", "one frame late"):
        plant, wanted = POSE_FAULTS[name]
        check = check_drive(plant(frames, np.random.default_rng(1)).frames, motions, rig)
        assert kinds(check) == list(wanted), name


@pytest.mark.parametrize("offset", [(0.0, 3.5, 0.0), (3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)])
@pytest.mark.parametrize("rows", [range(15, 16), range(14, 20), range(25, COUNT)])
def test_one_camera_finds_poses_metres_aside_by_the_speed_around_them(
    rows: range, offset: tuple[float, float, float]
) -> None:
    """Images do not show the length of a step, and a wrong pose's own is no measure of it."""
    frames, motions = one_camera_drive(2)
    shifted = moved(
        frames,
        lambda row, pose: (
            Pose(pose.rotation, pose.translation + np.array(offset)) if row in rows else pose
        ),
    )
    check = check_drive(noisy(shifted, 0.01, 0.02, np.random.default_rng(4)), motions, mono_rig())
    (fault,) = check.faults
    assert fault.kind == "shifted"
    assert abs(fault.first - rows[0]) <= 1
    assert abs(fault.last - rows[-1]) <= 1
    assert fault.shift_m == pytest.approx(np.linalg.norm(offset), abs=0.2)
    assert worst_m(frames, refined_frames(check)) < 0.2


@pytest.mark.parametrize("brake_mps2", [3.0, 9.0])
def test_one_camera_takes_no_stop_and_no_start_for_a_fault(brake_mps2: float) -> None:
    time_s = 0.1 * np.arange(60)
    speed_mps = np.clip(10.0 - brake_mps2 * (time_s - 1.0), 0.0, 10.0)
    speed_mps[40:] = np.minimum(4.0 * (time_s[40:] - 4.0), 10.0)
    frames, motions = one_camera_drive(5, tuple((0.1 * np.cumsum(speed_mps)).tolist()))
    for sigmas in ((0.0, 0.0), (0.01, 0.02)):
        check = check_drive(noisy(frames, *sigmas, np.random.default_rng(1)), motions, mono_rig())
        assert not check.faults, [fault.text for fault in check.faults]


def test_frames_without_a_pose_stay_without() -> None:
    frames, _, motions = healthy_drive(1)
    gappy = without_pose(frames, range(10, 13))
    check = check_drive(gappy, motions, stereo_rig())
    assert not check.faults
    missing = [frame.index for frame in refined_frames(check) if frame.T_map_camera is None]
    assert missing == [10, 11, 12]


def test_motions_are_kept_for_the_same_images_only(tmp_path: Path) -> None:
    _, _, motions = healthy_drive(1)
    path = tmp_path / "motions.safetensors"
    save_motions(motions, "these images", path)
    again = load_motions(path, "these images")
    assert again is not None
    assert np.array_equal(again.information, motions.information)
    assert np.array_equal(again.frames, motions.frames)
    assert load_motions(path, "other images") is None
    path.write_bytes(path.read_bytes()[:-5])
    assert load_motions(path, "these images") is None
    assert load_motions(tmp_path / "none", "these images") is None


def test_a_flipped_bit_of_kept_motions_costs_a_new_measurement(tmp_path: Path) -> None:
    """Most flips in a matrix leave finite numbers, which would move poses in silence."""
    _, _, motions = healthy_drive(1)
    path = tmp_path / "motions.safetensors"
    save_motions(motions, "these images", path)
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    for place in range(start, len(content), len(content) // 200):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        assert load_motions(path, "these images") is None
    path.write_bytes(content.replace(b"crc32", b"other"))  # a file of an earlier version
    assert load_motions(path, "these images") is not None
