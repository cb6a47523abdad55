"""Open, show and step through runs of many thousand frames, in the inspector and in rerun.

    python bench/long_runs.py make RUN.rrd FRAMES [ELEMENTS]
    python bench/long_runs.py measure RUN.rrd...
    python bench/long_runs.py rerun RUN.rrd...

``make`` records the demo's 120 frames again and again, with their images, each time in another copy
of its street, beside the earlier ones; the map has copies of the street until it has ELEMENTS
(default: two a frame). Poses, prior, submap and diagnosis move along; the poses that the search
tried do not. What only rerun draws is left out, which takes most of the time; for ``rerun``, make a
run with DRAWN=1 in the environment.
``measure`` needs an idle machine, Chromium and the test extra. Memory is that of the process of
``semviz serve``: its own pages, without those of files. A picture counts one screen refresh after
it was drawn. ``rerun`` measures its command that reads the same file (``rerun rrd stats``).
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import tests_support  # noqa: F401
from inspector_scale import merged
from pages import CHROMIUM, WATCH, report, serving, until
from pages import steps as image_steps
from playwright.sync_api import Browser, Page, sync_playwright
from serving import at

from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.reader import load_run
from semviz.runs.rerun_scene import RerunScene
from semviz.runs.run import KNOWN_DIAGNOSES, FrameRecord, Run
from semviz.runs.stored_run import open_run
from semviz.runs.writer import RunWriter
from semviz.workspace.demo import RUN, ensure_demo
from semviz.workspace.workspace import Workspace
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis.fault import Fault, FrameDiagnosis

APART_M = 300.0
ACROSS = 30
"""Copies of the street in a row."""
SIGNS_OF_LIFE = """
window.longest = 0;
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.longest = Math.max(window.longest, entry.duration);
}).observe({ entryTypes: ['longtask'] });
"""


def make(path: Path, frames: int, elements: int) -> None:
    """Write a run of so many frames in a map of so many elements."""
    demo = load_run(Workspace.open(ensure_demo()).run_path(RUN))
    info = replace(demo.info, name=path.stem, version=version("semviz"))
    start = time.perf_counter()
    with _drawing(), RunWriter(path, info, _city(demo, elements)) as writer:
        for number, record in enumerate(_drive(demo, frames)):
            writer.write(record)
            if number % 1000 == 0:
                print(f"{number} frames, {time.perf_counter() - start:.0f} s", flush=True)


@contextmanager
def _drawing() -> Iterator[None]:
    """Draw nothing, unless asked for."""
    if os.environ.get("DRAWN"):
        yield
        return
    dropped = mock.patch.object(RunWriter, "_send_drawn", RunWriter._flush)
    with mock.patch.object(RerunScene, "draw"), dropped:
        yield


def _away(copy: int) -> Pose:
    row, column = divmod(copy, ACROSS)
    return Pose(np.eye(3), APART_M * np.array([column, row, 0.0]))


def _city(demo: Run, elements: int) -> SemanticMap:
    street = demo.semantic_map
    step = int(street.elements.id.max()) + 1
    copies = [
        replace(street.elements.transformed(_away(copy)), id=street.elements.id + copy * step)
        for copy in range(-(-elements // len(street)))
    ]
    road = [_away(copy).apply(street.trajectory_m) for copy in range(len(copies))]
    return SemanticMap(
        merged(copies)[:elements], street.frame, street.classes, np.concatenate(road)
    )


def _drive(demo: Run, frames: int) -> Iterator[FrameRecord]:
    step = int(demo.semantic_map.elements.id.max()) + 1
    for number in range(frames):
        copy, position = divmod(number, len(demo.frames))
        record, away = demo.frames[position], _away(copy)
        truth = record.frame.T_map_camera
        ids = record.element_id
        moved = replace(
            record,
            frame=replace(
                record.frame,
                index=number,
                time_s=number / 10,
                T_map_camera=None if truth is None else away @ truth,
            ),
            localization=_moved(record.localization, away, copy * step),
            element_id=np.where(ids >= 0, ids + copy * step, ids),
        )
        if not os.environ.get("DRAWN"):
            KNOWN_DIAGNOSES[moved] = _renumbered(frame_diagnosis(demo, record), copy * step)
        yield moved


def _renumbered(diagnosis: FrameDiagnosis, step: int) -> FrameDiagnosis:
    def moved(fault: Fault) -> Fault:
        return replace(fault, elements=tuple(element + step for element in fault.elements))

    return replace(
        diagnosis,
        fault=moved(diagnosis.fault),
        secondary_faults=tuple(moved(fault) for fault in diagnosis.secondary_faults),
    )


def _moved(result: Localization, away: Pose, step: int) -> Localization:
    back, pose, prior = away.inverse(), result.T_camera_map, result.prior
    if prior is not None:
        road_m = None if prior.road_m is None else away.apply(prior.road_m)
        prior = replace(prior, position_m=away.apply(prior.position_m), road_m=road_m)
    submap = result.submap.transformed(away)
    return replace(
        result,
        submap=replace(submap, id=submap.id + step),
        prior=prior,
        T_camera_map=None if pose is None else pose @ back,
        alternatives=tuple(
            replace(other, T_camera_map=other.T_camera_map @ back) for other in result.alternatives
        ),
    )


def measure(path: Path, browser: Browser) -> None:
    """Measure opening, memory, first picture and steps of one run in the inspector."""
    start = time.perf_counter()
    run = open_run(path)
    opened_s = time.perf_counter() - start
    size_gb, load = path.stat().st_size / 1e9, os.getloadavg()[0]
    frames, elements = len(run.frames), len(run.semantic_map)
    del run
    print(f"{path.name}: {frames} frames, {elements} elements, {size_gb:.2f} GB; load {load:.1f}")
    print(f"  opened in {opened_s:.2f} s")
    with serving("serve", str(path)) as (url, start_s):
        server = _server(str(path))
        idle_mb = _own_mb(server)
        page = browser.new_context(viewport={"width": 1280, "height": 720}).new_page()
        for script in (WATCH, SIGNS_OF_LIFE, "localStorage.setItem('semviz.tour', 'seen')"):
            page.add_init_script(script)
        story_s = _seconds(page, at(url, ""), "document.querySelector('#story-causes .cause')")
        story_mb, hung_ms = _own_mb(server), page.evaluate("window.longest")
        image_s = _seconds(page, at(url, "?show=frame"), "window.shown.length > 0")
        print(
            f"  serve ready in {start_s:.1f} s; first page {story_s:.2f} s, frame {image_s:.2f} s"
        )
        print(f"  memory: {idle_mb:.0f} MB before, {story_mb:.0f} MB with the first page shown,")
        report("  key to new image", image_steps(page, pictures=1))
        hung_ms = max(hung_ms, page.evaluate("window.longest"))
        print(f"  {_own_mb(server):.0f} MB in the end; the page hung for at most {hung_ms:.0f} ms")
        print(f"  elements in the document: {page.evaluate('document.all.length')}")
        page.context.close()


def _seconds(page: Page, url: str, shown: str) -> float:
    start = time.perf_counter()
    page.goto(url)
    until(page, f"Boolean({shown})")
    return time.perf_counter() - start


def _server(argument: str) -> psutil.Process:
    children = psutil.Process().children(recursive=True)
    return next(child for child in children if argument in child.cmdline())


def _own_mb(process: psutil.Process) -> float:
    memory = process.memory_info()
    return float(memory.rss - memory.shared) / 1e6


def measure_rerun(path: Path) -> None:
    """Measure rerun's command that reads a whole file and counts what is in it."""
    start = time.perf_counter()
    command = [Path(sys.executable).parent / "rerun", "rrd", "stats", path]
    subprocess.run(command, capture_output=True, check=True)
    print(f"{path.name}: rerun rrd stats {time.perf_counter() - start:.1f} s")


def main() -> None:
    command, *arguments = sys.argv[1:]
    if command == "make":
        frames = int(arguments[1])
        make(Path(arguments[0]), frames, int(arguments[2]) if arguments[2:] else 2 * frames)
    elif command == "rerun":
        for path in arguments:
            measure_rerun(Path(path))
    else:
        names = ("chromium", "chromium-browser", "google-chrome")
        chromium = next(filter(None, map(shutil.which, names)), None)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM)
            for path in arguments:
                measure(Path(path).resolve(), browser)
            browser.close()


if __name__ == "__main__":
    main()
