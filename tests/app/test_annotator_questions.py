"""Questions before an edit is saved: two versions of a label, and one thing drawn twice."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from drawn_marks import do
from journeys.driver import POLE, ROUNDED, LabelDriver
from streets import street_workspace

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.browser


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with annotating(street_workspace(tmp_path / "street", 7, 4)) as served:
        yield served


@pytest.mark.parametrize("mine", [True, False])
def test_two_versions_of_a_label_are_asked_about(
    driver: LabelDriver, served: Served, mine: bool
) -> None:
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    (row,) = served.labels.observations.values()
    theirs = {"kind": "move", "observation_id": row.id, "anchor_px": [650.0, 110.0]}
    served.annotator.lock.acquire()  # the page has not heard of it when it sends its own
    try:
        driver.page.keyboard.press("Shift+ArrowRight")
        driver.page.wait_for_selector("#saved.saving")
        do(served.annotator.session, theirs)
    finally:
        served.annotator.lock.release()
    driver.page.wait_for_selector("#conflict:has-text('Both stay in the history')")
    driver.page.wait_for_selector("#saved:has-text('Waits for your answer')")
    driver.page.click(f"#conflict button:has-text('{'mine' if mine else 'theirs'}')")
    driver.page.wait_for_selector(f"#saved:has-text('Saved operation {3 if mine else 4}')")
    (now,) = served.labels.observations.values()
    expected = (701.0, 120.0) if mine else (650.0, 110.0)
    np.testing.assert_allclose(now.anchor_px, expected, atol=0.05)
    driver.page.wait_for_selector("#conflict", state="hidden")


@pytest.mark.parametrize("hears", [True, False])
def test_a_peak_nudged_while_the_bottom_is_dragged_stays_nudged(
    driver: LabelDriver, served: Served, hears: bool
) -> None:
    """Both ends are kept, whether or not the page hears of the other's during the drag."""
    peak, bottom = (600.0, 60.25), (601.5, 260.75)
    driver.draw_pole("left", peak, bottom)
    (row,) = served.labels.observations.values()
    theirs = {"kind": "move", "observation_id": row.id, "anchor_px": [597.0, 61.0]}
    driver.zoom_to("left", bottom, 4.0)
    view, mouse = driver.view("left"), driver.page.mouse
    mouse.move(*view.screen(bottom))
    mouse.down()
    mouse.move(*view.screen((603.5, 262.75)), steps=3)
    if hears:
        do(served.annotator.session, theirs)
        driver.page.wait_for_function("() => semviz.state.labels.frame.operation === 2")
        mouse.up()
    else:
        with served.annotator.lock:
            mouse.up()
            driver.page.wait_for_selector("#saved.saving")
            do(served.annotator.session, theirs)
    driver.page.wait_for_selector("#saved:has-text('Saved operation 3')")
    (now,) = served.labels.observations.values()
    np.testing.assert_allclose(now.anchor_px, (597.0, 61.0), atol=0.01)
    np.testing.assert_allclose(now.end_px, (603.5, 262.75), atol=0.05)
    assert driver.page.locator("#question").is_hidden()


def test_the_same_end_moved_by_two_is_asked_about_though_the_page_had_heard_of_it(
    driver: LabelDriver, served: Served
) -> None:
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    (row,) = served.labels.observations.values()
    view, mouse = driver.view("left"), driver.page.mouse
    mouse.move(*view.screen((700.0, 120.0)))
    mouse.down()
    mouse.move(*view.screen((720.0, 125.0)), steps=3)
    do(
        served.annotator.session,
        {"kind": "move", "observation_id": row.id, "anchor_px": [650.0, 110.0]},
    )
    driver.page.wait_for_function("() => semviz.state.labels.frame.operation === 2")
    mouse.up()
    driver.page.wait_for_selector("#conflict:has-text('Both stay in the history')")
    np.testing.assert_allclose(served.observations[0].anchor_px, (650.0, 110.0), atol=0.01)
    driver.page.click("#conflict button:has-text('theirs')")
    driver.page.wait_for_selector("#conflict", state="hidden")
    driver.page.wait_for_selector("#saved:has-text('Saved operation 4')")
    np.testing.assert_allclose(served.observations[0].anchor_px, (650.0, 110.0), atol=0.01)


@pytest.mark.parametrize("key", ["y", "Shift+Y", "Discard"])
def test_a_sign_drawn_on_another_is_asked_about(
    driver: LabelDriver, served: Served, key: str
) -> None:
    """``Y``: the same one, moved here; ``Shift Y``: another; *Discard*; ``Esc`` answers nothing."""
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    driver.zoom_to("left", (700.0, 120.0), 20.0)
    driver.click_at("left", (702.0, 120.0))
    driver.page.wait_for_selector("#question:has-text('Lies on O-01, 2.0 px away')")
    assert served.labels.operation == 1
    driver.page.keyboard.press("Escape")
    if key == "Discard":
        driver.page.click("#question button:has-text('Discard')")
    else:
        driver.page.keyboard.press(key)
    driver.page.wait_for_selector("#question", state="hidden")
    if key != "Discard":
        driver.wait_saved(1)
    places = {"y": [702.0], "Shift+Y": [700.0, 702.0], "Discard": [700.0]}[key]
    np.testing.assert_allclose([row.anchor_px[0] for row in served.observations], places, atol=0.05)


def test_x_then_draw_continues_the_element(driver: LabelDriver, served: Served) -> None:
    left, right = ((600.0, 60.25), (601.5, 260.75)), ((580.0, 60.25), (581.5, 260.75))
    driver.draw_pair(POLE, left, right)
    driver.goto(1)
    driver.clear_selection()
    driver.page.wait_for_function("() => semviz.state.currentProposal?.name === 'P-01'")
    driver.press_and_save("x")
    before = driver.operation
    driver.page.keyboard.press("1")
    for pixel in ((620.0, 62.0), (621.5, 262.0)):
        driver.click_at("left", pixel)
    driver.wait_saved(before)
    assert len(served.labels.elements) == 1


def test_what_somebody_deleted_can_be_kept(driver: LabelDriver, served: Served) -> None:
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    (row,) = served.labels.observations.values()
    served.annotator.lock.acquire()
    try:
        driver.page.keyboard.press("Shift+ArrowRight")
        driver.page.wait_for_selector("#saved.saving")
        do(served.annotator.session, {"kind": "delete", "observation_id": row.id})
    finally:
        served.annotator.lock.release()
    driver.page.click("#conflict button:has-text('mine')")
    driver.page.wait_for_selector("#saved:has-text('Saved operation 3')")
    (now,) = served.labels.observations.values()
    np.testing.assert_allclose(now.anchor_px, (701.0, 120.0), atol=0.05)
