"""Labels as arrays: every row where it belongs, and the images without distortion."""

from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.placing.place import place
from semviz_annotation.mapping.placing.sightings import gather
from semviz_core.camera import Camera, Rig
from semviz_core.errors import SemvizError


def test_every_label_is_one_row_of_its_thing_and_view(world):
    labels = world.labels()
    views, sightings, elements, observations = gather(labels, world)
    assert [one.number for one in elements] == [3, 4, 7, 9]
    assert len(sightings) == len(labels.observations)
    assert (np.diff(sightings.thing) >= 0).all()
    assert len(views) == 2 * world.count
    for row, number in enumerate(sightings.observation):
        one, view = observations[number], sightings.view[row]
        assert elements[sightings.thing[row]].id == one.element_id
        assert (views.frame_index[view], views.is_right[view]) == (
            one.frame_index,
            one.side == "right",
        )
        assert tuple(sightings.anchor_px[row]) == one.anchor_px
        assert np.array_equal(sightings.end_px[row], one.end_px or [np.nan] * 2, equal_nan=True)
        assert (sightings.anchor_known[row], sightings.end_known[row]) == (
            one.anchor_known,
            one.end_known,
        )
    left = views.center_m[~views.is_right]
    assert np.allclose(left, [frame.T_map_camera.translation for frame in world.frames])
    few = gather(labels, world, [1, 3])
    assert sorted(set(few.views.frame_index)) == [1, 3]
    assert {one.frame_index for one in few.observations} == {1, 3}


def test_distortion_is_taken_out(world):
    """Each camera its own: places come out exact, though both images are bent."""
    K = world.rig.left.K
    bent = Camera(1241, 376, K, np.array([-0.2, 0.05, 0.001, -0.001]))
    other = Camera(1241, 376, K * 1.1 - 0.1 * np.diag([0, 0, 1]), np.array([0.1, 0.0, 0.0, 0.0]))
    source = replace(world, rig=Rig(bent, other, world.rig.T_right_left))
    views, sightings, elements, _ = gather(source.labels(), source)
    placed = place(views, sightings)
    for thing, element in enumerate(elements):
        assert np.allclose(placed.anchor_m[thing], world.things[element.number][1], atol=1e-3)


def test_regrouping_and_choosing_keep_rows_together(world):
    _, sightings, _, _ = gather(world.labels(), world)
    thing = np.where(sightings.thing == 1, -1, 3 - sightings.thing)
    regrouped = sightings.regrouped(thing, 4)
    assert list(np.unique(regrouped.thing)) == [0, 1, 3]
    assert list(regrouped.seen) == [*sightings.seen[[3, 2]], 0, sightings.seen[0]]
    for row in range(len(regrouped)):
        before = int(np.flatnonzero(sightings.observation == regrouped.observation[row])[0])
        assert np.array_equal(regrouped.anchor_px[row], sightings.anchor_px[before])
        assert regrouped.view[row] == sightings.view[before]
        assert regrouped.thing[row] == thing[before]
    only = sightings.only(np.array([False, True, False, True]))
    assert only.count == 2
    assert list(only.seen) == list(sightings.seen[[1, 3]])
    total = regrouped.per_thing(np.add, np.ones(len(regrouped)))
    assert list(total) == list(regrouped.seen)


def test_bad_input_is_one_line(world):
    labels = world.labels()
    alone = replace(world, rig=Rig(world.rig.left))
    with pytest.raises(SemvizError, match="labelled in the right image, but the sequence has one"):
        gather(labels, alone)
    with pytest.raises(SemvizError, match="no element is labelled in two images"):
        gather(Labels(), world)
    with pytest.raises(SemvizError, match="frame 2 is labelled but not in this sequence"):
        gather(labels, replace(world, count=2))

    class Lost:
        map_frame, rig = world.map_frame, world.rig
        frames = (replace(world.frames[0], T_map_camera=None), *world.frames[1:])

    with pytest.raises(SemvizError, match="frame 0 is labelled but has no pose"):
        gather(labels, Lost())
    assert set(gather(labels, Lost(), range(1, 5)).views.frame_index) == {1, 2, 3, 4}
