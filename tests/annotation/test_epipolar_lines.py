"""Epipolar lines: whatever is ahead of both cameras lies on them."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from semviz_annotation.labels.views import PLAUSIBLE_DEPTH_M, epipolar_segment, other_side, rig_view
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.pose import Pose

K = np.array([[720.0, 0.0, 610.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
LEFT = Camera(1241, 376, K)
RECTIFIED = Rig(LEFT, LEFT, Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
TURNED = Rig(
    LEFT,
    Camera(1300, 400, K * 1.1 - 0.1 * np.diag([0.0, 0.0, 1.0])),
    Pose.from_rotvec([0.02, -0.05, 0.03], [-0.6, 0.05, -0.1]),
)
BENT = Rig(
    Camera(1241, 376, K, np.array([-0.3, 0.1, 1e-3, -1e-3])),
    Camera(1241, 376, K, np.array([-0.25, 0.08, 0.0, 0.0])),
    Pose.from_rotvec([0.01, -0.02, 0.01], [-0.54, 0.01, 0.02]),
)


def pair(rig, side):
    """The view on ``side`` and the one across from it."""
    return rig_view(rig, side), rig_view(rig, other_side(side))


def distance_px(line_px, point_px) -> float:
    """From a point to a polyline."""
    starts, steps = line_px[:-1], np.diff(line_px, axis=0)
    share = np.clip(((point_px - starts) * steps).sum(1) / (steps**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(starts + share[:, None] * steps - point_px, axis=1).min())


@settings(deadline=None)
@given(
    st.sampled_from([(RECTIFIED, 1e-6), (TURNED, 1e-6), (BENT, 0.1)]),
    st.sampled_from(["left", "right"]),
    st.tuples(st.floats(-8, 8), st.floats(-3, 3), st.floats(3, 60)),
)
def test_the_correspondence_lies_on_the_segment(case, side, point):
    rig, tolerance_px = case
    here, there = pair(rig, side)
    points = np.array([point])
    depth = here.depth_m(points)[0]
    pixel, correspondence = here.project(points)[0], there.project(points)[0]
    assume(here.camera.contains(pixel)[0] and there.camera.contains(correspondence)[0])
    assume(PLAUSIBLE_DEPTH_M[0] < depth < PLAUSIBLE_DEPTH_M[1])
    segment = epipolar_segment(here, there, tuple(pixel))
    assert distance_px(segment, correspondence) < tolerance_px
    assert there.camera.contains(segment).all()


def test_rectified_lines_are_level_and_end_at_the_depths_asked_for():
    segment = epipolar_segment(*pair(RECTIFIED, "left"), (800.0, 100.0), (5.0, 50.0))
    assert np.allclose(segment, [[800 - 720 * 0.54 / 5, 100], [800 - 720 * 0.54 / 50, 100]])
    segment = epipolar_segment(*pair(RECTIFIED, "right"), (800.0, 100.0), (5.0, np.inf))
    assert np.allclose(segment, [[800 + 720 * 0.54 / 5, 100], [800.0, 100]])


def test_clipped_at_the_border_and_empty_outside():
    segment = epipolar_segment(*pair(RECTIFIED, "left"), (20.0, 100.0), (5.0, 50.0))
    assert np.allclose(segment, [[-0.5, 100.0], [20 - 720 * 0.54 / 50, 100.0]])
    assert epipolar_segment(*pair(RECTIFIED, "left"), (3.0, 100.0), (5.0, 50.0)).shape == (0, 2)
    assert epipolar_segment(*pair(RECTIFIED, "left"), (800.0, -40.0)).shape == (0, 2)


def test_nothing_behind_the_other_camera():
    """The other camera is 6 m ahead: what is nearer is behind it and must not be drawn."""
    ahead = Rig(LEFT, LEFT, Pose(np.eye(3), np.array([-0.54, 0.0, -6.0])))
    segment = epipolar_segment(*pair(ahead, "left"), (630.0, 170.0), (2.0, 80.0))
    far = rig_view(ahead, "right").project(rig_view(ahead, "left").rays(np.array([[630.0, 170.0]])))
    assert np.isnan(far).all()
    assert len(segment) == 2
    assert LEFT.contains(segment).all()
    assert epipolar_segment(*pair(ahead, "left"), (630.0, 170.0), (2.0, 5.0)).shape == (0, 2)
