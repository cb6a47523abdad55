"""Tracks of detections: accepted, corrected and rejected as a whole, and what stays rejected."""

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from drawn_marks import do
from journeys.driver import LabelDriver
from streets import street_workspace
from tracked_detections import FALSE, detect_and_map, track_id

from semviz.annotator.map_review import ReviewEntry
from semviz.annotator.messages import ApplyEditRequest, ShowReviewRequest
from semviz.annotator.page_session import HANDLERS
from semviz.annotator.panes import Cameras
from semviz.annotator.proposals.proposal_views import ProposalView
from semviz.annotator.server import Annotator
from semviz.annotator.session import LabelSession
from semviz.annotator.tracks.detection_tracks import DetectionTrack, DetectionTracks, OpenTracks
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import load_proposals
from semviz_annotation.labels.rows import RowChange, review_decision
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 5
Found = dict[int, list[Proposal]]


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, Found]:
    workspace = street_workspace(tmp_path_factory.mktemp("tracked") / "street", 7, FRAMES)
    return workspace, detect_and_map(workspace, range(FRAMES))


@pytest.fixture
def found(tracked: tuple[Workspace, Found]) -> Found:
    return tracked[1]


@pytest.fixture
def workspace(tracked: tuple[Workspace, Found]) -> Iterator[Workspace]:
    """Its labels are gone at the end."""
    yield tracked[0]
    for file in tracked[0].path.glob("labels.db*"):
        file.unlink()


@pytest.fixture
def session(workspace: Workspace) -> Iterator[LabelSession]:
    session = opened(workspace)
    yield session
    session.close()


def opened(workspace: Workspace) -> LabelSession:
    session = LabelSession(workspace, "tester")
    session.map_work.refresh()
    session.map_work.wait_for_first()
    assert session.map_work.failure == ""
    return session


def accept(*rows: list[Proposal], **more: object) -> dict[str, object]:
    return {"kind": "accept tracks", "track_ids": [track_id(row) for row in rows]} | more


def reject(*rows: list[Proposal]) -> dict[str, object]:
    return {"kind": "reject tracks", "track_ids": [track_id(row) for row in rows]}


def proposed(session: LabelSession, frame: int) -> dict[str, ProposalView]:
    return {proposal.id: proposal for proposal in session.frame(frame).proposals}


def longest(found: Found) -> list[Proposal]:
    """The true pole or sign with the most detections."""
    return max((rows for name, rows in found.items() if name != FALSE), key=len)


def rows_of(labels: Labels, rows: list[Proposal]) -> dict[str, tuple[object, ...]]:
    return {
        row.id: (row.frame_index, row.side, row.anchor_px, row.end_px)
        for row in labels.of_element(track_id(rows))
    }


def test_every_frame_shows_the_tracks_that_were_detected_there(
    session: LabelSession, found: Found
) -> None:
    for frame in range(FRAMES):
        shown = {id_: view for id_, view in proposed(session, frame).items() if view.track}
        here = [rows for rows in found.values() if any(row.frame_index == frame for row in rows)]
        assert set(shown) == {track_id(rows) for rows in here}
    rows = longest(found)
    view = proposed(session, 2)[track_id(rows)]
    assert (view.track.frames, view.track.first, view.track.last) == (FRAMES, 0, FRAMES - 1)
    assert view.track.residual_px < 0.01
    assert {mark.id for mark in view.marks.values()} <= {row.id for row in rows}
    assert view.is_confident
    assert not session.pending_queries(2)  # a track needs no search in images


def test_accepting_a_track_labels_all_its_images_in_one_operation(
    session: LabelSession, found: Found
) -> None:
    rows, before = longest(found), session.summary()
    saved = do(session, accept(rows))
    assert (saved.operation.number, saved.added) == (1, len(rows))
    assert saved.note == f"Accepted P-01 in {FRAMES} frames. Ctrl Z undoes it."
    assert rows_of(session.labels, rows) == {
        row.id: (row.frame_index, row.side, row.anchor_px, row.end_px) for row in rows
    }
    assert session.summary().map.tracks == before.map.tracks - 1
    assert all(track_id(rows) not in proposed(session, frame) for frame in range(FRAMES))
    assert session.summary().history[0].text == "Accept P-01"
    do(session, {"kind": "undo"})
    assert session.labels == Labels()
    assert session.summary().map.tracks == before.map.tracks
    assert track_id(rows) in proposed(session, 0)
    do(session, {"kind": "redo"})
    assert len(session.labels.of_element(track_id(rows))) == len(rows)


def test_a_rejected_track_is_known_and_neither_shown_nor_proposed(
    session: LabelSession, found: Found
) -> None:
    rows = found[FALSE]
    saved = do(session, reject(rows))
    assert saved.note == (
        f"Rejected P-01 in {FRAMES} frames: no map will have it. Ctrl Z undoes it."
    )
    element_id = track_id(rows)
    assert session.labels.decisions_of(element_id) == (review_decision(element_id, "leave out"),)
    for frame in range(FRAMES):
        assert element_id not in proposed(session, frame)
        (element,) = session.frame(frame).elements
        assert element.left_out
        assert session.labels.review(frame) == "unseen"
    assert session.summary().counts == {}
    assert [frame.elements for frame in session.summary().frames] == [0] * FRAMES
    assert len(session.scene.elements()) == session.summary().mapped == 0
    do(session, {"kind": "review", "frame_index": 0, "state": "reviewed, empty"})
    do(session, {"kind": "undo"})
    do(session, {"kind": "undo"})
    assert session.labels == Labels()
    assert element_id in proposed(session, 0)


def test_what_was_rejected_is_not_proposed_in_frames_that_the_track_lacked(
    tmp_path: Path,
) -> None:
    """A later pass of the detector finds it again, and no map tells."""
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    found = detect_and_map(workspace, range(FRAMES), track_frames=range(3))
    with_false = opened(workspace)
    late = [row.id for row in found[FALSE] if row.frame_index == FRAMES - 1]
    assert late
    do(with_false, reject([row for row in found[FALSE] if row.frame_index < 3]))
    workspace.map_path(MAIN).unlink()
    with_false.map_work.refresh()
    with_false.map_work._pool.submit(lambda: None).result()
    assert not set(late) & marks_in(with_false, FRAMES - 1)
    do(with_false, {"kind": "undo"})
    assert set(late) & marks_in(with_false, FRAMES - 1)  # the fault that rejecting prevents
    with_false.close()


def test_a_detection_on_an_open_track_waits_for_it(tmp_path: Path) -> None:
    """It lies where the track is expected, in a frame that the track lacks."""
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    found = detect_and_map(workspace, range(FRAMES), track_frames=range(3))
    session = opened(workspace)
    late = {row.id for rows in found.values() for row in rows if row.frame_index == 4}
    tracked = {row.id for rows in found.values() for row in rows if any(
        other.frame_index < 3 for other in rows)}  # fmt: skip
    assert late & tracked
    assert not late & tracked & marks_in(session, 4)
    assert late - tracked <= marks_in(session, 4)
    do(session, accept([row for row in found[FALSE] if row.frame_index < 3]))
    (view,) = [view for view in proposed(session, 4).values() if view.id == track_id(found[FALSE])]
    assert view.origin == "map"
    session.close()


def test_what_was_rejected_never_returns_however_often_the_map_is_built(tmp_path: Path) -> None:
    frames = 8
    workspace = street_workspace(tmp_path / "street", 7, frames)
    false = {row.id for row in detect_and_map(workspace, range(frames))[FALSE]}
    session = opened(workspace)
    rebuilt(session)
    (track,) = [track for track in open_tracks(session) if false & ids(track)]
    others = {frozenset(ids(other)) for other in open_tracks(session)} - {frozenset(ids(track))}
    assert others
    do(session, {"kind": "reject tracks", "track_ids": [track.id]})
    for _ in range(2):
        rebuilt(session)
        assert not any(false & ids(other) for other in open_tracks(session))
        assert {frozenset(ids(other)) for other in open_tracks(session)} == others
        assert not any(false & marks_in(session, frame) for frame in range(frames))
    do(session, {"kind": "undo"})  # the fault that rejecting prevents
    rebuilt(session)
    assert any(false & ids(other) for other in open_tracks(session))
    session.close()


def test_accepted_tracks_are_labels_of_the_next_map(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 8)
    detect_and_map(workspace, range(8))
    session = opened(workspace)
    rebuilt(session)
    sure = session.summary().map.sure_tracks
    do(session, {"kind": "accept sure tracks", "count": sure})
    rebuilt(session)
    assert session.summary().map.sure_tracks == 0
    in_map = {id_ for source in workspace.read_map(MAIN).provenance for id_ in source.label_ids}
    assert set(session.labels.elements) <= in_map
    session.close()


def rebuilt(session: LabelSession) -> None:
    """As *Build map* does."""
    session.map_work.build()
    session.map_work._pool.submit(lambda: None).result()
    assert session.map_work.failure == ""


def open_tracks(session: LabelSession) -> tuple[DetectionTrack, ...]:
    return session._reviews.tracks().of(session.labels)


def ids(track: DetectionTrack) -> set[str]:
    return {row.id for row in track.detections}


def marks_in(session: LabelSession, frame: int) -> set[str]:
    views = proposed(session, frame).values()
    return {mark.id for view in views for mark in view.marks.values()}


def test_a_correction_in_one_image_is_accepted_with_the_detections_of_the_others(
    session: LabelSession, found: Found
) -> None:
    rows = found[FALSE]
    corrected = {"observation_id": rows[2].id, "anchor_px": (500.5, 60.0), "end_px": (501.0, 200.0)}
    do(session, accept(rows, corrections=[corrected]))
    for row in rows:
        label = session.labels.observation(row.id)
        is_corrected = row is rows[2]
        assert label.anchor_px == ((500.5, 60.0) if is_corrected else row.anchor_px)
        assert label.end_px == ((501.0, 200.0) if is_corrected else row.end_px)


def test_images_with_a_label_or_a_dismissal_there_are_skipped(
    session: LabelSession, found: Found
) -> None:
    rows = found[FALSE]
    first, second = rows[0], rows[1]
    drawn = {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": first.frame_index,
        "side": first.side,
        "anchor_px": first.anchor_px,
        "end_px": first.end_px,
        "class_id": first.class_id,
    }
    do(session, drawn)
    dismissal = {"id": second.id, "frame_index": second.frame_index, "side": second.side}
    dismissal |= {"why": "rejected", "element_id": None}
    do(session, {"kind": "dismiss", "dismissals": [dismissal]})
    do(session, accept(rows))
    assert set(rows_of(session.labels, rows)) == {row.id for row in rows[2:]}
    assert len(session.labels.observations) == len(rows) - 1
    assert second.id in session.labels.dismissals


def test_a_track_is_settled_once_and_by_its_id(session: LabelSession, found: Found) -> None:
    rows = longest(found)
    do(session, accept(rows))
    with pytest.raises(SemvizError, match="already"):
        do(session, accept(rows))
    with pytest.raises(SemvizError, match="already"):
        do(session, reject(rows))
    with pytest.raises(SemvizError, match="no such track"):
        do(session, {"kind": "accept tracks", "track_ids": [new_id()]})
    with pytest.raises(SemvizError, match="already"):  # all or none
        do(session, accept(found[FALSE], rows))
    assert len(session.labels.elements) == 1


def test_sure_tracks_are_accepted_together_if_there_are_as_many_as_were_shown(
    session: LabelSession, found: Found
) -> None:
    shown = session.summary().map
    assert 1 < shown.sure_tracks < shown.tracks == len(found)
    with pytest.raises(SemvizError, match=f"{shown.sure_tracks} tracks are sure now, not 1"):
        do(session, {"kind": "accept sure tracks", "count": 1})
    saved = do(session, {"kind": "accept sure tracks", "count": shown.sure_tracks})
    assert saved.note.startswith(f"Accepted {shown.sure_tracks} tracks in {FRAMES} frames")
    assert saved.operation.number == 1
    frames = {id_: len(session.labels.of_element(id_)) for id_ in session.labels.elements}
    assert len(frames) == shown.sure_tracks
    assert session.summary().map.sure_tracks == 0
    with pytest.raises(SemvizError, match="no open track is sure"):
        do(session, {"kind": "accept sure tracks", "count": 0})
    do(session, {"kind": "undo"})
    assert session.labels == Labels()


def test_the_list_of_open_tracks_begins_with_the_least_sure(session: LabelSession) -> None:
    first = entry(session, None, 0, 0)
    assert first.count == session.summary().map.tracks
    frames = []
    answer = first
    for place in range(first.count):
        assert answer.place == place
        assert answer.entry.kind == "track"
        assert answer.entry.frame in answer.entry.elements[0].frames or place
        frames.append(int(answer.entry.evidence[0].value))
        answer = entry(session, answer.entry.key, answer.place, 1)
    assert frames == sorted(frames)
    assert frames[0] < frames[-1]
    do(session, {"kind": "reject tracks", "track_ids": [first.entry.key]})
    following = entry(session, first.entry.key, 0, 0)
    assert (following.count, following.place) == (first.count - 1, 0)
    assert following.entry.key != first.entry.key


def entry(session: LabelSession, key: str | None, place: int, by: int) -> ReviewEntry:
    request = ShowReviewRequest(id="1", list_name="tracks", key=key, place=place, by=by)
    return session.review(request)


def test_open_tracks_are_followed_through_any_edits(session: LabelSession, found: Found) -> None:
    """What is updated edit by edit is what a fresh look finds."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        rows = list(found.values())[rng.integers(len(found))]
        edits = [accept(rows), reject(rows), {"kind": "undo"}, {"kind": "redo"}]
        row = rows[rng.integers(len(rows))]
        dismissal = {"id": row.id, "frame_index": row.frame_index, "side": row.side}
        edits.append({"kind": "dismiss", "dismissals": [
            dismissal | {"why": "rejected", "element_id": None}]})  # fmt: skip
        edits.append({"kind": "delete", "observation_id": row.id})
        try:
            do(session, edits[rng.integers(len(edits))])
        except SemvizError:
            continue
        fresh = OpenTracks(tracks_of(session))
        assert session.summary().map.tracks == len(fresh.of(session.labels))
        assert len(session.scene.tracks()) == len(fresh.of(session.labels))


def tracks_of(session: LabelSession) -> DetectionTracks:
    workspace = session.workspace
    cameras = Cameras(session.rig, session.source.frames)
    return DetectionTracks.of(
        workspace.read_map(MAIN), load_proposals(workspace.proposals_path), cameras
    )


def test_a_track_that_is_off_its_detections_is_not_sure(
    session: LabelSession, found: Found
) -> None:
    """A planted shift: the element stands elsewhere than the detections say."""
    semantic_map = session.workspace.read_map(MAIN)
    detected = load_proposals(session.workspace.proposals_path)
    cameras = Cameras(session.rig, session.source.frames)
    good = DetectionTracks.of(semantic_map, detected, cameras).by_id[track_id(found[FALSE])]
    assert good.is_sure
    assert not good.doubt
    elements = semantic_map.elements
    aside = np.where(elements.id[:, None] == FALSE, [0.0, 0.3, 0.0], 0.0)
    moved = replace(elements, anchor_m=elements.anchor_m + aside, end_m=elements.end_m + aside)
    semantic_map = replace(semantic_map, elements=moved)
    bad = DetectionTracks.of(semantic_map, detected, cameras).by_id[track_id(found[FALSE])]
    assert bad.residual_px > 3.0
    assert bad.doubt == f"{bad.residual_px:.1f} px off"
    assert replace(good, log_odds=4.0).doubt == "98.2 % sure"
    assert replace(good, log_odds=None).doubt == "existence unknown"
    assert replace(bad, detections=bad.detections[:1]).doubt == "1 frame only"


def test_the_views_of_an_open_track_are_its_detections(session: LabelSession, found: Found) -> None:
    rows = longest(found)
    views = session.tracks.open_track_views(track_id(rows))
    assert {(view.id, view.frame, view.side) for view in views} == {
        (row.id, row.frame_index, row.side) for row in rows
    }
    assert max(view.px or 0.0 for view in views) < 0.01
    sizes_px = [view.size_px for view in views if view.side == "left"]
    assert sizes_px == sorted(sizes_px)  # the camera comes nearer
    do(session, accept(rows))
    assert session.tracks.open_track_views(track_id(rows)) == []


def test_an_edit_that_comes_before_the_map_is_read_waits_for_it(
    workspace: Workspace, found: Found
) -> None:
    session = LabelSession(workspace, "tester")
    held = threading.Event()
    session.map_work._pool.submit(held.wait)
    session.map_work.refresh()
    threading.Timer(0.2, held.set).start()
    do(session, accept(longest(found)))
    assert len(session.labels.elements) == 1
    session.close()


def test_the_same_request_is_done_once(session: LabelSession, found: Found) -> None:
    """As after a kill: the page sends an edit again that is on disk already."""
    edit = accept(longest(found))
    request = {"type": "apply_edit", "id": new_id(), "edit": edit}
    decoded = HANDLERS.decode(request_text(request))
    assert isinstance(decoded, ApplyEditRequest)
    first = session.apply(decoded.id, decoded.edit)
    assert session.apply(decoded.id, decoded.edit).operation == first.operation
    sure = session.summary().map.sure_tracks
    request = {
        "type": "apply_edit", "id": new_id(),
        "edit": {"kind": "accept sure tracks", "count": sure},
    }  # fmt: skip
    decoded = HANDLERS.decode(request_text(request))
    second = session.apply(decoded.id, decoded.edit)
    assert session.apply(decoded.id, decoded.edit).operation == second.operation
    assert session.labels.operation == 2


def request_text(request: dict[str, object]) -> str:
    return json.dumps(request)


def test_two_clients_see_the_same_open_tracks(workspace: Workspace, found: Found) -> None:
    events: dict[str, list[object]] = {"one": [], "two": []}
    annotator = Annotator(workspace, "tester")
    pages = {name: annotator._open(name, events[name].append) for name in events}
    try:
        annotator.session.map_work.wait_for_first()
        edit = {"type": "apply_edit", "id": new_id(), "edit": reject(found[FALSE])}
        pages["one"].receive(HANDLERS.decode(request_text(edit)))
        saved = next(event for event in events["one"] if event.type == "edit_saved")
        deadline = time.monotonic() + 30.0  # others are told a moment later
        while not (updates := [event for event in events["two"] if event.type == "update"]):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        update = updates[-1]
        assert update.labels == saved.labels
        assert update.labels.map.tracks == len(found) - 1
        assert update.frame == saved.frame
        edit = {"type": "apply_edit", "id": new_id(), "edit": accept(found[FALSE])}
        with pytest.raises(SemvizError, match="already"):
            pages["two"].receive(HANDLERS.decode(request_text(edit)))
        undo = {"type": "apply_edit", "id": new_id(), "edit": {"kind": "undo"}}
        pages["two"].receive(HANDLERS.decode(request_text(undo)))
        assert annotator.session.labels == Labels()
    finally:
        annotator.close()


def test_left_out_elements_are_no_landmarks(session: LabelSession, found: Found) -> None:
    """``without_left_out`` is what exports and training read."""
    do(session, accept(longest(found)))
    accepted = session.labels
    do(session, reject(found[FALSE]))
    kept = session.labels.without_left_out()
    assert kept == accepted
    assert kept.operation == session.labels.operation
    assert accepted.without_left_out() is accepted
    decision = review_decision(track_id(found[FALSE]), "leave out")
    again = session.labels.changed([RowChange(decision, None)])
    assert again.without_left_out() is again


@pytest.fixture
def served(workspace: Workspace) -> Iterator[Served]:
    with annotating(workspace) as served:
        served.annotator.session.map_work.wait_for_first()
        yield served


@pytest.fixture
def driver(served: Served, page: "Page") -> LabelDriver:  # the page goes before its server
    driver = LabelDriver(page)
    driver.open(served.url)
    page.keyboard.press("Escape")  # the tour
    return driver


@pytest.mark.browser
def test_the_page_leads_from_track_to_track(
    driver: LabelDriver, served: Served, found: Found
) -> None:
    page = driver.page
    page.wait_for_selector(f'#jumps .row:has-text("Open tracks"):has-text("{len(found)}")')
    page.click('#jumps .row:has-text("Open tracks")')
    page.wait_for_selector(f'#review header:has-text("track 1 of {len(found)}")')
    assert "One landmark?" in page.inner_text("#review header")
    driver.press_and_save("y")
    page.wait_for_selector(f'#review header:has-text("track 1 of {len(found) - 1}")')
    assert page.inner_text("#message").startswith("Accepted ")
    driver.press_and_save("Shift+Y")
    page.wait_for_selector(f'#review header:has-text("track 1 of {len(found) - 2}")')
    assert page.inner_text("#message").startswith("Rejected ")
    assert len(served.labels.review_decisions) == 1
    driver.press("Shift+A")
    count = int(page.inner_text("#message").split()[0])
    assert "Press again to accept them in one operation" in page.inner_text("#message")
    assert len(served.labels.elements) == 2
    driver.press_and_save("Shift+A")
    assert page.inner_text("#message").startswith(f"Accepted {count} tracks")
    assert len(served.labels.elements) == 2 + count


@pytest.mark.browser
def test_the_view_tracks_shows_an_open_track_in_its_images(
    driver: LabelDriver, found: Found
) -> None:
    page, id_ = driver.page, track_id(found[FALSE])
    page.keyboard.press("F3")
    page.wait_for_selector("#tracks")
    page.wait_for_function("(id) => semviz.tracks.table.rows.has(id)", arg=id_)
    page.evaluate("(id) => semviz.tracks.choose(semviz.tracks.table.rows.get(id), 1)", id_)
    page.wait_for_selector('#track-views-about:has-text("Views of P-900")')
    assert page.locator("#track-views-strip .view").count() > 3
    assert "px" in page.inner_text("#track-views-strip .view")


@pytest.mark.browser
def test_a_dragged_end_is_accepted_with_the_rest_of_the_track(
    driver: LabelDriver, served: Served, found: Found
) -> None:
    rows, page = found[FALSE], driver.page
    first = next(row for row in rows if (row.frame_index, row.side) == (1, "left"))
    driver.goto(1)
    row = page.inner_text('#elements .row:has-text("P-900")')
    assert row.split("\n")[-1] == f"{FRAMES} frames"
    driver.select("P-900")
    driver.zoom_to("left", first.anchor_px)
    at = driver.view("left").screen(first.anchor_px)
    page.mouse.move(*at)
    page.mouse.down()
    page.mouse.move(at[0] + 24, at[1] + 36, steps=3)
    page.mouse.up()
    assert driver.operation == 0
    assert "Corrected in this image" in page.inner_text("#message")
    page.mouse.move(5, 5)
    driver.press_and_save("Space")
    assert page.inner_text("#message") == f"Accepted P-01 in {FRAMES} frames. Ctrl Z undoes it."
    label = served.labels.observation(first.id)
    scale = driver.view("left").scale
    moved = np.add(first.anchor_px, [24 / scale, 36 / scale])
    np.testing.assert_allclose(label.anchor_px, moved, atol=0.1)
    np.testing.assert_allclose(label.end_px, first.end_px)
    assert len(served.labels.observations) == len(rows)
    driver.press_and_save("Control+z")
    assert served.labels == Labels()


@pytest.mark.browser
def test_a_rejected_track_disappears_from_images_but_not_from_the_list(
    driver: LabelDriver, served: Served, found: Found
) -> None:
    page = driver.page
    driver.goto(1)
    driver.select("P-900")
    driver.press("o")
    assert "accepted or rejected in all its images" in page.inner_text("#message")
    assert driver.operation == 0
    driver.press_and_save("x")
    assert "no map will have it" in page.inner_text("#message")
    driver.clear_selection()
    row = '#elements .row:has-text("P-01"):has-text("left out")'
    page.wait_for_selector(row)
    assert "1 left out" in page.inner_text("#elements-about")
    hidden = "semviz.state.elements.filter(e => semviz.state.isHidden(e)).length"
    assert page.evaluate(hidden) == 1
    assert page.inner_text("#left-image .status") == "0 elements"
    page.click(row)  # shown again, and its decision can be revoked
    assert page.evaluate(hidden) == 0
    page.click('#card button:has-text("Left out of maps")')
    driver.wait_saved(1)
    assert not served.labels.review_decisions
    assert page.inner_text("#left-image .status") == "1 element"
