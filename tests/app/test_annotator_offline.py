"""Offline: what is known stays on the page, and every edit is kept and saved later."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import SIDES, annotating
from journeys.driver import POLE, ROUNDED, TRIANGULAR, LabelDriver
from streets import street_workspace

from semviz_annotation.labels.labels import new_id

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
CUT = """() => {
    window.Connected = WebSocket;
    window.WebSocket = class extends EventTarget { static OPEN = 1; readyState = 3; };
    semviz.socket._socket.close();
}"""
IS_CUT = "() => !semviz.state.connected && !(semviz.socket._socket instanceof window.Connected)"
MEND = """() => {
    window.WebSocket = window.Connected;
    semviz.socket._socket = semviz.socket._connect();
}"""


def says(page: "Page", where: str, text: str) -> None:
    page.wait_for_selector(f"{where}:has-text('{text}')")


def step(page: "Page", key: str, frame: int) -> None:
    page.keyboard.press(key)
    page.wait_for_selector(f'.tile.current[data-frame="{frame}"]')
    for side in SIDES:
        page.wait_for_selector(f'#{side}-image canvas.marks[data-frame="{frame}"]')


def test_offline_what_is_known_stays_and_what_is_drawn_is_kept(
    page: "Page", tmp_path: Path
) -> None:
    with annotating(street_workspace(tmp_path / "street", 7, 4)) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        driver.draw_pair(POLE, ((600.0, 60.0), (601.0, 260.0)), ((560.0, 60.0), (561.0, 260.0)))
        driver.clear_selection()
        driver.draw_sign("left", (800.0, 120.0), ROUNDED)
        driver.goto(1)
        driver.draw_sign("left", (300.0, 120.0), TRIANGULAR)
        driver.goto(0)
        driver.select("P-01")
        says(page, "#card", "±")
        depth = page.inner_text("#card dd >> nth=0")
        page.evaluate(CUT)
        page.wait_for_function(IS_CUT)
        says(page, "#saved", "Offline, 0 kept here")

        driver.select("O-02")  # never the numbers of another element
        says(page, "#card", "Offline: depth and errors follow.")
        assert depth not in page.inner_text("#card")
        driver.select("P-01")  # its own are known
        says(page, "#card", depth)
        page.keyboard.press("1")
        driver.click_at("left", (420.0, 60.0))
        says(page, "#card", "New pole")
        assert depth not in page.inner_text("#card")
        driver.press("Escape")

        step(page, ".", 1)  # seen before
        says(page, "#elements-about", "1 here")
        says(page, "#elements", "T-03")
        step(page, ".", 2)  # never seen
        says(page, "#elements-about", "0 drawn here")
        says(page, "#elements", "the other labels of this frame are not known here")
        driver.clear_selection()
        page.keyboard.press("2")
        driver.click_at("left", (400.0, 150.0))
        says(page, "#saved", "Offline, 1 kept here")
        says(page, "#elements-about", "1 drawn here")
        page.keyboard.press("Control+z")
        says(page, "#elements-about", "0 drawn here")
        driver.click_at("left", (420.0, 150.0))
        says(page, "#saved", "Offline, 3 kept here")
        says(page, "#elements-about", "1 drawn here")
        page.keyboard.press("Enter")
        says(page, "#message", "Kept here: it shows when the server is back.")
        page.keyboard.press("Shift+m")
        says(page, "#message", "Offline: not done.")
        page.keyboard.press("F7")
        says(page, "#filmstrip-about", "Offline: the images are searched when the server is back")
        page.keyboard.press("F2")
        for note in (new_id(), new_id()):  # what they are about is gone
            page.evaluate("id => semviz.submit({ kind: 'delete note', note_id: id })", note)

        step(page, ",", 1)
        driver.clear_selection()
        page.keyboard.press("1")
        driver.zoom_to("left", (500.0, 100.0), 3.0)
        driver.click_at("left", (500.0, 100.0))  # half a pole
        zoom = driver.view("left")
        page.evaluate(MEND)
        page.wait_for_selector("#saved.saved")
        page.wait_for_function("() => !semviz.state.pending.length && !semviz.state.isUnknown")
        says(page, "#question", "Not made, though kept while offline")
        assert page.inner_text("#question").count("no such note") == 2
        page.keyboard.press("y")
        page.wait_for_selector("#question", state="hidden")
        assert (driver.frame, driver.view("left")) == (1, zoom)  # not to where the undone one was
        before = driver.operation
        driver.click_at("left", (500.0, 160.0))
        driver.wait_saved(before)
        drawn = [(row.frame_index, row.anchor_px[0]) for row in served.observations[-2:]]
        assert drawn == [(2, pytest.approx(420.0, abs=0.5)), (1, pytest.approx(500.0, abs=0.5))]
        assert served.labels.review(2).startswith("reviewed")
        assert len(served.observations) == 6
        np.testing.assert_allclose(served.observations[0].anchor_px, (600.0, 60.0), atol=0.1)
