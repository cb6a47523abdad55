"""The view "Tracks" on 1,000 frames and 500 elements: loading, scrolling both ways, an edit.

    python bench/tracks_view.py
    python bench/tracks_view.py --elements 200 --frames 400

The workspace is synthetic: a straight drive past elements that 36 frames show in both images. The
peer is an HTML table of the same cells, drawn by the same browser in the same run. A frame of the
screen takes 16.7 ms at 60 Hz; without a graphics card the browser draws on the processor. One run.
"""

import os
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tests_support  # noqa: F401
import tyro
from annotator_scale import SEQUENCE, write_images
from pages import CHROMIUM, report, serving
from playwright.sync_api import Page, sync_playwright

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddElements, NewElement
from semviz_annotation.labels.labels import Observation, new_id
from semviz_core.base.pose import Pose

VIEWS = 36
"""Frames that show an element, from 40 m on, 1 m apart."""
FOCAL_PX, CENTER_PX, BASELINE_M = 720.0, (610.0, 180.0), 0.54

SCROLL = """
async (steps) => {
  const { matrix } = semviz.tracks;
  const draws = [], intervals = [];
  const draw = matrix.surface._draw;
  matrix.surface._draw = (...all) => {
    const start = performance.now();
    draw(...all);
    draws.push(performance.now() - start);
  };
  let long = 0;
  const observer = new PerformanceObserver((list) => { long += list.getEntries().length; });
  observer.observe({ entryTypes: ['longtask'] });
  let last = await new Promise(requestAnimationFrame);
  for (let step = 0; step < steps; step += 1) {
    matrix.look(step * 3, matrix.columns, step * 1.5);
    const now = await new Promise(requestAnimationFrame);
    intervals.push(now - last);
    last = now;
  }
  matrix.surface._draw = draw;
  observer.disconnect();
  return [draws, intervals, long];
}
"""
TABLE = """
async (steps) => {
  const { table, shown, places } = semviz.tracks;
  const box = document.createElement('div');
  box.id = 'peer';
  const lines = shown.map((row) => {
    const cell = (place) => `<td class="c${Math.max(-1, ...table.cells(row, place))}"></td>`;
    const cells = Array.from({ length: places }, (_, place) => cell(place));
    return `<tr><th>${row.name}</th>${cells.join('')}</tr>`;
  });
  const sheet = new CSSStyleSheet();
  sheet.replaceSync('#peer { position: fixed; inset: 0; overflow: auto; background: #000 }'
    + '#peer td { min-width: 8px; height: 20px; background: #357 }');
  document.adoptedStyleSheets.push(sheet);
  const start = performance.now();
  box.innerHTML = `<table>${lines.join('')}</table>`;
  document.body.append(box);
  await new Promise(requestAnimationFrame);
  const made = performance.now() - start;
  const intervals = [];
  let last = await new Promise(requestAnimationFrame);
  for (let step = 0; step < steps; step += 1) {
    box.scrollTo(step * 24, step * 30);
    const now = await new Promise(requestAnimationFrame);
    intervals.push(now - last);
    last = now;
  }
  box.remove();
  return [made, intervals];
}
"""


@dataclass(frozen=True)
class Options:
    elements: int = 500
    frames: int = 1000
    steps: int = 300
    seed: int = 0


def make_workspace(folder: Path, options: Options) -> Workspace:
    root = folder / "kitti"
    write_images(root / "sequences" / SEQUENCE, options.frames)
    (root / "poses").mkdir()
    poses = (Pose(np.eye(3), np.array([0.0, 0.0, float(n)])) for n in range(options.frames))
    lines = [" ".join(f"{v:.9e}" for v in pose.as_matrix()[:3].ravel()) for pose in poses]
    (root / "poses" / f"{SEQUENCE}.txt").write_text("\n".join(lines) + "\n")
    made = Workspace.create_kitti(folder / "big", root, SEQUENCE)
    with made.open_labels() as store:
        store.apply(AddElements(_elements(options)), "bench")
        print(f"{len(store.labels.observations):,} labels of {options.elements:,} elements")
    return made


def _elements(options: Options) -> tuple[NewElement, ...]:
    rng = np.random.default_rng(options.seed)
    elements = []
    for first in np.sort(rng.integers(0, options.frames - VIEWS, options.elements)).tolist():
        side_m, is_pole = rng.uniform(4.0, 8.0) * rng.choice([-1, 1]), rng.random() < 0.7
        rows = []
        for step in range(VIEWS):
            for side, camera_m in (("left", 0.0), ("right", BASELINE_M)):
                ends = np.array([[side_m - camera_m, -2.0], [side_m - camera_m, 1.0]])
                pixels = FOCAL_PX * ends / (40.0 - step) + CENTER_PX + rng.normal(0.0, 0.5, (2, 2))
                (u, v), bottom = np.clip(pixels, 0.0, (1240.0, 375.0)).tolist()
                end = (bottom[0], bottom[1]) if is_pole else None
                rows.append(
                    Observation(
                        new_id(), "", first + step, side, (u, v), end, True, end is not None
                    )
                )
        elements.append(NewElement(new_id(), 0 if is_pole else 3, tuple(rows)))
    return tuple(elements)


def measure(page: Page, url: str, options: Options) -> None:
    page.route("**/view/**", lambda route: route.fulfill(body="<!doctype html>"))
    page.goto(url)
    page.wait_for_selector("#saved.saved", timeout=120_000)
    start = time.perf_counter()
    page.keyboard.press("F3")
    page.wait_for_function("() => semviz.tracks.table.rows.size > 0", timeout=120_000)
    print(f"{'F3 to the first rows':<44} {time.perf_counter() - start:6.2f} s")
    page.wait_for_function(
        f"() => semviz.tracks.table.rows.size >= {options.elements}"
        " && !semviz.tracks.table.waiting",
        timeout=120_000,
    )
    print(f"{'F3 to all rows':<44} {time.perf_counter() - start:6.2f} s", flush=True)
    page.wait_for_function(
        f"() => semviz.tracks.table.numbersAt.size >= {options.frames}", timeout=600_000
    )
    print(f"{'F3 to all that is proposed':<44} {time.perf_counter() - start:6.2f} s", flush=True)
    for columns, what in ((88, "88 frames on screen"), (options.frames, "the whole drive")):
        page.evaluate(f"() => semviz.tracks.matrix.look(0, {columns}, 0)")
        draws, intervals, long = page.evaluate(SCROLL, options.steps)
        report(f"draw, {what}", draws)
        report(f"between two frames, {what}", intervals)
        print(f"{f'tasks over 50 ms in {options.steps} frames, {what}':<44} {long:6}")
    _edits(page)
    made, intervals = page.evaluate(TABLE, options.steps)
    print(f"{'peer: HTML table, made in':<44} {made / 1000:6.2f} s")
    report("peer: between two frames", intervals)


def _edits(page: Page) -> None:
    """Deletions over a range of 10 frames, each to the row that shows it, and its undo."""
    times = []
    for place in range(5, 105, 5):
        found: Any = page.evaluate(
            """(at) => { const row = semviz.tracks.shown[at];
                semviz.tracks.choose(row, row.first + 8); return row.id; }""",
            place,
        )
        page.wait_for_function("(id) => semviz.tracks.details?.id === id", arg=found)
        page.evaluate("() => semviz.tracks.widen(semviz.tracks.place + 9)")
        page.keyboard.press("Delete")
        start = time.perf_counter()
        page.keyboard.press("Control+Enter")
        gone = "(id) => semviz.tracks.table.rows.get(id).left[8] === -1"
        page.wait_for_function(gone, arg=found)
        times.append(1000.0 * (time.perf_counter() - start))
    report("delete 20 labels, to the row on screen", times)


def main(options: Options) -> None:
    print(f"load before: {os.getloadavg()[0]:.1f}; {os.cpu_count()} processors")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with tempfile.TemporaryDirectory() as folder:
        made = make_workspace(Path(folder), options)
        with serving("annotate", str(made.path)) as (url, _), sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
            measure(browser.new_page(viewport={"width": 1600, "height": 950}), url, options)
            browser.close()


if __name__ == "__main__":
    main(tyro.cli(Options))
