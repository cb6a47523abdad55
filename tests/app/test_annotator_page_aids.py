"""What the page owes a person: nothing cut or covered, all commands by name."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import Served, annotating, draw_on
from journeys.driver import LabelDriver
from streets import street_workspace

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.browser
SIZES = [(1280, 720), (1920, 1080)]
NAMES_CUT = """() => [...document.querySelectorAll(".left .row > .fill")]
    .filter(name => name.scrollWidth > name.clientWidth || name.getBoundingClientRect().right
        > name.parentElement.getBoundingClientRect().right).map(name => name.textContent)"""
PAINTED = """([side, x, y]) => {
    const canvas = document.querySelector(`#${side}-image canvas.marks`);
    const ratio = canvas.width / canvas.getBoundingClientRect().width;
    return canvas.getContext("2d").getImageData(x * ratio, y * ratio, 1, 1).data[3];
}"""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with annotating(street_workspace(tmp_path / "street", 7, 4)) as served:
        yield served


@pytest.mark.parametrize("size", SIZES)
def test_no_name_is_cut_and_a_message_covers_neither_hints_nor_images(
    driver: LabelDriver, size: tuple[int, int]
) -> None:
    page = driver.page
    page.set_viewport_size({"width": size[0], "height": size[1]})
    driver.settle()
    assert page.evaluate(NAMES_CUT) == []
    page.evaluate("semviz.notify('Deleted P-03 with 12 views in 6 frames. Ctrl Z brings it back.')")
    said = page.locator("#message").bounding_box()
    assert said is not None
    for place in ("#hints", "#left-image", "#right-image", ".topbar"):
        box = page.locator(place).bounding_box()
        assert box is not None
        assert said["y"] >= box["y"] + box["height"] or said["y"] + said["height"] <= box["y"]
    assert said["y"] + said["height"] <= size[1]


@pytest.mark.parametrize("at", [(0.1, 0.1), (0.5, 0.5), (0.95, 0.9)])
def test_the_loupe_is_beside_the_pointer_and_not_on_it(
    driver: LabelDriver, at: tuple[float, float]
) -> None:
    box = driver.page.locator("#left-image canvas.marks").bounding_box()
    assert box is not None
    x, y = at[0] * box["width"], at[1] * box["height"]
    driver.page.mouse.move(box["x"] + x, box["y"] + y)
    driver.settle()
    beside = [
        driver.page.evaluate(PAINTED, ["left", x + dx, y + dy])
        for dx in (-40.0, 40.0)
        for dy in (-40.0, 40.0)
    ]
    assert 255 in beside
    assert driver.page.evaluate(PAINTED, ["left", x, y]) < 255


def test_the_theme_follows_the_system_until_one_is_chosen(driver: LabelDriver) -> None:
    page = driver.page
    theme = "() => document.documentElement.dataset.theme"
    for scheme in ("light", "dark", "light"):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.wait_for_function(f"wanted => ({theme})() === wanted", arg=scheme)
        assert page.evaluate("() => semviz.state.theme") == scheme
    page.keyboard.press("t")
    assert page.evaluate(theme) == "dark"
    page.emulate_media(color_scheme="dark")
    page.emulate_media(color_scheme="light")
    driver.settle()
    assert page.evaluate(theme) == "dark"


@pytest.mark.parametrize(
    ("typed", "title"),
    [
        ("split", "Unlink: this view is another element"),
        ("playback", "Play the frames; again: stop"),
        ("export", "Export the labels: how"),
        ("go to frame", "Go to frame: type its number"),
    ],
)
def test_commands_are_found_by_what_people_call_them(
    driver: LabelDriver, typed: str, title: str
) -> None:
    driver.page.keyboard.press("Control+k")
    driver.page.keyboard.type(typed)
    assert driver.page.inner_text("#palette-list [aria-selected=true] .fill") == title


def test_go_to_frame_and_playback_by_the_keyboard(driver: LabelDriver) -> None:
    page = driver.page
    page.keyboard.press("Control+g")
    page.keyboard.type("2")
    page.keyboard.press("Enter")
    page.wait_for_selector('.tile.current[data-frame="2"]')
    page.keyboard.press("Control+g")
    page.keyboard.type("77")
    page.keyboard.press("Enter")
    page.wait_for_selector("#message:has-text('No frame 77: there are 0 to 3.')")
    driver.goto(0)
    page.keyboard.press("Control+.")
    page.wait_for_selector('.tile.current[data-frame="3"]')
    driver.goto(0)
    page.keyboard.press("Control+.")
    page.keyboard.press("Control+.")
    frame = driver.frame
    page.wait_for_timeout(900)
    assert driver.frame == frame < 3


def test_without_the_3d_map_its_room_is_the_lists(driver: LabelDriver) -> None:
    page = driver.page
    heights = "['.elements', '#map-panel'].map((one) => document.querySelector(one).clientHeight)"
    off = page.evaluate(heights)
    assert page.inner_text("#map-about") == "off: F shows it"
    page.keyboard.press("f")
    driver.settle()
    on = page.evaluate(heights)
    assert off[1] < 40 < 100 < on[1]
    assert off[0] > on[0] + 60


def test_the_row_of_an_element_that_is_selected_elsewhere_is_in_view(
    driver: LabelDriver, served: Served
) -> None:
    page = driver.page
    page.set_viewport_size({"width": 1280, "height": 720})
    page.keyboard.press("f")
    for place in range(24):
        draw_on(page, 0, 40.0 + 40.0 * place)
    driver.clear_selection()
    in_view = """() => {
        const [row, list] = ["#elements .chosen", "#elements"].map(
            (one) => document.querySelector(one).getBoundingClientRect());
        return row.top >= list.top - 1 && row.bottom <= list.bottom + 1;
    }"""
    for row in (served.observations[-1], served.observations[0]):
        page.evaluate("(id) => semviz.select(id)", row.element_id)
        driver.settle()
        assert page.evaluate(in_view)
