"""Latency of both pages in Chromium: start, loading, stepping through frames, saving.

    python bench/pages.py
    python bench/pages.py --only annotate

Needs an idle machine, Chromium and the test extra. The demo is made beforehand, outside the timing.
On a busy machine, compare the processor times of annotate: of the server, and of the page's main
thread with the 3D pane in it.
A frame counts as shown one screen refresh after its images were drawn, a 3D view when its pixels
were read back. Reading back delays the page, so it is done only while 3D views are timed. One run:
every step counts.
"""

import argparse
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
from playwright.sync_api import Browser, Frame, Page, sync_playwright

from semviz.workspace.demo import ensure_demo
from semviz.workspace.workspace import Workspace

SEMVIZ = Path(sys.executable).parent / "semviz"
CHROMIUM = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
]
STEPS = 50
PAUSE_MS = 300
"""Between two steps: as somebody who looks at each frame."""
STARTS = 5
SETTLED_MS = 12_000
WATCH = """
const seen = new WeakSet();
const draw = CanvasRenderingContext2D.prototype.drawImage;
let fresh = 0, pressed = 0, saved = '';
window.shown = [], window.acknowledged = [];
CanvasRenderingContext2D.prototype.drawImage = function (picture, ...rest) {
  if (picture instanceof ImageBitmap && !seen.has(picture)) {
    seen.add(picture);
    fresh += 1;
    const [number, start] = [fresh, pressed];
    requestAnimationFrame(() => window.shown.push([number, performance.now() - start]));
  }
  return draw.call(this, picture, ...rest);
};
addEventListener('keydown', (event) => { fresh = 0; pressed = event.timeStamp; }, true);
window.pressedAt = () => performance.timeOrigin + pressed;
addEventListener('pointerup', (event) => { pressed = event.timeStamp; }, true);
addEventListener('DOMContentLoaded', () => {
  const line = document.getElementById('saved');
  if (!line) return;
  saved = line.textContent;
  new MutationObserver(() => {
    const isNew = line.textContent.startsWith('Saved operation') && line.textContent !== saved;
    if (isNew) window.acknowledged.push(performance.now() - pressed);
    if (isNew) saved = line.textContent;
  }).observe(line, { childList: true, characterData: true, subtree: true });
});
"""
WATCH_3D = """
const changes = window.changes = []; // of the 3D pane's pixels: when, and how many
let drawn = null, before = null;
const webgl = WebGL2RenderingContext.prototype;
for (const name of ['drawArrays', 'drawElements', 'drawElementsInstanced']) {
  const draw = webgl[name];
  webgl[name] = function (...all) { drawn = this; return draw.apply(this, all); };
}
const refresh = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (callback) => refresh((time) => {
  drawn = null;
  callback(time);
  if (!drawn || !window.watched) return;
  const [width, height] = [drawn.drawingBufferWidth, drawn.drawingBufferHeight];
  const pixels = new Uint8Array(4 * width * height);
  drawn.readPixels(0, 0, width, height, drawn.RGBA, drawn.UNSIGNED_BYTE, pixels);
  const now = performance.timeOrigin + performance.now();
  let changed = 0;
  if (before?.length === pixels.length) { // another size is viser's answer to a slow screen
    for (let i = 0; i < pixels.length; i += 4) changed += Math.abs(pixels[i] - before[i]) > 12;
  }
  before = pixels;
  if (changed > 10) changes.push([now, changed]);
});
"""
LOOKED_MS = 700
"""So long after a step the 3D pane is watched: its last change is what counts."""


@contextmanager
def serving(*command: str) -> Iterator[tuple[str, float]]:
    """A tool in a process of its own: its address, and the seconds until it was printed."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [str(SEMVIZ), *command, "--no-open", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    waited_s = time.perf_counter() - start
    try:
        yield line.split(": ", 1)[1].strip(), waited_s
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=30)


@contextmanager
def opened(browser: Browser, with_3d: bool) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1600, "height": 950})
    page = context.new_page()
    page.add_init_script(WATCH)
    page.add_init_script(f"if (window !== top) {{ {WATCH_3D} }}")
    page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
    if not with_3d:
        page.route("**/view/**", lambda route: route.abort())
    yield page
    context.close()


def until(page: Page, said: str) -> None:
    """Playwright's own waiting needs eval, which the pages forbid."""
    for _ in range(500):
        if page.evaluate(said):
            return
        page.wait_for_timeout(20)
    raise RuntimeError(f"never came: {said}")


def steps(page: Page, pictures: int) -> list[float]:
    """Milliseconds from the key to the new frame on the screen, ``pictures`` of them."""
    times: list[float] = []
    page.wait_for_timeout(SETTLED_MS)
    for _ in range(STEPS):
        page.evaluate("window.shown = []")
        page.keyboard.press(".")
        until(page, f"window.shown.some(([number]) => number === {pictures})")
        times.append(page.evaluate("Math.max(...window.shown.map(([, ms]) => ms))"))
        page.wait_for_timeout(PAUSE_MS)
    return times


def scene(page: Page) -> Frame:
    """The 3D pane's own document."""
    return next(frame for frame in page.frames if "/view/" in frame.url)


def watch(page: Page, watched: bool) -> None:
    """Whether the 3D pane's pixels are read back; a picture a second is drawn in any case."""
    scene(page).evaluate(f"window.watched = {str(watched).lower()}")


def turns(page: Page, key: str, times: int) -> tuple[list[float], list[float]]:
    """Milliseconds from ``key`` to the first and to the last change in the 3D pane."""
    first, last = [], []
    watch(page, True)
    page.wait_for_timeout(SETTLED_MS)
    for _ in range(times):
        scene(page).evaluate("window.changes.length = 0")
        page.keyboard.press(key)
        page.wait_for_timeout(LOOKED_MS)
        changes = scene(page).evaluate("window.changes")
        if changes:  # a frame without an answer may look like the one before
            pressed = page.evaluate("window.pressedAt()")
            first.append(changes[0][0] - pressed)
            last.append(changes[-1][0] - pressed)
    watch(page, False)
    return first, last


def edits(page: Page) -> list[float]:
    """Milliseconds from the click that ends a round sign to "Saved operation N"."""
    box = page.locator("#left-image").bounding_box()
    assert box is not None
    for row in range(STEPS):
        page.keyboard.press("4")
        x, y = 0.1 + 0.08 * (row % 10), 0.2 + 0.15 * (row // 10)
        page.keyboard.down("Shift")  # draws, even where something is
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.keyboard.up("Shift")
        until(page, f"window.acknowledged.length > {row}")
        page.wait_for_timeout(PAUSE_MS)
    times: list[float] = page.evaluate("window.acknowledged")
    return times


def start_seconds() -> float:
    times = []
    for _ in range(STARTS):
        with serving("serve") as (_, seconds):
            times.append(seconds)
    return statistics.median(times)


def report(what: str, times_ms: list[float]) -> None:
    median, late = np.percentile(times_ms, (50, 95))
    print(f"{what:<44} {median:6.0f} ms {late:6.0f} ms p95", flush=True)


def inspect(browser: Browser) -> None:
    with serving("serve") as (url, _):
        for with_3d in (False, True):
            pane = "with" if with_3d else "without"
            with opened(browser, with_3d) as page:
                page.goto(f"{url}&frame=0", wait_until="commit")  # else the worst one
                page.wait_for_selector("#frame-list li")
                loaded_ms = page.evaluate("performance.now()")
                print(f"serve: page to list, {pane + ' 3D':<23} {loaded_ms:6.0f} ms", flush=True)
                report(f"serve: frame step, {pane} 3D", steps(page, pictures=1))
                if with_3d:
                    first, last = turns(page, ".", STEPS)
                    report("serve: frame step, key to new 3D", first)
                    report("serve: the same, to the photo in it", last)


def annotate(browser: Browser) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "street"
        Workspace.create_street(path, 7, range(STEPS + 2))
        with serving("annotate", str(path)) as (url, _):
            label(browser, url, "annotate")


class Processors:
    """Processor time of the server and of a page's main thread since they were read last."""

    def __init__(self, page: Page) -> None:
        self.page = page.context.new_cdp_session(page)
        self.page.send("Performance.enable", {"timeDomain": "threadTicks"})
        children = psutil.Process().children(recursive=True)
        self.server = next(child for child in children if "annotate" in child.cmdline())
        self.before = self.read()

    def read(self) -> np.ndarray:
        """Seconds of the server, of the main thread."""
        metrics = self.page.send("Performance.getMetrics")["metrics"]
        (main,) = (metric["value"] for metric in metrics if metric["name"] == "TaskDuration")
        times = self.server.cpu_times()
        return np.array([times.user + times.system, main])

    def report(self, times: int) -> None:
        now = self.read()
        server, main = 1000.0 * (now - self.before) / times
        self.before = now
        print(f"    processor time of each: server {server:.0f} ms, main thread {main:.0f} ms")


def label(browser: Browser, url: str, what: str) -> None:
    """Steps and edits as somebody at the screen has them: key to pixel, click to "Saved"."""
    for with_3d in (False, True):
        pane = "with" if with_3d else "without"
        with opened(browser, with_3d) as page:
            start = time.perf_counter()
            page.goto(url)
            page.wait_for_selector("#saved.saved")
            seconds = time.perf_counter() - start
            print(f"{what + ': page to what is saved, ' + pane + ' 3D':<44} {seconds:6.2f} s")
            processors = Processors(page)
            report(f"{what}: frame step, {pane} 3D", steps(page, pictures=2))
            processors.report(STEPS)
            report(f"{what}: click to saved, {pane} 3D", edits(page))
            processors.report(STEPS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=["serve", "annotate"])
    only = parser.parse_args().only
    print(f"load before: {os.getloadavg()[0]:.1f}; {os.cpu_count()} processors")
    if only != "annotate":
        ensure_demo()
        start = f"serve: process to address, median of {STARTS}"
        print(f"{start:<44} {start_seconds():6.2f} s")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
        if only != "annotate":
            inspect(browser)
        if only != "serve":
            annotate(browser)
        browser.close()


if __name__ == "__main__":
    main()
