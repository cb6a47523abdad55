"""Labels as arrays: every row where it belongs, and the images without distortion."""

from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.placement.observations import collect_observations
from semviz_annotation.mapping.placement.triangulation import triangulate_landmarks
from semviz_core.base.camera import Camera, Rig
from semviz_core.common.errors import SemvizError


def test_every_label_is_one_row_of_its_landmark_and_view(world):
    labels = world.labels()
    views, observations, elements, label_rows = collect_observations(labels, world)
    assert [element.number for element in elements] == [3, 4, 7, 9]
    assert len(observations) == len(labels.observations)
    assert (np.diff(observations.landmark) >= 0).all()
    assert len(views) == 2 * world.count
    for row, number in enumerate(observations.label_row):
        label, view = label_rows[number], observations.view[row]
        assert elements[observations.landmark[row]].id == label.element_id
        assert (views.frame_index[view], views.is_right[view]) == (
            label.frame_index,
            label.side == "right",
        )
        assert tuple(observations.anchor_px[row]) == label.anchor_px
        assert np.array_equal(
            observations.end_px[row], label.end_px or [np.nan] * 2, equal_nan=True
        )
        assert (observations.anchor_known[row], observations.end_known[row]) == (
            label.anchor_known,
            label.end_known,
        )
    left = views.center_m[~views.is_right]
    assert np.allclose(left, [frame.T_map_camera.translation for frame in world.frames])
    few = collect_observations(labels, world, [1, 3])
    assert sorted(set(few.views.frame_index)) == [1, 3]
    assert {observation.frame_index for observation in few.label_rows} == {1, 3}


def test_distortion_is_taken_out(world):
    """Each camera its own: places come out exact, though both images are bent."""
    K = world.rig.left.K
    bent = Camera(1241, 376, K, np.array([-0.2, 0.05, 0.001, -0.001]))
    other = Camera(1241, 376, K * 1.1 - 0.1 * np.diag([0, 0, 1]), np.array([0.1, 0.0, 0.0, 0.0]))
    source = replace(world, rig=Rig(bent, other, world.rig.T_right_left))
    views, observations, elements, _ = collect_observations(source.labels(), source)
    placed = triangulate_landmarks(views, observations)
    for landmark, element in enumerate(elements):
        assert np.allclose(placed.anchor_m[landmark], world.landmarks[element.number][1], atol=1e-3)


def test_regrouping_and_choosing_keep_rows_together(world):
    _, observations, _, _ = collect_observations(world.labels(), world)
    landmark = np.where(observations.landmark == 1, -1, 3 - observations.landmark)
    regrouped = observations.regrouped(landmark, 4)
    assert list(np.unique(regrouped.landmark)) == [0, 1, 3]
    assert list(regrouped.seen) == [*observations.seen[[3, 2]], 0, observations.seen[0]]
    for row in range(len(regrouped)):
        before = int(np.flatnonzero(observations.label_row == regrouped.label_row[row])[0])
        assert np.array_equal(regrouped.anchor_px[row], observations.anchor_px[before])
        assert regrouped.view[row] == observations.view[before]
        assert regrouped.landmark[row] == landmark[before]
    only = observations.only(np.array([False, True, False, True]))
    assert only.count == 2
    assert list(only.seen) == list(observations.seen[[1, 3]])
    total = regrouped.per_landmark(np.add, np.ones(len(regrouped)))
    assert list(total) == list(regrouped.seen)


def test_bad_input_is_one_line(world):
    labels = world.labels()
    alone = replace(world, rig=Rig(world.rig.left))
    with pytest.raises(SemvizError, match="labelled in the right image, but the sequence has one"):
        collect_observations(labels, alone)
    with pytest.raises(SemvizError, match="no element is labelled in two images"):
        collect_observations(Labels(), world)
    with pytest.raises(SemvizError, match="frame 2 is labelled but not in this sequence"):
        collect_observations(labels, replace(world, count=2))

    class Lost:
        map_frame, rig = world.map_frame, world.rig
        frames = (replace(world.frames[0], T_map_camera=None), *world.frames[1:])

    with pytest.raises(SemvizError, match="frame 0 is labelled but has no pose"):
        collect_observations(labels, Lost())
    assert set(collect_observations(labels, Lost(), range(1, 5)).views.frame_index) == {1, 2, 3, 4}
