"""The labelling page in small, usual and very large windows, dark and light."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest
from annotating import Served, annotating, draw_signs
from journeys.driver import POLE, LabelDriver

from semviz.workspace import Workspace

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser

SIZES = {(1280, 720): (160, 262), (1600, 950): (218, 312), (3840, 2160): (218, 312)}
"""Window and the widths of its left and right column, as the design has them."""

PANELS = ".topbar, .left > .panel, .images > .panel, .right > .panel, .frames"

GEOMETRY = f"""() => [...document.querySelectorAll({PANELS!r})]
    .filter(one => one.getClientRects().length)
    .map(one => {{
        const {{ left, top, right, bottom }} = one.getBoundingClientRect();
        return {{ name: one.id || one.className, left, top, right, bottom }};
    }})"""

CUT_OFF = """() => {
    const within = ":is(.topbar, .panel:not(#history-panel)) :is(button, h2, kbd, b, dt, .chip)";
    return [...document.querySelectorAll(within)]
        .filter(one => one.getClientRects().length && !one.closest("dialog, .scroll, .fill"))
        .map(one => [one, one.getBoundingClientRect(),
            (one.closest(".panel") ?? one.closest(".topbar")).getBoundingClientRect()])
        .filter(([, box, panel]) => box.right > panel.right + 0.5 || box.bottom > panel.bottom + 0.5
            || box.left < panel.left - 0.5 || box.top < panel.top - 0.5)
        .map(([one]) => one.textContent || one.id);
}"""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("layout") / "street"
    workspace = Workspace.create_street(folder, 7, range(0, 30))
    draw_signs(workspace, [(0, 100.0 * place) for place in range(1, 11)], "tester")
    with annotating(workspace) as served:
        yield served


@pytest.fixture
def driver(served: Served, page: "Page", size: tuple[int, int]) -> LabelDriver:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    driver = LabelDriver(page)
    driver.open(served.url)
    page.keyboard.press("Escape")  # ends the tour
    return driver


def overlap(one: dict[str, Any], two: dict[str, Any]) -> bool:
    across = min(one["right"], two["right"]) - max(one["left"], two["left"])
    down = min(one["bottom"], two["bottom"]) - max(one["top"], two["top"])
    return across > 0.5 and down > 0.5


def faults(page: "Page", size: tuple[int, int]) -> list[str]:
    """Panels that overlap, stick out of the window or are too low to show anything; cut texts."""
    panels = page.evaluate(GEOMETRY)
    found = [
        f"{one['name']} over {two['name']}"
        for place, one in enumerate(panels)
        for two in panels[:place]
        if overlap(one, two)
    ]
    for one in panels:
        if one["right"] > size[0] + 0.5 or one["bottom"] > size[1] + 0.5:
            found.append(f"{one['name']} sticks out")
        if one["bottom"] - one["top"] < 28:
            found.append(f"{one['name']} is {one['bottom'] - one['top']} high")
    return found + [f"cut off: {text}" for text in page.evaluate(CUT_OFF)]


@pytest.mark.parametrize("scheme", ["dark", "light"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_nothing_overlaps_and_the_card_is_whole_in_every_state(
    driver: LabelDriver, size: tuple[int, int], scheme: str
) -> None:
    page = driver.page
    if page.evaluate("document.documentElement.dataset.theme") != scheme:
        page.keyboard.press("t")
    if driver.page.locator('#elements .row:has-text("P-")').count() == 0:
        ends = ((600.0, 60.0), (600.0, 260.0)), ((580.0, 60.0), (580.0, 260.0))
        driver.draw_pair(POLE, *ends)
    driver.clear_selection()
    left, right = SIZES[size]
    assert abs(page.locator(".left .panel").first.bounding_box()["width"] - left) <= 20  # type: ignore[index]
    assert abs(page.locator("#card").bounding_box()["width"] - right) <= 8  # type: ignore[index]
    states = {"idle": [], "history": ["h"], "back": ["h"], "bright": ["b"], "naming": ["Control+b"]}
    for state, keys in states.items():
        for key in keys:
            page.keyboard.press(key)
        driver.settle()
        assert faults(page, size) == [], state
    page.keyboard.press("Escape")
    page.locator('#elements .row:has-text("P-")').first.click()
    page.wait_for_selector("#card .numbers")
    driver.settle()
    assert faults(page, size) == []
    card = page.locator("#card")
    assert card.evaluate("card => card.scrollHeight <= card.clientHeight")
    assert card.evaluate("card => card.getBoundingClientRect().bottom") <= size[1]
    page.keyboard.press("?")
    help_dialog = page.locator("dialog.help")
    assert help_dialog.evaluate("one => one.scrollHeight <= one.clientHeight"), "help scrolls"
    page.keyboard.press("Escape")
    page.keyboard.press("b")


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_the_images_get_most_of_the_window_and_the_same_zoom(
    driver: LabelDriver, size: tuple[int, int]
) -> None:
    boxes = [
        driver.page.locator(f"#{side}-image canvas.marks").bounding_box()
        for side in ("left", "right")
    ]
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert (boxes[0]["width"], boxes[0]["height"]) == (boxes[1]["width"], boxes[1]["height"])
    area = sum(box["width"] * box["height"] for box in boxes if box is not None)
    assert area / (size[0] * size[1]) > 0.4
    assert driver.view("left").scale == driver.view("right").scale


@pytest.mark.parametrize("size", [(1280, 720)], ids=str)
def test_everything_that_can_be_pressed_has_a_name(
    driver: LabelDriver, size: tuple[int, int]
) -> None:
    nameless = driver.page.evaluate(
        """() => [...document.querySelectorAll("button, input, canvas.marks, iframe")]
        .filter(one => !one.textContent.trim() && !one.title && !one.getAttribute("aria-label")
            && !one.labels?.length)
        .map(one => one.outerHTML)"""
    )
    assert nameless == []
