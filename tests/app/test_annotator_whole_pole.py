"""One click labels a pole: the whole one is shown before, and taken by mouse or keys."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from journeys.driver import ROUNDED, LabelDriver, Pixel
from streets import street_workspace

from semviz_annotation.assist.marked_image import MarkedImage
from semviz_annotation.assist.snap import whole_pole
from semviz_annotation.labels.views import rig_view
from semviz_core.base.classes import DEFAULT_CLASSES, POLE
from semviz_core.common.arrays import FloatArray

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
KNOWN = "() => !semviz.tools.ghosts.isBusy"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with annotating(street_workspace(tmp_path / "street", 7, 2)) as served:
        yield served


@pytest.fixture
def driver(served: Served, page: "Page") -> LabelDriver:  # the page goes before its server
    driver = LabelDriver(page)
    driver.open(served.url, with_snap=True)
    return driver


@pytest.fixture
def pole_px(served: Served) -> FloatArray:
    """Ends (2, 2) of a pole of the left image that the search gets right."""
    street = served.annotator.session.source
    view = rig_view(street.rig, "left", None)
    image = MarkedImage.of(view, street.image(0, "left"))
    seen, _ = street.labels(0, "left")  # type: ignore[attr-defined]
    rows = np.flatnonzero((seen.class_id == POLE) & seen.anchor_known & seen.end_known)
    for row in rows[np.argsort(seen.anchor_px[rows, 1])]:
        ends = np.stack([seen.anchor_px[row], seen.end_px[row]])
        found = whole_pole(image, ends.mean(axis=0), DEFAULT_CLASSES[POLE])
        if found is not None and np.abs(found.ends_px - ends).max() < 3.0:
            return ends
    raise AssertionError("no pole of this street is found whole")


def point_at(driver: LabelDriver, pixel: FloatArray) -> dict[str, object] | None:
    """Move the pointer there, and return the whole pole that is shown."""
    canvas = driver.page.locator("#left-image canvas.marks")
    box, view = canvas.bounding_box(), (canvas.get_attribute("data-view") or "").split()
    assert box is not None
    scale, x, y = map(float, view)
    at = box["x"] + (pixel[0] + 0.5) * scale + x, box["y"] + (pixel[1] + 0.5) * scale + y
    driver.page.mouse.move(*at)
    driver.page.wait_for_function(KNOWN)
    ghost: dict[str, object] | None = driver.page.evaluate("semviz.state.ghost")
    return ghost


def press(driver: LabelDriver) -> None:
    driver.page.mouse.down()
    driver.page.mouse.up()
    driver.settle()


def near(pixel: Pixel | None, expected: FloatArray) -> bool:
    return pixel is not None and float(np.abs(np.array(pixel) - expected).max()) < 3.0


def test_one_click_saves_the_pole_that_is_shown_and_one_key_its_match(
    driver: LabelDriver, served: Served, pole_px: FloatArray
) -> None:
    ghost = point_at(driver, pole_px.mean(axis=0))
    assert ghost is not None
    assert "the whole pole as dashed" in driver.page.inner_text("#hints")
    press(driver)
    (row,) = served.observations
    assert near(row.anchor_px, pole_px[0])
    assert near(row.end_px, pole_px[1])
    assert driver.page.evaluate("semviz.state.ghost") is None
    driver.page.wait_for_function("() => semviz.state.currentProposal?.is_confident")
    driver.press_and_save("Space")
    left, right = served.observations
    assert {left.side, right.side} == {"left", "right"}
    assert left.element_id == right.element_id
    for _ in range(2):
        driver.press_and_save("Control+z")
    assert served.observations == []


def test_the_same_by_keys_alone_and_off_by_one(
    driver: LabelDriver, served: Served, pole_px: FloatArray
) -> None:
    assert point_at(driver, pole_px.mean(axis=0)) is not None
    driver.page.keyboard.press("+")  # the cursor appears at the pointer
    driver.page.wait_for_function("() => semviz.state.cursor && semviz.state.ghost")
    driver.press_and_save("+")
    (row,) = served.observations
    assert near(row.end_px, pole_px[1])
    driver.page.keyboard.press("Control+z")
    driver.page.keyboard.press("Escape")
    driver.settle()
    driver.page.keyboard.press("Shift+P")
    assert point_at(driver, pole_px.mean(axis=0) + np.array([0.0, 2.0])) is None
    press(driver)
    assert driver.page.evaluate("semviz.state.drawing !== null")
    assert served.observations == []


def test_with_shift_or_another_class_a_click_draws_by_hand(
    driver: LabelDriver, served: Served, pole_px: FloatArray
) -> None:
    assert point_at(driver, pole_px.mean(axis=0)) is not None
    driver.page.keyboard.down("Shift")
    press(driver)
    driver.page.keyboard.up("Shift")
    assert driver.page.evaluate("semviz.state.drawing !== null")
    driver.page.keyboard.press("Escape")
    driver.page.keyboard.press(str(ROUNDED + 1))
    assert point_at(driver, pole_px.mean(axis=0) + np.array([0.0, 2.0])) is None
    assert served.observations == []
