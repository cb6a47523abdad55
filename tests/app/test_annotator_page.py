"""The labelling page in a real browser: what the mouse does, what is stored, what is never lost."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Killable, Served, annotating
from drawn_marks import do
from journeys.driver import POLE, RECTANGULAR, ROUNDED, TRIANGULAR, LabelDriver
from streets import street_workspace

from semviz.annotator.session import LabelSession
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import new_id
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
PANE_MS = 240_000
"""A pane that never comes is told from one that is drawn by a busy processor."""


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 4)


def stereo_pole(left: float = 600.0, disparity: float = 20.0):  # type: ignore[no-untyped-def]
    """Peak and bottom of a pole in both images."""
    right = left - disparity
    return ((left, 60.25), (left + 1.5, 260.75)), ((right, 60.25), (right + 1.5, 260.75))


def test_a_pole_drawn_left_and_right_is_one_element_and_survives_a_reload(
    driver: LabelDriver, served: Served
) -> None:
    left, right = stereo_pole()
    assert driver.draw_pair(POLE, left, right) == "P-01"
    driver.page.reload()
    driver.page.wait_for_selector('#elements .row:has-text("P-01")')
    assert driver.page.inner_text("#saved") == "Saved operation 2"
    assert len(served.labels.elements) == 1
    for row, (peak, bottom) in zip(served.observations, (left, right), strict=True):
        np.testing.assert_allclose(row.anchor_px, peak, atol=0.01)
        np.testing.assert_allclose(row.end_px, bottom, atol=0.01)


def test_nothing_is_drawn_on_the_picture_of_the_frame_before(
    driver: LabelDriver, served: Served
) -> None:
    """A click on an image that is slow to come would be a label on what it does not show."""
    page, held = driver.page, []
    page.route("**/image/3/*.png", lambda route: held.append(route))
    page.keyboard.press("4")
    page.click('.tile[data-frame="3"]')
    opacity = "side => document.querySelector(`#${side}-image canvas.picture`).style.opacity"
    page.wait_for_function(f"() => ({opacity})('left') === '0.3'")
    driver.click_at("left", (333.3, 121.7))
    driver.settle()
    assert driver.operation == 0
    for route in held:
        route.continue_()
    page.wait_for_function(f"() => ({opacity})('left') === '1'")
    driver.click_at("left", (333.3, 121.7))
    driver.wait_saved(0)
    assert [row.frame_index for row in served.observations] == [3]


@pytest.mark.parametrize("scale", [0.9, 1.7, 5.0, 40.0])
def test_clicks_land_on_the_pixel_under_the_pointer_at_every_zoom(
    driver: LabelDriver, served: Served, scale: float
) -> None:
    driver.page.keyboard.press("4")
    for side, pixel in (("left", (0.0, 0.0)), ("right", (1240.0, 375.0)), ("left", (333.3, 121.7))):
        driver.zoom_to(side, pixel, scale)
        before = driver.operation
        driver.click_at(side, pixel)
        driver.wait_saved(before)
        np.testing.assert_allclose(served.observations[-1].anchor_px, pixel, atol=0.05)


def test_both_images_have_the_same_zoom_and_pan(driver: LabelDriver) -> None:
    driver.zoom_to("right", (900.0, 100.0), 6.0)
    box = driver.page.locator("#left-image canvas.marks").bounding_box()
    assert box is not None
    driver.page.mouse.move(box["x"] + 500, box["y"] + 100)
    driver.page.mouse.down(button="right")
    driver.page.mouse.move(box["x"] + 440, box["y"] + 130, steps=2)
    driver.page.mouse.up(button="right")
    driver.settle()
    views = [
        driver.page.get_attribute(f"#{side}-image canvas.marks", "data-view")
        for side in ("left", "right")
    ]
    assert views[0] == views[1]
    assert driver.operation == 0


def test_a_box_around_a_sign_gives_its_middle(driver: LabelDriver, served: Served) -> None:
    middle = (700.37, 130.62)
    driver.page.keyboard.press("3")
    driver.zoom_to("left", middle)
    view, before = driver.view("left"), driver.operation
    driver.page.mouse.move(*view.screen((middle[0] - 6.5, middle[1] - 4.25)))
    driver.page.mouse.down()
    driver.page.mouse.move(*view.screen((middle[0] + 6.5, middle[1] + 4.25)), steps=4)
    driver.page.mouse.up()
    driver.wait_saved(before)
    (row,) = served.observations
    np.testing.assert_allclose(row.anchor_px, middle, atol=0.01)
    assert served.labels.element(row.element_id).class_id == RECTANGULAR


def test_escape_in_mid_drawing_leaves_nothing(driver: LabelDriver, served: Served) -> None:
    driver.page.keyboard.press("1")
    driver.click_at("left", (600.0, 100.0))
    driver.page.wait_for_selector("#left-image .status:has-text('second click sets the bottom')")
    driver.press("Escape")
    driver.page.mouse.move(900, 300)
    assert driver.draw_sign("left", (700.0, 120.0), TRIANGULAR) == "T-01"
    assert [row.end_px for row in served.observations] == [None]


def test_undo_and_redo_go_to_the_frame_that_they_change(
    driver: LabelDriver, served: Served
) -> None:
    driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    driver.goto(2)
    driver.press_and_save("Control+z")
    driver.page.wait_for_selector('.tile.current[data-frame="0"]')
    assert served.observations == []
    driver.goto(1)
    driver.press_and_save("Control+Shift+Z")
    driver.page.wait_for_selector('.tile.current[data-frame="0"]')
    assert len(served.observations) == 1
    assert driver.page.inner_text("#history .row >> nth=0").split() == ["3", "Redo", "1"]


def test_drag_nudge_flag_swap_and_delete(driver: LabelDriver, served: Served) -> None:
    (peak, bottom), _ = stereo_pole()
    driver.draw_pole("left", peak, bottom)
    before = driver.operation
    driver.zoom_to("left", bottom, 10.0)
    view = driver.view("left")
    driver.page.mouse.move(*view.screen(bottom))
    driver.page.mouse.down()
    driver.page.mouse.move(*view.screen((bottom[0] + 5.0, bottom[1] - 2.0)), steps=3)
    driver.page.mouse.up()
    driver.wait_saved(before)
    for key in ("ArrowRight", "Shift+ArrowUp"):
        driver.press_and_save(key)
    (row,) = served.observations
    np.testing.assert_allclose(row.anchor_px, peak, atol=0.01)
    np.testing.assert_allclose(row.end_px, (bottom[0] + 5.1, bottom[1] - 3.0), atol=0.02)
    driver.press_and_save("o")
    assert not served.observations[0].end_known
    driver.press_and_save("r")
    assert served.observations[0].end_px == row.anchor_px
    assert not served.observations[0].anchor_known
    driver.press_and_save("Delete")
    assert served.observations == []
    assert "Ctrl Z brings all back" in driver.page.inner_text("#message")
    driver.press_and_save("Control+z")
    assert len(served.observations) == 1


def test_two_drawn_apart_are_linked_and_one_class_becomes_another(
    driver: LabelDriver, served: Served
) -> None:
    first = driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    second = driver.draw_sign("right", (680.0, 120.0), TRIANGULAR)
    assert (first, second) == ("T-01", "T-02")
    driver.click_at("left", (700.0, 120.0))
    driver.page.keyboard.down("Control")
    driver.click_at("right", (680.0, 120.0))
    driver.page.keyboard.up("Control")
    driver.press_and_save("p")
    assert len(served.labels.elements) == 1
    driver.select("T-01")
    driver.press_and_save("Shift+Digit4")
    assert [element.class_id for element in served.labels.elements.values()] == [ROUNDED]


def test_reviewing_is_an_act_and_shows_in_the_frames(driver: LabelDriver, served: Served) -> None:
    driver.press_and_save("Shift+Enter")
    title = "Frame 0: reviewed, empty, 0 elements"
    driver.page.wait_for_selector(f'.tile[data-frame="0"][title="{title}"]')
    driver.press(".")
    driver.goto(1)
    assert served.labels.review(1) == "unseen"
    assert "1 / 4" in driver.page.inner_text("#reviewed")


def test_a_second_tab_sees_the_edits_of_the_first(driver: LabelDriver, served: Served) -> None:
    second = driver.page.context.new_page()
    other = LabelDriver(second)
    other.open(served.url)
    driver.page.bring_to_front()
    driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    second.bring_to_front()
    second.wait_for_selector('#elements .row:has-text("T-01")')
    other.draw_sign("left", (300.0, 150.0), ROUNDED)
    driver.page.bring_to_front()
    driver.page.wait_for_selector('#elements .row:has-text("O-02")')
    assert driver.page.inner_text("#saved") == "Saved operation 2"


def test_an_edit_by_another_process_appears_by_itself(
    driver: LabelDriver, workspace: Workspace
) -> None:
    other = LabelSession(workspace, "somebody else")
    for frame in (0, 2):
        do(other, rounded_sign(frame))
    other.close()
    driver.page.wait_for_selector('#elements .row:has-text("O-01")')
    driver.page.wait_for_selector('.tile[data-frame="2"][title*="1 element"]')
    assert driver.page.inner_text("#saved") == "Saved operation 2"


def rounded_sign(frame: int) -> dict[str, object]:
    return {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": "left",
        "class_id": ROUNDED,
        "anchor_px": [700.0, 120.0],
    }


def test_what_the_disk_refuses_is_kept_and_saved_when_there_is_room(
    driver: LabelDriver, served: Served
) -> None:
    """The second edit builds on the first, so it must wait behind it."""
    connection = served.annotator.session._store._file.connection
    connection.execute("PRAGMA query_only = 1")
    driver.page.keyboard.press("4")
    driver.click_at("left", (400.0, 150.0))
    driver.page.wait_for_selector("#saved.wrong:has-text('cannot be written')")
    driver.page.keyboard.press("Shift+ArrowRight")
    driver.page.wait_for_selector("#saved.wrong:has-text('2 kept here')")
    assert served.observations == []
    connection.execute("PRAGMA query_only = 0")
    driver.page.wait_for_selector("#saved:has-text('Saved operation 2')")
    (row,) = served.observations
    np.testing.assert_allclose(row.anchor_px, (401.0, 150.0), atol=0.05)


def test_what_changes_nothing_is_no_operation(driver: LabelDriver, served: Served) -> None:
    driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    at = driver.view("left").screen((700.0, 120.0))
    driver.page.mouse.move(*at)
    driver.page.mouse.down()
    driver.page.mouse.move(at[0] + 30.0, at[1], steps=2)
    driver.page.mouse.move(*at)
    driver.page.mouse.up()
    driver.press_and_save("Enter")
    driver.page.keyboard.press("Enter")
    driver.page.keyboard.press("Shift+Digit2")
    driver.press_and_save("ArrowRight")
    assert driver.operation == served.labels.operation == 3


def test_a_pole_too_far_to_be_expected_is_continued_from_the_list(
    driver: LabelDriver, served: Served
) -> None:
    left, right = stereo_pole(disparity=1.0)
    assert driver.draw_pair(POLE, left, right) == "P-01"
    driver.goto(1)
    driver.clear_selection()
    row = '#elements .row:has-text("P-01")'
    assert driver.page.inner_text(row).split("\n")[-1] == "far"
    assert driver.draw_pole("left", *left, element="P-01") == "P-01"
    assert "left only" in driver.page.inner_text(row)
    assert len(served.labels.elements) == 1


def test_the_new_element_appears_in_the_map(served: Served, page: "Page") -> None:
    """The pane is small, and out of sight while the element is drawn: without a graphics card one
    picture of it can take seconds."""
    page.emulate_media(color_scheme="dark")
    page.set_viewport_size({"width": 1280, "height": 720})
    driver = LabelDriver(page)
    driver.open(served.url, with_map=True)
    page.wait_for_selector("#scene.ready", timeout=PANE_MS)
    page.keyboard.press("f")
    left, right = stereo_pole(left=560.0, disparity=40.0)
    driver.draw_pair(POLE, left, right)
    driver.clear_selection()
    page.wait_for_selector("#map-about[title='1 element']", state="attached")
    scene = page.locator("#scene")
    assert scene.is_hidden()
    page.keyboard.press("f")
    deadline = time.monotonic() + PANE_MS / 1000.0
    while _count_pixels(scene.screenshot(timeout=PANE_MS), (239, 225, 84)) < 20:
        assert time.monotonic() < deadline, "no pole in the 3D map"
        page.wait_for_timeout(500)


def _count_pixels(png: bytes, color: tuple[int, int, int]) -> int:
    import cv2

    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return int((np.abs(image.astype(int) - color).max(axis=-1) < 40).sum())


def test_an_image_that_cannot_be_read_says_why(
    page: "Page",
    workspace: Workspace,
    page_errors: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = workspace.source
    image = source.image

    def broken(index, side):  # type: ignore[no-untyped-def]
        if side == "right":
            raise SemvizError("000000.png is 1242x375, calibration says 1241x376")
        return image(index, side)

    monkeypatch.setattr(source, "image", broken)  # the source is shared between tests
    with annotating(workspace) as served:
        page.goto(served.url)
        page.wait_for_selector("#right-image .message:has-text('calibration says 1241x376')")
        page.goto("about:blank")
    page_errors.clear()


def test_every_command_is_in_the_help_and_no_key_is_taken_twice(driver: LabelDriver) -> None:
    driver.page.keyboard.press("?")
    text = driver.page.inner_text("dialog.help")
    for title in ("Swap peak and bottom", "Mark as reviewed, empty", "Redo", "Epipolar line"):
        assert title in text
    badges = driver.page.locator("dialog.help li .keys").all_inner_texts()
    assert not {badge.strip().lower() for badge in badges} & set("wasdqe")


@pytest.fixture
def killable(workspace: Workspace) -> Iterator[Killable]:
    server = Killable(workspace.path)
    yield server
    server.kill()


def test_kill_9_loses_nothing_that_was_called_saved_nor_what_was_drawn_after(
    page: "Page", workspace: Workspace, killable: Killable, page_errors: list[str]
) -> None:
    driver = LabelDriver(page)
    driver.open(killable.start())
    driver.draw_sign("left", (700.0, 120.0), TRIANGULAR)
    killable.kill()
    with workspace.open_labels() as store:
        assert store.last_operation == 1
        (kept,) = store.labels.observations.values()
    np.testing.assert_allclose(kept.anchor_px, (700.0, 120.0), atol=0.01)

    driver.press("Escape")
    driver.click_at("left", (400.0, 150.0))
    page.wait_for_selector("#saved:has-text('Offline, 1 kept here')")
    page.keyboard.press("Control+z")
    driver.click_at("left", (420.0, 150.0))
    page.wait_for_selector("#saved:has-text('Offline, 3 kept here')")
    killable.start()
    page.wait_for_selector("#saved:has-text('Saved operation 4')", timeout=60_000)
    killable.kill()
    labels = workspace.read_labels()
    places = sorted(row.anchor_px[0] for row in labels.observations.values())
    np.testing.assert_allclose(places, (420.0, 700.0), atol=0.05)
    page.goto("about:blank")  # images that were under way have failed by now
    page_errors.clear()  # the browser reports the connections that were refused


def test_an_open_page_goes_on_once_the_new_address_was_opened(
    page: "Page", workspace: Workspace, killable: Killable, page_errors: list[str]
) -> None:
    """Each start has another token; the browser has one cookie for all its pages."""
    driver = LabelDriver(page)
    driver.open(killable.start())
    killable.kill()
    page.keyboard.press("2")
    driver.click_at("left", (400.0, 150.0))
    page.wait_for_selector("#saved:has-text('Offline, 1 kept here')")
    killable.token = "another"
    url = killable.start()
    page.wait_for_timeout(1000)
    assert len(workspace.read_labels().observations) == 0
    page.context.request.get(url)
    page.wait_for_selector("#saved:has-text('Saved operation 1')", timeout=60_000)
    assert len(workspace.read_labels().observations) == 1
    page.close()  # before its server ends: it is still fetching the next images
    page_errors.clear()


def test_edits_kept_by_a_closed_page_are_saved_by_the_next_one(
    page: "Page", workspace: Workspace, killable: Killable, page_errors: list[str]
) -> None:
    driver = LabelDriver(page)
    url = killable.start()
    driver.open(url)
    killable.kill()
    page.keyboard.press("2")
    driver.click_at("left", (400.0, 150.0))
    page.wait_for_selector("#saved:has-text('Offline, 1 kept here')")
    next_page = page.context.new_page()
    page.close()
    killable.start()
    next_page.goto(url)
    next_page.wait_for_selector("#saved:has-text('Saved operation 1')", timeout=60_000)
    assert len(workspace.read_labels().observations) == 1
    page_errors.clear()
