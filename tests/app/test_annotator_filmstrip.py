"""The filmstrip of the labelling page: key frames first, then the frames between by one key."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from annotator_page import Served
from journeys.driver import LabelDriver
from labelled_street import label_street
from streets import street, street_workspace

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import ReviewFrame
from semviz_annotation.labels.labels import Labels

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
FRAMES, KEY_FRAMES = 8, (0, 4)
WAIT_MS = 60_000


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = street_workspace(tmp_path / "street", 7, FRAMES)
    label_street(made, street(7, FRAMES), KEY_FRAMES)
    with made.open_labels() as store:
        store.apply(ReviewFrame(0, "reviewed"), "mara")
    return made


@pytest.fixture
def page(served: Served, page: "Page") -> "Page":
    """At a key frame whose earlier frames are on the filmstrip."""
    driver = LabelDriver(page)
    driver.open(served.url)
    page.keyboard.press("Shift+E")
    driver.goto(4)
    page.wait_for_function("() => !semviz.state.shownFrame.is_searching", timeout=WAIT_MS)
    page.keyboard.press("Control+Enter")
    page.wait_for_function(
        "() => semviz.state.view === 'filmstrip' && semviz.filmstrip.frames.length"
        " && !semviz.filmstrip.isSearching",
        timeout=WAIT_MS,
    )
    return page


def cells(page: "Page") -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = page.evaluate(
        "semviz.filmstrip.cells.map((cell) => ({ key: cell.key, frame: cell.frame,"
        " id: cell.proposal.id, marks: cell.proposal.marks, sure: cell.proposal.is_confident,"
        " taken: semviz.filmstrip.isTaken(cell) }))"
    )
    return found


def saved(page: "Page", operation: int) -> None:
    page.wait_for_function(
        "(number) => semviz.state.labels.operation >= number && !semviz.state.pending.length",
        arg=operation,
        timeout=WAIT_MS,
    )


def labelled(labels: Labels, frames: range) -> set[tuple[int, str, str]]:
    rows = labels.observations.values()
    return {
        (row.frame_index, row.element_id, row.side) for row in rows if row.frame_index in frames
    }


def marks_of(some: list[dict[str, Any]]) -> set[tuple[int, str, str]]:
    return {(cell["frame"], cell["id"], side) for cell in some for side in cell["marks"]}


def test_one_key_takes_what_is_ticked_and_one_undo_takes_it_back(
    page: "Page", served: Served
) -> None:
    before = served.labels
    shown = cells(page)
    assert {cell["frame"] for cell in shown} == {1, 2, 3}
    assert all(cell["taken"] == cell["sure"] for cell in shown)
    assert not labelled(before, range(1, 4))  # nothing is a label before somebody says so
    sure = [cell for cell in shown if cell["sure"]]
    page.click(f'[data-cell="{sure[0]["key"]}"] canvas')
    page.set_viewport_size({"width": 1280, "height": 400})
    page.wait_for_function("() => semviz.filmstrip.grid.body.clientHeight < 400")
    presses = 0
    while page.evaluate("semviz.state.view") == "filmstrip":  # what is not in view is not taken
        page.keyboard.press("Control+Enter")
        presses += 1
    assert presses > 1
    saved(page, before.operation + 1)
    assert labelled(served.labels, range(1, 4)) == marks_of(sure[1:])
    assert served.labels.operation == before.operation + 1
    assert page.evaluate("[semviz.state.view, semviz.state.frame]") == ["images", FRAMES - 1]
    page.keyboard.press("Control+z")
    saved(page, before.operation + 2)
    assert served.labels == before


def test_a_drag_in_a_cut_out_corrects_the_mark_and_takes_it(page: "Page", served: Served) -> None:
    before = served.labels
    cell = next(cell for cell in cells(page) if "left" in cell["marks"])
    canvas = page.locator(f'[data-cell="{cell["key"]}"] canvas[data-side="left"]')
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    zoom = page.evaluate("(node) => JSON.parse(node.dataset.crop).zoom", canvas.element_handle())
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 5 * zoom[0], y, steps=3)
    page.mouse.up()
    assert next(one for one in cells(page) if one["key"] == cell["key"])["taken"]
    while page.evaluate("semviz.state.view") == "filmstrip":
        page.keyboard.press("Control+Enter")
    saved(page, before.operation + 1)
    row = served.labels.find(cell["id"], cell["frame"], "left")
    assert row is not None
    moved = np.array(row.anchor_px) - cell["marks"]["left"]["anchor"]
    assert moved == pytest.approx([5.0, 0.0], abs=0.5)


def test_what_is_dragged_is_followed_into_the_other_images_of_its_row(page: "Page") -> None:
    shown = cells(page)
    rows = [cell["id"] for cell in shown if len(cell["marks"]) == 2]
    row = next(id for id in rows if rows.count(id) == 3)
    cell = next(cell for cell in shown if cell["id"] == row and cell["frame"] == 2)
    order = page.evaluate("semviz.filmstrip.grid.rows.map(({ id }) => id)")
    others = [
        (one["key"], side)
        for one in shown
        for side in one["marks"]
        if one["id"] == row and (one["key"], side) != (cell["key"], "left")
    ]
    page.evaluate(
        """([key, by]) => {
            const { filmstrip } = semviz, cell = filmstrip.cell(key);
            const { anchor, end, ...known } = cell.proposal.marks.left;
            const moved = (point) => point && [point[0] + by, point[1]];
            filmstrip.place(cell, "left", { ...known, anchor: moved(anchor), end: moved(end) });
        }""",
        [cell["key"], 6.0],
    )
    assert page.evaluate("semviz.filmstrip.isSearching")  # nothing is accepted meanwhile
    page.wait_for_function("() => !semviz.filmstrip.isSearching", timeout=WAIT_MS)
    now = {one["key"]: one for one in cells(page)}
    placed = np.subtract(
        now[cell["key"]]["marks"]["left"]["anchor"], cell["marks"]["left"]["anchor"]
    )
    assert placed == pytest.approx([6.0, 0.0])
    before = {one["key"]: one for one in shown}
    moves = [
        np.subtract(now[key]["marks"][side]["anchor"], before[key]["marks"][side]["anchor"])[0]
        for key, side in others
        if key in now and side in now[key]["marks"]
    ]
    assert len(moves) == 5
    assert np.median(moves) > 2.0
    unmoved = [one for one in shown if one["id"] != row]
    assert all(now[one["key"]]["marks"] == one["marks"] for one in unmoved)
    assert page.evaluate("semviz.filmstrip.grid.rows.map(({ id }) => id)") == order


@pytest.mark.parametrize(
    ("change", "code"),
    [({"frame": 99}, "not_found"), ({"end": [9.0, 9.0]}, "invalid"), ({"anchor": None}, "invalid")],
)
def test_a_correction_that_cannot_be_is_refused(
    change: dict[str, Any], code: str, page: "Page"
) -> None:
    sign = next(
        cell for cell in cells(page) if cell["marks"].get("left", {"end": 1})["end"] is None
    )
    mark = sign["marks"]["left"]
    names = ("frame", "side", "anchor", "end", "anchor_known", "end_known")
    corrected = {name: mark[name] for name in names} | change
    refused = page.evaluate(
        "(fields) => semviz.socket.request('follow_corrections', fields).catch((e) => e.code)",
        {"element_id": sign["id"], "frames": [1], "corrected": [corrected]},
    )
    assert refused == code


def test_the_strip_is_used_by_keys_alone(page: "Page", served: Served) -> None:
    before = served.labels
    first = cells(page)[0]
    page.evaluate("(key) => semviz.filmstrip.choose(key)", first["key"])
    page.keyboard.press("x")
    saved(page, before.operation + 1)
    rejected = {row.id for row in served.labels.dismissed_in(first["frame"])}
    assert rejected == {mark["id"] for mark in first["marks"].values()}
    assert first["key"] not in {cell["key"] for cell in cells(page)}
    chosen = page.evaluate("semviz.filmstrip.chosen")
    page.keyboard.press("ArrowRight")
    other = page.evaluate("semviz.filmstrip.chosen")
    assert other.split("/")[1] == chosen.split("/")[1]
    assert other != chosen
    page.keyboard.press("Space")
    page.keyboard.press("Shift+G")
    by_key = {cell["key"]: cell["taken"] for cell in cells(page)}
    left_out = {key for key, taken in by_key.items() if not taken}
    assert left_out == {other} or not left_out  # a weak one was ticked by Space
    page.keyboard.press("Enter")
    assert page.evaluate("semviz.state.view") == "images"
    assert page.evaluate("semviz.state.frame") == int(other.split("/")[0])
    assert served.labels.operation == before.operation + 1


def test_without_key_frames_the_strip_looks_ahead(served: Served, page: "Page") -> None:
    assert page.evaluate("semviz.filmstrip.frames") == [1, 2, 3]
    page.keyboard.press("Escape")
    page.keyboard.press("Shift+E")
    LabelDriver(page).goto(0)
    page.keyboard.press("F7")
    assert page.evaluate("semviz.filmstrip.frames") == [1, 2, 3, 4]
    assert page.evaluate("semviz.filmstrip.goesTo") == 4
    refused = page.evaluate(
        "semviz.socket.request('search_filmstrip', { frames: [99] }).catch((error) => error.code)"
    )
    assert refused == "not_found"


def test_a_frame_opened_from_the_strip_leads_back_to_it(page: "Page", served: Served) -> None:
    """With the answers as they were; what was accepted in that frame is not on the strip again."""
    frame = page.evaluate("semviz.filmstrip.frames[1]")
    answered = next(cell for cell in cells(page) if cell["frame"] != frame)
    page.evaluate("(key) => semviz.filmstrip.flip(key)", answered["key"])
    page.click(f"#filmstrip-cells button:text-is('Frame {frame}')")
    page.wait_for_selector("#message:has-text('goes back to it')")
    page.mouse.move(0, 0)  # what is under the pointer has hints of its own
    page.wait_for_function(
        f"() => semviz.state.shownFrame?.index === {frame} && !semviz.state.shownFrame.is_searching"
    )
    page.wait_for_selector("#hints .hint:has-text('back to the filmstrip')")
    page.keyboard.press("?")
    page.wait_for_selector("dialog.help li:has-text('next or back to strip')")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog.help", state="hidden")  # until then keys are the dialog's
    page.wait_for_function("() => semviz.state.shownFrame?.is_searching === false")
    page.keyboard.press("Control+Shift+Enter")
    page.wait_for_function(
        "() => semviz.state.view === 'filmstrip' && !semviz.state.pending.length"
        " && semviz.filmstrip.found.size && !semviz.filmstrip.isSearching",
        timeout=WAIT_MS,
    )
    assert served.labels.review(frame) == "reviewed"
    now = {cell["key"]: cell for cell in cells(page)}
    assert now[answered["key"]]["taken"] is not answered["taken"]
    assert frame not in {cell["frame"] for cell in now.values() if cell["sure"]}
    goes_to = page.evaluate("semviz.filmstrip.goesTo")
    while page.evaluate("semviz.state.view") == "filmstrip":
        page.keyboard.press("Control+Enter")
    page.wait_for_function(f"() => semviz.state.frame === {goes_to}")


def test_rows_with_weak_marks_come_first_and_all_are_in_view(page: "Page") -> None:
    """So that one look and one key are enough, for some fifteen elements."""
    weak = page.evaluate(
        "semviz.filmstrip.grid.rows.map((row) => semviz.filmstrip.cells.some(({ proposal }) =>"
        " proposal.id === row.id && !proposal.is_confident))"
    )
    assert weak == sorted(weak, reverse=True)
    assert 5 <= len(weak) <= 17
    heights = page.locator("#filmstrip-cells").evaluate(
        "one => [one.scrollHeight, one.clientHeight]"
    )
    assert heights[0] <= heights[1]
