"""History of the labelling page: every state can be seen, named and brought back, none is lost."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import Served, annotating, draw_signs
from drawn_marks import do
from journeys.driver import ROUNDED, LabelDriver
from streets import street_workspace

from semviz.annotator.history import PAGE_SIZE
from semviz.annotator.page_session import HANDLERS
from semviz.web.protocol import MalformedRequestError
from semviz.workspace.workspace import Workspace
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 3)


@pytest.fixture
def served(workspace: Workspace) -> Iterator[Served]:
    """Somebody else has drawn one sign in each frame; operations 1 to 3."""
    draw_signs(workspace, [(0, 300.0), (1, 300.0), (2, 300.0)], "somebody else")
    with annotating(workspace) as served:
        yield served


def names(page: "Page") -> list[str]:
    return page.locator("#elements .row .fill").all_inner_texts()


def look(driver: LabelDriver, number: int) -> None:
    """Presses "view" at an operation and waits for what it left."""
    row = driver.page.locator(f'.operation[data-number="{number}"]')
    row.hover()
    row.locator(".view").click()
    driver.page.wait_for_selector(f"#past:has-text('State after operation {number}')")
    driver.settle()


def test_an_earlier_state_is_looked_at_and_nothing_changes(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    driver.draw_sign("left", (500.0, 40.0), ROUNDED)
    driver.draw_sign("left", (600.0, 40.0), ROUNDED)
    driver.clear_selection()
    look(driver, 4)
    assert names(page) == ["O-01", "O-04"]
    said = page.inner_text("#past").replace("\n", " ")
    assert "just now, you, Draw O-04 left. Nothing is changed." in said
    driver.select("O-04")
    numbers = page.locator("#card .numbers b").all_inner_texts()
    assert set(numbers) == {"—"}  # they would be those of now
    driver.zoom_to("left", (700.0, 150.0))
    driver.click_at("left", (700.0, 150.0))
    page.wait_for_selector("#message:has-text('state after operation 4: press Esc to return')")
    page.keyboard.press("Control+z")
    page.keyboard.press("Enter")
    driver.goto(1)  # the past of every frame
    page.wait_for_function("() => document.querySelectorAll('#elements .row').length === 1")
    assert names(page) == ["O-02"]
    driver.goto(0)
    page.keyboard.press("Escape")
    page.wait_for_selector("#past", state="hidden")
    driver.settle()
    assert names(page)[:3] == ["O-01", "O-04", "O-05"]
    assert served.labels.operation == driver.operation == 5


def test_the_slider_goes_back_to_the_beginning_and_forth_to_now(driver: LabelDriver) -> None:
    page = driver.page
    page.locator("#past-slider").fill("0")
    page.wait_for_selector("#past:has-text('the beginning')")
    driver.settle()
    assert names(page) == []
    page.locator("#past-slider").fill("3")
    page.wait_for_selector("#past", state="hidden")
    driver.settle()
    assert names(page)[0] == "O-01"


def test_an_earlier_state_is_restored_as_an_operation_that_can_be_undone(
    driver: LabelDriver, served: Served
) -> None:
    driver.draw_sign("left", (500.0, 40.0), ROUNDED)
    look(driver, 2)
    before = driver.operation
    driver.page.click("text=Restore as new operation")
    driver.wait_saved(before)
    assert served.labels.operation == 5
    assert {row.frame_index for row in served.observations} == {0, 1}
    first = driver.page.locator("#history .row").first
    assert first.inner_text().split("\n") == ["5", "Restore operation 2"]
    driver.press_and_save("Control+z")
    assert {row.frame_index for row in served.observations} == {0, 1, 2}
    assert len(served.observations) == 4


def test_a_state_gets_a_name_and_is_found_by_it(driver: LabelDriver, served: Served) -> None:
    page = driver.page
    page.set_viewport_size({"width": 1280, "height": 720})
    assert page.locator("#history-panel").is_hidden()
    page.keyboard.press("Control+b")
    before = driver.operation
    page.keyboard.type("Before lunch <b>")
    page.keyboard.press("Enter")
    driver.wait_saved(before)
    named = page.locator("#named .row")
    named.wait_for()
    assert named.inner_text().split("\n") == ["Before lunch <b>", "4"]
    driver.draw_sign("left", (500.0, 40.0), ROUNDED)
    named.click()
    page.wait_for_selector("#past:has-text('State after operation 4')")
    driver.settle()
    assert names(page) == ["O-01"]
    page.keyboard.press("Escape")
    page.keyboard.press("Control+b")
    page.keyboard.type("Before lunch <b>")
    page.keyboard.press("Enter")
    page.wait_for_selector('#message:has-text("operation 4 is already named")')
    assert served.labels.operation == 5


def test_whose_edit_it_was_and_where(driver: LabelDriver) -> None:
    page = driver.page
    row = page.locator('.operation[data-number="3"] .row')
    assert row.inner_text().split("\n") == ["3", "Draw O-03 left", "somebody else"]
    assert (row.get_attribute("title") or "").endswith("frame 2")
    row.click()
    page.wait_for_selector('.tile.current[data-frame="2"]')


def test_older_operations_come_when_the_list_is_scrolled(
    workspace: Workspace, page: "Page"
) -> None:
    count = 2 * PAGE_SIZE + 30
    draw_signs(workspace, [(0, 4.0 * place) for place in range(count)], "tester")
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        for shown in (PAGE_SIZE, 2 * PAGE_SIZE, count):
            page.wait_for_function(
                "count => document.querySelectorAll('.operation').length === count", arg=shown
            )
            page.locator("#history").evaluate("list => list.scrollTo(0, list.scrollHeight)")
        numbers = page.locator(".operation").evaluate_all(
            "rows => rows.map(row => Number(row.dataset.number))"
        )
        assert numbers == list(range(count, 0, -1))
        page.goto("about:blank")


def test_what_the_page_may_ask_of_the_past(workspace: Workspace) -> None:
    draw_signs(workspace, [(0, 300.0), (1, 300.0)], "one")
    with annotating(workspace) as served:
        session = served.annotator.session
        past = session.history
        do(session, {"kind": "name", "name": "both"})
        (named,) = past.named_states()
        assert (named.number, named.text) == (3, "both")
        assert [row.number for row in past.operations(3)] == [2, 1]
        assert past.frame(0, 0).frame.elements == past.frame(1, 1).frame.elements == []
        assert past.frame(2, 1).frame.elements == session.frame(1).elements
        assert past.frame(0, 0).done is None
        for number, frame in ((4, 0), (1, 9)):
            with pytest.raises(SemvizError):
                past.frame(number, frame)
    for number, frame in ((-1, 0), (True, 0), ("1", 0), (1, None)):
        asked = {"type": "show_past_frame", "id": "1", "operation": number, "frame": frame}
        with pytest.raises(MalformedRequestError):
            HANDLERS.decode(json.dumps(asked))
