"""The labelling page without a mouse: keys that can be changed, the palette, a cursor, the tour."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from journeys.driver import RECTANGULAR, TRIANGULAR, LabelDriver
from streets import street_workspace

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.class_looks import ClassLook, new_class

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = pytest.mark.browser


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 3)


def help_row(page: "Page", title: str) -> "Locator":
    return page.locator(f'dialog.help li:has(span:text-is("{title}"))')


def change_key(page: "Page", title: str, key: str) -> str:
    """Opens the help, gives the command another key, and returns what the page said to it."""
    page.keyboard.press("?")
    page.click("text=Change keys…")
    help_row(page, title).locator("button.kbd").first.click()
    page.keyboard.press(key)
    said = page.inner_text("dialog.help [role=status]")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog", state="detached")
    return said


def test_a_changed_key_works_is_shown_everywhere_and_stays(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    assert change_key(page, "Loupe", "Shift+L") == "“Loupe” is now Shift L."
    aid = page.locator('#aids .row:has-text("Loupe")')
    for press, state in (("l", "true"), ("Shift+L", "false")):
        page.keyboard.press(press)
        driver.settle()
        assert aid.get_attribute("aria-checked") == state
    page.reload()
    page.wait_for_selector("#saved.saved")
    driver.settle()
    assert aid.locator("kbd").inner_text() == "Shift L"
    page.keyboard.press("?")
    assert help_row(page, "Loupe").locator("kbd").all_inner_texts() == ["Shift", "L"]
    page.click("text=Change keys…")
    page.click("text=Reset to defaults")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog", state="detached")
    driver.settle()
    assert aid.locator("kbd").inner_text() == "L"


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("x", "X is both “Reject: not here” and “Loupe”: nothing was changed."),
        ("w", "W moves the camera of the 3D scene: nothing was changed."),
        ("ArrowUp", "↑ is both “Move 0.1 px (cursor 1 px)” and “Loupe”: nothing was changed."),
        ("Control+l", "Ctrl L belongs to the browser: nothing was changed."),
    ],
)
def test_a_clash_is_refused_by_name(driver: LabelDriver, key: str, said: str) -> None:
    assert change_key(driver.page, "Loupe", key) == said
    assert driver.page.evaluate("localStorage['semviz.keys.annotate'] ?? '{}'") == "{}"


def test_a_kept_key_that_the_list_has_given_away_falls_back(served: Served, page: "Page") -> None:
    kept = {"l": {"key": "x", "shift": False, "ctrl": False}, "b": {"key": "Home"}}
    page.add_init_script(f"localStorage['semviz.keys.annotate'] = '{json.dumps(kept)}'")
    LabelDriver(page).open(served.url)
    assert page.inner_text('#aids .row:has-text("Loupe") kbd') == "L"
    assert page.inner_text('#aids .row:has-text("Brightness") kbd') == "Home"


def test_every_command_is_in_the_help_and_in_the_palette(driver: LabelDriver) -> None:
    page = driver.page
    page.keyboard.press("?")
    page.click("text=Change keys…")
    in_help = page.locator("dialog.help button.kbd").count()
    groups = page.locator("dialog.help h3").all_inner_texts()
    of_images = ["Draw", "Proposals", "View", "Frames", "Map", "History", "General"]
    assert groups == [*of_images, "Poses"]  # those that work in this view
    page.keyboard.press("Escape")
    page.keyboard.press("Control+k")
    in_palette = page.locator("dialog.palette [role=option]").count()
    everywhere = page.evaluate(
        "() => semviz.keys.commands.filter(({ run, view }) => run && (view ?? '') === '').length"
    )
    assert in_help == everywhere - 1  # Esc has its place and cannot be changed
    assert in_palette == page.evaluate("() => semviz.keys.commands.filter(({ run }) => run).length")
    page.keyboard.type("revi emp")
    options = page.locator("dialog.palette [role=option]")
    assert options.all_inner_texts() == ["Frames\nMark as reviewed, empty\nShift\nEnter"]
    before = driver.operation
    page.keyboard.press("Enter")
    driver.wait_saved(before)
    assert page.locator("dialog").count() == 0
    page.wait_for_selector('.tile[data-frame="0"][title*="reviewed, empty"]')


def test_class_keys_follow_the_classes_of_the_workspace(workspace: Workspace, page: "Page") -> None:
    with workspace.open_labels() as store:
        store.apply(new_class(store.labels, 4, "gantry", "line", ClassLook()), "ann")
        store.apply(new_class(store.labels, 5, "lamp", "point", ClassLook()), "ann")
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.keyboard.press("6")
        driver.settle()
        assert page.inner_text("#classes .row.chosen .fill") == "Lamp"
        assert driver.draw_sign("left", (700.0, 40.0), 5) == "L-01"
        driver.press_and_save("Shift+Digit2")
        assert [element.class_id for element in served.labels.elements.values()] == [TRIANGULAR]
        page.keyboard.press("?")
        keys = help_row(page, "Class of the selection").locator("kbd").all_inner_texts()
        assert keys == ["Shift", "1", "2", "3", "4", "5", "6"]
        page.goto("about:blank")


def press(page: "Page", key: str, times: int) -> None:
    for _ in range(times):
        page.keyboard.press(key)


def test_a_pole_and_its_correspondence_are_drawn_by_keys_alone(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    page.keyboard.press("1")
    page.keyboard.press("+")  # in the middle of the image: (620, 188)
    press(page, "Shift+ArrowUp", 12)
    press(page, "Control+ArrowRight", 3)
    before = driver.operation
    page.keyboard.press("+")
    page.wait_for_selector("#left-image .status:has-text('second click sets the bottom')")
    press(page, "Shift+ArrowDown", 15)
    press(page, "ArrowRight", 2)
    page.keyboard.press("+")
    driver.wait_saved(before)
    page.keyboard.press("-")  # the same place in the right image
    press(page, "Shift+ArrowUp", 15)
    press(page, "Shift+ArrowLeft", 2)
    press(page, "ArrowLeft", 2)
    before = driver.operation
    page.keyboard.press("+")
    press(page, "Shift+ArrowDown", 15)
    press(page, "ArrowRight", 2)
    page.keyboard.press("+")
    driver.wait_saved(before)
    left, right = served.observations
    assert left.element_id == right.element_id
    assert left.end_px is not None
    assert right.end_px is not None
    np.testing.assert_allclose(left.anchor_px[0] % 1.0, 0.3, atol=1e-9)
    np.testing.assert_allclose(np.subtract(left.end_px, left.anchor_px), (2.0, 150.0), atol=1e-9)
    by = [np.subtract(left.anchor_px, right.anchor_px), np.subtract(left.end_px, right.end_px)]
    np.testing.assert_allclose(by, [(20.0, 0.0)] * 2, atol=1e-9)
    page.keyboard.press("Escape")  # the cursor goes, the pole stays in hand
    driver.press_and_save("ArrowRight")
    assert np.isclose(served.observations[1].anchor_px[0] - right.anchor_px[0], 0.1)


def test_the_cursor_stays_in_the_image_and_in_sight(driver: LabelDriver) -> None:
    page = driver.page
    page.keyboard.press("+")
    press(page, "PageUp", 6)
    press(page, "Shift+ArrowRight", 90)
    driver.settle()
    view = driver.view("left")
    box = page.locator("#left-image canvas.marks").bounding_box()
    assert box is not None
    last = view.screen((1240.0, 188.0))
    assert box["x"] < last[0] < box["x"] + box["width"]


def test_panels_and_lists_are_worked_by_keys(driver: LabelDriver, served: Served) -> None:
    page = driver.page
    for u in (300.0, 400.0):
        driver.draw_sign("left", (u, 40.0), RECTANGULAR)
    driver.clear_selection()
    page.keyboard.press("F6")
    focused = "document.activeElement.closest('.list, .topbar, .image')?.id"
    for _ in range(12):
        if page.evaluate(focused) == "elements":
            break
        page.keyboard.press("F6")
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(outline) == "solid"
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    driver.settle()
    assert driver.selected == "R-02"
    assert page.evaluate(focused) == "elements"
    before = driver.operation
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    driver.settle()
    assert driver.operation == before  # Enter presses what has the focus; it reviews nothing
    page.keyboard.press("Escape")
    assert page.evaluate("document.activeElement.className") == "marks"
    driver.press_and_save("Enter")
    assert served.labels.review(0) == "reviewed"


def test_two_elements_are_linked_and_the_right_one_nudged_by_keys(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    driver.clear_selection()
    driver.draw_sign("right", (650.0, 40.0), TRIANGULAR)
    page.locator('#elements .row:has-text("T-01")').focus()
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Control+Enter")
    driver.settle()
    page.keyboard.press("Escape")
    driver.press_and_save("p")
    assert len(served.labels.elements) == 1
    sides = {row.side: row.anchor_px[0] for row in served.observations}
    driver.select("T-01")
    page.keyboard.press("-")
    driver.press_and_save("ArrowRight")
    moved = {row.side: row.anchor_px[0] for row in served.observations}
    assert moved["left"] == sides["left"]
    assert np.isclose(moved["right"] - sides["right"], 0.1)


def test_the_mouse_leaves_the_keys_with_the_images(driver: LabelDriver, served: Served) -> None:
    driver.page.click('#classes .row:has-text("Triangular")')
    driver.press_and_save("Shift+Enter")
    assert served.labels.review(0) == "reviewed, empty"


def test_the_tour_leads_through_three_steps_beside_the_images(served: Served, page: "Page") -> None:
    for width, height in ((1280, 720), (1600, 950)):
        page.set_viewport_size({"width": width, "height": height})
        page.goto(served.url)
        page.wait_for_selector("#tour:not([hidden])")
        tour, images = (page.locator(selector).bounding_box() for selector in ("#tour", ".images"))
        assert tour is not None
        assert images is not None
        assert tour["x"] >= images["x"] + images["width"]
        assert tour["y"] + tour["height"] <= height
    driver = LabelDriver(page)
    driver.open(served.url)
    title = page.locator("#tour h2")
    assert title.inner_text() == "Draw a pole"
    before = driver.operation
    page.keyboard.press("1")
    driver.click_at("left", (700.0, 60.0))
    driver.click_at("left", (700.0, 200.0))
    driver.wait_saved(before)
    assert title.inner_text() == "Second image, next frames"
    driver.goto(1)
    driver.settle()
    assert title.inner_text() == "Saved, and undo"
    page.keyboard.press("Escape")
    page.wait_for_selector("#tour", state="hidden")
    page.reload()
    page.wait_for_selector("#saved.saved")
    driver.settle()
    assert page.locator("#tour").is_hidden()
    page.keyboard.press("?")
    page.click("dialog.help >> text=Tour in 3 steps")
    page.wait_for_selector("#tour:has-text('step 1 of 3')")


def test_brightness_and_contrast_are_those_of_the_workspace(driver: LabelDriver) -> None:
    page = driver.page
    filters = """() => ["left", "right"].map(side =>
        getComputedStyle(document.querySelector(`#${side}-image canvas.picture`)).filter)"""
    assert page.evaluate(filters) == ["none", "none"]
    page.keyboard.press("b")
    page.wait_for_selector("#light:not([hidden])")
    assert page.evaluate(filters) == ["brightness(1.7) contrast(1.15)"] * 2
    page.locator("#brightness").focus()
    page.keyboard.press("ArrowRight")
    page.locator("#contrast").fill("2")
    driver.settle()
    assert page.evaluate(filters) == ["brightness(1.75) contrast(2)"] * 2
    page.reload()
    page.wait_for_selector("#saved.saved")
    driver.settle()
    assert page.evaluate(filters) == ["none", "none"]
    page.keyboard.press("b")
    driver.settle()
    assert page.evaluate(filters) == ["brightness(1.75) contrast(2)"] * 2
    page.click("#contrast-value")
    driver.settle()
    assert page.evaluate(filters) == ["brightness(1.75) contrast(1.15)"] * 2
