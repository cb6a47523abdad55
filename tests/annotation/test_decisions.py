"""Decisions of map building: which are open, and what each answer makes of the labels."""

from collections.abc import Callable

import pytest
from label_files import labels_of, pole

from semviz_annotation.labels.edits import (
    DecideElements,
    DeleteElement,
    DeleteObservation,
    Edit,
    Link,
    RevokeDecision,
)
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Rules, derived_id, different_elements, review_decision
from semviz_annotation.mapping.decisions import (
    decision_id,
    edit_of,
    frame_to_see,
    is_open,
    review_options,
    settling_decisions,
)
from semviz_core.base.semantic_map import Decision, DecisionKind
from semviz_core.common.errors import SemvizError

ENDS = (100.0, 50.0), (101.0, 200.0)


def element(number: int) -> str:
    return derived_id(f"element {number}")


def observation(number: int, frame: int, side: str = "left") -> str:
    return derived_id(f"observation {number} {frame} {side}")


def decided(kind: DecisionKind, *numbers: int, of: tuple[str, ...] = ()) -> Decision:
    return Decision(kind, tuple(map(element, numbers)), numbers, "machine", "So.", {}, of)


@pytest.fixture
def labels() -> Labels:
    """Poles 1 to 4: 1 in frames 0 and 1, 2 in 7, 3 in 9 and 10, 4 in 9 beside 3 and once more."""
    return labels_of(
        pole(1, 0, "left", *ENDS), pole(1, 1, "left", *ENDS), pole(2, 7, "left", *ENDS),
        pole(3, 9, "left", *ENDS), pole(3, 10, "left", *ENDS),
        pole(4, 9, "left", *ENDS), pole(4, 3, "left", *ENDS), pole(4, 5, "right", *ENDS),
    )  # fmt: skip


MERGE, THREE, APART = decided("merge", 1, 2), decided("merge", 1, 2, 3), decided("apart", 2, 3)
SPLIT = decided("split", 4, of=(observation(4, 3), observation(4, 5, "right")))
OUT, PARTLY = decided("leave out", 1), decided("leave out", 4, of=(observation(4, 3),))
EVERY = (MERGE, THREE, APART, SPLIT, OUT, PARTLY)


def after(labels: Labels, *edits: Edit) -> Labels:
    for edit in edits:
        labels = labels.changed(edit.changes(labels, Rules()))
    return labels


def names(decision: Decision, labels: Labels) -> list[str]:
    return [option.name for option in review_options(decision, labels)]


def test_each_kind_has_its_answers_the_machines_own_first(labels):
    assert all(is_open(decision, labels) for decision in EVERY)
    assert names(MERGE, labels) == ["same", "two"]
    assert names(THREE, labels) == ["same", "two", "not 1", "not 2", "not 3"]
    assert names(APART, labels) == ["two", "same"]
    assert names(SPLIT, labels) == ["two", "keep"]
    assert names(OUT, labels) == names(PARTLY, labels) == ["leave out", "keep"]
    assert names(decided("leave out", 2), labels) == ["leave out"]  # labelled once: no place
    assert [option.title for option in review_options(THREE, labels)][-1] == "Exclude P-03"


@pytest.mark.parametrize(
    "decision", EVERY, ids=lambda decision: f"{decision.kind} {decision.numbers}"
)
def test_every_answer_can_be_given_settles_the_decision_and_is_undone(decision, labels):
    for answer in review_options(decision, labels):
        assert edit_of(decision, answer.name, labels) == answer.edit
        changes = tuple(answer.edit.changes(labels, Rules()))
        answered = labels.changed(changes)
        assert answered != labels
        assert not is_open(decision, answered)
        assert review_options(decision, answered) == ()
        with pytest.raises(SemvizError, match="may be answered already"):
            edit_of(decision, answer.name, answered)
        undone = answered.changed(change.inverse() for change in changes)
        assert undone == labels
        assert is_open(decision, undone)
        taken_back = after(
            answered,
            *(RevokeDecision(settling.id) for settling in settling_decisions(decision, answered)),
        )
        if isinstance(answer.edit, DecideElements):
            assert is_open(decision, taken_back)


def test_answers_do_what_they_say(labels):
    same = after(labels, edit_of(THREE, "same", labels))
    assert {label.number for label in same.elements.values()} == {1, 4}
    assert len(same.of_element(element(1))) == 5
    two = after(labels, edit_of(THREE, "two", labels))
    assert len(two.review_decisions) == 3
    other = after(labels, edit_of(THREE, "not 2", labels))
    assert set(other.review_decisions.values()) == {
        different_elements(element(1), element(2)), different_elements(element(2), element(3))
    }  # fmt: skip
    split = after(labels, edit_of(SPLIT, "two", labels))
    new = next(label for label in split.elements.values() if label.number == 5)
    assert {row.id for row in split.of_element(new.id)} == set(SPLIT.observation_ids)
    assert set(split.review_decisions.values()) == {different_elements(element(4), new.id)}
    kept = after(labels, edit_of(SPLIT, "keep", labels))
    assert set(kept.review_decisions.values()) == {review_decision(element(4), "keep")}
    out = after(labels, edit_of(OUT, "leave out", labels))
    assert set(out.review_decisions.values()) == {review_decision(element(1), "leave out")}
    deleted = after(labels, edit_of(PARTLY, "leave out", labels))
    assert set(labels.observations) - set(deleted.observations) == set(PARTLY.observation_ids)


def test_what_one_image_shows_twice_is_no_question(labels):
    assert not is_open(decided("apart", 3, 4), labels)
    gone = after(labels, DeleteObservation(observation(3, 9)))
    assert names(decided("apart", 3, 4), gone) == ["two", "same"]


@pytest.mark.parametrize(
    ("decision", "edit"),
    [
        (MERGE, lambda: DeleteElement(element(2))),
        (MERGE, lambda: Link((element(1), element(2)))),
        (APART, lambda: Link((element(1), element(2)))),
        (APART, lambda: DecideElements((different_elements(element(3), element(2)),))),
        (SPLIT, lambda: DeleteElement(element(4))),
        (SPLIT, lambda: DecideElements((review_decision(element(4), "leave out"),))),
        (OUT, lambda: DeleteElement(element(1))),
        (PARTLY, lambda: DeleteObservation(observation(4, 3))),
        (PARTLY, lambda: DecideElements((review_decision(element(4), "keep"),))),
    ],
)
def test_decisions_whose_labels_are_gone_or_judged_are_not_open(
    decision: Decision, edit: Callable[[], Edit], labels: Labels
) -> None:
    assert not is_open(decision, after(labels, edit()))


def test_what_people_decided_is_not_open_and_others_decisions_settle_nothing(labels):
    human = Decision("merge", MERGE.label_ids, (1, 2), "human", "So.")
    assert not is_open(human, labels)
    elsewhere = DecideElements(
        (different_elements(element(1), element(3)), review_decision(element(2), "keep"))
    )
    assert is_open(MERGE, after(labels, elsewhere))
    assert is_open(
        SPLIT, after(labels, DecideElements((different_elements(element(4), element(1)),)))
    )


def test_of_a_merge_with_one_gone_the_rest_is_asked_about(labels):
    gone = after(labels, DeleteElement(element(3)))
    assert names(THREE, gone) == ["same", "two"]
    assert edit_of(THREE, "same", gone) == Link((element(1), element(2)))


def test_ids_are_of_what_is_decided_not_of_the_evidence():
    again = Decision(MERGE.kind, MERGE.label_ids, MERGE.numbers, "machine", "Else.", {"chi2": 1.0})
    assert decision_id(again) == decision_id(MERGE)
    assert len({decision_id(decision) for decision in EVERY}) == len(EVERY)


def test_the_frame_to_see_is_where_all_parts_are_or_nearly(labels):
    assert frame_to_see(MERGE, labels) == 1  # 1 in frames 0 and 1, 2 in 7
    assert frame_to_see(decided("apart", 3, 4), labels) == 9
    assert frame_to_see(SPLIT, labels) == 5  # the rest is in frame 9
    assert frame_to_see(OUT, labels) == 0
    assert frame_to_see(PARTLY, labels) == 3
    assert frame_to_see(decided("leave out", 8), labels) is None
