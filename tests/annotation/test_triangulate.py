"""Triangulation: exact without noise, honest about noise, silent where there is no answer."""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from semviz_annotation.labels.labels import Observation, new_id
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.triangulation import (
    MIN_ANGLE_RAD,
    Triangulated,
    TriangulationFailure,
    triangulate,
    triangulate_pair,
)
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError

K = np.array([[720.0, 0.0, 610.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(1241, 376, K)
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
PAIR = (rig_view(RIG, "left"), rig_view(RIG, "right"))


def seen(view: PosedView, anchor, end=None, *, noise=None, **known) -> Observation:
    points = np.array([anchor, anchor if end is None else end], dtype=np.float64)
    pixels = view.project(points) + (0.0 if noise is None else noise)
    return Observation(
        id=new_id(),
        element_id=new_id(),
        frame_index=0,
        side="left",
        anchor_px=tuple(pixels[0]),
        end_px=None if end is None else tuple(pixels[1]),
        anchor_known=known.get("anchor_known", True),
        end_known=known.get("end_known", end is not None),
    )


def answered(result: Triangulated | TriangulationFailure) -> Triangulated:
    assert isinstance(result, Triangulated), result
    return result


numbers = st.floats(-1, 1)
poses = st.builds(
    lambda turn, move: Pose.from_rotvec(np.array(turn) * 0.4, np.array(move) * 2.0),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers),
)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(poses, min_size=2, max_size=4),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers),
    st.sampled_from([0.0, 5e3]),
)
def test_exact_recovery_from_any_views(T_camera_map, place, lean, far_away):
    """Also far from the map's origin, where numbers are large."""
    shift = np.array([far_away, -far_away, 0.0])
    views = [
        PosedView(CAMERA, replace(T, translation=T.translation - T.rotation @ shift))
        for T in T_camera_map
    ]
    anchor = shift + np.array([0.0, -3.0, 14.0]) + np.array(place) * [4.0, 1.0, 4.0]
    end = anchor + np.array([lean[0], 5.0, lean[1]])
    assume(all((view.depth_m(np.stack([anchor, end])) > 1.0).all() for view in views))
    point = triangulate(views, [seen(view, anchor) for view in views])
    line = triangulate(views, [seen(view, anchor, end) for view in views])
    if isinstance(point, Triangulated):
        assert np.allclose(point.anchor_m, anchor, atol=1e-5)
        assert point.rms_px < 1e-5
        assert np.isnan(point.end_m).all()
    else:
        assert "parallel" in point.reason
    if isinstance(line, Triangulated):
        assert np.allclose(line.anchor_m, anchor, atol=1e-5)
        assert np.allclose(line.end_m, end, atol=1e-5)
        assert line.rms_px < 1e-5
    else:
        assert "parallel" in line.reason


@pytest.mark.parametrize("end", [[-3.0, 1.6, 15.0], [-3.3, 1.6, 15.5]])
def test_a_stereo_pole_needs_no_equal_pixels(end):
    """Exactly upright or not: other points of the same line in the right image change nothing."""
    anchor = np.array([-3.0, -2.0, 15.0])
    end = np.array(end)
    lower, upper = anchor + 0.3 * (end - anchor), anchor + 0.9 * (end - anchor)
    left = seen(PAIR[0], anchor, end)
    right = seen(PAIR[1], lower, upper, anchor_known=False, end_known=False)
    result = answered(triangulate(PAIR, [left, right]))
    assert np.allclose(result.anchor_m, anchor, atol=1e-9)
    assert np.allclose(result.end_m, end, atol=1e-9)
    assert (result.anchor_known, result.end_known) == (True, True)


def test_an_end_nobody_saw_is_the_furthest_point_seen():
    anchor, end = np.array([-3.0, -2.0, 15.0]), np.array([-3.0, 1.6, 15.0])
    middle = (anchor + end) / 2.0
    left = seen(PAIR[0], anchor, middle, end_known=False)
    right = seen(PAIR[1], anchor, end, end_known=False)
    result = answered(triangulate(PAIR, [left, right]))
    assert np.allclose(result.end_m, end, atol=1e-9)
    assert (result.anchor_known, result.end_known) == (True, False)


@pytest.mark.parametrize("end", [None, [-2.9, 1.6, 12.2]], ids=["sign", "pole"])
@pytest.mark.parametrize("views", [2, 4])
def test_covariance_agrees_with_monte_carlo(end, views):
    rng = np.random.default_rng(5)
    sigma_px = 0.5
    cameras = [*PAIR, PosedView(CAMERA, Pose(np.eye(3), [0.1, 0.0, -3.0]))]
    cameras = [*cameras, PosedView(CAMERA, Pose(np.eye(3), [-0.44, 0.0, -3.0]))][:views]
    anchor = np.array([-3.0, -1.5, 12.0])
    rows, predicted = [], np.zeros((6, 6))
    for trial in range(801):
        scale = sigma_px if trial else 0.0
        noise = rng.normal(0.0, scale, (views, 2, 2))
        labels = [seen(v, anchor, end, noise=n) for v, n in zip(cameras, noise, strict=True)]
        result = answered(triangulate(cameras, labels, sigma_px))
        if trial == 0:
            predicted = result.covariance_m2
        else:
            rows.append(np.concatenate([result.anchor_m, result.end_m]))
    size = 3 if end is None else 6
    actual = np.cov(np.array(rows)[:, :size].T)
    assert (predicted[size:] == 0.0).all()
    ratio = np.linalg.eigvals(np.linalg.solve(predicted[:size, :size], actual)).real
    print(ratio)
    assert ratio.min() > 0.8
    assert ratio.max() < (1.25 if views == 2 or end is None else 2.0)


def test_failures_have_reasons():
    anchor, end = np.array([-1.0, -1.0, 10.0]), np.array([-1.0, 1.0, 10.0])
    left, right = seen(PAIR[0], anchor), seen(PAIR[1], anchor)
    pole, correspondence = seen(PAIR[0], anchor, end), seen(PAIR[1], anchor, end)

    def reason(first, second) -> str:
        result = triangulate_pair(RIG, first, second)
        assert isinstance(result, TriangulationFailure)
        return result.reason

    assert "parallel (0.00 deg" in reason(left, left)
    assert "parallel" in reason(pole, pole)
    assert "behind the camera" in reason(right, left)
    assert "behind the camera" in reason(correspondence, pole)
    swapped = replace(
        correspondence, anchor_px=correspondence.end_px, end_px=correspondence.anchor_px
    )
    assert "swapped" in reason(pole, swapped)
    level = np.array([1.0, -1.0, 10.0])
    assert "along the line between" in reason(
        seen(PAIR[0], anchor, level), seen(PAIR[1], anchor, level)
    )
    far = np.array([3.0, -10.0, 300.0])
    assert "0.10 deg" in reason(seen(PAIR[0], far), seen(PAIR[1], far))


pixels = st.tuples(st.floats(0, 1240), st.floats(0, 375))


@settings(deadline=None, max_examples=200)
@given(st.tuples(pixels, pixels), st.tuples(pixels, pixels), st.booleans(), st.booleans())
def test_whatever_is_clicked_gives_a_place_ahead_or_a_reason(left, right, is_pole, is_level):
    """Also mid-drag: points on each other, lines along the epipolar line, no angle asked for."""
    if is_level:
        right = ((right[0][0], left[0][1]), (right[1][0], left[1][1]))
    clicked = [
        Observation(new_id(), new_id(), 0, side, a, b if is_pole else None, True, is_pole)
        for side, (a, b) in (("left", left), ("right", right))
    ]
    for min_angle_rad in (0.0, MIN_ANGLE_RAD):
        result = triangulate(PAIR, clicked, min_angle_rad=min_angle_rad)
        if isinstance(result, TriangulationFailure):
            assert result.reason
            continue
        assert result.angle_rad >= min_angle_rad
        assert np.isfinite(result.covariance_m2).all()
        assert result.anchor_m[2] > 0.0
        assert not is_pole or result.end_m[2] > 0.0


def test_calls_that_make_no_sense_are_errors():
    sign, pole = seen(PAIR[0], [0, 0, 9]), seen(PAIR[1], [0, 0, 9], [0, 1, 9])
    with pytest.raises(SemvizError, match="a pole in some views"):
        triangulate(PAIR, [sign, pole])
    with pytest.raises(SemvizError, match="two or more"):
        triangulate(PAIR[:1], [sign])


def test_fast_enough_to_follow_a_drag():
    anchor, end = np.array([-1.0, -1.0, 10.0]), np.array([-1.0, 1.0, 10.0])
    pair = [seen(view, anchor, end) for view in PAIR]
    times = []
    for _ in range(100):
        start = time.perf_counter()
        triangulate_pair(RIG, *pair)
        times.append(time.perf_counter() - start)
    assert min(times) < 2e-3  # 0.7 ms where this was written; room for slower machines
