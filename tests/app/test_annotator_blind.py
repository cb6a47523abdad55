"""Frames that two people label blind: neither sees the other's labels, and nothing is lost."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from annotator_page import WAIT_MS, draw_on, opened_pages, settled
from streets import street_workspace

from semviz.annotator import messages
from semviz.annotator.team.blind_annotator import TeamAnnotator
from semviz.annotator.team.blind_shares import chosen_frames
from semviz.annotator.team.blind_views import compared_event, share_views
from semviz.web.gateway import Gateway
from semviz.web.protocol import RefusedError
from semviz.workspace.blind import blind_workspace
from semviz.workspace.people import People
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.agreement import MATCH_PX
from semviz_annotation.labels.edits import (
    AddObservation,
    MoveObservation,
    ReviewFrame,
    SendBackFrame,
    SetAttribute,
    WriteNote,
)
from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.labels.rows import Note
from semviz_annotation.storage.integrity import check_labels
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROUNDED = 3


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 6)


@pytest.fixture
def annotator(workspace: Workspace) -> Iterator[TeamAnnotator]:
    made = TeamAnnotator(workspace, author="eva")
    yield made
    made.close()


def draw(store: LabelStore, frame: int, u: float, **rest: Any) -> None:
    sign = {"class_id": ROUNDED, "end_known": False, "anchor_px": (u, 40.0), "side": "left"}
    ids = {"observation_id": new_id(), "element_id": new_id()}
    store.apply(AddObservation(frame_index=frame, **ids, **{**sign, **rest}), "someone")


def labelled_blind(workspace: Workspace, name: str, marks: dict[int, list[float]]) -> None:
    """Label signs at these u in these frames, and review the frames."""
    with blind_workspace(workspace, name).open_labels() as store:
        for frame, places in marks.items():
            for u in places:
                draw(store, frame, u)
            state = "reviewed" if places else "reviewed, empty"
            store.apply(ReviewFrame(frame, state), name)  # type: ignore[arg-type]


def signs_of(labels: Labels, frame: int) -> list[float]:
    return sorted(row.anchor_px[0] for row in labels.in_frame(frame))


def merge(annotator: TeamAnnotator, frame: int, u: list[float]) -> None:
    marks = [
        messages.DrawnMark(
            observation_id=new_id(),
            element_id=new_id(),
            frame_index=frame,
            side="left",
            anchor_px=(place, 40.0),
            end_known=False,
            class_id=ROUNDED,
        )
        for place in u
    ]
    edit = messages.MergeFrameEdit(kind="merge frame", frame_index=frame, marks=marks)
    annotator.session.apply(new_id(), edit, author="eva")


def test_a_share_is_spread_evenly_and_the_same_each_time() -> None:
    assert chosen_frames(range(100), 10.0) == tuple(range(5, 100, 10))
    assert chosen_frames(range(4), 1.0) == (2,)
    assert chosen_frames([3, 5, 9], 100.0) == (3, 5, 9)
    for percent in (3.0, 17.0, 50.0, 99.0):
        chosen = chosen_frames(range(37), percent)
        assert sorted(set(chosen)) == list(chosen)
        assert len(chosen) == max(1, round(0.37 * percent))


def test_only_untouched_frames_are_assigned_to_two_different_people(
    annotator: TeamAnnotator,
) -> None:
    shares, store = annotator.shares, annotator.session.team.store
    draw(store, 1, 100.0)
    with pytest.raises(SemvizError, match="two different people"):
        shares.assign((0, 5), 50.0, ("mara", "Mara"), "eva")
    with pytest.raises(SemvizError, match="cannot be a file name"):
        shares.assign((0, 5), 50.0, ("..", "mara"), "eva")
    assert not shares.all
    assert shares.assign((0, 5), 100.0, ("mara", "jon"), "eva").frames == (0, 2, 3, 4, 5)
    with pytest.raises(SemvizError, match="without labels"):
        shares.assign((0, 5), 10.0, ("mara", "lin"), "eva")


def test_nobody_labels_such_a_frame_in_the_common_file_until_it_is_merged(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    shares, store = annotator.shares, annotator.session.team.store
    draw(store, 2, 100.0)
    store.undo("someone")
    shares.assign((2, 3), 100.0, ("mara", "jon"), "eva")
    for refused in (
        lambda: draw(store, 2, 100.0),
        lambda: store.redo("someone"),
        lambda: store.apply(ReviewFrame(2, "reviewed, empty"), "eva"),
        lambda: merge(annotator, 2, [10.0]),
    ):
        with pytest.raises(SemvizError, match="mara and jon"):
            refused()
    draw(store, 4, 100.0)  # others are open
    labelled_blind(workspace, "mara", {2: [100.0, 300.0], 3: []})
    with pytest.raises(SemvizError, match="not both reviewed"):
        shares.compared(2)
    labelled_blind(workspace, "jon", {2: [102.0]})
    found = shares.compared(2)
    assert (found.people, found.is_blind) == (("mara", "jon"), True)
    assert [pair.worst_px for pair in found.pairs] == pytest.approx([0.0, 2.0])
    merge(annotator, 2, [101.0, 300.0])
    assert signs_of(store.labels, 2) == [101.0, 300.0]
    assert store.labels.review(2) == "reviewed"
    with pytest.raises(SemvizError, match="has labels already"):
        merge(annotator, 2, [101.0])
    store.undo("eva")
    assert not store.labels.in_frame(2)
    with pytest.raises(SemvizError, match="mara and jon"):
        draw(store, 2, 5.0)
    store.redo("eva")
    assert signs_of(store.labels, 2) == [101.0, 300.0]
    for name, places in (("mara", [100.0, 300.0]), ("jon", [102.0])):  # nothing of either is lost
        assert signs_of(shares.labels_of(name), 2) == places
        assert check_labels(workspace.path / "blind" / name / "labels.db").operations >= 2
    check_labels(workspace.labels_path)


def test_the_frame_with_the_worst_disagreement_is_known(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    annotator.shares.assign((0, 2), 100.0, ("mara", "jon"), "eva")
    labelled_blind(workspace, "mara", {0: [100.0], 1: [100.0], 2: [100.0]})
    labelled_blind(workspace, "jon", {0: [101.0], 1: [105.0], 2: []})
    (view,) = share_views(annotator.shares, reviews=True)
    assert dict(zip(view.ready, view.worst_px, strict=True)) == pytest.approx(
        {0: 1.0, 1: 5.0, 2: MATCH_PX}
    )
    assert share_views(annotator.shares, reviews=False)[0].worst_px == [0.0] * 3


def test_attributes_and_notes_are_merged_with_their_elements(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    shares, store = annotator.shares, annotator.session.team.store
    shares.assign((2, 2), 100.0, ("mara", "jon"), "eva")
    labelled_blind(workspace, "mara", {2: [100.0]})
    labelled_blind(workspace, "jon", {2: [101.0]})
    for name, values in (("mara", {"sign code": "274-50"}), ("jon", {"sign code": "275"})):
        with blind_workspace(workspace, name).open_labels() as own:
            (element,) = own.labels.elements
            for key, value in {**values, f"of {name}": "yes"}.items():
                own.apply(SetAttribute(element, key, value), name)
            note = Note(new_id(), element, 2, True, f"{name}: bent?", name, "2026-01-01T00:00:00")
            own.apply(WriteNote(note), name)
            elsewhere = Note(new_id(), element, 3, False, "in another frame", name, note.time)
            own.apply(WriteNote(elsewhere), name)
    event = compared_event(shares, 2, annotator.session.classes, "")
    (compared,) = event.elements
    assert compared.apart == "sign code: 274-50, 275"  # nobody averages it without a look
    for of_second, code in (((), "274-50"), ((compared.id,), "275")):
        mark = messages.DrawnMark(
            observation_id=new_id(),
            element_id=compared.id,
            frame_index=2,
            side="left",
            anchor_px=(100.0, 40.0),
            end_known=False,
            class_id=ROUNDED,
        )
        edit = messages.MergeFrameEdit(
            kind="merge frame", frame_index=2, marks=[mark], of_second=of_second
        )
        annotator.session.apply(new_id(), edit, author="eva")
        (element,) = store.labels.elements
        found = {row.name: row.value for row in store.labels.attributes_of(element)}
        assert found == {"sign code": code, "of mara": "yes", "of jon": "yes"}
        notes = store.labels.notes_of(element)
        assert {(row.author, row.text) for row in notes} == {
            ("mara", "mara: bent?"),
            ("jon", "jon: bent?"),
        }
        store.undo("eva")
        assert not store.labels.attributes
        assert not store.labels.notes
    check_labels(workspace.labels_path)


def test_no_command_labels_a_frame_that_two_label_blind(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    """Without the server, another process opens the label file."""
    annotator.shares.assign((2, 2), 100.0, ("mara", "jon"), "eva")
    with workspace.open_labels() as store:
        with pytest.raises(SemvizError, match="mara and jon label frame 2 blind"):
            draw(store, 2, 100.0)
        draw(store, 3, 100.0)
        assert not store.labels.in_frame(2)
    labelled_blind(workspace, "mara", {2: [100.0]})
    labelled_blind(workspace, "jon", {2: [100.0]})
    merge(annotator, 2, [100.0])
    with workspace.open_labels() as store:
        draw(store, 2, 300.0)  # it is open again


def test_what_is_compared_no_longer_changes_and_an_ended_share_keeps_both_files(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    shares = annotator.shares
    number = shares.assign((0, 1), 100.0, ("mara", "jon"), "eva").number
    labelled_blind(workspace, "mara", {0: [100.0]})
    annotator.blind_address("mara")
    own = annotator._blind["mara"].session.team.store
    draw(own, 0, 200.0)  # jon has not reviewed the frame yet
    labelled_blind(workspace, "jon", {0: []})
    for refused in (lambda: draw(own, 0, 300.0), lambda: own.undo("mara")):
        with pytest.raises(SemvizError, match="both have reviewed frame 0"):
            refused()
    with pytest.raises(SemvizError, match="none of those"):
        draw(own, 3, 300.0)
    (view,) = share_views(shares, reviews=True)
    assert (view.reviewed, view.ready, view.merged) == ((1, 1), [0], 0)
    assert view.agreement is not None
    assert (view.agreement.elements, view.agreement.missed) == (2, (0, 2))
    assert share_views(shares, reviews=False)[0].agreement is None
    shares.end(number, "eva")
    draw(annotator.session.team.store, 1, 10.0)
    with pytest.raises(RefusedError):
        annotator.blind_address("jon")
    assert signs_of(blind_workspace(workspace, "mara").read_labels(), 0) == [100.0, 200.0]


def test_own_classes_and_every_command_reach_a_blind_file(
    annotator: TeamAnnotator, workspace: Workspace, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "semviz.cli"]
    add = [*command, "classes", "add", str(workspace.path), "gantry"]
    subprocess.run(add, check=True, capture_output=True)
    annotator.shares.assign((0, 1), 100.0, ("mara", "jon"), "eva")
    (own,) = annotator.shares.labels_of("mara").own_classes.values()
    assert own.name == "gantry"
    folder, log = workspace.path / "blind" / "mara", tmp_path / "mara.jsonl"
    for words in (["check", str(folder)], ["export", str(folder), str(log)]):
        subprocess.run([*command, "labels", *words], check=True, capture_output=True)
    assert json.loads(log.read_text().splitlines()[0])["format"] == "semviz-operations"
    refused = [*command, "labels", "check", str(workspace.path / "blind" / "lin")]
    assert subprocess.run(refused, check=False, capture_output=True).returncode == 2


WRITER = """
import sys
from semviz.workspace.blind import blind_workspace
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import new_id
workspace = Workspace.open(sys.argv[1])
with blind_workspace(workspace, "mara").open_labels() as store:
    for number in range(10_000):
        place = (1.0 + number / 10, 40.0)
        edit = AddObservation(new_id(), new_id(), 0, "left", place, None, True, False, 3)
        store.apply(edit, "mara")
        print(edit.observation_id, flush=True)
"""


def test_killed_while_somebody_labels_blind_every_acknowledged_label_is_there(
    annotator: TeamAnnotator, workspace: Workspace
) -> None:
    annotator.shares.assign((0, 1), 100.0, ("mara", "jon"), "eva")
    command = [sys.executable, "-c", WRITER, str(workspace.path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    said = [writer.stdout.readline().strip()]
    time.sleep(0.3)
    os.kill(writer.pid, signal.SIGKILL)
    said += writer.stdout.read().splitlines()
    writer.wait()
    acknowledged = [line for line in said if len(line) == 36]
    assert acknowledged
    assert set(acknowledged) <= set(annotator.shares.labels_of("mara").observations)
    check_labels(workspace.path / "blind" / "mara" / "labels.db")


@pytest.fixture
def pages(
    annotator: TeamAnnotator, workspace: Workspace, chromium: "Browser"
) -> Iterator[dict[str, "Page"]]:
    """The pages of who started the server, and of mara who labels."""
    people = People(workspace.path)
    people.invite("jon", "annotate")
    with (
        Gateway(annotator, guests=annotator.people.names_by_digest).running() as url,
        opened_pages(chromium, url, "eva", people, {"mara": "annotate"}) as opened,
    ):
        yield opened


@pytest.mark.browser
def test_the_owner_assigns_a_share_two_label_it_and_the_owner_merges(
    pages: dict[str, "Page"], annotator: TeamAnnotator, workspace: Workspace
) -> None:
    eva, mara = pages["eva"], pages["mara"]
    eva.keyboard.press("F8")
    eva.wait_for_selector("#twice-second option[value=mara]", state="attached")
    eva.keyboard.press("Shift+T")
    eva.keyboard.type("1-2")
    eva.fill("#twice-percent", "100")
    eva.select_option("#twice-first", "mara")
    eva.select_option("#twice-second", "jon")
    eva.click("#team-twice button")
    eva.wait_for_function("() => semviz.team.shares.known.length === 1", timeout=WAIT_MS)
    # mara labels her frames, where nobody else may enter
    mara.keyboard.press("F8")
    mara.click("#team-chips button:has-text('Twice')")
    mara.click("button:has-text('Label mine')")
    mara.wait_for_url("**/blind/1/**")
    mara.wait_for_function("() => window.semviz?.state.isReady", timeout=WAIT_MS)
    assert mara.locator("#tab-team").is_hidden()
    assert mara.locator("#blind").is_visible()
    assert mara.evaluate("semviz.state.order") == [1, 2]
    for u in (100, 300):
        draw_on(mara, 1, u)
    mara.evaluate("semviz.submit({ kind: 'review', frame_index: 1, state: 'reviewed' })")
    settled(mara)
    refused = eva.evaluate("fetch('/blind/1/').then((answer) => answer.status)")
    assert refused == 403
    assert not annotator.session.labels.observations
    labelled_blind(workspace, "jon", {1: [104.0, 500.0]})
    # eva compares: two of one sign, and one of each alone
    eva.evaluate("semviz.team.entered()")
    eva.wait_for_function("() => semviz.team.shares.ready.length === 1", timeout=WAIT_MS)
    eva.keyboard.press("Shift+J")
    eva.wait_for_function(
        "() => semviz.team.compared.shown?.elements.length === 3", timeout=WAIT_MS
    )
    eva.keyboard.press("Enter")
    assert "3 elements wait" in eva.inner_text("#message")
    assert len(eva.query_selector_all("#compared-elements .compared-element")) == 3
    for name in ("mara did not label it", "jon did not label it", "4.0 px apart"):
        eva.click(f"#compared-elements button:has-text('{name}')")
        eva.keyboard.press({"m": "Shift+Y", "j": "x", "4": "m"}[name[0]])
    eva.keyboard.press("Enter")
    settled(eva)
    eva.wait_for_function("() => !semviz.team.compared.shown?.is_blind", timeout=WAIT_MS)
    labels = annotator.session.labels
    assert signs_of(labels, 1) == pytest.approx([102.0, 500.0])
    assert labels.review(1) == "reviewed"
    assert signs_of(annotator.shares.labels_of("mara"), 1) == [100.0, 300.0]
    check_labels(workspace.labels_path)


@pytest.mark.browser
def test_two_versions_of_a_frame_stand_side_by_side(
    pages: dict[str, "Page"], annotator: TeamAnnotator
) -> None:
    eva, store = pages["eva"], annotator.session.team.store
    draw(store, 0, 100.0)
    (row,) = store.labels.in_frame(0)
    store.apply(ReviewFrame(0, "reviewed"), "mara")
    store.apply(SendBackFrame(0), "eva")
    eva.keyboard.press("F8")
    eva.evaluate("semviz.go(0)")
    eva.keyboard.press("v")
    eva.wait_for_selector("#compared-names:has-text('Nothing in this frame differs')")
    store.apply(MoveObservation(row.id, (110.0, 40.0), None), "mara")
    eva.wait_for_selector("#compared-elements .compared-element", timeout=WAIT_MS)
    assert "10.0 px apart" in eva.inner_text("#compared-elements")
    assert eva.inner_text("#compared-names").startswith("eva")
    eva.keyboard.press("v")
    eva.locator("#compared").wait_for(state="hidden")  # the panels are drawn with the next frame
    rows = "document.querySelectorAll('#team-queue .row')"
    eva.click("#team-chips button:has-text('Waiting')")
    eva.evaluate(LONG_QUEUE, 5000)
    eva.wait_for_function(f"() => {rows}.length > 20", timeout=WAIT_MS)
    for _ in range(2):  # the list grows by no redraw
        eva.evaluate("semviz.team.show()")
        assert eva.evaluate(f"{rows}.length") < 200
    eva.evaluate("semviz.team.list.box.scrollTop = 1e9")
    last = f"() => [...{rows}].at(-1)?.innerText.startsWith('4999')"
    eva.wait_for_function(last, timeout=WAIT_MS)
    eva.evaluate("semviz.team.known.queue.pop(), semviz.team.shownQueue = [], semviz.team.show()")
    eva.wait_for_function(last.replace("4999", "4998"))  # news leaves the list where it was


LONG_QUEUE = """(count) => {
  const { team } = semviz;
  const entry = { state: "waiting", person: "mara", elements: 5, stands_out: "", notes: [] };
  const queue = Array.from({ length: count }, (_, frame) => ({ ...entry, frame, time: "" }));
  const known = { ...team.known, queue };
  Object.defineProperty(team, "known", { get: () => known, set: () => {} }); // news stays out
  semviz.state.set({});
}"""
