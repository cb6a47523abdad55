"""From a duplicate in the labels to the map without it, by a person's word, on the page alone."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import Killable
from duplicated_pole import element_id, street
from journeys.driver import LabelDriver

from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.rows import different_elements

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
WAIT_MS = 60_000


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street(tmp_path / "street")


@pytest.fixture
def killable(workspace: Workspace) -> Iterator[Killable]:
    server = Killable(workspace.path)
    yield server
    server.kill()


def build(page: "Page", operation: int) -> None:
    """By the button, until the page knows the map of ``operation``."""
    page.click("#build")
    known = f'#build[title$="up to operation {operation}"]'
    page.wait_for_selector(known, timeout=WAIT_MS)


def open_question(page: "Page") -> None:
    """Opens the list and goes on in it to the merge of the planted pole."""
    page.click('#jumps .row:has-text("Map decisions")')
    page.wait_for_selector("#review:not([hidden])")
    for _ in range(50):
        shown = page.inner_text("#review")
        if "Same landmark?" in shown and "P-01" in shown and "P-02" in shown:
            return
        page.keyboard.press("Shift+.")
        page.wait_for_timeout(100)
    raise AssertionError(f"no question about P-01 and P-02, but: {shown}")


def mapped(workspace: Workspace) -> set[int]:
    """Which of the planted elements the map has."""
    return set(workspace.read_map(MAIN).elements.id.tolist()) & {1, 2}


def test_a_person_says_two_and_the_next_map_has_two_until_that_is_undone(
    workspace: Workspace, killable: Killable, page: "Page", page_errors: list[str]
) -> None:
    driver = LabelDriver(page)
    driver.open(killable.start())
    page.wait_for_selector('#jumps .row:has-text("Map decisions"):has-text("no map")')
    build(page, 1)
    assert mapped(workspace) == {1}
    open_question(page)
    assert driver.frame == 2  # the last in which it is P-01; P-02 is in the next
    assert page.locator("#review .frame").all_inner_texts() == list("012345")

    before = driver.operation
    page.keyboard.press("Shift+Y")
    driver.wait_saved(before)
    judged = {different_elements(element_id(1), element_id(2))}
    assert set(workspace.read_labels().review_decisions.values()) == judged
    page.wait_for_selector("#build.due")
    build(page, 2)
    assert mapped(workspace) == {1, 2}
    (decision,) = (
        decision
        for decision in workspace.read_map(MAIN).decisions
        if set(decision.numbers) == {1, 2}
    )
    assert (decision.kind, decision.by) == ("apart", "human")

    killable.kill()
    page.goto(killable.start())
    page.wait_for_selector("#saved.saved")
    page_errors.clear()  # the connection that was cut
    assert set(workspace.read_labels().review_decisions.values()) == judged
    driver.press_and_save("Control+z")
    assert not workspace.read_labels().review_decisions
    build(page, 3)
    assert mapped(workspace) == {1}
    open_question(page)

    before = driver.operation
    page.keyboard.press("y")  # the other answer
    driver.wait_saved(before)
    assert {1, 2} & {element.number for element in workspace.read_labels().elements.values()} == {1}
    page.wait_for_selector("#review", state="hidden")
    assert "No decision is open." in page.inner_text("#message")
    driver.press_and_save("Control+z")
    assert element_id(2) in workspace.read_labels().elements
