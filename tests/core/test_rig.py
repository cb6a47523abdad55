"""One pose of a rig: that of its cameras together, each at its own time."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_frames import MOUNTS, RigFrame, RigKind, bound, make_rig_frame, without_times

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import OdometryNoise, Prior, adjoint
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.errors import SemvizError
from semviz_core.common.linalg import rotate_left
from semviz_core.localization.camera_views import (
    STANDING,
    BodyMotion,
    CameraView,
    prior_of_camera,
    rolling_shutter,
)
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.residuals import fill_rows, new_rows
from semviz_core.localization.rig import localize_rig
from semviz_core.localization.rig_problem import RigProblem
from semviz_core.metrics.pose_errors import pose_error

SEEDS = st.integers(0, 10_000)
FOUR = ("front", "left", "right", "back")
FAST = BodyMotion(np.array([10.0, 0.0, 0.0]), np.array([0.0, 0.0, np.deg2rad(20.0)]))
MOVING = RigKind(FOUR, FAST, 0.03)
FRAMES = 30


def localized(frame: RigFrame, motion: BodyMotion = STANDING) -> tuple[Localization, ...]:
    return localize_rig(frame.views, frame.submap, frame.prior, motion=motion)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_a_rig_of_one_camera_is_that_camera(seed: int) -> None:
    frame = make_rig_frame(seed, RigKind())
    view = frame.views[0]
    alone = Localizer().localize(view.observed, frame.submap, view.camera, frame.prior)
    (rig,) = localized(frame)
    assert rig.status == alone.status
    if alone.status != "ok":
        return
    assert rig.T_camera_map is not None
    assert alone.T_camera_map is not None
    assert alone.covariance is not None
    assert alone.refinement is not None
    assert rig.refinement is not None
    off = (rig.T_camera_map @ alone.T_camera_map.inverse()).log()
    assert off @ np.linalg.solve(alone.covariance, off) < 0.1**2  # sigmas
    sigma = np.sqrt(np.diag(alone.covariance))
    assert (np.abs(rig.covariance - alone.covariance) < 0.02 * np.outer(sigma, sigma)).all()
    np.testing.assert_array_equal(rig.refinement.pairs, alone.refinement.pairs)


@settings(max_examples=8, deadline=None)
@given(SEEDS)
def test_derivatives_are_exact_where_rows_have_times(seed: int) -> None:
    frame = make_rig_frame(seed, MOVING)
    problem = RigProblem.of(frame.views, frame.submap, FAST, DetectorModel()).whole
    rng = np.random.default_rng(seed)
    start = rotate_left(*frame.T_first_map.writable(), rng.normal(0.0, 0.02, 6))
    for i, j in frame.all_pairs:
        rows = new_rows()
        used = fill_rows(problem, *start, i, j, rows)
        exact = rows.jacobian[:used].copy()
        for axis, step in enumerate(1e-6 * np.eye(6)):
            ends = []
            for sign in (1.0, -1.0):
                assert fill_rows(problem, *rotate_left(*start, sign * step), i, j, rows) == used
                ends.append(rows.residual[:used].copy())
            slope = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(exact[:, axis], slope, rtol=1e-4, atol=2e-3)


@settings(max_examples=10, deadline=None)
@given(SEEDS, st.sampled_from(FOUR))
def test_all_poses_follow_from_one(seed: int, other: str) -> None:
    frame = make_rig_frame(seed, replace(MOVING, cameras=("front", other)))
    first, second = localized(frame, FAST)
    assert (first.status, first.reason) == (second.status, second.reason)
    if first.T_camera_map is None or second.T_camera_map is None:
        return
    T = frame.views[1].T_body_camera.inverse() @ frame.views[0].T_body_camera
    expected = T @ first.T_camera_map
    np.testing.assert_allclose(second.T_camera_map.as_matrix(), expected.as_matrix(), atol=1e-9)
    A = adjoint(T)
    np.testing.assert_allclose(second.covariance, A @ first.covariance @ A.T, rtol=1e-6, atol=1e-12)
    assert second.refinement is not None
    assert (second.refinement.pairs[:, 0] < len(second.observed)).all()
    assert np.nanmedian(np.abs(second.refinement.residual_px)) < 2.5


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_any_point_of_the_vehicle_can_be_the_body(seed: int) -> None:
    """The velocity is then that of this point: v' = v + w x r, in its axes."""
    frame = make_rig_frame(seed, MOVING)
    rng = np.random.default_rng(seed)
    T_body_other = Pose.from_rotvec(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 2.0, 3))
    views = [
        replace(view, T_body_camera=T_body_other.inverse() @ view.T_body_camera)
        for view in frame.views
    ]
    R, r = T_body_other.rotation, T_body_other.translation
    turn = FAST.turn_radps
    other = BodyMotion(R.T @ (FAST.velocity_mps + np.cross(turn, r)), R.T @ turn)
    expected = localized(frame, FAST)[0]
    found = localize_rig(views, frame.submap, frame.prior, motion=other)[0]
    assert found.status == expected.status
    if expected.T_camera_map is not None and found.T_camera_map is not None:
        off = (found.T_camera_map @ expected.T_camera_map.inverse()).log()
        assert np.abs(off).max() < 1e-4


class Errors(NamedTuple):
    right: float
    ok: float
    said: float
    """Share of frames whose reason says that the stated sigma is too small."""
    to_bound: float
    """Root of the mean square of position errors over the bound, of right frames."""
    nees: float
    """Of a degree of freedom, mean of right frames."""
    rms_m: float


@cache
def errors(kind_name: str, knows_times: bool = True) -> Errors:
    kind = {
        "front": RigKind(("front",)),
        "two": RigKind(("front", "back")),
        "four": RigKind(FOUR),
        "moving": MOVING,
    }[kind_name]
    rows = []
    for seed in range(FRAMES):
        frame = make_rig_frame(seed, kind)
        found = localized(frame if knows_times else without_times(frame), kind.motion)[0]
        if found.T_camera_map is None or found.covariance is None:
            continue
        off = (frame.T_first_map @ found.T_camera_map.inverse()).log()
        off_m, off_deg = pose_error(found.T_camera_map, frame.T_first_map)
        rows.append([
            off_m < 1.0 and off_deg < 2.0, found.status == "ok", "stated sigma" in found.reason,
            off_m**2, np.trace(bound(frame, kind)[:3, :3]),
            off @ np.linalg.solve(found.covariance, off) / 6.0,
        ])  # fmt: skip
    right, ok, said, square, bound_m2, nees = np.array(rows).T
    kept = right > 0.0
    return Errors(
        right.sum() / FRAMES,
        ok.sum() / FRAMES,
        said.mean(),
        np.sqrt((square[kept] / bound_m2[kept]).mean()),
        float(nees[kept].mean()),
        np.sqrt(square[kept].mean()),
    )


@pytest.mark.parametrize("kind", ["two", "four", "moving"])
def test_errors_of_a_rig_are_those_of_the_bound(kind: str) -> None:
    found = errors(kind)
    assert found.right == 1.0
    assert found.ok >= 0.95
    assert 0.75 < found.to_bound < 1.3
    assert 0.8 < found.nees < 1.3


def test_every_camera_makes_the_pose_more_accurate() -> None:
    assert errors("four").rms_m < errors("two").rms_m < errors("front").rms_m


def test_rows_taken_to_be_exposed_at_once_bias_the_pose_and_are_noticed() -> None:
    known, ignored = errors("moving"), errors("moving", knows_times=False)
    assert ignored.to_bound > 3.0
    assert ignored.nees > 3.0
    assert known.said < 0.1
    assert ignored.said > 0.5


def test_cameras_that_see_too_little_alone_localize_together() -> None:
    frame = make_rig_frame(3, RigKind(FOUR, most_seen=2))
    alone = [
        Localizer().localize(view.observed, frame.submap, view.camera, prior_of_camera(
            frame.prior, view.T_body_camera.inverse() @ frame.views[0].T_body_camera
        ))
        for view in frame.views
    ]  # fmt: skip
    assert {found.status for found in alone} == {"cannot"}
    together = localized(frame)[0]
    assert together.status == "ok", together.reason
    assert together.reason.startswith("4 cameras: 8 of 8 elements fit")
    assert together.T_camera_map is not None
    assert pose_error(together.T_camera_map, frame.T_first_map)[0] < 0.15


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.sampled_from(FOUR))
def test_the_prior_of_another_camera_holds_for_it(seed: int, name: str) -> None:
    """A prior without error, but for where around the first camera the other one is."""
    frame = make_rig_frame(seed, RigKind(("front", name)))
    T_other_first = frame.views[1].T_body_camera.inverse() @ frame.views[0].T_body_camera
    T_map_first = frame.T_first_map.inverse()
    T_map_other = T_map_first @ T_other_first.inverse()
    prior = Prior(
        T_map_first.translation, 1e-3, 1e-3, T_map_first.rotation[2], 1e-3,
        heading_rad=heading_rad(T_map_first), road_m=T_map_first.translation[None],
    )  # fmt: skip
    other = prior_of_camera(prior, T_other_first)
    assert other.up_camera is not None
    assert other.heading_rad is not None
    assert other.road_m is not None
    np.testing.assert_allclose(other.up_camera, T_map_other.rotation[2], atol=1e-9)
    turn = other.heading_rad - heading_rad(T_map_other)
    assert abs(np.angle(np.exp(1j * turn))) < 1e-6
    off_m = other.position_m - T_map_other.translation
    assert abs(off_m[2]) < 1e-9
    assert abs(other.road_m[0, 2] - T_map_other.translation[2]) < 1e-9
    assert np.hypot(*off_m[:2]) <= other.horizontal_sigma_m + 1e-9


def test_rows_are_exposed_from_the_top_down_around_the_middle() -> None:
    camera = MOUNTS["front"][0]
    observed = Elements2D.from_ends(
        [[100.0, -0.5], [300.0, 189.5]], [[100.0, 379.5], [np.nan, np.nan]], [0, 3]
    )
    times = rolling_shutter(observed, camera, 0.04)
    np.testing.assert_allclose(times, [[-0.02, 0.02], [0.0, 0.0]], atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_the_motion_of_a_step_takes_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_now_before = Pose.exp(rng.normal(0.0, [1.0] * 3 + [0.2] * 3))
    motion = BodyMotion.of_step(OdometryNoise().measured(T_now_before), 0.2)
    after = motion.after(0.2).as_matrix()
    np.testing.assert_allclose(after, T_now_before.as_matrix(), atol=1e-9)


def test_wrong_input_is_one_line() -> None:
    frame = make_rig_frame(0, RigKind(("front", "back")))
    front, back = frame.views
    with pytest.raises(SemvizError, match="a rig without cameras"):
        localize_rig([], frame.submap, frame.prior)
    with pytest.raises(SemvizError, match=r"time_s has shape \(3,\); give a number"):
        CameraView(front.observed, front.camera, time_s=np.zeros(3))
    with pytest.raises(SemvizError, match="give seconds after its time"):
        CameraView(front.observed, front.camera, time_s=30.0)
    unknown = replace(back, observed=replace(back.observed, class_id=back.observed.class_id + 9))
    with pytest.raises(SemvizError, match="view 1: observed elements have unknown class"):
        localize_rig([front, unknown], frame.submap, frame.prior)
    with pytest.raises(SemvizError, match="motion: velocity_mps"):
        BodyMotion(np.zeros(2), np.zeros(3))
    nothing = localize_rig([replace(front, observed=front.observed[:0], time_s=0.0)],
                           frame.submap, frame.prior)  # fmt: skip
    assert nothing[0].reason == "0 elements seen, 4 needed."
