"""Latency of a selection, and of a matrix of 200 x 200, in the inspector in Chromium.

    python bench/inspector_selection.py

Needs an idle machine, Chromium and the test extra. A click counts as shown one screen refresh after
the tab "Selected" shows the element. The matrix is full, with logarithmic colours: the worst case.
While it is panned, hovered and recoloured, each screen refresh is timed; the screen refreshes every
16.7 ms. "Of it busy" is the processor time of the page's main thread.
"""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from pages import CHROMIUM, PAUSE_MS, report, serving, until
from playwright.sync_api import Browser, Page, sync_playwright
from recording import make_info, make_jpeg, make_map, make_records
from serving import at

from semviz.runs.run import FrameRecord
from semviz.runs.writer import RunWriter
from semviz_core.base.elements import Elements2D
from semviz_core.base.localization import Match, Refinement
from semviz_core.base.semantic_map import SemanticMap

SIZE = 200
CLICKS = 20
SCREENS = ((1600, 950), (3840, 2160))
SHOWN = """
window.shown = [];
let clicked = 0;
addEventListener('click', (event) => { clicked = event.timeStamp; }, true);
const note = () => window.shown.push(performance.now() - clicked);
new MutationObserver(() => requestAnimationFrame(note))
  .observe(document.getElementById('selected-rest'), { childList: true });
"""
REFRESHES = """async (change) => {
  const scroller = document.getElementById('matrix-scroller');
  const box = scroller.getBoundingClientRect();
  const move = (at) => scroller.dispatchEvent(new PointerEvent('pointermove', {
    clientX: box.left + 40 + at % 200, clientY: box.top + 60 + at % 170 }));
  const changes = {
    pan: (step) => scroller.scrollTo(2 * step, 3 * step),
    hover: (step) => move(5 * step),
    recolour: () => document.getElementById('matrix-log').click(),
  };
  const next = () => new Promise(requestAnimationFrame);
  const times = [];
  let before = await next();
  for (let step = 0; step < 100; step += 1) {
    changes[change](step);
    const now = await next();
    times.push(now - before);
    before = now;
  }
  return times;
}"""


def full_record(semantic_map: SemanticMap) -> FrameRecord:
    """A frame in which everything may be anything."""
    (record,) = make_records(semantic_map, 1, make_jpeg())
    rng = np.random.default_rng(0)
    submap = semantic_map.elements[:SIZE]
    anchor = rng.uniform([0, 0], [1240, 300], (SIZE, 2))
    end = np.where(submap.is_line[:, None], anchor + np.array([0, 60]), np.nan)
    pairs = np.stack([np.arange(SIZE)] * 2, axis=1)
    result = replace(
        record.localization,
        observed=Elements2D.from_ends(anchor, end, submap.class_id),
        submap=submap,
        match=Match(np.zeros((SIZE, SIZE)), rng.dirichlet(np.ones(SIZE + 1), SIZE + 1), pairs),
        refinement=Refinement(
            pairs, np.zeros((SIZE, 2)), np.zeros(SIZE), rng.random(SIZE) < 0.7, np.ones(3)
        ),
    )
    return replace(record, localization=result, element_id=submap.id.copy())


def measured(page: Page, what: str, act: Callable[[], list[float]]) -> None:
    """Reports what ``act`` measures, and the processor time of the main thread for each."""
    client = page.context.new_cdp_session(page)
    client.send("Performance.enable", {"timeDomain": "threadTicks"})

    def ticks() -> float:
        metrics = client.send("Performance.getMetrics")["metrics"]
        return float(
            next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration")
        )

    before = ticks()
    times = act()
    report(what, times)
    print(f"{'  of it busy, mean':<44} {1e3 * (ticks() - before) / len(times):6.0f} ms", flush=True)


def clicks(page: Page) -> list[float]:
    """Milliseconds from a click on a cell of the matrix to the card."""
    page.evaluate(SHOWN)
    box = page.locator("#matrix-scroller").bounding_box()
    assert box is not None
    for row in range(CLICKS):
        before = page.evaluate("window.shown.length")
        x, y = 45 + 10 * row, 70 + 60 * (row % 2)  # another pair each time
        page.mouse.click(box["x"] + x, box["y"] + y)
        until(page, f"window.shown.length > {before}")
        page.wait_for_timeout(PAUSE_MS)
    times: list[float] = page.evaluate("window.shown")
    return times


def click_through(browser: Browser, url: str, query: str, what: str) -> None:
    page = browser.new_page(viewport={"width": 1600, "height": 950})
    page.route("**/view/**", lambda route: route.abort())
    page.goto(at(url, f"?card=selected&{query}"))
    page.wait_for_selector("#selected-head p")
    page.wait_for_timeout(3000)
    measured(page, f"click to card, {what}", lambda: clicks(page))
    page.close()


def refreshes(browser: Browser, url: str, width: int, height: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.route("**/view/**", lambda route: route.abort())
    page.goto(url)
    page.wait_for_selector("#frame-list li")
    page.keyboard.press("m")
    page.wait_for_timeout(3000)
    for change in ("pan", "hover", "recolour"):
        what = f"{SIZE} x {SIZE} on {width} x {height}: {change}"
        measured(page, what, partial(page.evaluate, REFRESHES, change))
    page.close()


def main() -> None:
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        run, semantic_map = Path(folder, "full.rrd"), make_map()
        with RunWriter(run, make_info("full"), semantic_map) as writer:
            writer.write(full_record(semantic_map))
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
        with serving("serve", str(run)) as (url, _):
            for screen in SCREENS:
                refreshes(browser, url, *screen)
        with serving("serve") as (url, _):
            click_through(browser, url, "frame=97", "the demo")
        browser.close()


if __name__ == "__main__":
    main()
