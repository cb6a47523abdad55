"""What-if: frames of a run solved again with something changed, from the run alone."""

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from small_runs import saved, small_run, unanswered

from semviz.runs.comparison import compare_runs
from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.metrics import errors_of
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.what_if.change import (
    CropRadius,
    MovePrior,
    PriorAtTruth,
    PriorSigma,
    RaisePrior,
    WhatIfChange,
    WithoutPriorPart,
)
from semviz.what_if.request_changes import (
    AddElement,
    ChangeElementClass,
    DetectionClass,
    DropDetection,
    DropElement,
    ForbidPair,
    ForcePair,
    ForceTruePairs,
    IgnoreClasses,
    LeastScore,
    NoiseFactor,
    StartAtTruth,
    UseMethod,
)
from semviz.what_if.solve import (
    KINDS,
    affected_frames,
    best_suggestion,
    changed_map,
    changes_text,
    describe_changes,
    free_path,
    from_json,
    localize_request,
    save,
    solve_with_changes,
    sweep,
    to_json,
)
from semviz.what_if.solve import describe_sweep as outcome
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.roads import move_element


def first() -> tuple[Run, FrameRecord]:
    run = small_run()
    return run, run.frames[0]


def error_m(record: FrameRecord) -> float:
    """Infinite without a pose."""
    errors = errors_of(record)
    return np.inf if errors is None else errors.distance_m


def pairs(record: FrameRecord) -> IntArray:
    fine = record.localization.refinement
    assert fine is not None
    return fine.pairs


def rows_and_ids(record: FrameRecord) -> list[tuple[int, int]]:
    """Observed rows and the elements that the answer matched them with."""
    ids = record.localization.submap.id
    return [(i, int(ids[j])) for i, j in pairs(record).tolist()]


def same(frame_record: FrameRecord, other: FrameRecord) -> bool:
    """To the last bit."""
    a, b = frame_record.localization, other.localization
    if a.T_camera_map is None or b.T_camera_map is None:
        return a.T_camera_map is b.T_camera_map and a.reason == b.reason
    equal = a.T_camera_map.as_matrix().tobytes() == b.T_camera_map.as_matrix().tobytes()
    return (
        equal and a.reason == b.reason and np.array_equal(frame_record.element_id, other.element_id)
    )


EVERY: tuple[WhatIfChange, ...] = (
    DropElement(3), AddElement(3), ChangeElementClass(3, 1), DropDetection(10, 0),
    DetectionClass(10, 0, 1), LeastScore(0.5), NoiseFactor(2.0), IgnoreClasses(),
    ForcePair(10, 0, 3), ForbidPair(10, 0, 3), ForceTruePairs(), MovePrior(3.0, -1.5),
    PriorAtTruth(), PriorSigma(9.0), CropRadius(70.0), UseMethod("direct"), StartAtTruth(),
    WithoutPriorPart("gravity"), RaisePrior(0.5),
)  # fmt: skip


def test_without_changes_the_answer_is_that_of_the_run(tmp_path: Path) -> None:
    """From the file alone: the run is read back from disk."""
    run = load_run(saved(small_run(), tmp_path / "first.rrd"))
    for record in run.frames:
        assert same(solve_with_changes(run, record), record)


def test_every_kind_of_change_is_told_and_read_back() -> None:
    run = small_run()
    assert {type(decision) for decision in EVERY} == set(KINDS.values())
    for decision in EVERY:
        assert from_json(json.loads(json.dumps(to_json(decision)))) == decision
        said = decision.describe(run.semantic_map)
        assert said.startswith(("without ", "with ", "from "))
        assert "\n" not in said
    assert json.loads(changes_text(EVERY))["changes"] == [to_json(decision) for decision in EVERY]
    assert describe_changes((), run.semantic_map) == ""
    said = describe_changes(
        (DropElement(10**6), NoiseFactor(2.0), StartAtTruth()), run.semantic_map
    )
    expected = "without element 1000000, with 2 times the detections' noise and from the true pose"
    assert said == expected


@pytest.mark.parametrize(
    "told",
    [
        None, 7, [], {}, {"change": "drop table"}, {"change": "drop element"},
        {"change": "drop element", "element": "3"}, {"change": "drop element", "element": True},
        {"change": "drop element", "element": 3, "frame": 1}, {"change": "noise", "factor": 0.0},
        {"change": "crop radius", "radius_m": -1.0}, {"change": "move prior", "ahead_m": None},
        {"change": "crop radius", "radius_m": float("nan")}, {"change": ["noise"]},
    ],
)  # fmt: skip
def test_what_is_no_change_is_refused_in_one_line(told: object) -> None:
    with pytest.raises(SemvizError, match=r"^[^\n]+$"):
        from_json(told)


def test_an_element_that_is_dropped_is_not_in_the_question() -> None:
    run, record = first()
    _, element = rows_and_ids(record)[0]
    after = solve_with_changes(run, record, (DropElement(element),))
    assert element not in after.localization.submap.id
    assert len(after.localization.submap) == len(record.localization.submap) - 1
    assert after.localization.status == "ok"
    assert element in record.localization.submap.id  # the run is as it was


def test_a_change_that_does_not_concern_a_frame_changes_nothing() -> None:
    run, record = first()
    other = run.frames[1].frame.index
    absent = (
        DropElement(10**6), AddElement(10**6), ChangeElementClass(10**6, 1),
        DropDetection(other, 0),
        DetectionClass(other, 0, 1), ForcePair(other, 0, 3), ForbidPair(other, 0, 3),
        LeastScore(0.0), DropDetection(record.frame.index, 10**6), UseMethod("search"),
        CropRadius(_radius_m(record)), PriorSigma(record.localization.prior.horizontal_sigma_m),
    )  # fmt: skip
    for change in absent[:-2]:
        assert record not in affected_frames(replace(run, frames=(record,)), (change,)), change
    assert same(solve_with_changes(run, record, absent[:-2]), record)


def _radius_m(record: FrameRecord) -> float:
    offset_m = record.localization.submap.anchor_m - record.localization.prior.position_m
    return float(np.linalg.norm(offset_m[:, :2], axis=1).max())


def test_the_order_of_changes_does_not_matter() -> None:
    """A crop is made before an element is added to it, whichever is named first."""
    run, record = first()
    narrow = solve_with_changes(run, record, (CropRadius(30.0),)).localization.submap.id.tolist()
    within = [pair for pair in rows_and_ids(record) if pair[1] in narrow]
    (row, element), (_, dropped) = within[:2]
    outside = next(
        element_id
        for element_id in record.localization.submap.id.tolist()
        if element_id not in narrow
    )
    changes = (
        AddElement(outside),
        CropRadius(30.0),
        DropElement(dropped),
        ForcePair(record.frame.index, row, element),
    )
    answers = [solve_with_changes(run, record, order) for order in permutations(changes)]
    assert all(same(answers[0], answer) for answer in answers[1:])
    assert set(answers[0].localization.submap.id.tolist()) == {*narrow, outside} - {dropped}


def test_a_detection_that_is_dropped_leaves_the_others_their_truth() -> None:
    run, record = first()
    after = solve_with_changes(run, record, (DropDetection(record.frame.index, 1),))
    np.testing.assert_array_equal(after.element_id, np.delete(record.element_id, 1))
    kept = np.delete(np.arange(len(record.localization.observed)), 1)
    expected = record.localization.observed[kept]
    np.testing.assert_array_equal(after.localization.observed.anchor_px, expected.anchor_px)


def test_pairs_name_detections_as_they_were_recorded() -> None:
    """Also where others before them are left out."""
    run, record = first()
    index = record.frame.index
    (row, element), (first_row, _) = rows_and_ids(record)[-1], rows_and_ids(record)[0]
    assert first_row < row
    dropped, forbidden = DropDetection(index, first_row), ForbidPair(index, row, element)
    assert (row - 1, element) in rows_and_ids(solve_with_changes(run, record, (dropped,)))
    assert (row - 1, element) not in rows_and_ids(
        solve_with_changes(run, record, (dropped, forbidden))
    )


def test_a_forced_wrong_pair_is_worse_or_has_no_answer() -> None:
    run = small_run()
    for record in run.frames:
        (row, element), submap = rows_and_ids(record)[0], record.localization.submap
        alike = submap.class_id == record.localization.observed.class_id[row]
        for other in submap.id[alike & (submap.id != element)].tolist():
            after = solve_with_changes(run, record, (ForcePair(record.frame.index, row, other),))
            if after.localization.T_camera_map is None:
                assert after.localization.reason.endswith(".")
            else:
                assert (row, other) in rows_and_ids(after)
                assert error_m(after) > error_m(record)


def test_forced_true_pairs_are_within_a_centimetre_without_noise() -> None:
    """As the street is, and where a pole is moved in the map: that pair is not forced."""
    run = small_run()
    for record in run.frames:
        after = solve_with_changes(run, record, (ForceTruePairs(),))
        assert after.localization.status == "ok"
        assert error_m(after) < 0.01
        _, element = rows_and_ids(record)[0]
        faulty = replace(run, semantic_map=move_element(run.semantic_map, element, [2.0, 1.0, 0.0]))
        asked = solve_with_changes(faulty, record, (CropRadius(50.5), ForceTruePairs()))
        assert error_m(asked) < 0.01
        assert element not in [element_id for _, element_id in rows_and_ids(asked)]


def test_a_class_that_was_wrong_is_repaired_from_either_side() -> None:
    run, record = first()
    submap = record.localization.submap
    row, element = next(
        (i, element_id)
        for i, element_id in rows_and_ids(record)
        if not submap.is_line[submap.id == element_id][0]
    )
    true = int(record.localization.observed.class_id[row])
    wrong = 1 + true % 3
    index = record.frame.index
    spoiled = solve_with_changes(run, record, (DetectionClass(index, row, wrong),))
    assert element not in [element_id for _, element_id in rows_and_ids(spoiled)]
    assert (row, element) in rows_and_ids(
        solve_with_changes(run, spoiled, (DetectionClass(index, row, true),))
    )
    assert (row, element) in rows_and_ids(
        solve_with_changes(run, spoiled, (ChangeElementClass(element, wrong),))
    )
    with pytest.raises(SemvizError, match="another shape"):
        solve_with_changes(run, record, (DetectionClass(index, row, 0),))


def far_off(record: FrameRecord, run: Run) -> FrameRecord:
    """The frame with a fix 80 m off, as the localizer answered it."""
    result = record.localization
    prior = replace(result.prior, position_m=result.prior.position_m + np.array([0, 80, 0]))
    submap = run.semantic_map.crop(prior.position_m, 50.0)
    found = Localizer().localize(result.observed, submap, result.camera, prior)
    return replace(record, localization=found)


def test_a_prior_that_is_moved_takes_its_submap_along() -> None:
    run, record = first()
    lost = far_off(record, run)
    assert lost.localization.status != "ok"
    found = solve_with_changes(run, lost, (PriorAtTruth(), CropRadius(50.0)))
    assert found.localization.status == "ok"
    assert error_m(found) < 0.05
    moved_prior = solve_with_changes(run, record, (MovePrior(4.0, 3.0),)).localization.prior
    offset_m = moved_prior.position_m - record.localization.prior.position_m
    ahead = record.frame.T_map_camera.rotation[:, 2]  # type: ignore[union-attr]
    assert np.linalg.norm(offset_m) == pytest.approx(5.0)
    assert offset_m[:2] @ ahead[:2] / np.linalg.norm(ahead[:2]) == pytest.approx(4.0)
    assert ahead[0] * offset_m[1] - ahead[1] * offset_m[0] > 0.0  # to the left


def test_an_element_is_added_from_beyond_the_crop() -> None:
    run, record = first()
    narrow = solve_with_changes(run, record, (CropRadius(12.0),))
    outside = [
        element_id for element_id in record.element_id.tolist()
        if element_id in run.semantic_map.elements.id
        and element_id not in narrow.localization.submap.id
    ]  # fmt: skip
    after = solve_with_changes(run, narrow, (AddElement(outside[0]),))
    assert outside[0] in after.localization.submap.id
    assert len(after.localization.submap) == len(narrow.localization.submap) + 1


def test_without_classes_a_triangle_may_be_a_square() -> None:
    run, record = first()
    after = solve_with_changes(run, record, (IgnoreClasses(),)).localization
    assert set(after.observed.class_id.tolist()) <= {0, 1}
    match, before = after.match, record.localization.match
    assert match is not None
    assert before is not None
    assert np.isfinite(match.cost).sum() > np.isfinite(before.cost).sum()


def test_method_start_noise_and_score_are_those_that_are_asked_for() -> None:
    run, record = first()
    assert solve_with_changes(run, record, (UseMethod("direct"),)).localization.method == "direct"
    with pytest.raises(SemvizError, match="known are search, direct"):
        solve_with_changes(run, record, (UseMethod("magic"),))
    started = solve_with_changes(run, record, (StartAtTruth(),))
    assert started.localization.search is not None
    assert len(started.localization.search.score) == 1
    assert error_m(started) < 0.05
    noisy = solve_with_changes(run, record, (NoiseFactor(3.0),)).localization.observed
    np.testing.assert_allclose(noisy.sigma_px, 3.0 * record.localization.observed.sigma_px)
    assert len(solve_with_changes(run, record, (LeastScore(1.1),)).localization.observed) == 0


@pytest.mark.parametrize("method", ["minimal", "p3p"])
def test_solvers_that_take_matches_take_those_of_the_frame(method: str) -> None:
    run, record = first()
    found = solve_with_changes(run, record, (UseMethod(method),))
    assert found.localization.method == method
    assert error_m(found) < 0.1
    (row, element), index = rows_and_ids(record)[0], record.frame.index
    without = solve_with_changes(run, record, (UseMethod(method), ForbidPair(index, row, element)))
    assert (row, element) not in rows_and_ids(without)
    alike = record.localization.submap.class_id == record.localization.observed.class_id[row]
    wrong = int(record.localization.submap.id[alike][-1])
    assert wrong != element
    forced = solve_with_changes(run, record, (UseMethod(method), ForcePair(index, row, wrong)))
    assert "forced pairs fit no pose" in forced.localization.reason
    fewer = solve_with_changes(
        run, record, (UseMethod(method), DropElement(element), DropDetection(index, 1))
    )
    assert len(fewer.localization.observed) == len(record.localization.observed) - 1
    bare = replace(record, localization=replace(record.localization, match=None))
    with pytest.raises(SemvizError, match="no recorded matches"):
        solve_with_changes(run, bare, (UseMethod(method),))
    assert same(solve_with_changes(run, record, (UseMethod("search"),)), record)


def test_what_contradicts_itself_is_said_in_one_line() -> None:
    run, record = first()
    (row, element), (_, other) = rows_and_ids(record)[:2]
    index = record.frame.index
    both = (ForcePair(index, row, element), ForbidPair(index, row, element))
    twice = (ForcePair(index, row, element), ForcePair(index, row, other))
    gone = (ForcePair(index, row, element), DropElement(element))
    for changes in (both, twice, gone):
        with pytest.raises(SemvizError, match=r"^[^\n]+$"):
            solve_with_changes(run, record, changes)


def test_a_run_that_followed_the_camera_is_compared_with_the_frame_by_itself() -> None:
    run, record = first()
    follower = replace(run, info=replace(run.info, method="track"))
    tracked = unanswered(replace(record, localization=replace(record.localization, method="track")))
    assert localize_request(run, record) is record
    assert same(localize_request(follower, tracked), record)


@dataclass(frozen=True)
class Planted:
    """A frame that an element which is moved in the map harms."""

    run: Run
    record: FrameRecord
    element: int


@lru_cache
def planted() -> tuple[Planted, ...]:
    """All frames with six detections of elements nearby that such an element harms."""
    run = small_run()
    found = []
    for record in run.frames:
        for element in np.intersect1d(record.element_id, run.semantic_map.elements.id).tolist():
            mapped = move_element(run.semantic_map, element, [0.8, 0.8, 0.0])
            sound, faulty = (
                _few(elements, record, element) for elements in (run.semantic_map, mapped)
            )
            was_good = sound.localization.status == "ok" and error_m(sound) < 0.05
            if was_good and (faulty.localization.status != "ok" or error_m(faulty) > 0.1):
                found.append(Planted(replace(run, semantic_map=mapped), faulty, element))
    return tuple(found)


def _few(semantic_map: SemanticMap, record: FrameRecord, element: int) -> FrameRecord:
    """The frame with six detections, that of the element among them, in another map."""
    result, ids = record.localization, record.element_id.tolist()
    others = [i for i, known in enumerate(ids) if known >= 0 and known != element][:5]
    rows = np.sort([*others, ids.index(element)])
    submap = semantic_map.crop(result.prior.position_m, 50.0)
    found = Localizer().localize(result.observed[rows], submap, result.camera, result.prior)
    return FrameRecord(record.frame, found, record.element_id[rows])


def test_dropping_the_element_that_is_moved_repairs_the_frame() -> None:
    assert len(planted()) >= 8
    frames = [sweep(case.run, case.record, (DropElement(case.element),)) for case in planted()]
    for frame in frames:
        assert frame.record.localization.status == "ok"
        assert error_m(frame.record) < 0.1
        assert frame.change.change == "fixed" or frame.change.status[0] == "ok"
    said = outcome([frame.change for frame in frames])
    assert said.startswith(f"{len(frames)} of {len(frames)} frames change: median ")
    assert f"→ {len(frames)}," in said
    assert said.endswith(" 0 broken.")


def test_what_is_advised_is_what_repairs() -> None:
    for case in planted():
        best = best_suggestion(case.run, case.record, frame_diagnosis(case.run, case.record))
        assert best == DropElement(case.element)
    whole, record = first()
    lost = far_off(record, whole)
    lost_run = replace(
        whole, info=replace(whole.info, observations="labels", options={"crop_radius_m": 50.0})
    )
    best = best_suggestion(lost_run, lost, frame_diagnosis(lost_run, lost))
    assert best == PriorAtTruth()
    few = replace(
        record,
        localization=Localizer().localize(
            record.localization.observed[[0, 1]], record.localization.submap,
            record.localization.camera, record.localization.prior,
        ),
        element_id=record.element_id[:2],
    )  # fmt: skip
    assert best_suggestion(whole, few, frame_diagnosis(whole, few)) is None


def test_frames_that_changes_do_not_concern_are_left_alone() -> None:
    run = small_run()
    index = run.frames[2].frame.index
    assert [frame.frame.index for frame in affected_frames(run, (DropDetection(index, 0),))] == [
        index
    ]
    assert affected_frames(run, ()) == ()
    assert outcome([]) == "No result changes in 0 frames."
    alike = [sweep(run, frame, ()).change for frame in run.frames]
    assert outcome(alike) == f"No result changes in {len(alike)} frames."


def test_a_saved_run_is_read_by_compare_and_says_its_changes(tmp_path: Path) -> None:
    run = small_run()
    _, element = rows_and_ids(run.frames[0])[0]
    changes = (DropElement(element),)
    base = saved(run, tmp_path / "first.rrd")
    before = base.read_bytes()
    found = {frame.frame.index: solve_with_changes(run, frame, changes) for frame in run.frames[:4]}
    path = free_path(base, "tried")
    save(run, changes, found, path)
    assert path.name == "first-tried-1.rrd"
    assert free_path(base, "tried").name == "first-tried-2.rrd"
    other = load_run(path)
    assert other.complete
    assert other.info.options["changes"] == [to_json(changes[0])]
    assert element not in other.semantic_map.elements.id
    for frame, record in zip(other.frames, run.frames, strict=True):
        assert same(frame, found.get(record.frame.index, record))
    told = compare_runs(load_run(base), other)
    assert told.maps is not None
    assert len(told.frames) == len(run.frames)
    assert base.read_bytes() == before


def test_a_changed_map_keeps_what_is_known_of_the_rest() -> None:
    run = small_run()
    assert changed_map(run.semantic_map, (NoiseFactor(2.0),)) is run.semantic_map
    ids = run.semantic_map.elements.id
    dropped = changed_map(run.semantic_map, (DropElement(int(ids[1])),))
    np.testing.assert_array_equal(dropped.elements.id, np.delete(ids, 1))
