"""Keys that come before what they are for: while a frame loads, is searched, or is saved."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import WAIT_MS, Served, annotating, draw_signs
from drawn_marks import do, sign
from journeys.driver import LabelDriver
from streets import street_workspace

from semviz.annotator import messages

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from semviz.annotator.proposals.label_proposals import ImageQuery
    from semviz.web.protocol import Event

FOR_ALL = ["Control+Enter", "Control+Shift+Enter"]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    workspace = street_workspace(tmp_path / "street", 7, 4)
    draw_signs(workspace, [(0, 640.0), (1, 640.0), (2, 640.0)], "tester")
    with annotating(workspace) as served:
        yield served


@pytest.fixture
def driver(served: Served, page: "Page") -> LabelDriver:
    driver = LabelDriver(page)
    driver.open(served.url)
    page.wait_for_function("() => semviz.state.shownFrame?.is_searching === false")
    return driver


@pytest.mark.browser
@pytest.mark.parametrize("key", [*FOR_ALL, "Enter"])
def test_no_key_reviews_a_frame_that_still_loads(
    driver: LabelDriver, served: Served, key: str
) -> None:
    """Nobody has seen it: the key is refused, and says so. After two quick steps, too."""
    page = driver.page
    with served.annotator.lock:  # the server does not answer
        page.keyboard.press(".")
        page.keyboard.press(".")
        page.keyboard.press(key)
        page.wait_for_selector("#message:has-text('Frame 2 is still loading')")
    page.wait_for_function("() => semviz.state.shownFrame?.is_searching === false")
    driver.settle()
    assert driver.frame == 2
    assert reviewed(served) == []
    page.keyboard.press(key)
    page.wait_for_function("() => semviz.state.labels.frames[2].state === 'reviewed'")


@pytest.mark.browser
@pytest.mark.parametrize("key", FOR_ALL)
def test_the_key_for_all_waits_for_the_search(
    driver: LabelDriver, served: Served, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is still searched would be left out of a frame that counts as complete."""
    worker, page = served.annotator.session.image_worker, driver.page
    monkeypatch.setattr(worker, "search", lambda query: None)  # never done
    page.keyboard.press("4")
    page.mouse.click(*_middle(page))
    page.wait_for_function("() => semviz.state.shownFrame?.is_searching === true")
    page.keyboard.press(key)
    page.wait_for_selector("#message:has-text('still being searched')")
    driver.settle()
    assert driver.frame == 0
    assert reviewed(served) == []


@pytest.mark.browser
def test_a_key_that_is_held_down_reviews_one_frame(driver: LabelDriver, served: Served) -> None:
    page = driver.page
    page.keyboard.down("Control")
    page.keyboard.down("Enter")
    page.wait_for_function("() => semviz.state.shownFrame?.index === 1")
    page.wait_for_function("() => !semviz.state.shownFrame.is_searching")
    for _ in range(5):
        page.keyboard.down("Enter")  # repeats
    page.keyboard.up("Enter")
    page.keyboard.up("Control")
    driver.settle()
    assert reviewed(served) == [0]


@pytest.mark.browser
def test_who_comes_back_to_a_frame_keeps_its_labels(driver: LabelDriver, served: Served) -> None:
    """The answer about the frame between does not take them away, and keys with them."""
    page = driver.page
    page.evaluate(
        "semviz.state.onChange(() => { window.lost ||= semviz.state.shownFrame?.index !== 0; })"
    )
    page.evaluate("window.heard = 0, semviz.socket.on('frame', () => { window.heard += 1; })")
    with served.annotator.lock:
        page.evaluate("semviz.go(1); window.lost = false; semviz.go(0); window.lost = false")
    page.wait_for_function("() => window.heard >= 2", timeout=WAIT_MS)
    assert page.evaluate("window.lost") is False


def test_a_search_that_another_has_finished_is_told(served: Served) -> None:
    """One search may end what the next was queued for: the page must not wait for ever."""
    events: list[Event] = []
    page = served.annotator._open("page", events.append)
    session = served.annotator.session
    page.receive(messages.GoToFrameRequest(id="1", frame=0))
    _finish(served)
    search = session.image_worker.search

    def interrupted(query: "ImageQuery") -> None:
        """The frame changes while its first query is processed; the others are done before."""
        session.image_worker.search = search  # type: ignore[method-assign]
        for each in session.pending_queries(0):
            search(each)
        page._search_queued.set()

    do(session, sign(0, "left", (300.0, 60.0), class_id=3))
    do(session, sign(0, "left", (500.0, 60.0), class_id=3))
    session.image_worker.search = interrupted  # type: ignore[method-assign]
    page.receive(messages.GoToFrameRequest(id="2", frame=0))
    _finish(served)
    served.annotator.search_thread.submit(page._search)
    _finish(served)
    frames = [event.frame for event in events if isinstance(event, messages.LabelledFrameEvent)]
    assert not frames[-1].is_searching
    page.close()


def reviewed(served: Served) -> list[int]:
    return [frame for frame in range(4) if served.labels.review(frame).startswith("reviewed")]


def _finish(served: Served) -> None:
    served.annotator.search_thread.submit(lambda: None).result()


def _middle(page: "Page") -> tuple[float, float]:
    box = page.locator("#left-image canvas.marks").bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 3
