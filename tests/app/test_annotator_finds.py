"""What a detector found, as a person gets to see it: one thing, one offer, in both images."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from annotating import SIDES, true_finds
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz.annotator.offers import Answer, Offer, Origin
from semviz.annotator.panes import Pane
from semviz.annotator.rivals import checked
from semviz.annotator.session import LabelSession
from semviz.workspace import Workspace
from semviz_annotation.assist.shot import Mark, Proposed
from semviz_annotation.detections import as_proposals
from semviz_annotation.edits import ReviewFrame
from semviz_annotation.formats.plan import ImportLabels
from semviz_annotation.labels import Labels, Observation, new_id
from semviz_annotation.looked import Looked
from semviz_annotation.proposals import Proposal, Proposals, save_proposals
from semviz_annotation.street_labels import careful, label_street
from semviz_core.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street


def look(session: LabelSession, frame: int) -> None:
    for question in session.unanswered(frame):
        session.looker.answer(question)


def detector_offers(session: LabelSession, frame: int) -> list[dict[str, Any]]:
    return [one for one in session.frame(frame)["offers"] if one["origin"] == "detector"]


def accepted(session: LabelSession, frame: int, offers: list[dict[str, Any]]) -> None:
    """As the page accepts offers."""
    marks = [
        {
            "observation_id": offer[side]["id"] if is_new(offer) else new_id(),
            "element_id": offer["id"],
            "frame_index": frame,
            "side": side,
            "anchor_px": offer[side]["anchor"],
            "end_px": offer[side]["end"],
            "anchor_known": offer[side]["anchor_known"],
            "end_known": offer[side]["end_known"],
        }
        | ({"class_id": offer["class"]} if is_new(offer) else {})
        for offer in offers
        for side in SIDES
        if side in offer
    ]
    if marks:
        session.do(new_id(), {"kind": "accept", "marks": marks})


def is_new(offer: dict[str, Any]) -> bool:
    return bool(offer["origin"] == "detector")


@pytest.mark.parametrize("sides", [SIDES, ("left",), ("right",)])
def test_a_detectors_find_is_one_offer_for_both_images(
    tmp_path: Path, sides: tuple[Side, ...]
) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 3))
    street = workspace.street
    detected = true_finds(street, 0, sides)
    save_proposals(detected, workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    both = [one for one in detector_offers(session, 0) if "left" in one and "right" in one]
    sure = [one for one in both if one["sure"]]
    assert len(sure) >= 0.6 * len(detected) / len(sides)
    accepted(session, 0, sure)
    assert len(session.labels.elements) == len(sure)
    assert all(session.place(one) is not None for one in session.labels.elements)
    for element in session.labels.elements:
        rows = [session.labels.find(element, 0, side) for side in SIDES]
        true = [[one for one in seen(street, row) if one is not None] for row in rows]
        assert set(true[0]) & set(true[1])
    assert not {one["id"] for one in sure} & {one["id"] for one in detector_offers(session, 0)}
    session.do(new_id(), {"kind": "undo"})
    look(session, 0)
    assert {one["id"] for one in sure} <= {one["id"] for one in detector_offers(session, 0)}
    session.close()


def seen(street: Street, row: Observation | None) -> list[int]:
    """The elements that a label lies on within 2 px."""
    assert row is not None
    marks, ids = street.labels(row.frame_index, row.side)
    drawn, end = Mark.of(row), marks.end_px
    found = []
    for n, name in enumerate(ids.tolist()):
        one = Mark(tuple(marks.anchor_px[n]), tuple(end[n]) if marks.is_line[n] else None)
        if drawn.gap_px(one) < 2.0:
            found.append(name)
    return found


def test_what_is_mapped_is_not_offered_again_as_something_new(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 3))
    finds = [true_finds(workspace.street, frame, SIDES) for frame in range(2)]
    save_proposals(finds[0].joined(finds[1]), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    accepted(session, 0, detector_offers(session, 0))
    look(session, 1)
    offers = session.frame(1)["offers"]
    mapped = [one for one in offers if one["origin"] == "map"]
    assert mapped
    for new in detector_offers(session, 1):
        for side in SIDES:
            near = [mark_of(one[side]) for one in mapped if side in one]
            if side in new:
                assert all(mark_of(new[side]).gap_px(one) >= 6.0 for one in near)
    assert len(detector_offers(session, 1)) < 0.3 * len(mapped)
    session.close()


def mark_of(offered: dict[str, Any]) -> Mark:
    return Mark(tuple(offered["anchor"]), offered["end"] and tuple(offered["end"]))


@st.composite
def marks(draw: st.DrawFn) -> tuple[str, int, tuple[float, float], tuple[float, float] | None]:
    """Side, class, anchor and end of something, often where something else is."""
    u = draw(st.sampled_from([400.0, 404.0, 420.0, 800.0]) | st.floats(20.0, 1200.0))
    v = draw(st.sampled_from([100.0, 103.0]) | st.floats(20.0, 200.0))
    class_id = draw(st.sampled_from([POLE, ROUNDED, TRIANGULAR]))
    end = (u + draw(st.floats(-4.0, 4.0)), v + draw(st.floats(20.0, 150.0)))
    side = draw(st.sampled_from(SIDES))
    return side, class_id, (u, v), end if class_id == POLE else None


@settings(max_examples=8, deadline=None)
@given(st.lists(marks(), max_size=4), st.lists(marks(), min_size=1, max_size=12, unique=True))
def test_whatever_a_detector_finds_what_a_person_drew_stays(
    drawn: list[tuple[Side, int, tuple[float, float], tuple[float, float] | None]],
    found: list[tuple[Side, int, tuple[float, float], tuple[float, float] | None]],
) -> None:
    """Also when all is accepted, of which nothing lies where something is labelled."""
    with TemporaryDirectory() as folder:
        workspace = Workspace.create_street(Path(folder) / "street", 7, range(0, 2))
        rows = [
            Proposal(new_id(), 0, side, class_id, at, end, True, end is not None, 0.9, 2.0)
            for side, class_id, at, end in found
        ]
        save_proposals(Proposals.of(rows), workspace.proposals_path)
        session = LabelSession(workspace, "tester")
        for side, class_id, at, end in drawn:
            one = {"kind": "draw", "observation_id": new_id(), "element_id": new_id()}
            where = {"frame_index": 0, "side": side, "anchor_px": at, "end_px": end}
            session.do(new_id(), one | where | {"class_id": class_id})
        before = dict(session.labels.observations)
        look(session, 0)
        for offer in detector_offers(session, 0):
            for row in before.values():
                shown = offer.get(row.side)
                assert shown is None or mark_of(shown).gap_px(Mark.of(row)) >= 6.0
        accepted(session, 0, session.frame(0)["offers"])
        assert before.items() <= dict(session.labels.observations).items()
        seen = [(row.element_id, row.side) for row in session.labels.in_frame(0)]
        assert len(seen) == len(set(seen))
        session.close()


def test_of_two_finds_of_one_place_the_surer_one_is_offered(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    found = [
        Proposal(
            new_id(), 0, "left", class_id, (700.0 + class_id, 120.0), None, True, False, s, 1.0
        )
        for class_id, s in ((ROUNDED, 0.5), (TRIANGULAR, 0.9))
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    (offer,) = detector_offers(session, 0)
    assert offer["class"] == TRIANGULAR
    session.close()


def learnt(session: LabelSession, frame: int) -> dict[str, Any]:
    """What the jump lists say of a frame."""
    while not session.learn(1.0)[1]:
        pass
    return next(one for one in session.summary()["frames"] if one["index"] == frame)


def test_where_detector_and_labels_disagree_is_told_the_worst_first(tmp_path: Path) -> None:
    """Planted: a find of nothing in frame 1, a pole in frame 2 that was labelled and not found."""
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 4))
    street = workspace.street
    see = careful(street, 1e-6, 0)
    labels = label_street(see, range(4), 4).labels
    with workspace.open_labels() as store:
        rows = tuple(labels.elements.values()), tuple(labels.observations.values())
        store.apply(ImportLabels(*rows), "tester")
        for frame in range(4):
            store.apply(ReviewFrame(frame, "reviewed"), "tester")
    poles = [row for row in labels.in_frame(2, "left") if row.end_px is not None]
    missed = max(poles, key=lambda row: row.end_px[1] - row.anchor_px[1])
    found = [
        one
        for frame in range(4)
        for side in SIDES
        for one in as_proposals(frame, side, see(frame, side).observed, street.rig.left, "true")
        if not any(
            row.side == side and np.hypot(*np.subtract(row.anchor_px, one.anchor_px)) < 1.0
            for row in labels.of_element(missed.element_id)
            if row.frame_index == frame == 2
        )
    ]
    planted = Proposal(new_id(), 1, "left", ROUNDED, (620.0, 330.0), None, True, False, 0.7, 1.0)
    planted = replace(planted, detector="true")
    looked = Looked("true", images=frozenset((frame, side) for frame in range(3) for side in SIDES))
    save_proposals(Proposals.of([*found, planted], looked), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    one, two, three = (learnt(session, frame)["disagreement"] for frame in (0, 1, 2))
    assert (one["new"], one["unseen"], one["weight"]) == (0, 0, 0.0)
    assert (two["new"], two["unseen"], two["weight"]) == (1, 0, 0.7)
    assert (three["new"], three["unseen"]) == (0, 1)
    assert three["worst_id"] == missed.element_id
    assert three["weight"] > two["weight"]
    assert "disagreement" not in learnt(session, 3)  # the detector did not look at it
    down = {"id": planted.id, "frame_index": 1, "side": "left", "why": "rejected"}
    session.do(new_id(), {"kind": "dismiss", "dismissals": [down | {"element_id": None}]})
    session.news()
    assert learnt(session, 1)["disagreement"]["weight"] == 0.0
    session.close()


@pytest.mark.parametrize("paired", [True, False])
def test_what_is_turned_down_does_not_come_back_as_another_find(
    tmp_path: Path, paired: bool
) -> None:
    """One thing that was found in both images, whether or not anybody knew that it is one."""
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    rows = true_finds(workspace.street, 0, SIDES).rows()
    if not paired:  # the same mark twice: two could be the partner
        rows += tuple(replace(row, id=new_id()) for row in rows)
    save_proposals(Proposals.of(rows), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    offers = [one for one in detector_offers(session, 0) if all(side in one for side in SIDES)]
    assert offers
    for offer in offers:
        down = [
            {"id": offer[side]["id"], "frame_index": 0, "side": side, "why": "rejected"}
            for side in SIDES
        ]
        down = [one | {"element_id": None} for one in down]
        session.do(new_id(), {"kind": "dismiss", "dismissals": down})
        look(session, 0)
        for other in detector_offers(session, 0):
            for side in SIDES:
                if side in other:
                    assert mark_of(other[side]).gap_px(mark_of(offer[side])) >= 6.0
    session.close()


def turned_down(session: LabelSession, frame: int, offer: dict[str, Any], why: str) -> None:
    """As the page turns an offer down."""
    down = [
        {"id": offer[side]["id"], "frame_index": frame, "side": side, "why": why}
        for side in SIDES
        if side in offer
    ]
    down = [one | {"element_id": None} for one in down]
    session.do(new_id(), {"kind": "dismiss", "dismissals": down})


def near(offers: list[dict[str, Any]], marks: dict[Side, Mark]) -> list[dict[str, Any]]:
    """Those that lie at marks, in each image."""
    return [
        one
        for one in offers
        if all(
            side in one and side in marks and mark_of(one[side]).gap_px(marks[side]) < 2.0
            for side in SIDES
        )
    ]


def test_what_is_turned_down_in_one_frame_is_not_sure_in_others(tmp_path: Path) -> None:
    """But it is proposed; and what is only hidden in one frame is as sure as it was in others."""
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 3))
    street = workspace.street
    finds = true_finds(street, 0, SIDES).joined(true_finds(street, 2, SIDES))
    save_proposals(finds, workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    look(session, 2)
    first, before = (surely(detector_offers(session, frame)) for frame in (0, 2))
    offer, there = next(
        (offer, there)
        for offer in first
        for element in at_mark(street, 0, "left", offer["left"])
        if near(before, there := true_marks(street, 2, element))
    )
    for why, stays in (("rejected", False), ("absent", False), ("occluded", True)):
        turned_down(session, 0, offer, why)
        (again,) = near(detector_offers(session, 2), there)
        assert again["sure"] == stays
        sure = {one["id"] for one in surely(detector_offers(session, 2))}
        assert sure >= {one["id"] for one in before} - {again["id"]}
        session.do(new_id(), {"kind": "undo"})
        assert surely(near(detector_offers(session, 2), there))
    session.close()


def surely(offers: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one for one in offers if one["sure"]]


def at_mark(street: Street, frame: int, side: Side, shown: dict[str, Any]) -> list[int]:
    """The elements within 2 px of a mark."""
    _, ids = street.labels(frame, side)
    marks = {one: true_marks(street, frame, one).get(side) for one in ids.tolist()}
    return [one for one, mark in marks.items() if mark and mark_of(shown).gap_px(mark) < 2.0]


def true_marks(street: Street, frame: int, element: int) -> dict[Side, Mark]:
    """Where an element is seen."""
    found: dict[Side, Mark] = {}
    for side in SIDES:
        marks, ids = street.labels(frame, side)
        for row in np.flatnonzero(ids == element):
            end = tuple(marks.end_px[row]) if marks.is_line[row] else None
            found[side] = Mark(tuple(marks.anchor_px[row]), end)
    return found


@pytest.mark.parametrize(
    ("origin", "depth_m", "sure"),
    [
        ("detector", 50.0, True),
        ("detector", 70.0, False),
        ("detector", None, True),
        ("map", 70.0, True),
    ],
)
def test_what_a_detector_found_too_far_ahead_to_label_is_never_sure(
    origin: Origin, depth_m: float | None, sure: bool
) -> None:
    offer = Offer("id", Pane(0, "left"), POLE, origin, "element", Mark((1.0, 2.0), (1.0, 50.0)))
    answered = offer.answered(Answer(Proposed(Mark((1.0, 2.0), (1.0, 50.0)), 0.9), None, depth_m))
    assert answered.sure == sure


@pytest.mark.parametrize(
    ("aside_px", "score", "seen"),
    [
        ((0.5, 0.5), 0.9, True),
        ((0.5, 3.0), 0.9, False),
        ((0.5, 0.5), 0.7, False),
        ((0.5,), 0.9, False),
    ],
)
def test_a_find_adds_the_peak_that_nobody_saw_before_and_moves_nothing_else(
    aside_px: tuple[float, ...], score: float, seen: bool
) -> None:
    """Where it lies on the line of what is followed in both images; in one, two may do so."""
    followed = Mark((500.0, 130.0), (500.0, 220.0), False, False)
    offers = [Offer(side, Pane(0, side), POLE, "map", "element", followed, 0.95) for side in SIDES]
    for side, aside in zip(SIDES, aside_px, strict=False):
        found = Mark((500.0 + aside, 110.0), (500.0 + aside, 223.0), True, True)
        offers.append(Offer("new", Pane(0, side), POLE, "detector", "thing", found, score))
    known = checked(offers, Labels())
    for one in known:
        peak = replace(followed, anchor_px=(500.5, 110.0), anchor_known=True)
        assert one.mark == (peak if seen else followed)
        assert one.element_id == "element"
    assert len(known) == 2
