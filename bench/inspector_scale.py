"""The inspector with a map of a city, in Chromium: until all is on screen, frame steps, clicks.

    python bench/inspector_scale.py [ELEMENTS]

Takes the demo's frames and puts copies of its street beside each other until the map has ELEMENTS
(100,000). Wants an idle machine, Chromium and the test extra. A picture counts as shown when its
pixels can be read back. Without a graphics card all is drawn by the processor, and says so.
"""

import os
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pages import CHROMIUM, PAUSE_MS, report, serving, until
from playwright.sync_api import Page, sync_playwright

from semviz.demo import ensure_demo
from semviz.demo_street import RUN
from semviz.recording.reader import load_run
from semviz.recording.run import FrameRecord, Run
from semviz.recording.writer import RunWriter
from semviz.web import viewpoint
from semviz.workspace import Workspace
from semviz_core.elements import Elements3D, joined
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap

APART_M = 260.0
STEPS = 50
TURNS = 10
SETTLED_MS = 6_000

WATCH = """
const now = () => performance.timeOrigin + performance.now();
let pressed = 0, fresh = 0, small = null, before = null, seen = null;
const drawImage = CanvasRenderingContext2D.prototype.drawImage;
const bitmaps = new WeakSet();
window.imageMs = [];
CanvasRenderingContext2D.prototype.drawImage = function (picture, ...rest) {
  if (picture instanceof ImageBitmap && !bitmaps.has(picture)) {
    bitmaps.add(picture);
    requestAnimationFrame(() => window.imageMs.push(now() - pressed));
  }
  return drawImage.call(this, picture, ...rest);
};
const press = (event) => { pressed = performance.timeOrigin + event.timeStamp; };
addEventListener('keydown', press, true);
function pixels() { // of the 3D canvas, small
  const canvas = document.querySelector('canvas[data-engine]');
  small ??= Object.assign(document.createElement('canvas'), { width: 180, height: 80 });
  const context = small.getContext('2d', { willReadFrequently: true });
  drawImage.call(context, canvas, 0, 0, 180, 80);
  return context.getImageData(0, 0, 180, 80).data;
}
window.pressed = () => pressed;
window.watch = () => { before = pixels(); seen = null; look(); };
window.seen = () => seen;
function look() {
  const after = pixels();
  let changed = 0;
  for (let i = 0; i < after.length; i += 4) changed += Math.abs(after[i] - before[i]) > 12;
  if (changed > 10) seen = now(); else requestAnimationFrame(look);
}
const drawArrays = WebGL2RenderingContext.prototype.drawArrays;
window.dots = null;
WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
  drawArrays.call(this, mode, first, count);
  if (mode !== this.POINTS || count < 50000 || window.dots) return;
  window.dots = true;
  requestAnimationFrame(() => { // it is drawn with this frame; reading waits for that
    this.readPixels(0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, new Uint8Array(4));
    window.dots = now();
  });
};
"""
ANSWERED = """
(() => {
  const place = history.replaceState.bind(history);
  history.replaceState = (...all) => { window.answered = performance.now(); place(...all); };
})()
"""
ARRIVED = """
(() => {
  const about = document.getElementById('space-about');
  new MutationObserver(() => { window.arrived ??= performance.timeOrigin + performance.now(); })
    .observe(about, { childList: true, characterData: true, subtree: true });
  window.arrived = null;
})()
"""


def make_city(run: Run, elements: int, path: Path) -> None:
    """``run`` as a file whose map goes on with copies of its street, ``elements`` in all."""
    one = run.semantic_map.elements
    across = int(np.ceil(np.sqrt(elements / len(one))))
    copies, step = [one], int(one.id.max()) + 1
    for number in range(1, int(np.ceil(elements / len(one)))):
        row, column = divmod(number, across)
        away = APART_M * np.array([column, row, 0.0])
        moved = one.transformed(Pose(np.eye(3), away))
        copies.append(replace(moved, id=one.id + number * step))
    city = SemanticMap(
        merged(copies)[:elements],
        run.semantic_map.frame,
        run.semantic_map.classes,
        run.semantic_map.trajectory_m,
    )
    with RunWriter(path, replace(run.info, name="city"), city) as writer:
        for record in run.frames:
            writer.write(record)


def merged(parts: list[Elements3D]) -> Elements3D:
    """All of them, in order; by halves, so that each is copied a few times only."""
    if len(parts) == 1:
        return parts[0]
    half = len(parts) // 2
    return joined(merged(parts[:half]), merged(parts[half:]))


def scene(page: Page) -> Any:
    """The 3D pane's own document."""
    return next(frame for frame in page.frames if "/view/" in frame.url)


def load(page: Page, url: str) -> None:
    """Opens the demo, then the city: the 3D pane is there already, the map comes."""
    page.goto(url)
    page.wait_for_selector("#frame-list li")
    page.wait_for_selector("#scene.ready", timeout=60_000)
    page.wait_for_timeout(SETTLED_MS)
    page.evaluate(ARRIVED)
    chosen = page.evaluate("performance.timeOrigin + performance.now()")
    page.select_option("#run", "city")
    until(page, "window.arrived !== null")
    for _ in range(500):
        if isinstance(scene(page).evaluate("window.dots"), float | int):
            break
        page.wait_for_timeout(20)
    arrived, shown = page.evaluate("window.arrived"), scene(page).evaluate("window.dots")
    print(f"{'city: run chosen to run in the page':<48} {arrived - chosen:6.0f} ms")
    print(f"{'city: run in the page to all elements on screen':<48} {shown - arrived:6.0f} ms")


def steps(page: Page, key: str, times: int, with_image: bool) -> tuple[list[float], list[float]]:
    """Milliseconds from ``key`` to the new image, and to changed pixels in the 3D pane."""
    images, spaces = [], []
    page.wait_for_timeout(SETTLED_MS)
    for _ in range(times):
        page.evaluate("window.imageMs = []")
        scene(page).evaluate("window.watch()")
        page.keyboard.press(key)
        if with_image:
            until(page, "window.imageMs.length > 0")
            images.append(page.evaluate("Math.max(...window.imageMs)"))
        spaces.append(changed(page) - page.evaluate("window.pressed()"))
        page.wait_for_timeout(PAUSE_MS)
    return images, spaces


def changed(page: Page) -> float:
    """When the 3D pane's pixels had changed."""
    for _ in range(500):
        shown = scene(page).evaluate("window.seen()")
        if shown is not None:
            return float(shown)
        page.wait_for_timeout(10)
    raise RuntimeError("the 3D pane stayed as it was")


def clicks(page: Page, run: Run) -> list[float]:
    """Milliseconds from a click on an element in 3D to the answer that it is selected."""
    page.keyboard.press("u")
    page.wait_for_timeout(SETTLED_MS)
    record = run.frames[STEPS]  # where the steps ended
    answers: list[float] = []
    page.evaluate(ANSWERED)
    box = page.locator("#scene").bounding_box()
    assert box is not None
    for x, y in above(record, box["width"], box["height"])[:TURNS]:
        page.evaluate("window.answered = null")
        start = time.perf_counter()
        page.mouse.click(box["x"] + x, box["y"] + y)
        until(page, "window.answered !== null")
        answers.append(1000 * (time.perf_counter() - start))
        page.wait_for_timeout(PAUSE_MS)
    return answers


def above(record: FrameRecord, width: float, height: float) -> list[tuple[float, float]]:
    """Where the elements of its submap are in the pane, seen from above a frame."""
    pose, elements = record.localization.T_camera_map, record.localization.submap
    assert pose is not None
    view = viewpoint.above(pose.inverse())
    forward = view.target_m - view.eye_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, viewpoint.UP)
    right /= np.linalg.norm(right)
    offset = elements.anchor_m - view.eye_m
    focal = height / 2 / np.tan(view.fov_rad(width / height) / 2)
    depth = offset @ forward
    x = width / 2 + focal * (offset @ right) / depth
    y = height / 2 + focal * (offset @ np.cross(forward, right)) / depth
    inside = (x > 40) & (x < width - 40) & (y > 40) & (y < height - 80)
    return list(zip(x[inside].tolist(), y[inside].tolist(), strict=True))


def measure(page: Page, url: str, run: Run) -> None:
    load(page, url)
    images, spaces = steps(page, ".", STEPS, with_image=True)
    report("city: frame step, key to new image", images)
    report("city: frame step, key to new 3D", spaces)
    report("city: other colours of the map, key to new 3D", steps(page, "v", TURNS, False)[1])
    report("city: click on an element to its selection", clicks(page, run))


def main() -> None:
    elements = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    demo = Workspace.open(ensure_demo()).run_path(RUN)
    run = load_run(demo)
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next(filter(None, map(shutil.which, names)), None)
    with tempfile.TemporaryDirectory() as folder:
        city = Path(folder) / "city.rrd"
        make_city(run, elements, city)
        size_mb, load = city.stat().st_size / 1e6, os.getloadavg()[0]
        print(f"{elements} elements, {size_mb:.0f} MB; load before: {load:.1f}", flush=True)
        with serving("serve", str(demo), str(city)) as (url, _), sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM)
            page = browser.new_page(viewport={"width": 1600, "height": 950})
            page.add_init_script(WATCH)
            measure(page, url, run)
            browser.close()


if __name__ == "__main__":
    main()
