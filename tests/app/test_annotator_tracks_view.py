"""The view "Tracks" of the labelling page: every verb, its preview, its one undo, its keys."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from annotator_page import Served
from journeys.driver import LabelDriver
from labelled_street import label_street
from streets import street, street_workspace

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import DeleteObservation, Unlink
from semviz_annotation.labels.labels import Labels, Observation, new_id

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
FRAMES, LABELLED = 8, 6
WAIT_MS = 60_000


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = street_workspace(tmp_path / "street", 7, FRAMES)
    label_street(made, street(7, FRAMES), range(LABELLED))
    return made


@pytest.fixture
def page(served: Served, page: "Page") -> "Page":
    driver = LabelDriver(page)
    driver.open(served.url)
    page.keyboard.press("F3")
    page.wait_for_function(
        "() => semviz.tracks.table.total !== null"
        " && semviz.tracks.table.rows.size === semviz.tracks.table.total"
        " && !semviz.tracks.table.waiting"
        f" && semviz.tracks.table.numbersAt.size === {FRAMES}",
        timeout=WAIT_MS,
    )
    return page


def choose(page: "Page", name: str, frame: int) -> str:
    """Chooses a cell as a click would; returns the element's id."""
    id_: str = page.evaluate(
        """([name, frame]) => {
          const { tracks } = semviz;
          const row = tracks.shown.find((one) => one.name === name);
          tracks.choose(row, tracks.placeOf(frame));
          return row.id;
        }""",
        [name, frame],
    )
    page.wait_for_function("(id) => semviz.tracks.details?.id === id", arg=id_, timeout=WAIT_MS)
    page.wait_for_function("(frame) => semviz.state.frame === frame", arg=frame, timeout=WAIT_MS)
    return id_


def longest(labels: Labels, class_id: int = 0) -> str:
    """The name of an element of a class with the most labels."""
    elements = [row for row in labels.elements.values() if row.class_id == class_id]
    best = max(elements, key=lambda row: (len(labels.of_element(row.id)), -row.number))
    return f"{'PTRO'[class_id]}-{best.number:02}"


def widen(page: "Page", by: int) -> None:
    for _ in range(by):
        page.keyboard.press("Shift+ArrowRight")


def apply_preview(page: "Page", text: str) -> None:
    """Waits for a preview that says ``text``, and applies it."""
    page.wait_for_selector(f"#track-bar:has-text({text!r})", timeout=WAIT_MS)
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#track-bar", state="hidden")


def saved(page: "Page", operation: int) -> None:
    page.wait_for_function(
        "(number) => semviz.state.labels.operation >= number && !semviz.state.pending.length",
        arg=operation,
        timeout=WAIT_MS,
    )


def undo(page: "Page", served: Served, before: Labels) -> None:
    """One undo takes an action back as a whole."""
    number = served.labels.operation
    page.keyboard.press("Control+z")
    saved(page, number + 1)
    assert served.labels == before


def test_a_range_is_deleted_by_one_operation_after_a_preview(page: "Page", served: Served) -> None:
    before = served.labels
    element = choose(page, longest(before), 2)
    widen(page, 2)
    page.keyboard.press("Delete")
    count = sum(2 <= row.frame_index <= 4 for row in before.of_element(element))
    page.wait_for_selector(f"#track-bar:has-text('Delete {count} labels in 3 frames')")
    assert served.labels == before  # nothing yet
    page.keyboard.press("Escape")
    page.wait_for_selector("#track-bar", state="hidden")
    page.keyboard.press("Delete")
    apply_preview(page, "Delete")
    saved(page, before.operation + 1)
    left = served.labels.of_element(element)
    assert {row.frame_index for row in left} == {0, 1, 5}
    assert served.labels.operation == before.operation + 1
    page.wait_for_function(
        "(id) => semviz.tracks.table.rows.get(id).left[2] === -1", arg=element, timeout=WAIT_MS
    )
    undo(page, served, before)


def test_split_and_merge_are_each_others_inverse(page: "Page", served: Served) -> None:
    before = served.labels
    name = longest(before)
    element = choose(page, name, 3)
    page.keyboard.press("Shift+U")
    apply_preview(page, "become another element")
    saved(page, before.operation + 1)
    after = served.labels
    (new,) = after.elements.keys() - before.elements.keys()
    assert {row.frame_index for row in after.of_element(new)} == {3, 4, 5}
    assert {row.frame_index for row in after.of_element(element)} == {0, 1, 2}
    choose(page, name, 0)
    page.wait_for_function(
        "(id) => semviz.tracks.details?.merge?.id === id", arg=new, timeout=WAIT_MS
    )
    page.keyboard.press("Shift+P")
    apply_preview(page, f"Merge {name} with")
    saved(page, after.operation + 1)
    assert set(served.labels.elements) == set(before.elements)
    assert len(served.labels.of_element(element)) == len(before.of_element(element))


def test_resnap_moves_what_was_accepted_and_not_what_a_person_drew(
    page: "Page", served: Served
) -> None:
    element = choose(page, longest(served.labels), 2)
    (drawn, *_) = served.labels.of_element(element)
    page.evaluate(  # a person moves one label: it is hand-drawn from then on
        "([id, ...to]) => semviz.submit({ kind: 'move', observation_id: id, anchor_px: to })",
        [drawn.id, drawn.anchor_px[0] + 0.5, drawn.anchor_px[1]],
    )
    saved(page, served.labels.operation)
    before = served.labels
    page.wait_for_function(
        "(number) => semviz.tracks.details?.operation >= number", arg=before.operation
    )
    page.keyboard.press("Shift+R")
    apply_preview(page, "1 drawn by hand")
    saved(page, before.operation + 1)
    after = served.labels
    moved = {
        row.id
        for row in before.of_element(element)
        if after.observations[row.id].anchor_px != row.anchor_px
    }
    assert moved
    assert drawn.id not in moved
    page.wait_for_selector("#message:has-text('Ctrl Z undoes it')")
    undo(page, served, before)


ALL_SEARCHED = """() => {
  const [first, last] = semviz.tracks.frames;
  const found = semviz.tracks.actions.proposals;
  return found && found.first <= first && found.last >= last;
}"""


def test_all_sure_ones_of_a_range_are_accepted_and_weak_ones_stay(
    page: "Page", served: Served
) -> None:
    before = served.labels
    rows: list[dict[str, Any]] = page.evaluate(
        """() => semviz.tracks.shown.map((one) => ({
          name: one.name, places: [...(semviz.tracks.table.expected.get(one.number)?.keys() ?? [])],
        }))"""
    )
    for row in rows:
        if len(row["places"]) < 2:
            continue
        element = choose(page, row["name"], min(row["places"]))
        widen(page, max(row["places"]) - min(row["places"]))
        page.wait_for_function(ALL_SEARCHED, timeout=WAIT_MS)
        sure: int = page.evaluate(
            "() => semviz.tracks.actions.proposals.proposals.filter((x) => x.is_confident).length"
        )
        if sure:
            break
        page.keyboard.press("Shift+Space")
        page.wait_for_selector("#message:has-text('sure')")
        assert served.labels == before
    assert sure
    page.keyboard.press("Shift+Space")
    apply_preview(page, f"Accept {sure} sure")
    saved(page, before.operation + 1)
    assert len(served.labels.of_element(element)) == len(before.of_element(element)) + sure
    undo(page, served, before)


def test_one_cell_is_accepted_or_rejected(page: "Page", served: Served) -> None:
    before = served.labels
    name, frame = page.evaluate(
        """() => {
          const { table, shown } = semviz.tracks;
          const row = shown.find((one) => table.expected.get(one.number)?.size);
          return [row.name, [...table.expected.get(row.number).keys()][0]];
        }"""
    )
    element = choose(page, name, frame)
    page.keyboard.press("x")
    saved(page, before.operation + 1)
    rejected = served.labels.dismissed_of(element)
    assert {row.frame_index for row in rejected} == {frame}
    undo(page, served, before)


def test_the_class_of_a_range_makes_an_element_of_its_own(page: "Page", served: Served) -> None:
    before = served.labels
    name = longest(before, 3)
    element = choose(page, name, 2)
    widen(page, 1)
    page.keyboard.press("Shift+Digit1")  # a sign cannot become a pole
    page.wait_for_selector("#message:has-text('cannot become a pole')")
    page.keyboard.press("Shift+Digit2")
    apply_preview(page, "an element of their own")
    saved(page, before.operation + 1)
    (new,) = served.labels.elements.keys() - before.elements.keys()
    assert served.labels.elements[new].class_id == 1
    assert {row.frame_index for row in served.labels.of_element(new)} == {2, 3}
    assert served.labels.elements[element].class_id == 3
    undo(page, served, before)
    page.keyboard.press("Escape")  # drops the range: now all of it
    choose(page, name, 2)
    page.keyboard.press("Shift+Digit3")
    apply_preview(page, "become rectangular")
    saved(page, before.operation + 3)
    assert served.labels.elements[element].class_id == 2
    assert served.labels.elements.keys() == before.elements.keys()


def test_an_action_waits_for_the_labels_as_they_are_now(page: "Page", served: Served) -> None:
    name = longest(served.labels, 3)
    element = choose(page, name, 2)
    page.evaluate(
        """() => {
          const { tracks } = semviz;
          tracks.known = { ...tracks.details, labels: tracks.details.labels.slice(0, 2) };
          tracks.read = tracks.asked = "";
        }"""
    )
    page.keyboard.press("Shift+Digit3")
    page.evaluate("() => semviz.state.set({})")  # reads them, if nothing did before
    count = len(served.labels.of_element(element))
    page.wait_for_selector(f"#track-bar:has-text('{count} labels of {name} become rectangular')")


def test_notes_and_the_unsure_flag_are_found_again(page: "Page", served: Served) -> None:
    before = served.labels
    name = longest(before)
    element = choose(page, name, 2)
    page.evaluate("() => { window.before = semviz.tracks.details; }")
    page.keyboard.press("Shift+X")
    saved(page, before.operation + 1)
    (flag,) = served.labels.notes_of(element)
    assert (flag.unsure, flag.text, flag.frame_index, flag.author) == (True, "", 2, "tester")
    page.keyboard.press("n")
    page.keyboard.type("hidden behind the bus")
    page.evaluate("() => { semviz.tracks.known = window.before; }")  # as if read again only later
    page.keyboard.press("Enter")
    saved(page, before.operation + 2)
    page.wait_for_selector(".track-note:has-text('hidden behind the bus')")
    page.keyboard.press("/")
    page.keyboard.type("note:bus unsure")
    page.keyboard.press("Enter")
    page.wait_for_function("() => semviz.tracks.shown.length === 1")
    assert "filter=note%3Abus" in page.url
    page.keyboard.press("Escape")
    page.wait_for_function("() => semviz.tracks.shown.length > 1")
    page.keyboard.press("Shift+X")
    saved(page, before.operation + 3)
    assert [note.text for note in served.labels.notes_of(element)] == ["hidden behind the bus"]
    page.click(".track-note button")
    saved(page, before.operation + 4)
    assert served.labels == before


def test_a_filter_without_a_hit_says_what_there_is(page: "Page") -> None:
    page.fill("#track-search", "residual>40 frames:2-4")
    page.wait_for_selector("#track-message:has-text('No element has residual>40 in frames 2–4.')")
    page.fill("#track-search", "colour:red")
    page.wait_for_selector("#track-message:has-text('is not understood')")
    page.fill("#track-search", "class:pole views>3")
    page.wait_for_selector("#track-message", state="hidden")
    kinds: list[int] = page.evaluate("() => semviz.tracks.shown.map((row) => row.class_id)")
    assert set(kinds) == {0}


def test_verifying_goes_from_the_nearest_view_to_farther_ones(page: "Page", served: Served) -> None:
    element = choose(page, longest(served.labels), 0)
    sizes = "() => semviz.tracks.details.labels.map(({ frame, size_px }) => [size_px, frame])"
    nearest = max(page.evaluate(sizes))[1]
    page.keyboard.press("Shift+B")
    page.wait_for_function("(frame) => semviz.state.frame === frame", arg=nearest)
    page.keyboard.press("Shift+B")
    page.wait_for_function("() => semviz.tracks.views.seenCount > 0")
    row: Observation = served.labels.of_element(element)[0]
    assert row.element_id == element
    assert page.locator("#track-views-strip .view").count() > 3


def test_the_page_tells_two_things_that_were_linked(page: "Page", served: Served) -> None:
    labels = served.labels
    name = longest(labels)
    element = choose(page, name, 0)
    rows = [row for row in labels.of_element(element) if row.frame_index >= 3]
    session = served.annotator.session
    for row in rows:  # as if another pole, 60 px aside, had been taken for it
        session.apply(new_id(), _moved(row, 60.0))
    page.wait_for_function("() => semviz.tracks.details?.split?.frame === 3", timeout=WAIT_MS)
    page.wait_for_selector(".track-cause:has-text('Two elements from frame 3 on')")


def _moved(row: Observation, by_px: float) -> Any:
    from semviz_annotation.labels.edits import MoveObservation

    end = None if row.end_px is None else (row.end_px[0] + by_px, row.end_px[1])
    return MoveObservation(row.id, (row.anchor_px[0] + by_px, row.anchor_px[1]), end)


def test_what_others_do_meanwhile_is_kept(page: "Page", served: Served) -> None:
    """A range is deleted while somebody else splits the track and deletes one of its labels."""
    before = served.labels
    name = longest(before)
    element = choose(page, name, 2)
    widen(page, 1)
    page.keyboard.press("Delete")
    page.wait_for_selector("#track-bar:has-text('Delete')")
    others = [row for row in before.of_element(element) if row.frame_index == 5]
    with served.annotator.session.workspace.open_labels() as store:
        store.apply(Unlink(tuple(row.id for row in others), new_id()), "jon")
    page.wait_for_selector("#message:has-text('Look again')", timeout=WAIT_MS)
    assert page.locator("#track-bar").is_hidden()
    assert {row.frame_index for row in served.labels.of_element(element)} == {0, 1, 2, 3, 4}
    gone = served.labels.of_element(element)[0]
    with served.annotator.session.workspace.open_labels() as store:
        store.apply(DeleteObservation(gone.id), "jon")
    assert gone.id not in served.labels.observations


def test_keys_of_the_images_rest_and_the_list_of_commands_leads_there(
    page: "Page", served: Served
) -> None:
    count = len(served.labels.observations)
    page.keyboard.press("c")
    page.keyboard.press("Shift+Enter")
    page.keyboard.press("Control+k")
    page.locator("dialog.palette input").fill("whole pole")
    page.keyboard.press("Enter")
    page.wait_for_selector("#left-image")
    assert len(served.labels.observations) == count
    page.keyboard.press("Control+k")
    page.locator("dialog.palette input").fill("split here")
    page.keyboard.press("Enter")
    page.wait_for_selector("#tracks")
    assert "view=tracks" in page.url
