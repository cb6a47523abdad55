"""Several elements selected together on the page: by a rectangle, by keys, in the list."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import Served, annotating, settled
from journeys.driver import POLE, ROUNDED, LabelDriver
from labelled_street import label_street
from streets import street, street_workspace

from semviz_annotation.labels.labels import Labels, Observation

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.browser
FRAMES = 4


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    label_street(workspace, street(7, FRAMES), range(2))
    with annotating(workspace) as served:
        yield served


def here(labels: Labels, side: str = "left") -> list[Observation]:
    return [row for row in labels.in_frame(0) if row.side == side]


def select_all_with_rectangle(driver: LabelDriver) -> None:
    """Ctrl and a drag over the whole left image, in the middle of which nothing else begins."""
    page = driver.page
    box = page.locator("#left-image canvas.marks").bounding_box()
    assert box is not None
    page.keyboard.down("Control")
    page.mouse.move(box["x"] + 3, box["y"] + 3)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] - 3, box["y"] + box["height"] - 3, steps=4)
    page.mouse.up()
    page.keyboard.up("Control")


def press(driver: LabelDriver, key: str) -> None:
    before = driver.operation
    driver.page.keyboard.press(key)
    driver.wait_saved(before)
    settled(driver.page)


def test_what_a_rectangle_touches_is_changed_together_and_undone_as_one(
    driver: LabelDriver, served: Served
) -> None:
    page, before = driver.page, served.labels
    signs = {row.element_id for row in here(before) if row.end_px is None}
    poles = {row.id for row in here(before) if row.end_px is not None}
    assert len(signs) > 1
    assert len(poles) > 1
    select_all_with_rectangle(driver)
    page.wait_for_selector(f"#card h2:text-is('{len(here(before))} selected')")
    chosen = page.locator("#elements .row.chosen").count()
    assert chosen == len(here(before))

    press(driver, f"Shift+Digit{ROUNDED + 1}")
    assert {served.labels.element(id_).class_id for id_ in signs} == {ROUNDED}
    assert f"{len(poles)} of {len(here(before))} stay as they are" in page.inner_text("#message")
    press(driver, "Control+z")
    assert served.labels == before

    press(driver, "o")
    assert not any(row.end_known for row in here(served.labels) if row.id in poles)
    press(driver, "o")
    assert all(row.end_known for row in here(served.labels) if row.id in poles)
    press(driver, "Control+z")
    press(driver, "Control+z")
    assert served.labels == before

    press(driver, "Delete")
    assert not here(served.labels)
    assert here(served.labels, "right") == here(before, "right")
    assert page.inner_text("#message").startswith(f"Deleted {len(here(before))} views in 1 frame")
    press(driver, "Delete")
    assert not here(served.labels, "right"), "those in the other image stayed selected"
    press(driver, "Control+z")
    press(driver, "Control+z")
    assert served.labels == before


def test_proposals_are_accepted_and_rejected_together_by_keys_alone(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    driver.goto(2)
    page.wait_for_function("() => !semviz.state.shownFrame.is_searching")
    page.keyboard.press("Control+a")
    count = page.evaluate("semviz.state.selectedProposals.length")
    assert count > 2
    page.wait_for_selector(f"#hints .hint:has-text('accept {count}')")
    page.keyboard.press("F6")
    while not page.evaluate("document.activeElement.matches('#elements .row')"):
        page.keyboard.press("F6")
    page.keyboard.press("Control+Enter")  # the first row is taken out
    assert page.evaluate("semviz.state.selectedProposals.length") == count - 1
    page.keyboard.press("Escape")
    press(driver, "x")
    left = page.evaluate("semviz.state.proposals.length")
    assert left == 1
    press(driver, "Control+z")
    page.keyboard.press("Control+a")
    before = driver.operation
    press(driver, "Space")
    assert driver.operation == before + 1
    assert len({row.element_id for row in served.labels.in_frame(2)}) == count


def test_a_drawing_joins_none_of_several_and_another_frame_forgets_them(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    page.keyboard.press("Control+a")
    known = set(served.labels.elements)
    page.keyboard.press("4")
    driver.zoom_to("left", (5.0, 5.0))
    page.keyboard.down("Shift")
    driver.click_at("left", (5.0, 5.0))
    page.keyboard.up("Shift")
    settled(page)
    page.wait_for_function("count => semviz.state.elements.length > count", arg=0)
    assert len(set(served.labels.elements) - known) == 1
    page.keyboard.press("Control+a")
    page.keyboard.press(".")
    driver.settle()
    assert page.evaluate("semviz.state.selected") is None


def test_a_rejected_pole_is_drawn_again_without_its_class_key(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    driver.goto(2)
    page.wait_for_function("() => !semviz.state.shownFrame.is_searching")
    page.keyboard.press(f"Digit{ROUNDED + 1}")
    pole = page.evaluate(
        """() => {
            const pole = semviz.state.proposals.find(({ class_id: id, marks }) => id === 0
                && marks.left?.anchor[1] > 20 && marks.left?.end);
            semviz.select(pole.id);
            return { ...pole.marks.left, id: pole.id };
        }"""
    )
    press(driver, "x")
    for point in (pole["anchor"], pole["end"]):
        driver.zoom_to("left", tuple(point))
        page.keyboard.down("Shift")
        driver.click_at("left", tuple(point))
        page.keyboard.up("Shift")
    settled(page)
    drawn = [row for row in served.labels.in_frame(2) if row.element_id == pole["id"]]
    assert [row.end_px is not None for row in drawn] == [True]
    assert page.evaluate("semviz.state.classId") == ROUNDED
    assert served.labels.element(pole["id"]).class_id == POLE
