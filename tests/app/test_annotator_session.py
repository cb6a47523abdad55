"""What labelling does, without a browser: edits, undo, and what the page is told."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import BOTTOM, PEAK, draw, pixel, pole, sign

from semviz.annotator import looker
from semviz.annotator.places import Places
from semviz.annotator.session import Drawing, LabelSession, Look
from semviz.workspace import Workspace
from semviz_annotation.assist.shot import Mark
from semviz_annotation.assist.snap import snap
from semviz_annotation.formats.plan import ImportLabels
from semviz_annotation.labels import LabelElement, new_id
from semviz_annotation.proposals import Proposal, Proposals, save_proposals
from semviz_annotation.storing.backup import backup_labels, restore_labels
from semviz_core.classes import POLE, ROUNDED
from semviz_core.errors import SemvizError


@pytest.fixture
def session(tmp_path: Path) -> Iterator[LabelSession]:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 6))
    session = LabelSession(workspace, "tester")
    yield session
    session.close()


def test_a_bottom_that_ends_above_the_ground_is_hidden(tmp_path: Path) -> None:
    """Only where it is asked for, and never where it is seen; what is far away may not be told."""
    workspace = Workspace.create_street(tmp_path / "cars", 2, range(0, 8))
    session = LabelSession(workspace, "tester")
    street = workspace.street
    seen, ids = street.labels(0, "left")
    right = set(street.labels(0, "right")[1].tolist())
    marked, judged = {}, []
    for row in np.flatnonzero(seen.is_line & seen.anchor_known):
        if int(ids[row]) not in right or seen.end_px[row, 1] > street.rig.left.height - 3:
            continue
        ends = {"anchor_px": seen.anchor_px[row].tolist(), "end_px": seen.end_px[row].tolist()}
        edit = pole(session, 0, "left", snap=True, **ends)
        element = draw(session, edit | {"asks_bottom": True})
        for question in session.unanswered(0):
            session.looker.answer(question)
        (drawn,) = session.labels.of_element(element)
        marked[element] = edit
        judged.append((bool(seen.end_known[row]), drawn.end_known))
    assert sum(not truth for truth, _ in judged) >= 3
    assert all(said for truth, said in judged if truth)
    assert sum(not said for _, said in judged) >= 3
    hidden = next(one for one in marked if not session.labels.of_element(one)[0].end_known)
    session.do(new_id(), {"kind": "delete element", "element_id": hidden})
    new = {"observation_id": new_id(), "element_id": new_id()}
    session.do(new_id(), marked[hidden] | new)
    said = session.labels.observations[new["observation_id"]]
    assert said.end_known, "whoever says what is seen is believed"
    session.close()


def test_what_is_shown_and_then_saved_is_looked_for_once(
    session: LabelSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[object] = []

    def noted(shot: Any, mark: Any, element_class: Any) -> Any:
        looks.append(mark)
        return snap(shot, mark, element_class)

    monkeypatch.setattr(looker, "snap", noted)
    edit = pole(session, 0, "left", snap=True)
    anchor, end = tuple(edit["anchor_px"]), tuple(edit["end_px"])
    for _ in range(2):
        session.look(Look(0, drawing=Drawing("left", POLE, anchor, end, snap=True)))
    draw(session, edit)
    assert len(looks) == 1
    draw(session, pole(session, 0, "left", snap=True, shift_px=(60.0, 0.0)))
    draw(session, pole(session, 0, "right", snap=True, anchor_px=anchor, end_px=end))
    assert len(looks) == 3


def test_ghosts_lie_where_the_element_is_in_other_frames(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    (ghost,) = session.frame(2)["offers"]
    assert ghost["id"] == first
    for side in ("left", "right"):
        np.testing.assert_allclose(ghost[side]["anchor"], pixel(session, PEAK, 2, side), atol=1e-4)
        np.testing.assert_allclose(ghost[side]["end"], pixel(session, BOTTOM, 2, side), atol=1e-4)
    assert session.frame(0)["offers"] == []


def test_the_same_request_is_done_once(session: LabelSession) -> None:
    request, edit = new_id(), pole(session, 0, "left")
    numbers = {session.do(request, edit).operation.number for _ in range(3)}
    assert numbers == {1}
    assert len(session.labels.observations) == 1


def test_undo_goes_to_the_frame_it_changes(session: LabelSession) -> None:
    draw(session, pole(session, 3, "left"))
    draw(session, pole(session, 0, "left"))
    assert session.do(new_id(), {"kind": "undo"}).frame == 0
    assert session.do(new_id(), {"kind": "undo"}).frame == 3
    assert session.labels.observations == {}
    assert session.do(new_id(), {"kind": "redo"}).frame == 3


def test_deleting_says_what_falls(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    left = session.labels.in_frame(0, "left")[0]
    note = session.do(new_id(), {"kind": "delete", "observation_id": left.id}).note
    assert note == "Deleted P-01 left. 1 view left. Ctrl Z brings it back."
    session.do(new_id(), {"kind": "undo"})
    note = session.do(new_id(), {"kind": "delete element", "element_id": first}).note
    assert note == "Deleted P-01 with 2 views in 1 frame. Ctrl Z brings all back."


def test_the_card_knows_depth_height_and_errors_before_anything_is_saved(
    session: LabelSession,
) -> None:
    first = draw(session, pole(session, 0, "left"))
    drawing = Drawing(
        side="right",
        class_id=POLE,
        anchor_px=pixel(session, PEAK, 0, "right"),
        end_px=pixel(session, BOTTOM, 0, "right"),
    )
    seen = session.look(Look(frame_index=0, selected_id=first, drawing=drawing))
    assert seen["joins"] == "P-01"
    card = seen["card"]
    assert card["depth_m"] == pytest.approx(14.0, abs=1e-6)
    assert card["height_m"] == pytest.approx(2.8, abs=1e-6)
    assert card["epipolar_px"] == pytest.approx(0.0, abs=1e-6)
    assert card["views"] == 2
    assert card["depth_sigma_m"] > 0.0
    assert len(session.labels.observations) == 1


def test_guides_run_through_the_partner(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    guides = session.look(Look(frame_index=0, selected_id=first, side="left"))["guides"]
    assert guides["left"] == []
    for guide, point in zip(guides["right"], (PEAK, BOTTOM), strict=True):
        (near, far), partner = np.array(guide["plausible"]), pixel(session, point, 0, "right")
        along = (partner - near) @ (far - near) / ((far - near) @ (far - near))
        assert 0.0 < along < 1.0
        np.testing.assert_allclose(near + along * (far - near), partner, atol=1e-6)


def test_history_reads_like_what_was_done(session: LabelSession) -> None:
    draw(session, pole(session, 0, "left"))
    session.do(new_id(), {"kind": "review", "frame_index": 0, "state": "reviewed"})
    session.do(new_id(), {"kind": "undo"})
    summary = session.summary()
    texts = [entry["text"] for entry in summary["history"]]
    assert texts == ["Undo 2", "Frame 0 reviewed", "Draw P-01 left"]
    assert summary["operation"] == 3
    assert summary["frames"][0] == {"index": 0, "state": "in work", "elements": 1}


@pytest.mark.parametrize(("count", "told"), [(1, "Import O-01 left"), (3, "Import 3 elements")])
def test_history_counts_what_came_at_once(session: LabelSession, count: int, told: str) -> None:
    elements = tuple(LabelElement(new_id(), 1 + row, ROUNDED) for row in range(count))
    rows = tuple(
        Mark((300.0 + 50.0 * row, 120.0), None, True, False).at(0, "left", new_id(), one.id)
        for row, one in enumerate(elements)
    )
    with session.workspace.open_labels() as store:
        store.apply(ImportLabels(elements, rows), "somebody else")
    session.news()
    assert [entry["text"] for entry in session.summary()["history"]] == [told]


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        ({"kind": "paint"}, "not an edit"),
        (sign(0, "left", (5000.0, 10.0)), "outside the left image"),
        (sign(77, "left", (50.0, 10.0)), "frame 77 is not in this sequence"),
        (sign(0, "left", (50.0, 10.0)) | {"end_px": [1.0, 2.0]}, "has one point"),
        ({"kind": "delete", "observation_id": new_id()}, "no observation"),
    ],
)
def test_nonsense_is_refused_and_leaves_nothing(
    session: LabelSession, edit: dict[str, Any], reason: str
) -> None:
    with pytest.raises(SemvizError, match=reason):
        session.do(new_id(), edit)
    assert session.summary()["operation"] == 0


def test_what_is_expected_or_passed_or_labelled_long_ago_is_not_offered(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 12))
    session = LabelSession(workspace, "tester")
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    once = draw(session, sign(0, "left", (700.0, 120.0)))
    offered = {frame: {one["id"] for one in session.frame(frame)["nearby"]} for frame in range(12)}
    expected = {frame: {one["id"] for one in session.frame(frame)["offers"]} for frame in range(12)}
    assert expected[1] == {first}
    assert all(first not in ids for ids in offered.values())
    assert [once in offered[frame] for frame in range(12)] == [False] + [True] * 5 + [False] * 6
    session.close()


def test_news_tell_what_another_process_did(session: LabelSession) -> None:
    session.news()
    assert not session.has_news()
    other = LabelSession(session.workspace, "somebody else")
    draw(other, pole(other, 4, "left"))
    other.close()
    assert session.has_news()
    news = session.news()
    assert news["frames"] == [{"index": 4, "state": "in work", "elements": 1}]
    assert news["operation"] == 1
    assert not session.has_news()


def test_news_tell_when_all_elements_have_their_places(
    session: LabelSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a large label file a page first gets those that are placed in no time."""
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    monkeypatch.setattr(Places.settle, "__defaults__", (0.0,))
    again = LabelSession(session.workspace, "tester")
    again.news()
    assert (again.summary()["mapped"], again.has_news()) == (0, False)
    while not again.learn(1.0)[1]:
        pass
    assert again.has_news()
    assert (again.news()["mapped"], again.has_news()) == (1, False)
    again.close()


def test_labels_that_were_put_back_are_shown_and_labelled_on(
    session: LabelSession, tmp_path: Path
) -> None:
    draw(session, pole(session, 0, "left"))
    backup_labels(session.workspace.labels_path, tmp_path / "backup.db")
    for frame in (1, 2):
        draw(session, sign(frame, "left", (700.0, 120.0)))
    session.news()
    restore_labels(session.workspace.labels_path, tmp_path / "backup.db")
    assert session.has_news()
    news = session.news()
    assert (news["operation"], len(news["history"])) == (1, 1)
    assert {one["index"]: one["elements"] for one in news["frames"]} == dict.fromkeys(
        range(6), 0
    ) | {0: 1}
    draw(session, sign(3, "left", (700.0, 120.0)))
    assert session.news()["operation"] == 2


def test_what_a_detector_found_is_proposed_until_it_is_labelled(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    places = {"aside": (700.0, 120.0), "labelled": (300.0, 150.0)}
    found = [
        Proposal(new_id(), 0, "left", ROUNDED, place, None, True, False, 0.9, 1.0)
        for place in places.values()
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    draw(session, sign(0, "left", (303.0, 152.0)))  # by a person, about where the detector's is
    (offer,) = [one for one in session.frame(0)["offers"] if one["origin"] == "detector"]
    assert (offer["left"]["id"], offer["score"], offer["sure"]) == (found[0].id, None, False)
    assert session.frame(0)["looking"]
    for question in session.unanswered(0):
        session.looker.answer(question)
    assert not session.frame(0)["looking"]
    (offer,) = [one for one in session.frame(0)["offers"] if one["origin"] == "detector"]
    assert 0.0 < offer["score"] < 1.0
    mark = sign(0, "left", places["aside"], observation_id=found[0].id)
    session.do(new_id(), {"kind": "accept", "marks": [mark]})
    assert session.labels.observations[found[0].id].anchor_px == places["aside"]
    origins = {one["origin"] for one in session.frame(0)["offers"]}
    assert "detector" not in origins
    session.close()
