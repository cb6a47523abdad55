"""The paper's map: pairs by themselves, DBSCAN, means."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from semviz_annotation.labels.edits import DecideElements
from semviz_annotation.labels.labels import LabelElement, Labels, Row, new_id
from semviz_annotation.labels.rows import Rules, different_elements
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.build import PART_ID, build_map
from semviz_annotation.mapping.paper_baseline import PaperOptions, dbscan
from semviz_annotation.mapping.placement.triangulation import triangulate
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError


def each_frame_anew(labels: Labels) -> Labels:
    """Each stereo pair is a label element of its own."""
    rows: list[Row] = []
    for index in labels.frames:
        new: dict[str, LabelElement] = {}
        for row in labels.in_frame(index):
            class_id = labels.element(row.element_id).class_id
            number = 100 * (index + 1) + labels.element(row.element_id).number
            element = new.setdefault(row.element_id, LabelElement(new_id(), number, class_id))
            rows.append(replace(row, element_id=element.id))
        rows += new.values()
    return Labels.from_rows(rows)


def test_a_landmark_is_at_the_mean_of_its_pairs(world):
    labels = world.labels(sigma_px=0.5)
    elements = build_map(labels, world, PaperOptions(eps_m=5.0))[0].elements
    assert list(elements.id) == [3, 4, 7, 9]
    for row, number in enumerate(elements.id):
        places = []
        for frame in world.frames:
            views = [
                rig_view(world.rig, side, frame.T_map_camera.inverse())
                for side in ("left", "right")
            ]
            pairs = labels.pairs(frame.index)
            pair = next(pair for pair in pairs if pair.element.number == number)
            places.append(triangulate(views, [pair.left, pair.right]))
        mean = np.mean([place.anchor_m for place in places], axis=0)
        assert np.allclose(elements.anchor_m[row], mean, atol=1e-6)
        if elements.is_line[row]:
            mean = np.mean([place.end_m for place in places], axis=0)
            assert np.allclose(elements.end_m[row], mean, atol=1e-6)
        spread = np.sum([place.covariance_m2 for place in places], axis=0) / len(places) ** 2
        assert np.allclose(elements.covariance_m2[row], spread, rtol=1e-3)


@pytest.mark.parametrize("eps_m", [0.3, 1.0])
def test_identity_is_not_looked_at(world, eps_m):
    labels = world.labels(sigma_px=1.0)
    options = PaperOptions(eps_m=eps_m)
    given, _ = build_map(labels, world, options)
    without, _ = build_map(each_frame_anew(labels), world, options)
    assert len(given) == len(without) > len(world.landmarks)
    ours, theirs = (
        labels.elements.anchor_m[np.lexsort(labels.elements.anchor_m.T)]
        for labels in (given, without)
    )
    assert np.allclose(ours, theirs)
    main = given.elements.id < PART_ID
    assert list(given.elements.id[main]) == [3, 4, 7, 9]
    splits = [decision for decision in given.decisions if decision.kind == "split"]
    assert len(splits) == len(given) - len(world.landmarks)
    merges = [decision for decision in without.decisions if decision.kind == "merge"]
    assert sum(len(merge.numbers) - 1 for merge in merges) == 4 * world.count - len(without)


def test_neither_what_an_image_shows_twice_nor_what_people_said(make_world):
    sign = np.array([22.0, -4.0, 2.4])
    twins = make_world({1: (1, sign, None), 2: (1, sign + np.array([0.0, 0.4, 0.0]), None)})
    labels = twins.labels()
    first, second = sorted(labels.elements)
    labels = labels.changed(
        DecideElements((different_elements(first, second),)).changes(labels, Rules())
    )
    assert len(build_map(labels, twins, PaperOptions())[0]) == 1
    assert len(build_map(labels, twins)[0]) == 2


def test_an_end_is_where_the_pairs_have_it_that_show_it(make_world):
    pole = (np.array([20.0, 5.0, 4.0]), np.array([20.0, 5.02, 0.4]))
    world = make_world({1: (0, *pole)})
    labels = world.labels()
    rows = [
        replace(row, end_px=tuple(np.mean([row.anchor_px, row.end_px], axis=0)), end_known=False)
        if row.frame_index
        else row
        for row in labels.observations.values()
    ]
    some = Labels.from_rows([*labels.elements.values(), *rows])
    elements = build_map(some, world, PaperOptions())[0].elements
    assert np.allclose(elements.end_m[0], pole[1], atol=1e-3)
    assert elements.end_known[0]


def test_what_is_left_out_is_said(world):
    labels = world.labels(sigma_px=0.1)
    rows = [
        row
        for row in labels.observations.values()
        if labels.element(row.element_id).number != 9 or row.side == "left"
    ]
    some = Labels.from_rows([*labels.elements.values(), *rows])
    built, report = build_map(some, world, PaperOptions(min_points=3))
    assert list(built.elements.id) == [3, 4, 7]
    assert "left out O-09: in no frame labelled in both images" in str(report).splitlines()
    with pytest.raises(SemvizError, match="fewer than 6 pairs within 1 m"):
        build_map(labels, world, PaperOptions(min_points=6))
    with pytest.raises(SemvizError, match="eps_m must be positive, not 0"):
        PaperOptions(eps_m=0.0)


def clustered_by_open3d(open3d: Any, points: FloatArray, eps: float, least: int) -> IntArray:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    return np.asarray(cloud.cluster_dbscan(eps, least), dtype=np.int64)


@given(
    # on a grid many points are at the same place, or exactly as far away as the radius
    points=arrays.arrays(
        np.int8, st.tuples(st.integers(1, 40), st.just(3)), elements=st.integers(0, 5)
    ),
    eps=st.sampled_from([0.5, 1.0, 1.5, 2.0, 2.5]),
    least=st.integers(1, 7),
)
def test_dbscan_gives_the_labels_of_open3d(
    open3d: Any, points: IntArray, eps: float, least: int
) -> None:
    at = points.astype(np.float64) * [1.0, 1.0, 0.5]
    wanted = clustered_by_open3d(open3d, at, eps, least)
    assert np.array_equal(dbscan(at, eps, least), wanted)


@pytest.mark.parametrize("seed", range(10))
def test_dbscan_gives_the_labels_of_open3d_on_a_map(open3d: Any, seed: int) -> None:
    """Poles and signs along a road, each seen in some frames, with noise and false ones."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform((0.0, -12.0, 0.0), (600.0, 12.0, 5.0), (120, 3))
    pairs = np.repeat(landmarks, rng.integers(1, 12, len(landmarks)), axis=0)
    pairs += rng.normal(0.0, rng.choice([0.1, 0.4, 1.0], (len(pairs), 1)), pairs.shape)
    false = rng.uniform((0.0, -12.0, 0.0), (600.0, 12.0, 5.0), (80, 3))
    points = rng.permutation(np.concatenate([pairs, false]))
    for eps, least in ((0.3, 1), (0.3, 2), (1.0, 1), (1.0, 3), (1.0, 6), (2.5, 2), (2.5, 8)):
        wanted = clustered_by_open3d(open3d, points, eps, least)
        assert np.array_equal(dbscan(points, eps, least), wanted)
        assert least == 1 or {-1, 0, 1} <= set(wanted.tolist())
