"""Verdicts: a fault planted is the fault named; what is healthy stays healthy."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import count
from typing import get_args

import numpy as np
import pytest

from semviz_core.evaluation.planted import PLANTED, WHOLE, Given, Planted, plant
from semviz_core.evaluation.planted_runs import PlantedRun, plant_in_run
from semviz_core.evaluation.problems import DETECTOR, default_road, make_problem, mapped_elements
from semviz_core.explaining import case
from semviz_core.explaining.case import is_healthy
from semviz_core.explaining.explain import explain
from semviz_core.explaining.places import Sights, meeting_places
from semviz_core.explaining.run_verdict import RunVerdict, explain_run
from semviz_core.explaining.told import UNKNOWN, Fault, Kind, Knowledge, Truth, Verdict
from semviz_core.explaining.trust import SURE
from semviz_core.localization import Localization

UNDECIDED: tuple[Kind, ...] = ("false or not mapped", "moved in the map")
"""What one frame says of a stranger, where it does not know what is what."""


@lru_cache
def planted(fault: Kind) -> tuple[Planted, ...]:
    """Frames of the published figures; a search that misses among others is named so, rightly."""
    found = (plant(fault, seed) for seed in count(1000))
    return tuple(one for one, _ in zip(filter(None, found), range(4), strict=False))


@lru_cache
def planted_run(fault: Kind) -> PlantedRun:
    found = (plant_in_run(fault, seed, default_road()) for seed in count())
    return next(filter(None, found))


def told(one: Planted, truth: Truth | None) -> Verdict:
    return explain(one.localization, one.semantic_map, truth, DETECTOR)


def first(verdict: Verdict) -> Fault:
    """What is named: the broken link, or what is noticed in a frame that came out well."""
    healthy = verdict.kind == "healthy"
    return verdict.noticed[0] if healthy and verdict.noticed else verdict.fault


def ids_unknown(truth: Truth) -> Truth:
    return replace(truth, element_id=None)


@pytest.mark.parametrize("fault", ["healthy", *PLANTED])
def test_a_planted_fault_is_named_with_what_it_is_about(fault: Kind) -> None:
    for one in planted(fault):
        found = first(told(one, one.truth))
        assert found.kind == fault, found.sentence
        assert not one.elements or set(one.elements) & set(found.elements)
        assert not one.rows or set(found.rows) == set(one.rows)


@pytest.mark.xfail(
    strict=True, reason="a false pair spoils the fit at the best start; it settles elsewhere"
)
def test_the_search_finds_the_pose_in_spite_of_the_false_detection_of_the_first_seed() -> None:
    one = next(filter(None, (plant("false detection", seed) for seed in count())))
    assert first(told(one, one.truth)).kind == "false detection"


@pytest.mark.parametrize("fault", ["healthy", *PLANTED])
def test_the_true_pose_alone_tells_all_but_what_a_stranger_is(fault: Kind) -> None:
    strangers = ("false detection", "moved in the map", "missing in the map")
    for one in planted(fault):
        found = first(told(one, ids_unknown(one.truth)))
        # a stranger that is not in the answer is not blamed for a frame that fails without it
        undecided = UNDECIDED if one.is_healthy else (*UNDECIDED, "ambiguous geometry")
        assert found.kind in (undecided if fault in strangers else (fault,)), found.sentence


@pytest.mark.parametrize(
    "fault", ["wrong class", "twice in the map", "refinement diverged", "ambiguous geometry"]
)
def test_some_faults_show_without_any_truth(fault: Kind) -> None:
    named = [first(told(one, None)).kind for one in planted(fault)]
    assert named.count(fault) >= len(named) - 1


def test_every_verdict_has_a_sentence_numbers_and_a_share() -> None:
    for fault in ("healthy", *PLANTED):
        verdict = told(planted(fault)[0], planted(fault)[0].truth)
        for one in (verdict.fault, *verdict.noticed):
            assert one.sentence.endswith(".")
            assert "\n" not in one.sentence
            assert all(isinstance(number.value, int | float) for number in one.evidence)
        assert 0.5 < verdict.sure < 1.0


def test_shares_are_given_for_every_kind_and_knowledge() -> None:
    for knowledge in get_args(Knowledge):
        assert set(SURE[knowledge]) == set(get_args(Kind))
        assert all(0.0 <= share < 1.0 for share in SURE[knowledge].values())


def permuted(given: Given, order: np.ndarray) -> tuple[Localization, Truth]:
    changed = given.seen(order)
    return changed.localized(), Truth(given.T_camera_map, changed.ids)


def test_healthy_stays_healthy_whatever_the_order_of_rows() -> None:
    elements = mapped_elements(default_road(), 3, WHOLE)
    rng = np.random.default_rng(0)
    checked = 0
    for index in range(0, 400, 20):
        given = Given.of(make_problem(3, WHOLE, index=index), elements)
        one = given.localized()
        if not is_healthy(one, given.T_camera_map):
            continue
        again, truth = permuted(given, rng.permutation(len(given.ids)))
        verdict = explain(again, given.semantic_map, truth, DETECTOR)
        assert (verdict.kind, verdict.noticed) == ("healthy", ())
        checked += 1
    assert checked >= 5


def test_rows_of_other_order_are_named_by_their_new_numbers() -> None:
    for one in planted("wrong class"):
        seen, ids = one.localization.observed, one.truth.element_id
        assert ids is not None
        order = np.arange(len(seen))[::-1]
        turned = replace(one.localization, observed=seen[order], refinement=None, match=None)
        verdict = explain(turned, one.semantic_map, replace(one.truth, element_id=ids[order]))
        (row,) = one.rows
        assert (len(seen) - 1 - row,) in [fault.rows for fault in verdict.noticed]


def test_the_same_frame_is_told_the_same() -> None:
    for fault in PLANTED:
        one = planted(fault)[0]
        for truth in (one.truth, None):
            assert told(one, truth) == told(one, truth)


def test_a_row_of_which_nothing_is_known_is_not_called_false() -> None:
    one = planted("false detection")[0]
    ids = one.truth.element_id
    assert ids is not None
    unknown = replace(one.truth, element_id=np.where(ids < 0, UNKNOWN, ids))
    assert first(told(one, unknown)).kind in UNDECIDED


def test_what_is_seen_far_away_is_not_missing_in_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """People label further than a detector sees."""
    monkeypatch.setattr(case, "NEARBY_M", 10.0)
    for one in planted("healthy"):
        assert told(one, one.truth).noticed == ()


def test_what_a_detector_missed_is_named() -> None:
    for one in planted("missed detection"):
        seen = one.truth.element_id
        assert seen is not None
        sentence = first(told(one, one.truth)).sentence
        names = re.findall(r"[A-Z]-(\d+)", sentence.split("Not seen: ")[1])
        assert 0 < len(names) <= 3
        assert not {int(name) for name in names} & set(seen.tolist())
        assert {int(name) for name in names} <= set(one.semantic_map.elements.id.tolist())


# --- runs ---


Blind = Callable[[Truth], Truth | None]


def told_of(run: PlantedRun, blind: Blind = lambda truth: truth) -> RunVerdict:
    frames = [(one, blind(truth)) for one, truth in run.frames]
    return explain_run(frames, run.semantic_map, DETECTOR)


@pytest.mark.parametrize("fault", ["moved in the map", "missing in the map", "twice in the map"])
@pytest.mark.parametrize("blind", [lambda truth: truth, ids_unknown])
def test_a_run_names_the_element_that_is_wrong_in_its_map(fault: Kind, blind: Blind) -> None:
    run = planted_run(fault)
    verdict = told_of(run, blind)
    assert verdict.calibration is None
    assert [one.kind for one in verdict.elements] == [fault]
    elements = verdict.elements[0].elements
    assert set(elements) & set(run.elements) or (fault == "missing in the map" and not elements)
    assert verdict.elements[0].evidence[0].value >= 3
    sights = list(zip(verdict.elements[0].frames, verdict.elements[0].rows, strict=True))
    assert len({frame for frame, _ in sights}) == verdict.elements[0].evidence[0].value
    seen = {int(run.frames[frame][1].element_id[row]) for frame, row in sights}
    assert seen & {*run.elements, *elements}


def test_a_run_in_which_nothing_is_wrong_names_nothing() -> None:
    for blind in (lambda truth: truth, ids_unknown, lambda truth: None):
        verdict = told_of(planted_run("healthy"), blind)
        assert verdict.calibration is None
        assert verdict.elements == ()


@pytest.mark.parametrize("percent", [-4.0, 3.0])
def test_a_focal_length_that_is_wrong_is_told_with_its_amount(percent: float) -> None:
    elements = mapped_elements(default_road(), 5, WHOLE)
    frames = []
    for index in range(0, 40, 4):
        given = Given.of(make_problem(5, WHOLE, index=index, driving=True), elements)
        K = given.camera.K.copy()
        K[[0, 1], [0, 1]] *= 1.0 + percent / 100.0
        given = replace(given, camera=replace(given.camera, K=K))
        frames.append((given.localized(), Truth(given.T_camera_map)))
    verdict = explain_run(frames, given.semantic_map, DETECTOR)
    assert verdict.calibration is not None
    assert "focal length" in verdict.calibration.sentence
    # what the camera lacks: stated 3 % too long, it must become 3 % shorter
    assert verdict.calibration.evidence[0].value == pytest.approx(-percent, abs=0.5)


def test_a_run_of_no_frames_says_nothing() -> None:
    run = planted_run("healthy")
    assert explain_run([], run.semantic_map) == RunVerdict(None, (), 0)


def test_rays_of_three_frames_meet_where_the_thing_stands() -> None:
    centers = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [8.0, 0.0]])
    ways = np.array([[20.0, 6.0], [20.0, 6.0], [20.0, 6.0], [30.0, -9.0]]) - centers
    toward = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    sights = Sights(np.array([0, 1, 2, 2]), np.zeros(4, int), np.zeros(4, int), centers, toward)
    (place,) = meeting_places(sights)
    np.testing.assert_allclose(place.at_m, [20.0, 6.0], atol=1e-9)
    assert place.sights.tolist() == [0, 1, 2]
    other_class = replace(sights, class_id=np.array([0, 0, 1, 0]))
    assert meeting_places(other_class) == []
