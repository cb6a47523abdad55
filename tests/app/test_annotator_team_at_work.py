"""What people who label at the same time see of each other: two versions, news, who is where."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import WAIT_MS, Served, draw_on, opened_pages, settled
from drawn_marks import do
from streets import street_workspace

from semviz.annotator.page_session import AnnotatorPage
from semviz.annotator.server import Annotator
from semviz.web.gateway import Gateway
from semviz_annotation.labels.edits import MoveObservation
from semviz_annotation.labels.labels import new_id

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.browser


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    annotator = Annotator(street_workspace(tmp_path / "street", 7, 3), author="tester")
    try:
        with Gateway(annotator, guests=annotator.people.names_by_digest).running() as url:
            yield Served(url, annotator)
    finally:
        annotator.close()


@pytest.fixture
def pages(served: Served, chromium: "Browser") -> Iterator[dict[str, "Page"]]:
    """The pages of who started the server, and of mara who labels."""
    people = served.annotator.people
    with opened_pages(chromium, served.url, "tester", people, {"mara": "annotate"}) as opened:
        yield opened


def both_move(page: "Page", served: Served) -> None:
    """Draw a sign at u = 100; mara moves it to 90, the page, unaware of that, to 104."""
    draw_on(page, 0, 100.0)
    (row,) = served.labels.observations.values()
    with served.annotator.lock:
        page.evaluate(
            """(id) => semviz.submit({ kind: 'move', observation_id: id, anchor_px: [104, 40],
              end_px: null })""",
            row.id,
        )
        page.wait_for_function("() => semviz.state.pending.length === 1")
        served.annotator.session._store.apply(MoveObservation(row.id, (90.0, 40.0), None), "mara")


@pytest.mark.parametrize(("view", "key"), [("F2", "y"), ("F3", "Shift+Y"), ("F8", "y")])
def test_two_versions_of_a_label_are_shown_side_by_side_in_every_view(
    pages: dict[str, "Page"], served: Served, view: str, key: str
) -> None:
    page = pages["tester"]
    page.keyboard.press(view)
    both_move(page, served)
    panel = page.locator("#conflict")
    panel.wait_for(timeout=WAIT_MS)
    page.wait_for_selector("#conflict:has-text('mara changed O-01 while you did')")
    assert "Two versions of O-01" in panel.inner_text()
    assert "14.0 px to the right" in panel.inner_text()
    page.wait_for_function("() => semviz.conflict.bitmap !== null", timeout=WAIT_MS)
    assert page.locator("#question").is_hidden()
    assert panel.is_visible()
    page.keyboard.press(key)
    settled(page)
    panel.wait_for(state="hidden")
    (row,) = served.labels.observations.values()
    is_mine = key == "y"
    np.testing.assert_allclose(row.anchor_px, (104.0 if is_mine else 90.0, 40.0))
    authors = [step.author for step in served.annotator.session._store.operations()]
    assert authors == ["tester", "mara", "tester", *([] if is_mine else ["tester"])]
    if not is_mine:  # both are in the history, and redo takes mine after all
        page.evaluate("semviz.submit({ kind: 'redo' })")
        settled(page)
        np.testing.assert_allclose(served.observations[0].anchor_px, (104.0, 40.0))


def test_theirs_is_kept_and_they_are_asked(
    pages: dict[str, "Page"], served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    with monkeypatch.context() as held:  # the refusal is there before the other version
        held.setattr(AnnotatorPage, "send_update", lambda page: None)
        both_move(tester, served)
        tester.wait_for_selector("#conflict button:has-text('Ask mara'):disabled")
    served.annotator.updates_queued.set()
    tester.click("#conflict button:has-text('Ask mara')")
    settled(tester)
    np.testing.assert_allclose(served.observations[0].anchor_px, (90.0, 40.0))
    (note,) = served.labels.notes.values()
    assert (note.text, note.unsure) == ("@mara: middle 14.0 px to the right?", True)
    mara.keyboard.press("F8")
    asked = "#team-feed .row:has-text('asks you')"
    mara.wait_for_selector(f"{asked}:has-text('Note on O-01: @mara')", timeout=WAIT_MS)
    tester.keyboard.press("F8")
    assert tester.locator(asked).count() == 0
    mara.keyboard.press("F2")
    mara.evaluate("semviz.select(semviz.state.elements[0].id)")
    mara.click(".card-notes button")  # answered
    settled(mara)
    assert not served.labels.notes


def test_the_page_follows_somebody_until_one_goes_elsewhere(pages: dict[str, "Page"]) -> None:
    tester, mara = pages["tester"], pages["mara"]
    tester.wait_for_selector(".person[title*='mara (annotate): frame']", timeout=WAIT_MS)
    tester.keyboard.press("F8")
    tester.keyboard.press("Shift+L")
    tester.wait_for_selector("#message:has-text('Following mara')")
    for frame in (1, 2):
        mara.keyboard.press(".")
        tester.wait_for_function(f"() => semviz.state.frame === {frame}", timeout=WAIT_MS)
    tester.keyboard.press(",")
    tester.wait_for_selector("#message:has-text('No longer following mara')")
    mara.keyboard.press(",")
    mara.keyboard.press(",")
    tester.wait_for_selector(".person[title*='frame 0']", timeout=WAIT_MS)
    assert tester.evaluate("semviz.state.frame") == 1


def test_news_of_everybody_lead_to_their_frames(pages: dict[str, "Page"]) -> None:
    tester, mara = pages["tester"], pages["mara"]
    tester.keyboard.press("F8")
    tester.wait_for_selector("#team-feed:has-text('Nobody did anything yet')")
    draw_on(mara, 2, 100.0)
    mara.evaluate("semviz.select(semviz.state.labels.frame.elements[0]?.id ?? null)")
    tester.click("#team-feed .row:has-text('Draw O-01')", timeout=WAIT_MS)
    assert tester.evaluate("semviz.state.frame") == 2
    mara.evaluate("semviz.go(2)")
    mara.wait_for_function("() => semviz.state.elements.length === 1", timeout=WAIT_MS)
    mara.evaluate("semviz.select(semviz.state.elements[0].id)")
    tester.wait_for_selector(".team-person:has-text('frame 2, O-01')", timeout=WAIT_MS)
    tester.evaluate("semviz.select(semviz.state.elements[0].id)")
    tester.wait_for_selector(".team-person:has-text('both in O-01')", timeout=WAIT_MS)


def test_what_was_sent_back_is_a_list_of_who_has_the_frame(
    pages: dict[str, "Page"], served: Served
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    store = served.annotator.session._store
    store.state("assign", "0-1 mara", "tester")
    tester.wait_for_function("() => semviz.state.labels.team.assigned.mara", timeout=WAIT_MS)
    draw_on(tester, 0, 100.0)
    tester.wait_for_selector('#message:has-text("Frame 0 is mara\'s. Labels count")')
    for kind in ("review", "send back"):
        state = {"state": "reviewed"} if kind == "review" else {}
        do(served.annotator.session, {"kind": kind, "frame_index": 0, **state})
    mara.keyboard.press(".")
    first = mara.locator("#jumps .row").first
    mara.wait_for_selector("#jumps .row:has-text('Sent back')", timeout=WAIT_MS)
    assert "Sent back" in first.inner_text()
    assert tester.locator("#jumps .row:has-text('Sent back')").count() == 0
    first.click()
    mara.wait_for_function("() => semviz.state.shownFrame?.index === 0")
    mara.keyboard.press("Enter")
    settled(mara)
    mara.wait_for_function("() => !semviz.state.labels.team.sent_back.length", timeout=WAIT_MS)


def test_what_somebody_is_unsure_about_is_listed_and_looked_at_closely(
    pages: dict[str, "Page"], served: Served
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    for frame, u in ((0, 100.0), (1, 140.0)):
        draw_on(mara, frame, u)
    row = served.observations[-1]
    flag = {"note_id": new_id(), "element_id": row.element_id, "frame_index": 1, "unsure": True}
    do(served.annotator.session, {"kind": "note", "text": "", **flag})
    tester.keyboard.press("F8")
    tester.click(".chip:has-text('Unsure 1')", timeout=WAIT_MS)
    tester.click("#team-queue .row:has-text('tester')")
    tester.wait_for_function("() => semviz.state.frame === 1", timeout=WAIT_MS)
    tester.wait_for_selector("#team-frame-panel:has-text('in work')")
    tester.keyboard.press("Enter")
    tester.wait_for_selector("#message:has-text('does not wait for a reviewer')")
    assert tester.locator("#team-queue .row").count() == 1
    tester.wait_for_selector("#team-notes:has-text('unsure')", timeout=WAIT_MS)
    tester.select_option("#team-element", row.element_id)
    tester.wait_for_function("() => semviz.team.picture.bitmap", timeout=WAIT_MS)
    picture = "document.getElementById('team-picture').toDataURL()"
    whole = tester.evaluate(picture)
    tester.keyboard.press("Escape")  # from the list of elements
    tester.keyboard.press("F8")
    tester.keyboard.press("z")
    tester.wait_for_function(f"(whole) => {picture} !== whole", arg=whole)
    tester.keyboard.press("z")
    tester.wait_for_function(f"(whole) => {picture} === whole", arg=whole)
