"""Edits: what they do, what they refuse, how they are read."""

from dataclasses import replace

import pytest

from semviz_annotation.labels.edits import (
    AddElements,
    AddMany,
    AddObservation,
    DecideElements,
    DeleteElement,
    DeleteMany,
    DeleteObservation,
    Dismiss,
    Link,
    MoveObservation,
    NewElement,
    ReviewFrame,
    RevokeDecision,
    SetClass,
    SetClassOfMany,
    SetKnown,
    SetKnownOfMany,
    SwapEnds,
    Unlink,
    edit_from_json,
    edit_to_json,
)
from semviz_annotation.labels.labels import Dismissal, Labels, Observation, new_id, proposal_id
from semviz_annotation.labels.rows import Rules, different_elements, review_decision
from semviz_core.common.errors import SemvizError

RULES = Rules()


def after(labels: Labels, *edits) -> Labels:
    for edit in edits:
        labels = labels.changed(edit.changes(labels, RULES))
    return labels


def pole(frame: int = 0, side: str = "left", **more) -> AddObservation:
    values = {
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": side,
        "anchor_px": (100.0, 50.0),
        "end_px": (101.0, 200.0),
        "class_id": 0,
    }
    return AddObservation(**(values | more))


def sign(**more) -> AddObservation:
    return pole(**({"end_px": None, "class_id": 1} | more))


def correspondence(first: AddObservation) -> AddObservation:
    return replace(first, observation_id=new_id(), side="right", class_id=None)


def test_one_element_is_labelled_in_both_images_and_over_frames():
    first = pole()
    labels = after(
        Labels(), first, correspondence(first), replace(correspondence(first), frame_index=1)
    )
    labels = after(labels, pole(frame=1))
    (pair,) = labels.pairs(0)
    assert pair.element.id == first.element_id
    assert (pair.left.side, pair.right.side) == ("left", "right")
    assert list(labels.pairs(1)) == []
    assert [len(labels.in_frame(0)), len(labels.in_frame(1, "right"))] == [2, 1]
    assert len(labels.of_element(first.element_id)) == 3
    assert labels.find(first.element_id, 1, "left") is None
    assert labels.find(first.element_id, 0, "right") == pair.right
    assert labels.frames == (0, 1)
    assert [element.number for element in labels.elements.values()] == [1, 2]


def test_numbers_are_never_used_again():
    first, second = pole(), pole(frame=1)
    labels = after(Labels(), first, second, DeleteElement(second.element_id), pole(frame=2))
    assert sorted(element.number for element in labels.elements.values()) == [1, 3]


def test_moving_swapping_and_hiding():
    edit = pole()
    labels = after(Labels(), edit, MoveObservation(edit.observation_id, end_px=(5.0, 6.0)))
    assert labels.observation(edit.observation_id).anchor_px == edit.anchor_px
    assert labels.observation(edit.observation_id).end_px == (5.0, 6.0)
    labels = after(labels, SetKnown(edit.observation_id, end_known=False))
    assert labels.observation(edit.observation_id).anchor_known
    labels = after(labels, SwapEnds(edit.observation_id))
    swapped = labels.observation(edit.observation_id)
    assert (swapped.anchor_px, swapped.end_px) == ((5.0, 6.0), edit.anchor_px)
    assert (swapped.anchor_known, swapped.end_known) == (False, True)
    assert after(labels, SwapEnds(edit.observation_id), SwapEnds(edit.observation_id)) == labels


def test_the_last_observation_takes_its_element_along():
    edit = pole()
    labels = after(Labels(), edit, correspondence(edit), DeleteObservation(edit.observation_id))
    assert len(labels.elements) == 1
    (rest,) = labels.observations
    assert after(labels, DeleteObservation(rest)) == Labels()


def test_many_are_deleted_together_or_not_at_all():
    first, other = pole(), pole(frame=1)
    more = correspondence(first)
    labels = after(
        Labels(), first, more, other, DecideElements((review_decision(first.element_id, "keep"),))
    )
    left = after(labels, DeleteMany((more.observation_id, other.observation_id)))
    assert set(left.observations) == {first.observation_id}
    assert len(left.review_decisions) == 1
    assert after(left, DeleteMany((first.observation_id,))) == Labels()
    every = DeleteMany((first.observation_id, more.observation_id, other.observation_id))
    assert after(labels, every) == Labels()
    with pytest.raises(SemvizError, match="no observation"):
        after(labels, DeleteMany((first.observation_id, new_id())))


def test_many_get_a_class_or_hidden_ends_as_one_by_one_or_not_at_all():
    poles, signs = (pole(), pole(frame=1)), (sign(), sign(frame=1))
    labels = after(Labels(), *poles, *signs)
    elements = tuple(one.element_id for one in signs)
    one_by_one = after(labels, *(SetClass(id_, 3) for id_ in elements))
    assert after(labels, SetClassOfMany((*elements, elements[0]), 3)) == one_by_one != labels
    rows = tuple(one.observation_id for one in poles)
    one_by_one = after(labels, *(SetKnown(id_, end_known=False) for id_ in rows))
    assert after(labels, SetKnownOfMany(rows, end_known=False)) == one_by_one != labels
    with pytest.raises(SemvizError, match="cannot become"):
        after(labels, SetClassOfMany((elements[0], poles[0].element_id), 3))
    with pytest.raises(SemvizError, match="only a pole's ends"):
        after(labels, SetKnownOfMany((rows[0], signs[0].observation_id), end_known=False))


def test_link_keeps_the_smaller_number_and_unlink_makes_a_new_one():
    first, second = pole(), pole(side="right")
    labels = after(Labels(), first, second, Link((second.element_id, first.element_id)))
    assert [element.number for element in labels.elements.values()] == [1]
    assert len(list(labels.pairs(0))) == 1
    labels = after(labels, Unlink((second.observation_id,), new_id()))
    assert sorted(element.number for element in labels.elements.values()) == [1, 3]
    assert list(labels.pairs(0)) == []


def test_a_review_is_overtaken_by_later_labels():
    assert Labels().review(0) == "unseen"
    labels = after(Labels(), ReviewFrame(0, "reviewed, empty"))
    assert labels.review(0) == "reviewed, empty"
    edit = pole()
    labels = after(labels, edit)
    assert labels.review(0) == "in work"
    labels = after(labels, ReviewFrame(0, "reviewed"))
    assert labels.review(0) == "reviewed"
    assert after(labels, DeleteObservation(edit.observation_id)).review(0) == "in work"
    assert after(labels, ReviewFrame(0, "unseen")).review(0) == "in work"
    assert after(Labels(), ReviewFrame(4, "in work")).review(4) == "in work"


def dismissal(element_id: str, frame: int, side: str = "left", why: str = "absent") -> Dismissal:
    return Dismissal(proposal_id(element_id, frame, side), frame, side, why, element_id)


def of_detector(frame: int) -> Dismissal:
    return Dismissal(new_id(), frame, "left", "rejected", None)


def test_ids_of_proposals_depend_on_element_frame_and_side_only():
    element_id, other = new_id(), new_id()
    ids = {
        proposal_id(e, f, s)
        for e in (element_id, other)
        for f in (1, 11)
        for s in ("left", "right")
    }
    assert len(ids) == 8
    assert all(dismissal(element_id, 1).id in ids and len(x) == 36 and x[14] == "8" for x in ids)
    fixed = proposal_id("01a1fda4-ce72-7ec6-ab2d-ece8376e7e3d", 3, "left")
    assert fixed == "57976abb-55a0-8b7d-83f6-a3a0f939f8df"


def test_drawing_where_it_was_turned_down_takes_that_back():
    a = pole()
    there, elsewhere, foreign = (
        dismissal(a.element_id, 1),
        dismissal(a.element_id, 2),
        of_detector(1),
    )
    labels = after(Labels(), a, Dismiss((there, elsewhere, foreign)))
    assert set(labels.dismissed_in(1)) == {there, foreign}
    assert labels.dismissals.keys() == {there.id, elsewhere.id, foreign.id}
    drawn = replace(a, observation_id=new_id(), frame_index=1, class_id=None)
    labels = after(labels, drawn)
    assert labels.dismissed_in(1) == (foreign,)
    accepted = pole(frame=1, observation_id=foreign.id)
    assert set(after(labels, accepted).dismissals) == {elsewhere.id}
    again = after(labels, Dismiss((replace(elsewhere, why="occluded"),)))
    assert [refusal.why for refusal in again.dismissed_in(2)] == ["occluded"]
    assert list(Dismiss((elsewhere,)).changes(labels, RULES)) == []


@pytest.mark.parametrize(
    ("why", "stays"), [("rejected", False), ("occluded", True), ("absent", True)]
)
def test_a_label_takes_back_that_its_element_is_not_in_the_other_image(why, stays):
    """What was rejected is the mark; that it is hidden there, somebody saw."""
    a, b = pole(), pole()
    right, of_b, later = (
        dismissal(a.element_id, 1, "right", why),
        dismissal(b.element_id, 1, "right", why),
        dismissal(a.element_id, 2, "right", why),
    )
    labels = after(Labels(), a, b, Dismiss((right, of_b, later)))
    drawn = replace(a, observation_id=new_id(), frame_index=1, class_id=None)
    rest = set(after(labels, drawn).dismissals.values())
    assert rest == {right, of_b, later} if why != "rejected" else rest == {of_b, later}


def test_dismissals_go_with_their_element():
    a, b = pole(), pole(frame=1)
    turned_down = Dismiss((dismissal(a.element_id, 1), dismissal(b.element_id, 2), of_detector(2)))
    labels = after(Labels(), a, b, turned_down)
    for gone in (DeleteElement(b.element_id), DeleteObservation(b.observation_id)):
        rest = after(labels, gone).dismissals.values()
        assert {row.element_id for row in rest} == {a.element_id, None}
    linked = after(labels, Link((b.element_id, a.element_id)))  # b is seen where a was turned down
    assert [refusal.element_id for refusal in linked.dismissals.values()] == [None]


def test_a_decision_is_made_once_about_its_elements_and_taken_back():
    a, b = pole(), pole(frame=1)
    two, other = (
        different_elements(b.element_id, a.element_id),
        review_decision(a.element_id, "leave out"),
    )
    assert two == different_elements(a.element_id, b.element_id)
    assert two.element_id < (two.other_id or "")
    labels = after(Labels(), a, b, DecideElements((two, review_decision(a.element_id, "keep"))))
    labels = after(labels, DecideElements((two, other)))
    assert set(labels.review_decisions.values()) == {two, other}
    assert set(labels.decisions_of(a.element_id)) == {two, other}
    assert labels.decisions_of(b.element_id) == (two,)
    assert list(DecideElements((two, other)).changes(labels, RULES)) == []
    labels = after(labels, RevokeDecision(two.id))
    assert labels.decisions_of(b.element_id) == ()
    with pytest.raises(SemvizError, match="there is no such decision"):
        after(labels, RevokeDecision(two.id))


def test_review_decisions_go_with_their_element():
    a, b, c = pole(), pole(frame=1), pole(frame=2)
    said = DecideElements(
        (different_elements(a.element_id, b.element_id), review_decision(b.element_id, "keep"),
         review_decision(c.element_id, "leave out"))
    )  # fmt: skip
    labels = after(Labels(), a, b, c, said)
    for gone in (DeleteElement(b.element_id), DeleteObservation(b.observation_id)):
        rest = after(labels, gone)
        assert set(rest.review_decisions.values()) == {review_decision(c.element_id, "leave out")}
        assert rest.decisions_of(a.element_id) == ()


def test_what_was_said_of_linked_elements_is_said_of_the_one_that_is_kept():
    a, b, c, d = (pole(frame=frame) for frame in range(4))
    ab, bd, cd = (
        different_elements(first.element_id, second.element_id)
        for first, second in ((a, b), (b, d), (c, d))
    )
    said = DecideElements(
        (
            ab,
            bd,
            cd,
            review_decision(b.element_id, "keep"),
            review_decision(c.element_id, "leave out"),
        )
    )
    labels = after(Labels(), a, b, c, d, said)
    linked = after(labels, Link((c.element_id, a.element_id, b.element_id)))
    (first,) = (
        decision for decision in linked.decisions_of(a.element_id) if decision.other_id is None
    )
    assert first.verdict in ("keep", "leave out")  # of b and c: either, but always the same
    assert set(linked.review_decisions.values()) == {
        first,
        different_elements(a.element_id, d.element_id),
    }
    alone = after(labels, Link((a.element_id, b.element_id)))
    assert set(alone.review_decisions.values()) == {
        review_decision(a.element_id, "keep"), different_elements(a.element_id, d.element_id), cd,
        review_decision(c.element_id, "leave out"),
    }  # fmt: skip
    own = review_decision(a.element_id, "leave out")
    stays = after(labels, DecideElements((own,)), Link((a.element_id, b.element_id)))
    assert own in stays.review_decisions.values()


def test_what_is_unlinked_is_apart_and_no_longer_kept_as_one():
    first = pole()
    more = [replace(correspondence(first), observation_id=new_id(), frame_index=f) for f in (1, 2)]
    labels = after(
        Labels(), first, *more, DecideElements((review_decision(first.element_id, "keep"),))
    )
    new = new_id()
    labels = after(labels, Unlink(tuple(row.observation_id for row in more), new))
    assert [len(labels.of_element(value)) for value in (first.element_id, new)] == [1, 2]
    assert set(labels.review_decisions.values()) == {different_elements(first.element_id, new)}
    assert not after(labels, Link((new, first.element_id))).review_decisions
    left_out = after(labels, DecideElements((review_decision(new, "leave out"),)))
    left_out = after(left_out, Unlink((more[0].observation_id,), new_id()))
    assert review_decision(new, "leave out") in left_out.review_decisions.values()


def test_many_are_added_together_or_not_at_all():
    first, lonely = pole(), pole(frame=4)
    down = dismissal(first.element_id, 1)
    labels = after(Labels(), AddMany((first, correspondence(first), lonely)))
    assert len(list(labels.pairs(0))) == 1
    assert sorted(element.number for element in labels.elements.values()) == [1, 2]
    more = [replace(correspondence(first), observation_id=new_id(), frame_index=f) for f in (1, 2)]
    labels = after(
        labels,
        Dismiss((replace(down, side="right", id=proposal_id(first.element_id, 1, "right")),)),
    )
    assert after(labels, AddMany(tuple(more))).dismissals == {}
    with pytest.raises(SemvizError, match="P-01 is already labelled"):
        after(labels, AddMany((more[0], replace(more[0], observation_id=new_id()))))


A, B, S = pole(), pole(), sign(frame=3)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (replace(A, element_id=new_id()), "already exists"),
        (replace(A, observation_id=new_id()), "omit its class"),
        (replace(A, observation_id=new_id(), class_id=None), "P-01 is already labelled"),
        (pole(class_id=None), "no element"),
        (pole(class_id=7), "unknown class 7"),
        (pole(end_px=None), "two points"),
        (sign(end_px=(1.0, 1.0)), "one point"),
        (pole(end_px=(100.0, 50.1)), "same point"),
        (pole(anchor_px=(float("nan"), 1.0)), "not a number"),
        (MoveObservation(new_id(), (1.0, 1.0)), "no observation"),
        (MoveObservation(S.observation_id, end_px=(1.0, 1.0)), "one point"),
        (MoveObservation(A.observation_id, anchor_px=(101.0, 200.0)), "same point"),
        (SetKnown(S.observation_id, end_known=True), "pole"),
        (SwapEnds(S.observation_id), "nothing to swap"),
        (Link((A.element_id, A.element_id)), "itself"),
        (Link((A.element_id, B.element_id)), "left image of frame 0"),
        (Link((A.element_id, S.element_id)), "differ in class"),
        (Unlink((A.observation_id,), new_id()), "only observation"),
        (Link((A.element_id, S.element_id, A.element_id)), "itself"),
        (Unlink((A.observation_id, B.observation_id), new_id()), "not all observations are"),
        (Unlink((A.observation_id,) * 2, new_id()), "nothing to unlink|same row twice"),
        (DecideElements((review_decision(new_id(), "keep"),)), "no element"),
        (DecideElements((different_elements(A.element_id, new_id()),)), "no element"),
        (
            DecideElements((different_elements(A.element_id, A.element_id),)),
            "the one with the smaller id first",
        ),
        (
            DecideElements((replace(review_decision(A.element_id, "keep"), verdict="apart"),)),
            "two elements",
        ),
        (
            DecideElements(
                (replace(different_elements(A.element_id, B.element_id), verdict="keep"),)
            ),
            "only a decision .apart. is about two",
        ),
        (
            DecideElements((replace(review_decision(A.element_id, "keep"), id=new_id()),)),
            "not the id",
        ),
        (
            DecideElements(
                (review_decision(A.element_id, "keep"), review_decision(A.element_id, "leave out"))
            ),
            "twice",
        ),
        (SetClass(A.element_id, 2), "cannot become"),
        (SetClass(S.element_id, 9), "unknown class 9"),
        (DeleteElement(new_id()), "no element"),
        (ReviewFrame(0, "reviewed, empty"), "not empty"),
        (ReviewFrame(8, "reviewed"), "no labels"),
        (AddMany((pole(frame=7), A)), "already exists"),
        (Dismiss((dismissal(A.element_id, 0),)), "P-01 is labelled in this left image"),
        (Dismiss((dismissal(new_id(), 0),)), "no element"),
        (Dismiss((replace(of_detector(1), id=A.observation_id),)), "was accepted"),
        (Dismiss((replace(dismissal(A.element_id, 1), id=new_id()),)), "not the id"),
        (Dismiss((dismissal(A.element_id, 1),) * 2), "same row twice"),
    ],
)
def test_nonsense_is_refused_in_words(edit, words):
    labels = after(Labels(), A, B, S)
    with pytest.raises(SemvizError, match=words) as caught:
        after(labels, edit)
    assert "\n" not in str(caught.value)


def test_points_must_be_in_the_image_of_their_side(world):
    rules = Rules(rig=world.rig)
    inside = pole(anchor_px=(-0.5, -0.5), end_px=(1240.5, 375.5))
    Labels().changed(inside.changes(Labels(), rules))
    for outside in ((-0.6, 5.0), (5.0, 376.0)):
        with pytest.raises(SemvizError, match=r"outside the left image \(1241x376\)"):
            list(pole(end_px=outside).changes(Labels(), rules))
    alone = Rules(rig=replace(world.rig, right=None, T_right_left=None))
    with pytest.raises(SemvizError, match="no right camera"):
        list(pole(side="right").changes(Labels(), alone))
    with pytest.raises(SemvizError, match="no right camera"):
        list(Dismiss((replace(of_detector(1), side="right"),)).changes(Labels(), alone))


EVERY = [
    A,
    S,
    MoveObservation(A.observation_id, (0.125, 7.0)),
    SetKnown(A.observation_id, False, None),
    SetKnownOfMany((A.observation_id,), None, False),
    SwapEnds(A.observation_id),
    DeleteObservation(A.observation_id),
    DeleteElement(A.element_id),
    DeleteMany((A.observation_id, S.observation_id)),
    Link((A.element_id, B.element_id)),
    Unlink((A.observation_id,), new_id()),
    SetClass(A.element_id, 3),
    SetClassOfMany((A.element_id,), 3),
    ReviewFrame(3, "reviewed, empty"),
    AddMany((A, S)),
    Dismiss((dismissal(A.element_id, 1), of_detector(2))),
    DecideElements(
        (different_elements(A.element_id, B.element_id), review_decision(A.element_id, "leave out"))
    ),
    RevokeDecision(review_decision(A.element_id, "keep").id),
]


@pytest.mark.parametrize("edit", EVERY, ids=lambda edit: edit.kind)
def test_json_round_trip(edit):
    assert edit_from_json(edit_to_json(edit)) == edit


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"frame_index": "3"}, "frame_index"),
        ({"frame_index": -1}, "frame_index"),
        ({"frame_index": 10**400}, "frame_index"),
        ({"frame_index": True}, "frame_index"),
        ({"anchor_px": [1.0]}, "anchor_px"),
        ({"anchor_px": [1.0, float("nan")]}, "anchor_px.1"),
        ({"anchor_px": [1.0, float("inf")]}, "anchor_px.1"),
        ({"element_id": "x' OR 1"}, "element_id"),
        ({"side": "up"}, "side"),
        ({"more": 1}, "more"),
        ({"kind": "drop table"}, "drop table"),
    ],
)
def test_broken_json_is_refused_by_field(change, field):
    with pytest.raises(SemvizError, match=field) as caught:
        edit_from_json(edit_to_json(A) | change)
    assert "\n" not in str(caught.value)


def test_an_empty_list_is_no_edit():
    for edit in (
        AddMany(()),
        Dismiss(()),
        DecideElements(()),
        DeleteMany(()),
        SetClassOfMany((), 1),
        SetKnownOfMany((), True),
        Unlink((), new_id()),
    ):
        with pytest.raises(SemvizError, match="at least 1 item"):
            edit_from_json(edit_to_json(edit))


@pytest.mark.parametrize("data", [None, 3, [], "x", {}, {"kind": "add"}, {"kind": []}, object()])
def test_no_edit_at_all(data):
    with pytest.raises(SemvizError, match="not an edit"):
        edit_from_json(data)


def new_element(*frames: int, class_id: int = 0, **more) -> NewElement:
    values = {"anchor_px": (100.0, 50.0), "end_px": (101.0, 200.0)} | more
    rows = tuple(
        Observation(new_id(), "", frame, side, anchor_known=True, end_known=True, **values)
        for frame in frames
        for side in ("left", "right")
    )
    return NewElement(new_id(), class_id, rows)


def test_elements_are_added_whole_with_the_next_numbers():
    drawn = after(Labels(), pole())
    first, second = new_element(1, 2), new_element(1)
    labels = after(drawn, AddElements((first, second)))
    assert [element.number for element in labels.elements.values()] == [1, 2, 3]
    assert [row.frame_index for row in labels.of_element(first.id)] == [1, 1, 2, 2]
    assert labels.review_decisions == {}
    changes = [change.inverse() for change in AddElements((first, second)).changes(drawn, RULES)]
    assert labels.changed(changes) == drawn


def test_what_is_added_as_left_out_shows_no_landmark():
    rejected = new_element(1)
    labels = after(Labels(), AddElements((rejected,), left_out=True))
    assert labels.is_left_out(rejected.id)
    assert labels.without_left_out() == Labels()
    assert labels.review(1) == "unseen"
    empty = after(labels, ReviewFrame(1, "reviewed, empty"))
    assert empty.review(1) == "reviewed, empty"
    assert after(empty, pole(1)).review(1) == "in work"
    kept = after(labels, RevokeDecision(review_decision(rejected.id, "leave out").id))
    assert kept.review(1) == "in work"
    with pytest.raises(SemvizError, match="2 labels"):
        after(kept, ReviewFrame(1, "reviewed, empty"))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (AddElements((new_element(1, class_id=9),)), "class"),
        (AddElements((new_element(1, end_px=None),)), "needs two points"),
        (AddElements((new_element(1, 1),)), "two observations in one image"),
        (AddElements((NewElement(new_id(), 0, ()),)), "without observations"),
        (AddElements((new_element(1),) * 2), "twice"),
    ],
)
def test_elements_are_added_all_or_none(edit, words):
    good = AddElements((new_element(1), *edit.elements))
    with pytest.raises(SemvizError, match=words):
        after(Labels(), good)


def test_an_element_is_added_once():
    edit = AddElements((new_element(1),))
    with pytest.raises(SemvizError, match="P-01 already"):
        after(Labels(), edit, edit)
