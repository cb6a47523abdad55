"""The labelling page in small, usual and very large windows."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest
from annotator_page import Served, annotating, draw_signs
from fonts import FONTS
from journeys.driver import POLE, LabelDriver
from streets import street_workspace

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
        .filter(([one, box, panel]) => !one.closest("#hints") || box.top < panel.bottom)
        .map(([one]) => one.textContent || one.id);
}"""

NAMELESS = """() => [...document.querySelectorAll("button, input, canvas.marks, iframe")]
    .filter(one => !one.textContent.trim() && !one.title && !one.getAttribute("aria-label")
        && !one.labels?.length)
    .map(one => one.outerHTML)"""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("layout") / "a drive through town with a long name"
    workspace = street_workspace(folder, 7, 30)
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


def bounding_box(page: "Page", selector: str) -> dict[str, float]:
    box = page.locator(selector).first.bounding_box()
    assert box is not None
    return dict(box)


def overlap(first: dict[str, Any], second: dict[str, Any]) -> bool:
    across = min(first["right"], second["right"]) - max(first["left"], second["left"])
    down = min(first["bottom"], second["bottom"]) - max(first["top"], second["top"])
    return across > 0.5 and down > 0.5


def faults(page: "Page", size: tuple[int, int]) -> list[str]:
    """Panels that overlap, stick out of the window or are too low to show anything; cut texts."""
    panels = page.evaluate(GEOMETRY)
    found = [
        f"{first['name']} over {second['name']}"
        for place, first in enumerate(panels)
        for second in panels[:place]
        if overlap(first, second)
    ]
    for panel in panels:
        if panel["right"] > size[0] + 0.5 or panel["bottom"] > size[1] + 0.5:
            found.append(f"{panel['name']} sticks out")
        if panel["bottom"] - panel["top"] < 28:
            found.append(f"{panel['name']} is {panel['bottom'] - panel['top']} high")
    return found + [f"cut off: {text}" for text in page.evaluate(CUT_OFF)]


@pytest.mark.parametrize("fonts", FONTS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_nothing_overlaps_and_the_card_is_whole_in_every_state(
    driver: LabelDriver, size: tuple[int, int]
) -> None:
    page = driver.page
    if page.locator('#elements .row:has-text("P-")').count() == 0:
        left, right = (((u, 60.0), (u, 260.0)) for u in (600.0, 580.0))
        driver.draw_pair(POLE, left, right)
    driver.clear_selection()
    pane = bounding_box(page, ".map")
    columns = [bounding_box(page, selector)["width"] for selector in (".left .panel", "#card")]
    assert columns == pytest.approx(SIZES[size], abs=20)
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
    assert bounding_box(page, ".map") == pane, "at another size the 3D pane is drawn anew"
    assert page.locator("#card").evaluate("card => card.scrollHeight <= card.clientHeight")
    images = [bounding_box(page, f"#{side}-image canvas.marks") for side in ("left", "right")]
    assert images[0]["width"] == images[1]["width"]
    assert images[0]["height"] == images[1]["height"]
    assert sum(box["width"] * box["height"] for box in images) > 0.4 * size[0] * size[1]
    page.keyboard.press("?")
    help_dialog = page.locator("dialog.help")
    assert help_dialog.evaluate("one => one.scrollHeight <= one.clientHeight"), "help scrolls"
    assert page.evaluate(NAMELESS) == []
