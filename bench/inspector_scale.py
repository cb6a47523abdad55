"""The inspector with a map of a city, in Chromium: time to load, to step, and to select.

    python bench/inspector_scale.py [ELEMENTS]

The map has copies of the demo's street side by side, until it has ELEMENTS (100,000). Needs an idle
machine, Chromium and the test extra. A 3D view counts as shown when its pixels were read back, an
image and a card one screen refresh after they were drawn.
"""

import os
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from pages import CHROMIUM, LOOKED_MS, opened, report, scene, serving, turns, until, watch
from pages import steps as image_steps
from playwright.sync_api import Page, sync_playwright
from serving import at

from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.runs.writer import RunWriter
from semviz.web import viewpoint
from semviz.workspace.demo import RUN, ensure_demo
from semviz.workspace.workspace import Workspace
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap

APART_M = 260.0
STEPS = 50
TURNS = 10
SETTLED_MS = 6_000

ARRIVED = """
(() => {
  const about = document.getElementById('space-about');
  new MutationObserver(() => { window.arrived ??= performance.timeOrigin + performance.now(); })
    .observe(about, { childList: true, characterData: true, subtree: true });
  window.arrived = null;
})()
"""
CLICKED = "addEventListener('pointerup', (event) => { window.clicked = event.timeStamp; }, true)"
ANSWERED = """
new MutationObserver(() => requestAnimationFrame(() => {
  window.answered ??= performance.timeOrigin + performance.now();
})).observe(document.getElementById('selected-rest'), { childList: true })
"""


def make_city(run: Run, elements: int, path: Path) -> None:
    """``run`` as a file whose map goes on with copies of its street, ``elements`` in all."""
    street = run.semantic_map.elements
    across = int(np.ceil(np.sqrt(elements / len(street))))
    copies, step = [street], int(street.id.max()) + 1
    for number in range(1, int(np.ceil(elements / len(street)))):
        row, column = divmod(number, across)
        away = APART_M * np.array([column, row, 0.0])
        moved = street.transformed(Pose(np.eye(3), away))
        copies.append(replace(moved, id=street.id + number * step))
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


def load(page: Page, url: str) -> None:
    """Opens the demo, then the city: the 3D pane is there already, the map comes."""
    page.goto(at(url, "?card=selected"))
    page.wait_for_selector("#frame-list li")
    page.wait_for_selector("#scene.ready", timeout=60_000)
    watch(page, True)
    page.wait_for_timeout(SETTLED_MS)
    page.evaluate(ARRIVED)
    chosen = page.evaluate("performance.timeOrigin + performance.now()")
    page.select_option("#run", "city")
    page.wait_for_timeout(SETTLED_MS)
    arrived = page.evaluate("window.arrived")
    shown, _ = scene(page).evaluate("window.changes.at(-1)")
    watch(page, False)
    print(f"{'city: run chosen to run in the page':<48} {arrived - chosen:6.0f} ms")
    print(f"{'city: run in the page to the last change in 3D':<48} {shown - arrived:6.0f} ms")


def steps(page: Page, what: str, key: str, times: int) -> None:
    """From ``key`` to the new picture in the 3D pane, and to its last change."""
    first, last = turns(page, key, times)
    report(f"city: {what}, key to new 3D", first)
    report("  to its last change", last)


def clicks(page: Page, record: FrameRecord) -> list[float]:
    """Milliseconds from a click on an element in 3D to one refresh after the card tells of it."""
    page.keyboard.press("u")
    page.wait_for_timeout(SETTLED_MS)
    answers: list[float] = []
    page.evaluate(ANSWERED)
    scene(page).evaluate(CLICKED)
    box = page.locator("#scene").bounding_box()
    assert box is not None
    for x, y in above(record, box["width"], box["height"])[:TURNS]:
        page.evaluate("window.answered = null")
        page.mouse.click(box["x"] + x, box["y"] + y)
        until(page, "window.answered !== null")
        clicked = scene(page).evaluate("performance.timeOrigin + window.clicked")
        answers.append(page.evaluate("window.answered") - clicked)
        page.wait_for_timeout(LOOKED_MS)
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
    report("city: frame step, key to new image", image_steps(page, pictures=1))
    steps(page, "frame step", ".", STEPS)
    steps(page, "other colours of the map", "v", TURNS)
    report("city: click on an element to its card", clicks(page, run.frames[2 * STEPS]))


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
            with opened(browser, with_3d=True) as page:
                measure(page, url, run)
            browser.close()


if __name__ == "__main__":
    main()
