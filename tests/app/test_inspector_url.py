"""The page's address: whoever opens it sees the same; back and forward go between frames."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlencode, urlsplit

import pytest
from inspector_page import in_url, open_flat, wait_for
from small_runs import FRAMES, run_with_a_moved_pole, saved, small_run, spoiled, unanswered

from semviz.inspector.server import Inspector
from semviz.web.gateway import Gateway

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser

FAILED = FRAMES[2]
LOOKED_AT_MS = 1300
"""So long a frame must be seen to be one to come back to."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    first = saved(spoiled(small_run(), {FAILED: unanswered}), folder / "first.rrd")
    return [first, saved(run_with_a_moved_pole()[0], folder / "moved.rrd")]


@pytest.fixture
def url(recorded: list[Path]) -> Iterator[str]:
    with Gateway(Inspector(recorded)).running() as url:
        yield url


def query_of(page: "Page") -> dict[str, str]:
    return {name: value for name, (value,) in parse_qs(urlsplit(page.url).query).items()}


def test_all_that_is_chosen_is_in_the_address_and_comes_back(url: str, page: "Page") -> None:
    """Made by hand, then opened as a link: the second page has the same address again."""
    open_flat(page, url, "run=moved")
    page.keyboard.press(".")
    wait_for(page, lambda: in_url(page, "frame") == str(FRAMES[1]), "the next frame")
    for key in ("3", "m", "h", "i", "u", "v", "g"):
        page.keyboard.press(key)
        page.wait_for_timeout(120)
    page.keyboard.press("Tab")
    wanted = {
        "run": "moved", "frame": str(FRAMES[1]), "image": "pairs", "log": "yes", "list": "elements",
        "card": "selected", "view": "above", "colors": "residual", "others": "no", "seen": "0",
    }  # fmt: skip
    wait_for(page, lambda: query_of(page) | wanted == query_of(page), f"{wanted} in {page.url}")
    link = page.url
    page.goto("about:blank")
    page.goto(link)
    for chosen in (
        "#matrix-log[aria-pressed=true]", "[data-tab=elements][aria-selected=true]",
        "[data-tab=selected][aria-selected=true]", "[data-mode=pairs][aria-pressed=true]",
        "[data-view=above][aria-pressed=true]",
    ):  # fmt: skip
        page.wait_for_selector(chosen)
    wait_for(page, lambda: query_of(page) == parsed(link), "the same address")
    assert page.locator("#run").input_value() == "moved"
    assert page.locator("#notice").is_hidden()


def parsed(link: str) -> dict[str, str]:
    return {name: value for name, (value,) in parse_qs(urlsplit(link).query).items()}


def test_filters_and_the_run_to_compare_with_come_back(url: str, page: "Page") -> None:
    _, pole = run_with_a_moved_pole()
    asked = {"run": "first", "frame": str(FAILED), "status": "cannot", "only": str(pole),
             "sort": "px", "class": "pole", "base": "moved", "forecast": "yes"}  # fmt: skip
    open_flat(page, url, urlencode(asked))
    wait_for(
        page,
        lambda: page.locator("#filters button[aria-pressed=true][title=cannot]").count() == 1,
        "it",
    )
    wait_for(page, lambda: page.locator("#element-filter[aria-pressed=true]").count() == 1, "it")
    assert page.locator("#forecast").get_attribute("aria-pressed") == "true"
    wait_for(page, lambda: query_of(page) == asked, f"{asked}, not {page.url}")


def test_what_is_not_known_is_left_out_and_said_in_one_line(url: str, page: "Page") -> None:
    asked = {"run": "gone", "frame": "12", "view": "sideways", "foo": "<b>", "status": "ok",
             "only": "x"}  # fmt: skip
    open_flat(page, url, urlencode(asked))
    notice = page.locator("#notice")
    wait_for(page, notice.is_visible, "what was left out")
    said = notice.text_content() or ""
    assert "\n" not in said
    for value in ("run=gone", "view=sideways", "foo=<b>", "only=x"):
        assert value in said
    assert "status" not in said
    wait_for(
        page,
        lambda: query_of(page) == {"run": "first", "frame": "12", "status": "ok"},
        "what is known",
    )


def test_back_and_forward_go_between_the_frames_that_were_looked_at(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.wait_for_timeout(LOOKED_AT_MS)
    for frame in (FRAMES[2], FRAMES[5]):
        page.locator(f'#frame-list li .index:text-is("{frame}")').click()
        wait_for(page, lambda frame=frame: in_url(page, "frame") == str(frame), f"frame {frame}")
        page.wait_for_timeout(LOOKED_AT_MS)
    first, _, middle = FRAMES[:3]
    number = page.locator("#frame-number")
    for go, frame in ((page.go_back, middle), (page.go_back, first), (page.go_forward, middle)):
        go()
        told = f"Frame {frame} of {FRAMES[-1]}"
        wait_for(page, lambda told=told: number.text_content() == told, told)
        page.wait_for_timeout(200)
        assert in_url(page, "frame") == str(frame)


def test_steps_are_no_places_to_go_back_to(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.wait_for_timeout(LOOKED_AT_MS)
    before = page.evaluate("() => history.length")
    for frame in FRAMES[1:4]:
        page.keyboard.press(".")
        wait_for(page, lambda frame=frame: in_url(page, "frame") == str(frame), f"frame {frame}")
    assert page.evaluate("() => history.length") == before
