"""Labelling without a browser: edits, undo, and updates for the page."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from annotator_page import SIDES
from drawn_marks import BOTTOM, PEAK, do, draw, pixel, pole, sign
from pydantic import ValidationError
from streets import street_workspace

from semviz.annotator.drawing.draft import DraftState, ElementDraft
from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.messages import DrawEdit
from semviz.annotator.proposals import image_worker
from semviz.annotator.session import LabelSession
from semviz.annotator.tracks.track_edits import AlignLabelsEdit
from semviz.annotator.views import FrameSummary
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.assist.snap import snap
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import LabelElement, new_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_annotation.storage.backup import backup_labels, restore_labels
from semviz_annotation.storage.label_file import LabelFileError
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.common.errors import SemvizError


@pytest.fixture
def session(tmp_path: Path) -> Iterator[LabelSession]:
    workspace = street_workspace(tmp_path / "street", 7, 6)
    session = LabelSession(workspace, "tester")
    yield session
    session.close()


def test_proposals_that_cannot_follow_the_labels_do_not_lock_them_out(tmp_path: Path) -> None:
    """Triangular signs of an older detector, by their box and without a height."""
    workspace = street_workspace(tmp_path / "street", 7, 6)
    older = Proposal(new_id(), 0, "left", TRIANGULAR, (300.0, 100.0), None, True, False, 0.9, 1.0)
    known = replace(older, id=new_id(), to_centroid_px=3.0)
    workspace.open_labels().close()  # they follow the centroid from then on
    save_proposals(Proposals.of([older, known]), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    try:
        assert session.labels.triangle_center == "centroid"
        assert session.left_out_proposals == 1
        assert Proposals.of([older, known]).usable("centroid").anchor_px[:, 1].tolist() == [103.0]
        assert len(Proposals.of([older, known]).usable("box")) == 2
    finally:
        session.close()


def test_marks_beside_the_image_or_far_from_it_are_no_error(session: LabelSession) -> None:
    """Found by random messages: OpenCV has no edges in an empty window, and squares overflow."""
    for class_id, end in ((ROUNDED, None), (POLE, (5.0, 9e4))):
        beside = ElementDraft("left", class_id, (-3.0, 9e4), end, snap=True)
        assert session.preview(DraftState(0, drawing=beside)).snapped is None
    half = ElementDraft("left", POLE, (300.0, 60.0), (5.0, 9e4), snap=True)
    session.preview(DraftState(0, drawing=half))
    for far in (1e308, -1e6):
        with pytest.raises(ValidationError, match="100000"):
            ElementDraft("left", POLE, (5.0, 5.0), (far, 5.0))
        with pytest.raises(ValidationError, match="100000"):
            DrawEdit(**sign(0, "left", (5.0, 5.0)) | {"anchor_px": (far, 5.0)})


def test_a_bottom_that_ends_above_the_ground_is_hidden(tmp_path: Path) -> None:
    """Only where it is asked for, and never where it is seen; what is far away may not be told."""
    workspace = street_workspace(tmp_path / "cars", 2, 8)
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
        for question in session.pending_queries(0):
            session.image_worker.search(question)
        (drawn,) = session.labels.of_element(element)
        marked[element] = edit
        judged.append((bool(seen.end_known[row]), drawn.end_known))
    assert sum(not truth for truth, _ in judged) >= 3
    assert all(said for truth, said in judged if truth)
    assert sum(not said for _, said in judged) >= 3
    hidden = next(
        element_id
        for element_id in marked
        if not session.labels.of_element(element_id)[0].end_known
    )
    do(session, {"kind": "delete element", "element_id": hidden})
    new = {"observation_id": new_id(), "element_id": new_id()}
    do(session, marked[hidden] | new)
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

    monkeypatch.setattr(image_worker, "snap", noted)
    edit = pole(session, 0, "left", snap=True)
    anchor, end = tuple(edit["anchor_px"]), tuple(edit["end_px"])
    for _ in range(2):
        session.preview(DraftState(0, drawing=ElementDraft("left", POLE, anchor, end, snap=True)))
    draw(session, edit)
    assert len(looks) == 1
    draw(session, pole(session, 0, "left", snap=True, shift_px=(60.0, 0.0)))
    draw(session, pole(session, 0, "right", snap=True, anchor_px=anchor, end_px=end))
    assert len(looks) == 3


def test_proposals_lie_where_the_element_is_in_other_frames(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    (proposed,) = session.frame(2).proposals
    assert proposed.id == first
    for side in ("left", "right"):
        np.testing.assert_allclose(
            proposed.marks[side].anchor, pixel(session, PEAK, 2, side), atol=1e-4
        )
        np.testing.assert_allclose(
            proposed.marks[side].end, pixel(session, BOTTOM, 2, side), atol=1e-4
        )
    assert session.frame(0).proposals == []


def test_the_same_request_is_done_once(session: LabelSession) -> None:
    request, edit = new_id(), pole(session, 0, "left")
    numbers = {do(session, edit, request).operation.number for _ in range(3)}
    assert numbers == {1}
    assert len(session.labels.observations) == 1


def test_undo_goes_to_the_frame_it_changes(session: LabelSession) -> None:
    draw(session, pole(session, 3, "left"))
    draw(session, pole(session, 0, "left"))
    assert do(session, {"kind": "undo"}).frame == 0
    assert do(session, {"kind": "undo"}).frame == 3
    assert session.labels.observations == {}
    assert do(session, {"kind": "redo"}).frame == 3


def test_deleting_says_what_falls(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    left = session.labels.in_frame(0, "left")[0]
    note = do(session, {"kind": "delete", "observation_id": left.id}).note
    assert note == "Deleted P-01 left. 1 view left. Ctrl Z brings it back."
    do(session, {"kind": "undo"})
    note = do(session, {"kind": "delete element", "element_id": first}).note
    assert note == "Deleted P-01 with 2 views in 1 frame. Ctrl Z brings all back."


def test_the_card_knows_depth_height_and_errors_before_anything_is_saved(
    session: LabelSession,
) -> None:
    first = draw(session, pole(session, 0, "left"))
    drawing = ElementDraft(
        side="right",
        class_id=POLE,
        anchor_px=pixel(session, PEAK, 0, "right"),
        end_px=pixel(session, BOTTOM, 0, "right"),
    )
    seen = session.preview(DraftState(frame_index=0, selected_id=first, drawing=drawing))
    assert seen.joins == "P-01"
    card = seen.card
    assert card.depth_m == pytest.approx(14.0, abs=1e-6)
    assert card.height_m == pytest.approx(2.8, abs=1e-6)
    assert card.epipolar_px == pytest.approx(0.0, abs=1e-6)
    assert card.views == 2
    assert card.depth_sigma_m > 0.0
    assert len(session.labels.observations) == 1


def test_guides_run_through_the_correspondence(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    guides = session.preview(DraftState(frame_index=0, selected_id=first, side="left")).guides
    assert guides["left"] == []
    for guide, point in zip(guides["right"], (PEAK, BOTTOM), strict=True):
        (near, far), correspondence = np.array(guide.plausible), pixel(session, point, 0, "right")
        along = (correspondence - near) @ (far - near) / ((far - near) @ (far - near))
        assert 0.0 < along < 1.0
        np.testing.assert_allclose(near + along * (far - near), correspondence, atol=1e-6)


def test_history_reads_like_what_was_done(session: LabelSession) -> None:
    draw(session, pole(session, 0, "left"))
    do(session, {"kind": "review", "frame_index": 0, "state": "reviewed"})
    do(session, {"kind": "undo"})
    summary = session.summary()
    texts = [entry.text for entry in summary.history]
    assert texts == ["Undo 2", "Frame 0 reviewed", "Draw P-01 left"]
    assert summary.operation == 3
    assert summary.frames[0] == FrameSummary(index=0, state="in work", elements=1)


@pytest.mark.parametrize(("count", "told"), [(1, "Import O-01 left"), (3, "Import 3 elements")])
def test_history_counts_what_came_at_once(session: LabelSession, count: int, told: str) -> None:
    elements = tuple(LabelElement(new_id(), 1 + row, ROUNDED) for row in range(count))
    rows = tuple(
        Mark((300.0 + 50.0 * row, 120.0), None, True, False).at(0, "left", new_id(), element.id)
        for row, element in enumerate(elements)
    )
    with session.workspace.open_labels() as store:
        store.apply(ImportLabels(elements, rows), "somebody else")
    session.updates()
    assert [entry.text for entry in session.summary().history] == [told]


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        ({"kind": "paint"}, "not a message of this page"),
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
        do(session, edit)
    assert session.summary().operation == 0


def test_expected_passed_and_old_elements_are_not_listed_as_nearby(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 12)
    session = LabelSession(workspace, "tester")
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    once = draw(session, sign(0, "left", (700.0, 120.0)))
    proposed = {
        frame: {proposal.id for proposal in session.frame(frame).nearby} for frame in range(12)
    }
    expected = {
        frame: {proposal.id for proposal in session.frame(frame).proposals} for frame in range(12)
    }
    assert expected[1] == {first}
    assert all(first not in ids for ids in proposed.values())
    assert [once in proposed[frame] for frame in range(12)] == [False] + [True] * 5 + [False] * 6
    session.close()


def test_updates_contain_changes_of_another_process(session: LabelSession) -> None:
    session.updates()
    assert not session.has_updates()
    other = LabelSession(session.workspace, "somebody else")
    draw(other, pole(other, 4, "left"))
    other.close()
    assert session.has_updates()
    updates = session.updates()
    assert updates.frames == [FrameSummary(index=4, state="in work", elements=1)]
    assert updates.operation == 1
    assert not session.has_updates()


def test_updates_follow_when_all_elements_are_triangulated(
    session: LabelSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a large label file a page first gets those that are placed in no time."""
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    monkeypatch.setattr(ElementPositions.update, "__defaults__", (0.0,))
    again = LabelSession(session.workspace, "tester")
    again.updates()
    assert (again.summary().mapped, again.has_updates()) == (0, False)
    while not again.analyze(1.0):
        pass
    assert again.has_updates()
    assert (again.updates().mapped, again.has_updates()) == (1, False)
    again.close()


def test_what_was_analyzed_before_an_edit_is_sent_as_it_is_after_it(session: LabelSession) -> None:
    """Pages get the analysis twice a second: an edit meanwhile must not be undone on them."""
    drawn = draw(session, pole(session, 0, "left"))
    session.tracks.known()  # a page looks at them
    while not session.analyze(1.0):
        pass
    do(session, {"kind": "review", "frame_index": 0, "state": "reviewed"})
    draw(session, pole(session, 0, "right", drawn))
    session.updates()
    assert [row.views for row in session.tracks.changed() if row.id == drawn] == [2]
    assert {frame.index: frame.state for frame in session.take_assessed()}[0] == "reviewed"
    assert (session.take_assessed(), session.tracks.take_collected()) == ([], [])


def test_labels_that_were_put_back_are_shown_and_labelled_on(
    session: LabelSession, tmp_path: Path
) -> None:
    draw(session, pole(session, 0, "left"))
    backup_labels(session.workspace.labels_path, tmp_path / "backup.db")
    for frame in (1, 2):
        draw(session, sign(frame, "left", (700.0, 120.0)))
    session.updates()
    restore_labels(session.workspace.labels_path, tmp_path / "backup.db")
    assert session.has_updates()
    updates = session.updates()
    assert (updates.operation, len(updates.history)) == (1, 1)
    assert {frame.index: frame.elements for frame in updates.frames} == dict.fromkeys(
        range(6), 0
    ) | {0: 1}
    draw(session, sign(3, "left", (700.0, 120.0)))
    assert session.updates().operation == 2


def test_what_a_detector_found_is_proposed_until_it_is_labelled(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 2)
    places = {"aside": (700.0, 120.0), "labelled": (300.0, 150.0)}
    found = [
        Proposal(new_id(), 0, "left", ROUNDED, place, None, True, False, 0.9, 1.0)
        for place in places.values()
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    draw(session, sign(0, "left", (303.0, 152.0)))  # by a person, about where the detector's is
    (proposal,) = [
        proposal for proposal in session.frame(0).proposals if proposal.origin == "detector"
    ]
    assert (proposal.marks["left"].id, proposal.score, proposal.is_confident) == (
        found[0].id,
        None,
        False,
    )
    assert session.frame(0).is_searching
    for question in session.pending_queries(0):
        session.image_worker.search(question)
    assert not session.frame(0).is_searching
    (proposal,) = [
        proposal for proposal in session.frame(0).proposals if proposal.origin == "detector"
    ]
    assert 0.0 < proposal.score < 1.0
    drawn = sign(0, "left", places["aside"], observation_id=found[0].id)
    mark = {name: drawn[name] for name in drawn.keys() - {"kind", "selected_id"}}
    do(session, {"kind": "accept", "marks": [mark]})
    assert session.labels.observations[found[0].id].anchor_px == places["aside"]
    origins = {proposal.origin for proposal in session.frame(0).proposals}
    assert "detector" not in origins
    session.close()


def test_of_marks_accepted_together_what_others_labelled_meanwhile_is_left_out(
    session: LabelSession,
) -> None:
    element_id = draw(session, pole(session, 0, "left"))

    def accept(*frames: int) -> dict[str, object]:
        drawn = [pole(session, frame, "left") for frame in frames]
        fields = drawn[0].keys() - {"kind", "selected_id"}
        known = {"element_id": element_id, "class_id": None}
        marks = [{name: mark[name] for name in fields} | known for mark in drawn]
        return {"kind": "accept", "marks": marks}

    together = accept(1, 2, 3)
    theirs = do(session, pole(session, 2, "left", element_id)).operation.number
    accepted = do(session, together)
    assert accepted.note == "1 of 3 were labelled meanwhile: theirs stay."
    assert (accepted.added, accepted.operation.number) == (2, theirs + 1)
    assert {row.frame_index for row in session.labels.of_element(element_id)} == {0, 1, 2, 3}
    with pytest.raises(SemvizError, match="already labelled in this left image"):
        do(session, accept(2))


def test_labels_put_back_with_other_triangles_must_be_reopened(
    session: LabelSession, tmp_path: Path
) -> None:
    with LabelStore.open(tmp_path / "box.db", triangle_center="box"):
        pass
    edit = pole(session, 0, "left")
    restore_labels(session.workspace.labels_path, tmp_path / "box.db")
    with pytest.raises(LabelFileError, match="reopen"):
        draw(session, edit)
    with pytest.raises(LabelFileError, match="reopen"):
        session.frame(0)
    again = LabelSession(session.workspace, "tester")
    draw(again, edit)
    again.close()


@pytest.mark.parametrize("off_px", [2.5, -2.5])
def test_labels_of_far_frames_are_aligned_to_the_nearest_view_in_one_operation(
    session: LabelSession, off_px: float
) -> None:
    """An offset that was followed from the first drawing; and a pole labelled by half."""
    street, frames = session.workspace.street, (0, 1, 5)
    seen = {(frame, side): street.labels(frame, side) for frame in frames for side in SIDES}
    element = _whole_pole_in_all(seen)
    ids: dict[tuple[int, str], str] = {}
    element_id = None
    for (frame, side), (marks, numbers) in seen.items():
        (row,) = np.flatnonzero(numbers == element)
        peak, bottom = marks.anchor_px[row].copy(), marks.end_px[row].copy()
        if frame < 5:
            peak += 0.5 * (bottom - peak) + [off_px, 0.0]
            bottom += [off_px, 0.0]
        edit = pole(session, frame, side, anchor_px=peak.tolist(), end_px=bottom.tolist())
        edit |= {"selected_id": element_id, "is_chosen": element_id is not None}
        element_id = draw(session, edit)
        ids[frame, side] = edit["observation_id"]
    preview = session.preview(DraftState(5, selected_id=element_id))
    assert preview.card is not None
    assert preview.card.smaller_views == 4
    before = dict(session.labels.observations)
    edit = {"kind": "align labels", "element_id": element_id, "frame_index": 5}
    asked = AlignLabelsEdit(kind="align labels", element_id=element_id, frame_index=5)
    for query in session.queries_of(asked):
        session.image_worker.search(query)
    with pytest.MonkeyPatch.context() as patch:  # all is searched by then, without the lock
        patch.setattr(session.image_worker, "search", None)
        saved = do(session, edit)
    assert saved.note.startswith("Aligned 4 labels to this view")
    for (frame, side), id_ in ids.items():
        marks, numbers = seen[frame, side]
        (row,) = np.flatnonzero(numbers == element)
        label = session.labels.observations[id_]
        off = np.abs(
            np.array([label.anchor_px, label.end_px]) - [marks.anchor_px[row], marks.end_px[row]]
        )
        assert off[:, 0].max() < 1.0, (frame, side)
        assert off[:, 1].max() < 3.0, (frame, side)
    with pytest.raises(SemvizError, match="no label moves"):
        do(session, edit)
    with pytest.raises(SemvizError, match="label it in this frame first"):
        do(session, edit | {"frame_index": 3})
    do(session, {"kind": "undo"})
    assert session.labels.observations == before


def _whole_pole_in_all(seen: dict[tuple[int, str], Any]) -> int:
    """The pole with both ends in all images that is longest in the last."""
    whole = [
        set(ids[marks.is_line & marks.anchor_known & marks.end_known].tolist())
        for marks, ids in seen.values()
    ]
    marks, ids = list(seen.values())[-1]
    lengths = np.linalg.norm(marks.end_px - marks.anchor_px, axis=1)
    common = set.intersection(*whole)
    return max(common, key=lambda id_: lengths[ids.tolist().index(id_)])
