"""Localizing a drive: follows, waits while ambiguous, survives blindness, notices it is lost."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Belief, Odometry, OdometryNoise, Prior, adjoint
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.tracking import tracker as tracker_module
from semviz_core.tracking.association import POSE, JointBelief
from semviz_core.tracking.tracker import TrackedPose, Tracker

CAMERA = Camera(800, 400, np.array([[500.0, 0.0, 400.0], [0.0, 500.0, 200.0], [0.0, 0.0, 1.0]]))
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SIGHT_M = 18.0
DETECTOR = DetectorModel(
    false_detections=0.1, recall_near=0.9, recall_far=0.02, near_m=SIGHT_M, far_m=SIGHT_M + 2.0
)
STEP_M, MAP_SIGMA_M = 1.0, 0.05
NOISE = OdometryNoise()
SURE = np.diag(np.repeat([0.05, 0.003], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Step:
    observed: Elements2D
    odometry: Odometry | None
    prior: Prior
    T_camera_map: Pose


def street(seed: int, length_m: float = 150.0, spacing_m: float = 2.5) -> Elements3D:
    """Poles of many heights and signs on both sides of a road along x; no two stretches alike."""
    rng = np.random.default_rng(seed)
    count = int(length_m / spacing_m)
    x = rng.uniform(0.0, length_m, count)
    y = rng.choice([-1.0, 1.0], count) * rng.uniform(4.0, 9.0, count)
    kind = rng.choice([POLE, TRIANGULAR, ROUNDED], count, p=[0.6, 0.2, 0.2])
    return elements(np.column_stack([x, y]), rng.uniform(2.0, 5.0, count), kind)


def elements(places_m: FloatArray, height_m: FloatArray, kind: FloatArray) -> Elements3D:
    anchor = np.column_stack([places_m, height_m])
    end = np.column_stack([places_m, np.zeros(len(places_m))])
    end[kind != POLE] = np.nan
    return Elements3D.from_ends(np.arange(len(kind)), anchor, end, kind, MAP_SIGMA_M)


def mapped(world: Elements3D, seed: int) -> SemanticMap:
    """The map of ``world`` with its errors, the same in every frame."""
    noise = np.random.default_rng(seed).normal(0.0, MAP_SIGMA_M, (2, len(world), 3))
    anchor_m, end_m = world.anchor_m + noise[0], world.end_m + noise[1]
    return SemanticMap(replace(world, anchor_m=anchor_m, end_m=end_m), MapFrame("street"))


def looks(
    world: Elements3D, T_camera_map: Pose, rng: np.random.Generator, sigma_px: float = 1.0
) -> Elements2D:
    """Everything from 3 m to ``SIGHT_M`` ahead."""
    anchor_c, end_c = T_camera_map.apply(world.anchor_m), T_camera_map.apply(world.end_m)
    anchor, end = CAMERA.project(anchor_c), CAMERA.project(end_c)
    near = (anchor_c[:, 2] > 3.0) & (anchor_c[:, 2] < SIGHT_M) & CAMERA.contains(anchor)
    rows = np.flatnonzero(near & (CAMERA.contains(end) | ~world.is_line))
    noise = rng.normal(0.0, sigma_px, (2, len(rows), 2))
    return Elements2D.from_ends(
        anchor[rows] + noise[0], end[rows] + noise[1], world.class_id[rows], max(sigma_px, 0.1)
    )


def drive(
    world: Elements3D,
    x_m: FloatArray,
    seed: int = 0,
    sigma_px: float = 1.0,
    noise: OdometryNoise = NOISE,
    fix_sigma_m: float = 5.5,
) -> list[Step]:
    """A drive along the road, with a camera at each of ``x_m``; the fix is 6 m off throughout."""
    rng = np.random.default_rng(seed)
    steps: list[Step] = []
    for x in x_m:
        pose = Pose.from_rotvec([0.0, 0.0, 0.02 * np.sin(x / 20.0)], [x, -1.0, 1.6])
        T_camera_map = (pose @ Pose(AXES, np.zeros(3))).inverse()
        odometry = None
        if steps:
            odometry = noise.measure(T_camera_map @ steps[-1].T_camera_map.inverse(), rng)
        prior = Prior(
            np.array([x + 5.0, 2.0, 1.6]), fix_sigma_m, 0.15, up_camera=T_camera_map.rotation[:, 2]
        )
        observed = looks(world, T_camera_map, rng, sigma_px)
        steps.append(Step(observed, odometry, prior, T_camera_map))
    return steps


def tracked(tracker: Tracker, steps: list[Step]) -> list[TrackedPose]:
    return [tracker.step(step.observed, step.odometry, step.prior) for step in steps]


def following(world: Elements3D, steps: list[Step], seed: int = 0) -> Tracker:
    """A tracker that is told where the drive starts."""
    return Tracker(CAMERA, mapped(world, seed), DETECTOR, start=Belief(steps[0].T_camera_map, SURE))


def errors_m(tracks: list[TrackedPose], steps: list[Step]) -> FloatArray:
    return np.array([
        np.nan if track.T_camera_map is None
        else pose_error(track.T_camera_map, step.T_camera_map)[0]
        for track, step in zip(tracks, steps, strict=True)
    ])  # fmt: skip


def blinded(step: Step, with_odometry: bool) -> Step:
    none = step.observed[np.zeros(len(step.observed), dtype=bool)]
    return replace(step, observed=none, odometry=step.odometry if with_odometry else None)


def test_a_clean_drive_is_followed_from_the_first_fix() -> None:
    world = street(1)
    steps = drive(
        world, np.arange(20.0, 45.0, STEP_M), sigma_px=0.1, noise=OdometryNoise(1e-4, 1e-5)
    )
    semantic_map = SemanticMap(world, MapFrame("street"))

    tracks = tracked(Tracker(CAMERA, semantic_map, DETECTOR), steps)

    found = [track.status for track in tracks].index("ok")
    assert found < 10
    assert all(track.status == "ok" for track in tracks[found:])
    assert np.nanmax(errors_m(tracks, steps)) < 0.4  # the first pose rests on few elements
    assert errors_m(tracks, steps)[-5:].max() < 0.02
    pairs = tracks[-1].element_id
    assert (world.class_id[pairs[pairs >= 0]] == steps[-1].observed.class_id[pairs >= 0]).all()


def test_two_equal_rows_of_poles_are_not_decided_until_a_sign_tells_them_apart() -> None:
    offset = np.array([0.0, 1.0, 4.0, 5.0, 8.0, 11.0, 14.0, 17.0])
    x = np.concatenate([offset + 20.0 * block for block in range(-2, 6)])
    side = np.where(np.tile(offset, 8) % 2 == 0, 7.0, -8.0)
    kind = np.full(len(x) + 2, POLE)
    kind[-2:] = TRIANGULAR
    places = np.vstack([np.column_stack([x, side]), [[46.0, 7.0], [47.0, -8.0]]])
    height = np.append(np.full(len(x), 3.0), [2.5, 2.0])
    world = elements(places, height, kind)
    steps = drive(world, np.arange(19.0, 36.0, STEP_M), fix_sigma_m=30.0)
    first_sign = next(row for row, step in enumerate(steps) if (step.observed.class_id > 0).any())

    tracks = tracked(Tracker(CAMERA, SemanticMap(world, MapFrame("row")), DETECTOR), steps)

    status = [track.status for track in tracks]
    assert set(status[:first_sign]) == {"starting"}
    assert any("poses are left" in track.reason for track in tracks[:first_sign])
    assert "ok" in status[first_sign : first_sign + 8]
    assert np.nanmax(errors_m(tracks, steps)) < 0.5


def test_a_map_of_half_of_what_is_seen_is_found_by_frames_that_are_sure_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A detector of real images sees stakes and trees that no map holds, in every frame."""
    world = street(8, spacing_m=1.25)
    half = world[np.arange(len(world)) % 2 == 0]
    steps = drive(world, np.arange(20.0, 32.0, STEP_M), sigma_px=0.3)

    tracks = tracked(Tracker(CAMERA, mapped(half, 8), DETECTOR), steps)
    monkeypatch.setattr(tracker_module, "CONFIRMATIONS", len(steps) + 1)
    alone = tracked(Tracker(CAMERA, mapped(half, 8), DETECTOR), steps)

    first = [track.status for track in tracks].index("ok")
    assert tracks[first - 1].status == "starting"
    assert all(track.status == "ok" for track in tracks[first:])
    assert np.nanmax(errors_m(tracks, steps)) < 0.5
    assert {track.status for track in alone} == {"starting"}
    assert "explains only" in alone[-1].reason


def test_frames_at_a_standstill_confirm_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong and sure is so again in the next image of the same place."""
    world = street(8, spacing_m=1.25)
    half = mapped(world[np.arange(len(world)) % 2 == 0], 8)
    steps = drive(world, np.linspace(22.0, 22.3, 8), sigma_px=0.3)

    standing = tracked(Tracker(CAMERA, half, DETECTOR), steps)
    monkeypatch.setattr(tracker_module, "CONFIRMED_APART_M", 0.0)
    counted_each = tracked(Tracker(CAMERA, half, DETECTOR), steps)

    assert {track.status for track in standing} == {"starting"}
    assert "ok" in {track.status for track in counted_each}


def test_an_element_missed_in_one_image_is_paired_again_when_it_returns() -> None:
    world = street(1)
    steps = drive(world, np.arange(20.0, 40.0, STEP_M))
    complete = tracked(following(world, steps), steps)
    ids = [set(track.element_id[track.element_id >= 0].tolist()) for track in complete]
    element, row = next(
        (element, row)
        for row in range(3, len(ids) - 1)
        for element in ids[row]
        if element in ids[row - 1] and element in ids[row + 1]
    )
    without = steps[row].observed[complete[row].element_id != element]
    missed = [*steps[:row], replace(steps[row], observed=without), *steps[row + 1 :]]

    tracks = tracked(following(world, missed), missed)

    assert element not in tracks[row].element_id
    assert element in tracks[row + 1].element_id
    assert abs(errors_m(tracks, missed)[row + 1] - errors_m(complete, steps)[row + 1]) < 0.02


def test_three_blind_seconds_are_bridged_by_odometry() -> None:
    world = street(2)
    steps = drive(world, np.arange(20.0, 70.0, STEP_M))
    dark = [blinded(step, True) if 10 <= row < 40 else step for row, step in enumerate(steps)]

    tracks = tracked(following(world, steps), dark)

    assert all(track.status == "ok" for track in tracks)
    sigma = [np.sqrt(np.trace(track.covariance[:3, :3])) for track in tracks]
    assert (np.diff(sigma[10:40]) > 0.0).all()
    assert sigma[45] < 0.5 * sigma[39]
    assert errors_m(tracks, steps).max() < 1.0


def test_blind_and_without_odometry_it_is_lost_and_recovers() -> None:
    world = street(3)
    steps = drive(world, np.arange(20.0, 75.0, STEP_M))
    dark = [blinded(step, False) if 5 <= row < 35 else step for row, step in enumerate(steps)]

    tracks = tracked(following(world, steps), dark)

    assert "lost" in {track.status for track in tracks[5:35]}
    assert tracks[34].status == "lost"
    assert tracks[34].T_camera_map is None
    assert "ok" in {track.status for track in tracks[35:45]}
    assert errors_m(tracks[35:], steps[35:])[-1] < 0.3


def test_a_jump_of_30_m_is_noticed_within_a_second_and_repaired() -> None:
    world = street(4)
    place = np.concatenate([np.arange(20.0, 26.0), np.arange(56.0, 76.0)])
    steps = drive(world, place)
    steps[6] = replace(steps[6], odometry=steps[5].odometry)  # as if nothing had happened

    tracks = tracked(following(world, steps), steps)

    lost = [track.status for track in tracks].index("lost")
    assert 6 <= lost <= 16
    assert "Another place" in tracks[lost].reason
    assert tracks[-1].status == "ok"
    assert errors_m(tracks, steps)[-1] < 0.3


def test_covariance_is_sound_although_map_errors_stay_the_same() -> None:
    nees = []
    for seed in range(12):
        world = street(seed)
        steps = drive(world, np.arange(20.0, 34.0, STEP_M), seed)
        wrong = np.random.default_rng(seed).normal(0.0, np.sqrt(np.diag(SURE)))
        start = Belief(Pose.exp(wrong) @ steps[0].T_camera_map, SURE)
        tracker = Tracker(CAMERA, mapped(world, seed), DETECTOR, start=start)
        last = tracked(tracker, steps)[-1]
        assert last.T_camera_map is not None
        error = (steps[-1].T_camera_map @ last.T_camera_map.inverse()).log()
        nees.append(error @ np.linalg.solve(last.covariance, error))

    assert np.mean(nees) == pytest.approx(6.0, abs=3.0)  # 99.7 % of means of 12


def test_the_error_of_one_mapped_pole_is_learned_from_the_others() -> None:
    world = street(5)
    steps = drive(world, np.arange(20.0, 32.0, STEP_M))
    seen = tracked(following(world, steps), steps)[5].element_id
    row = int(seen[seen >= 0][0])
    anchor_m, end_m = world.anchor_m.copy(), world.end_m.copy()
    anchor_m[row, 1] += 0.12
    end_m[row, 1] += 0.12
    moved = SemanticMap(replace(world, anchor_m=anchor_m, end_m=end_m), MapFrame("street"))
    tracker = Tracker(CAMERA, moved, DETECTOR, start=Belief(steps[0].T_camera_map, SURE))

    tracks = tracked(tracker, steps)

    assert tracker._state is not None
    belief = tracker._state.belief
    error = belief.error_m[int(np.flatnonzero(belief.id == row)[0])]
    assert error[1] == pytest.approx(-0.12, abs=0.08)
    assert errors_m(tracks, steps)[-1] < 0.1


def test_the_same_drive_gives_the_same_tracks() -> None:
    world = street(6)
    steps = drive(world, np.arange(20.0, 27.0, STEP_M))

    first, second = (tracked(Tracker(CAMERA, mapped(world, 0), DETECTOR), steps) for _ in range(2))

    assert [track.reason for track in first] == [track.reason for track in second]
    for pose, other in zip(first, second, strict=True):
        if pose.T_camera_map is not None and other.T_camera_map is not None:
            np.testing.assert_array_equal(
                pose.T_camera_map.as_matrix(), other.T_camera_map.as_matrix()
            )


TANGENT = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6)


@given(TANGENT, TANGENT)
@settings(max_examples=30, deadline=None)
def test_adjoint_carries_a_tangent_through_a_pose(at: list[float], tangent: list[float]) -> None:
    T = Pose.exp(at)
    moved = T @ Pose.exp(tangent) @ T.inverse()
    np.testing.assert_allclose(
        moved.as_matrix(), Pose.exp(adjoint(T) @ tangent).as_matrix(), atol=1e-9
    )


def test_there_and_back_costs_certainty_twice() -> None:
    step = OdometryNoise().measure(
        Pose.exp([0.1, 0.0, -1.0, 0.0, 0.05, 0.0]), np.random.default_rng(0)
    )
    start = JointBelief.start(Belief(Pose.identity(), SURE))

    back = start.moved(step).moved(step.inverse())

    np.testing.assert_allclose(back.T_camera_map.as_matrix(), np.eye(4), atol=1e-12)
    A = adjoint(step.T_now_before.inverse())
    twice = SURE + 2.0 * A @ step.covariance @ A.T
    np.testing.assert_allclose(back.covariance[POSE, POSE], twice, atol=1e-12)


def test_news_of_the_pose_moves_what_is_correlated_with_it() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12))
    prior = root @ root.T / 12.0
    joint = JointBelief(Pose.identity(), np.array([7]), np.zeros((1, 6)), prior)
    H, R = np.eye(6, 12), 0.3 * np.eye(6)
    measured = 1e-4 * rng.normal(size=6)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)  # Kalman's own way
    posterior = (np.eye(12) - gain @ H) @ prior

    told = joint.with_pose(Belief(Pose.exp((gain @ measured)[:6]), posterior[:6, :6]))

    np.testing.assert_allclose(told.covariance, posterior, atol=1e-9)
    np.testing.assert_allclose(told.error_m[0], (gain @ measured)[6:], atol=1e-9)


def test_odometry_with_an_impossible_covariance_is_refused() -> None:
    with pytest.raises(SemvizError, match="not positive semidefinite"):
        Odometry(Pose.identity(), -np.eye(6))
