"""Maps from labels."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.labels.edits import DeleteObservation, Link
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, Row, new_id
from semviz_annotation.labels.rows import Rules
from semviz_annotation.mapping.build import BuildOptions, build_map, rebuild_map
from semviz_annotation.mapping.paper_baseline import PaperOptions
from semviz_annotation.mapping.placement.bundle_adjustment import RefineOptions
from semviz_annotation.mapping.quality.check import mapping_accuracy
from semviz_annotation.mapping.quality.label_links import UNKNOWN, observe
from semviz_core.base.camera import Rig
from semviz_core.base.map_file import load_map, save_map
from semviz_core.common.errors import SemvizError

POLE = (np.array([20.0, 5.0, 4.0]), np.array([20.0, 5.02, 0.4]))
SIGN = np.array([22.0, -4.0, 2.4])


def split_by_frame(labels: Labels) -> Labels:
    """The same without identity over frames: each stereo pair is an element of its own."""
    rows: list[Row] = []
    number = 100
    for index in labels.frames:
        new: dict[str, LabelElement] = {}
        for row in labels.in_frame(index):
            if row.element_id not in new:
                class_id = labels.element(row.element_id).class_id
                new[row.element_id] = LabelElement(new_id(), number, class_id)
                number += 1
            rows.append(replace(row, element_id=new[row.element_id].id))
        rows += new.values()
    return Labels.from_rows(rows)


def rebuilt(labels: Labels, rows: Iterable[Row]) -> Labels:
    return Labels.from_rows([*labels.elements.values(), *rows], operation=labels.operation)


def test_exact_labels_give_the_exact_map(world, tmp_path):
    labels = replace(world.labels(), operation=42)
    semantic_map, report = build_map(labels, world)
    elements = semantic_map.elements
    assert list(elements.id) == [3, 4, 7, 9]
    for row, number in enumerate(elements.id):
        class_id, anchor, end = world.landmarks[number]
        assert elements.class_id[row] == class_id
        assert np.allclose(elements.anchor_m[row], anchor, atol=1e-6)
        assert np.array_equal(np.isfinite(elements.end_m[row]), [end is not None] * 3)
        if end is not None:
            assert np.allclose(elements.end_m[row], end, atol=1e-6)
    assert report.used == report.observations == len(labels.observations)
    assert report.decisions == semantic_map.decisions == ()
    assert semantic_map.frame == world.map_frame
    assert np.allclose(semantic_map.trajectory_m[:, 0], 2.0 * np.arange(world.count))
    assert semantic_map.operation == 42
    assert semantic_map.provenance[0].label_ids == (
        next(element.id for element in labels.elements.values() if element.number == 3),
    )
    assert set(semantic_map.provenance[0].observation_ids) <= labels.observations.keys()
    save_map(semantic_map, tmp_path / "m.parquet")
    assert load_map(tmp_path / "m.parquet").digest == semantic_map.digest


def test_covariances_hold_and_fusing_beats_single_pairs(world):
    normalized, single = [], []
    for seed in range(40):
        labels = world.labels(sigma_px=0.5, seed=seed)
        options = BuildOptions(sigma_px=0.5)
        fused = build_map(labels, world, options)[0].elements
        first = build_map(labels, world, options, frames=[0])[0].elements
        for elements, errors in ((fused, normalized), (first, single)):
            row = list(elements.id).index(7)
            error = elements.anchor_m[row] - world.landmarks[7][1]
            errors.append(error @ np.linalg.solve(elements.covariance_m2[row, :3, :3], error))
            if elements is fused:
                far = np.trace(first.covariance_m2[list(first.id).index(7)])
                assert np.trace(elements.covariance_m2[row]) < 0.5 * far
    assert 2.0 < np.mean(normalized) < 4.5  # chi2 with 3 degrees of freedom
    assert 2.0 < np.mean(single) < 4.5


def test_what_has_no_identity_is_linked(world):
    labels = split_by_frame(world.labels(sigma_px=0.2))
    semantic_map, report = build_map(labels, world)
    assert len(semantic_map) == len(world.landmarks)
    merges = [decision for decision in report.decisions if decision.kind == "merge"]
    assert len(merges) == len(report.decisions) == len(world.landmarks)
    assert semantic_map.elements.id[0] == 100
    for entry, row in zip(semantic_map.provenance, semantic_map.elements.id, strict=True):
        numbers = sorted(labels.element(label_id).number for label_id in entry.label_ids)
        assert numbers[0] == row
        assert len(numbers) == world.count
        assert tuple(numbers) in {merge.numbers for merge in merges}


def test_ids_stay_over_rebuilds_and_links(world):
    labels = split_by_frame(world.labels(sigma_px=0.2))
    before, _ = build_map(labels, world)
    by_number = {element.number: element.id for element in labels.elements.values()}
    first, second = sorted(labels.element(i).number for i in before.provenance[0].label_ids)[:2]
    edit = Link((by_number[second], by_number[first]))
    after, _ = build_map(labels.changed(edit.changes(labels, Rules())), world)
    assert np.array_equal(after.elements.id, before.elements.id)


def test_given_identity_is_kept_however_far_apart(world):
    """Metres of noise in depth: DBSCAN tears the pairs apart, the annotator does not."""
    far = replace(world, landmarks={1: (1, np.array([55.0, 3.0, 3.0]), None)})
    labels = far.labels(sigma_px=1.0)
    semantic_map, _ = build_map(labels, far)
    assert list(semantic_map.elements.id) == [1]
    torn = split_by_frame(labels)
    assert len(build_map(torn, far)[0]) == 1
    assert len(build_map(torn, far, PaperOptions())[0]) > 1


@pytest.mark.parametrize("frames", [None, [0, 1]])
def test_what_one_image_shows_twice_is_two_landmarks(make_world, frames):
    """However near: labelled badly enough, each two would fit one place."""
    twins = make_world(
        {
            1: (1, SIGN, None),
            2: (1, SIGN + np.array([0.0, 0.0, 0.05]), None),
            3: (0, *POLE),
            4: (0, POLE[0] + [0.0, 0.05, 0.0], POLE[1] + [0.0, 0.05, 0.0]),
        }
    )
    labels = twins.labels(sigma_px=0.2)
    semantic_map, report = build_map(labels, twins, frames=frames)
    assert list(semantic_map.elements.id) == [1, 2, 3, 4]
    assert [(decision.kind, decision.numbers, decision.by) for decision in report.decisions] == [
        ("apart", (1, 2), "machine"),
        ("apart", (3, 4), "machine"),
    ]
    assert "kept apart T-01, T-02: frame 0 shows both in its left image" in str(report)
    torn, _ = build_map(split_by_frame(labels), twins)
    assert len(torn) == 4
    assert all(len(entry.label_ids) == twins.count for entry in torn.provenance)


def test_seen_together_in_an_unused_frame_still_counts(make_world):
    twins = make_world({1: (1, SIGN, None), 2: (1, SIGN + np.array([0.0, 0.0, 0.05]), None)})
    labels = twins.labels()
    kept = [
        row
        for row in labels.observations.values()
        if row.frame_index == 4
        or (row.frame_index == 0) == (labels.element(row.element_id).number == 1)
    ]
    labels = rebuilt(labels, kept)
    assert len(build_map(labels, twins, frames=[0, 1])[0]) == 2
    unseen = rebuilt(labels, [row for row in kept if row.frame_index != 4])
    assert len(build_map(unseen, twins, frames=[0, 1])[0]) == 1


def test_an_end_hidden_in_some_views_comes_from_the_others(make_world):
    world = make_world({1: (0, *POLE)})
    labels = world.labels()

    def hidden(row: Observation) -> Observation:
        halfway = tuple(np.mean([row.anchor_px, row.end_px], axis=0))
        return replace(row, end_px=halfway, end_known=False)

    rows = labels.observations.values()
    some = rebuilt(labels, [hidden(row) if row.frame_index else row for row in rows])
    elements = build_map(some, world)[0].elements
    assert np.allclose(elements.end_m[0], POLE[1], atol=1e-3)
    assert elements.end_known[0]
    nowhere = rebuilt(labels, [hidden(row) for row in rows])
    elements = build_map(nowhere, world)[0].elements
    assert not elements.end_known[0]
    assert 1.5 < elements.end_m[0, 2] < 2.7
    assert np.linalg.norm(elements.end_m[0, :2] - POLE[1][:2]) < 0.05
    assert np.linalg.eigvalsh(elements.covariance_m2[0]).max() < 1.0


def test_what_too_few_frames_show_is_left_out(world):
    labels = split_by_frame(world.labels(sigma_px=0.1))
    lonely = replace(world, landmarks={1: (2, np.array([15.0, -3.0, 3.0]), None)}, count=1).labels()
    both = Labels.from_rows(
        [
            row
            for part in (labels, lonely)
            for row in [*part.elements.values(), *part.observations.values()]
        ]
    )
    assert len(build_map(both, world)[0]) == 5
    semantic_map, report = build_map(both, world, BuildOptions(min_frames=2))
    assert len(semantic_map) == 4
    assert "left out R-01: seen in fewer than 2 frames" in str(report).splitlines()


def test_what_cannot_be_placed_is_reported_by_name(world):
    labels = world.labels()
    rows = []
    for row in labels.observations.values():
        number = labels.element(row.element_id).number
        if number == 7 and row.side == "right":
            row = replace(row, anchor_px=(row.anchor_px[0] + 60.0, row.anchor_px[1] + 20.0))
        if number != 9 or (row.side, row.frame_index) == ("left", 2):
            rows.append(row)
    semantic_map, report = build_map(rebuilt(labels, rows), world)
    assert {3, 4} <= set(semantic_map.elements.id)
    assert "left out O-09: labelled in one image only" in str(report).splitlines()
    assert any(decision.numbers == (7,) for decision in report.decisions)


def test_what_is_too_far_for_stereo_is_placed_by_motion(make_world):
    place = np.array([80.0, -9.0, 3.0])
    world = make_world({1: (2, place, None)})
    semantic_map, report = build_map(world.labels(), world)
    assert report.decisions == ()
    assert np.allclose(semantic_map.elements.anchor_m[0], place, atol=1e-3)
    noisy = build_map(world.labels(sigma_px=0.3), world)[0].elements
    sigma_m = np.sqrt(np.linalg.eigvalsh(noisy.covariance_m2[0, :3, :3]).max())
    assert np.linalg.norm(noisy.anchor_m[0] - place) < 4.0 * sigma_m


def seen_from_the_left(labels: Labels) -> Labels:
    rows = [row for row in labels.observations.values() if row.side == "left"]
    return Labels.from_rows(
        [*(labels.element(element_id) for element_id in {r.element_id for r in rows}), *rows]
    )


@pytest.mark.parametrize("stereo", [False, True])
def test_one_camera_is_enough_where_it_moves(world, stereo):
    labels = seen_from_the_left(world.labels())
    source = world if stereo else replace(world, rig=Rig(world.rig.left))
    semantic_map, report = build_map(labels, source)
    elements = semantic_map.elements
    assert list(elements.id) == [3, 4, 7, 9]
    for row, number in enumerate(elements.id):
        _, anchor, end = world.landmarks[number]
        assert np.allclose(elements.anchor_m[row], anchor, atol=1e-6)
        assert end is None or np.allclose(elements.end_m[row], end, atol=1e-6)
    assert report.decisions == ()
    assert set(semantic_map.provenance[0].observation_ids) <= labels.observations.keys()
    accuracy = mapping_accuracy(semantic_map, labels, source)
    assert accuracy.unmapped == 0
    assert accuracy.classes["pole"].lateral_rmse_px == pytest.approx(0.0, abs=1e-6)


def test_covariances_by_motion_hold_near_and_far(make_world):
    """Views from 45 m to 12 m of a sign, and of a pole whose bottom hides in half of them."""
    landmarks = {1: (1, np.array([45.0, -4.0, 2.4]), None), 2: (0, *POLE)}
    world = make_world(landmarks, count=7)
    normalized: dict[int, list[float]] = {1: [], 2: []}
    for seed in range(60):
        labels = seen_from_the_left(world.labels(sigma_px=0.5, seed=seed))
        rows = [
            replace(row, end_known=row.end_known and row.frame_index % 2 == 0)
            for row in labels.observations.values()
        ]
        elements = build_map(rebuilt(labels, rows), world, BuildOptions(sigma_px=0.5))[0].elements
        for row, number in enumerate(elements.id):
            _, anchor, end = landmarks[number]
            error = elements.anchor_m[row] - anchor
            if end is not None:
                error = np.append(error, elements.end_m[row] - end)
            size = len(error)
            Q = elements.covariance_m2[row, :size, :size]
            normalized[number].append(error @ np.linalg.solve(Q, error) / size)
    assert 0.75 < np.mean(normalized[1]) < 1.3
    assert 0.75 < np.mean(normalized[2]) < 1.3


def test_motion_that_tells_nothing_is_said_by_name(make_world):
    ahead = {
        1: (1, np.array([60.0, 0.05, 1.7]), None),  # where the camera drives to
        2: (0, np.array([22.0, 5.0, 4.0]), np.array([22.0, 5.0, 0.4])),
    }
    world = make_world(ahead, count=3)
    semantic_map, report = build_map(seen_from_the_left(world.labels()), world)
    assert list(semantic_map.elements.id) == [2]
    (only,) = report.decisions
    assert (only.kind, only.numbers, only.observation_ids) == ("leave out", (1,), ())
    assert "the rays are nearly parallel (0.0" in only.reason


def test_two_landmarks_under_one_name_are_not_placed_between_them(make_world):
    """One camera; one of the two in a single frame: too little to be a landmark."""
    signs = {1: (1, SIGN, None), 2: (1, SIGN + np.array([0.0, -2.0, 0.3]), None), 3: (0, *POLE)}
    world = make_world(signs)
    labels = seen_from_the_left(world.labels())
    by_number = {element.number: element.id for element in labels.elements.values()}
    rows = [
        replace(row, element_id=by_number[1]) if row.element_id == by_number[2] else row
        for row in labels.observations.values()
        if (row.element_id == by_number[2]) == (row.frame_index == 3) or row.end_px
    ]
    mixed = Labels.from_rows(
        [*(element for element in labels.elements.values() if element.number != 2), *rows]
    )
    semantic_map, report = build_map(mixed, world)
    assert list(semantic_map.elements.id) == [1, 3]
    assert np.allclose(semantic_map.elements.anchor_m[0], SIGN, atol=1e-6)
    (left_out,) = report.decisions
    assert [mixed.observation(id_).frame_index for id_ in left_out.observation_ids] == [3]


def test_pairs_that_are_wrong_do_not_spoil_the_motion(make_world):
    """Too far for stereo; in one frame the right click is on another landmark."""
    place = np.array([80.0, -9.0, 3.0])
    world = make_world({1: (2, place, None)})
    labels = world.labels()
    rows = [
        replace(row, anchor_px=(row.anchor_px[0] + 30.0, row.anchor_px[1]))
        if (row.frame_index, row.side) == (2, "right")
        else row
        for row in labels.observations.values()
    ]
    semantic_map, report = build_map(rebuilt(labels, rows), world)
    assert np.allclose(semantic_map.elements.anchor_m[0], place, atol=1e-3)
    (left_out,) = report.decisions
    (wrong,) = map(labels.observation, left_out.observation_ids)
    assert (wrong.frame_index, wrong.side) == (2, "right")
    assert left_out.evidence["error_px"] == pytest.approx(30.0, abs=0.1)
    assert left_out.reason == "a label is 30.0 px off"
    assert wrong.id not in semantic_map.provenance[0].observation_ids


def test_bad_input_is_one_line(world):
    labels = world.labels()
    frames = world.frames

    class Broken:
        map_frame, rig = world.map_frame, world.rig
        frames = (replace(world.frames[0], T_map_camera=None), *world.frames[1:])

    with pytest.raises(SemvizError, match="frame 0 is labelled but has no pose"):
        build_map(labels, Broken())
    assert len(build_map(labels, Broken(), frames=range(1, 5))[0]) == 4
    Broken.frames = frames[:2]
    with pytest.raises(SemvizError, match="frame 2 is labelled but not in this sequence"):
        build_map(labels, Broken())
    for nothing in (Labels(), labels):
        with pytest.raises(SemvizError, match="no element is labelled in two images"):
            build_map(nothing, world, frames=[77])
    gone = labels
    for row in labels.observations.values():
        if (row.side, row.frame_index) != ("left", 1):
            gone = gone.changed(DeleteObservation(row.id).changes(gone, Rules()))
    with pytest.raises(SemvizError, match="no element is labelled in two images"):
        build_map(gone, world)
    with pytest.raises(SemvizError, match="nothing can be placed; the first of all: "):
        build_map(labels, world, BuildOptions(min_angle_deg=80.0))
    with pytest.raises(SemvizError, match="sigma_px must be positive"):
        build_map(labels, world, BuildOptions(sigma_px=0.0))
    with pytest.raises(SemvizError, match="min_frames 1 or more"):
        build_map(labels, world, BuildOptions(min_frames=0))


WAYS = (
    BuildOptions(sigma_px=0.5, min_angle_deg=0.4, min_frames=2),
    BuildOptions(refine=RefineOptions(pose_sigma_m=0.02)),
    PaperOptions(eps_m=0.5),
)


@pytest.mark.parametrize("options", WAYS)
def test_a_map_can_be_built_again_as_it_was(world, tmp_path, options):
    """From its file; labels that are another way now make another map."""
    labels = world.labels()
    path = tmp_path / "main.parquet"
    built, _ = build_map(labels, world, options, frames=range(1, 4))
    save_map(built, path)
    again, _ = rebuild_map(load_map(path), labels, world)
    assert again.digest == built.digest
    assert again.made_by == built.made_by
    assert again.settings == built.settings
    fewer = labels
    (nine,) = (element for element in labels.elements.values() if element.number == 9)
    for row in labels.of_element(nine.id):
        fewer = fewer.changed(DeleteObservation(row.id).changes(fewer, Rules()))
    assert 9 not in rebuild_map(built, fewer, world)[0].elements.id


def test_a_map_of_unknown_origin_is_not_built_again(world):
    built, _ = build_map(world.labels(), world)
    with pytest.raises(SemvizError, match="does not say how it was built"):
        rebuild_map(replace(built, settings={}), world.labels(), world)
    with pytest.raises(SemvizError, match="another version"):
        rebuild_map(replace(built, settings={"method": "joint", "x": 1}), world.labels(), world)


def test_observing_labels_gives_elements_and_the_ids_they_should_match(world):
    labels = world.labels()
    semantic_map, _ = build_map(split := split_by_frame(labels), world)
    for side in ("left", "right"):
        elements, ids = observe(split, 2, side, semantic_map, sigma_px=0.7)
        rows = split.in_frame(2, side)
        assert len(elements) == len(rows) == 4
        assert [tuple(px) for px in elements.anchor_px] == [row.anchor_px for row in rows]
        assert (elements.sigma_px == 0.7).all()
        assert np.array_equal(elements.end_known, elements.is_line)
        by_id = dict(zip(semantic_map.elements.id, semantic_map.elements.class_id, strict=True))
        assert [by_id[id_] for id_ in ids] == list(elements.class_id)
        assert len(set(ids)) == 4
    assert list(observe(labels, 2, "left", semantic_map)[1]) == [UNKNOWN] * 4
    assert list(observe(labels, 2)[1]) == [UNKNOWN] * 4
    assert len(observe(labels, 99)[0]) == 0
